"""The pages over tables: what they link to is there, names of others stay text, columns sort, and a phone shows them."""

import io
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from browser import Heard, launched, watched
from PIL import Image
from tables_fakes import BENCHMARK, TABLE, balanced, fake_runs, filled_of, value

from vlgs.tables.benchmark import Benchmark
from vlgs.tables.gallery import FILE, FOLDER, GalleryView, Shown, read_gallery, write_gallery
from vlgs.tables.grid import arrange, means_first
from vlgs.tables.latex import to_latex
from vlgs.tables.markdown import to_markdown
from vlgs.tables.registry import Table, load_table
from vlgs.tables.write import write_all

HOSTILE = "<script>document.title='got'</script>"
OTHER = "a #1 & 'co' 100%"
"""Name of a benchmark."""


def shown(label: str, number: int, language: bool = True) -> Shown:
    return Shown(
        label=label,
        run=f"run{number}",
        render=f"tiny/{number}.jpg",
        psnr=20.0 + number,
        relevancy=f"tiny/{number}-relevancy.jpg" if language else None,
        iou=0.5 if language else None,
    )


VIEW = GalleryView(
    scene="glassware",
    view="view_1",
    place="lowest",
    tab="tiny",
    seed=0,
    results_version=6,
    protocol="dense@1/synthetic",
    width=64,
    height=48,
    photograph="tiny/photograph.jpg",
    word=HOSTILE,
    outlined="tiny/outlined.jpg",
    rows=(shown("Full", 0), shown(HOSTILE, 1), shown("3DGS", 2, language=False)),
)


def draw(folder: Path, view: GalleryView = VIEW) -> None:
    """A gallery whose pictures are grey."""
    stream = io.BytesIO()
    Image.new("RGB", (view.width, view.height), "grey").save(stream, "JPEG")
    for name in view.files:
        path = folder / FOLDER / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(stream.getvalue())
    write_gallery(folder, [view])


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Table:
    path = tmp_path_factory.mktemp("tables") / "tiny.yaml"
    path.write_text(TABLE)
    return load_table(path)


@pytest.fixture(scope="module")
def results(tiny: Table, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two benchmarks with pages, one with a gallery and an odd name."""
    folder = tmp_path_factory.mktemp("results")
    other = replace(BENCHMARK, name=OTHER)
    for benchmark in (BENCHMARK, other):
        benchmark.extend(folder / benchmark.name / "benchmark.yaml")
    fake_runs(folder, [tiny], BENCHMARK, value)
    draw(folder / OTHER)
    (folder / "bench").mkdir()
    shutil.copy(folder / OTHER / FOLDER / "tiny/0.jpg", folder / "bench" / "growth.png")
    (folder / "README.md").write_text("")
    write_all(folder, [tiny], html=True)
    return folder


class Read(HTMLParser):
    """Addresses, ids, tags and text of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        found = dict(attrs)
        self.addresses += [a for key in ("href", "src") if (a := found.get(key)) is not None]
        self.ids += [i for key in ("id",) if (i := found.get(key)) is not None]
        if tag == "img":
            assert found.get("alt")
            assert found.get("loading") == "lazy"

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize("name", ["index.html", f"{OTHER}/index.html"])
def test_all_that_a_page_links_to_is_there_and_relative(results: Path, name: str):
    path = results / name
    page = Read(path)
    assert len(page.addresses) > 20
    assert len(page.ids) == len(set(page.ids))
    for address in page.addresses:
        assert not re.match(r"\w+:|/", address), address
        file, _, anchor = address.partition("#")
        assert not file or (path.parent / unquote(file)).is_file(), address
        assert not anchor or anchor in page.ids, address
    assert not re.search(r"https?://|url\(|@import", path.read_text())


def test_names_of_others_stay_text(results: Path):
    for path in (results / "index.html", results / OTHER / "index.html"):
        page = Read(path)
        assert page.tags.count("script") == page.tags.count("style") == 1
        assert page.text.count(HOSTILE) >= 3  # its row, its word
        assert OTHER in page.text


def test_the_page_over_all_says_which_code_and_data(results: Path):
    text = Read(results / "index.html").text
    for said in ("seeds 0, 1", "commit abcdef", "dense@1/synthetic", "Renders and answers", "21.00 dB", "IoU 50.0 %"):  # fmt: skip
        assert said in text, said
    assert "Time of a training step" in text  # results/bench


def test_one_benchmark_alone_leaves_the_page_over_all(results: Path, tiny: Table):
    before = (results / "index.html").read_bytes()
    write_all(results, [tiny], name="synthetic", html=True)
    assert (results / "index.html").read_bytes() == before


def test_one_document_has_all_tables_with_labels_of_their_own(results: Path):
    text = (results / "tables.tex").read_text()
    assert r"\input{synthetic/tiny}" in text
    assert r"\plain{synthetic:#1}" in text
    assert "% left out" in text  # LaTeX cannot be told the other's name
    own = (results / "synthetic" / "tiny.tex").read_text()
    assert "n: 2 seeds on each of 2 scenes (glassware, mirrors), 12 runs. Protocol dense@1/synthetic" in own  # fmt: skip
    assert "Run with data=synthetic." in own
    assert r"\multicolumn{2}{c}{glassware}" in own
    assert r"\cmidrule(lr){5-6}" in own  # after group, name and two marks
    assert own.count(r"mIoU (\%)") == 3


def test_a_wide_table_is_panels_that_keep_scenes_whole(tiny: Table, tmp_path: Path):
    many = Benchmark("many", ("data=synthetic",), tuple(f"s{i}" for i in range(8)), (0,))
    fake_runs(tmp_path, [tiny], many, lambda row, scene, seed: int(scene[1:]) / 10)
    text = to_latex(filled_of(tiny, tmp_path, many))
    balanced(text)
    heads = re.findall(r"\\multicolumn\{2\}\{c\}\{(\w+)\}", text)
    assert heads == ["avg", *many.scenes]  # each once
    assert text.count(r"\begin{tabular}") == 3  # of 18 numbers
    means, first, second = text.split(r"\end{tabular}")[:3]
    assert "avg" in means
    assert "s3" in first
    for number in range(8):
        panel = first if number < 4 else second
        assert rf"& {10 * number:.1f} &" in panel, number
    parts = to_markdown(filled_of(tiny, tmp_path, many)).split("\n\n")[2:5]
    assert [part.count(" mIoU (%)") for part in parts] == [1, 4, 4]
    assert all(part.count("\n") == 1 + len(tiny.rows) for part in parts)
    grid = means_first(arrange(filled_of(tiny, tmp_path, many)))
    assert [column for column, _ in grid.columns[::2]] == ["avg", *many.scenes]
    assert [entry.mean for entry in grid.lines[1].entries[:4:2]] == pytest.approx([35.0, 0.0])


def test_a_field_without_gaussians_is_not_the_smallest(tiny: Table, tmp_path: Path):
    table = replace(tiny, metrics=("n_gaussians_k",))
    fake_runs(tmp_path, [table], BENCHMARK, value)
    path = min(tmp_path.glob("runs/*/metrics.json"))
    path.write_text(path.read_text().replace('"n_gaussians": 20000', '"n_gaussians": 0'))
    filled = filled_of(table, tmp_path, BENCHMARK)
    counts = [number.value for number in filled.numbers]
    assert set(counts) == {20.0}


def damaged(**more: Any) -> str:
    entry = json.loads(json.dumps(VIEW, default=vars))
    return json.dumps({"form": "vlgs-gallery-1", "views": [{**entry, **more}]})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "Expecting value"),
        ("[]", "no object of form"),
        ('{"form": "vlgs-gallery-1"}', "no list of views"),
        ("[" * 100_000, "recursion|nest"),
        ("\udcff", "utf-8"),
        (damaged(extra=1), "just the keys"),
        (damaged(rows=[3]), "just the keys"),
        (damaged(rows=3), "rows must be a list"),
        (damaged(width="64"), "width must be a whole number"),
        (damaged(width=0), "width must be 1 to"),
        (damaged(place="middle"), "place must be"),
        (damaged(tab="../x"), "tab must be the label"),
        (damaged(photograph="../../secret.jpg"), "outside of the folder"),
        (damaged(photograph="/etc/passwd.jpg"), "outside of the folder"),
        (damaged(photograph="link.jpg"), "outside of the folder"),
        (damaged(photograph="tiny/none.jpg"), "not there"),
        (damaged(photograph="gallery.json"), "no name of a .jpg"),
        (damaged(photograph="a\0.jpg"), "no name of a .jpg"),
        (damaged(photograph="\ud800.jpg"), "no name of a .jpg"),
    ],
)
def test_a_gallery_is_not_believed(tmp_path: Path, content: str, said: str):
    draw(tmp_path)
    (tmp_path / "secret.jpg").write_bytes(b"")
    (tmp_path / FOLDER / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    assert read_gallery(tmp_path) == [VIEW]
    path = tmp_path / FOLDER / FILE
    path.write_text(content, errors="surrogateescape")
    with pytest.raises(ValueError, match=rf"^{path}: must be as vlgs\.gallery writes it, got: .*({said})"):  # fmt: skip
        read_gallery(tmp_path)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched(graphics=False) as browser:
        yield browser


def column(page: Any, number: int) -> list[list[str]]:
    """Texts of a column of the first table, by group."""
    return page.evaluate(
        """(number) => [...document.querySelector("table.sortable").tBodies].map((body) =>
            [...body.rows].filter((row) => row.cells.length > 1).map((row) => row.cells[number].innerText.trim()))""",
        number,
    )


def test_columns_sort_as_numbers_within_groups_with_what_is_missing_last(
    browser: Any, results: Path
):
    with watched(browser, 1280, 900) as (page, heard):
        page.goto((results / "index.html").as_uri())
        names = column(page, 0)
        assert names == [["Without_it", "Full"], ["Opacity", "Someone"]]
        head = page.locator("table.sortable").first.locator("thead th").nth(3)
        assert head.get_attribute("aria-sort") == "none"
        head.get_by_role("button").press("Enter")
        assert head.get_attribute("aria-sort") == "descending"
        assert column(page, 0) == [["Full", "Without_it"], ["Opacity", "Someone"]]
        head.get_by_role("button").click()
        assert head.get_attribute("aria-sort") == "ascending"
        assert column(page, 0) == [["Without_it", "Full"], ["Opacity", "Someone"]]
        assert column(page, 3)[1][1] == "--"
        head.get_by_role("button").click()
        assert (head.get_attribute("aria-sort"), column(page, 0)) == ("none", names)
        groups = page.locator("table.sortable").first.locator("tr.group")
        assert groups.all_inner_texts() == ["A: one & all", "B: other"]
        assert heard == Heard()


def test_numbers_are_compared_as_numbers(browser: Any, results: Path):
    sources = Path(__file__).parents[2] / "vlgs" / "tables" / "pages" / "sort.js"
    cells = ["9.5", "-10", "below 0.001", "--", "+100.2", "none", "3 of 4"]
    rows = "".join(f"<tr><td>{cell}</td></tr>" for cell in cells)
    page_text = (
        f"<table class=sortable><thead><tr><th>x</th></tr></thead><tbody>{rows}</tbody></table>"
    )
    (results / "numbers.html").write_text(f"{page_text}<script>{sources.read_text()}</script>")
    with watched(browser, 300, 300) as (page, heard):
        page.goto((results / "numbers.html").as_uri())
        page.get_by_role("button").click()
        texts = page.locator("td").all_inner_texts()
        assert texts == ["+100.2", "9.5", "3 of 4", "below 0.001", "-10", "--", "none"]
        assert heard == Heard()


def test_a_phone_shows_the_page_without_scrolling_sideways(browser: Any, results: Path):
    for scheme in ("light", "dark"):
        with watched(browser, 390, 844, color_scheme=scheme) as (page, heard):
            page.goto((results / "index.html").as_uri())
            assert page.title() == "vlgs: results"
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
            strip = page.locator(".strip").first
            assert strip.evaluate("(it) => it.scrollWidth > it.clientWidth")
            strip.scroll_into_view_if_needed()
            page.wait_for_function(
                "[...document.querySelectorAll('.strip img')][0].naturalWidth == 64"
            )
            ink, paper = page.evaluate("(({color, backgroundColor}) => [color, backgroundColor])(getComputedStyle(document.body))")  # fmt: skip
            assert (max(map(int, re.findall(r"\d+", paper)[:3])) < 60) == (scheme == "dark")
            assert (min(map(int, re.findall(r"\d+", ink)[:3])) > 200) == (scheme == "dark")
            assert heard == Heard()


def test_without_a_script_tables_are_plain(browser: Any, results: Path):
    with watched(browser, 800, 600, java_script_enabled=False) as (page, heard):
        page.goto((results / "index.html").as_uri())
        assert page.get_by_text("Without_it").first.is_visible()
        assert page.get_by_role("button").count() == 0
        assert heard == Heard()
