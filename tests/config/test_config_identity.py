"""What the id of a run is a hash of: options by their names and values that can move a number, and nothing else."""

import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from tiny_runs import composed

from vlgs.identity import (
    AS_WITHOUT,
    MOVES_NOTHING,
    PLACES,
    SAID_ELSEWHERE,
    given_folders,
    identity,
    moves,
    run_id,
    trained_id,
)
from vlgs.known import CONF, contents, groups, is_group, last, nodes, option, options, targets

MOVING_NOTHING = (
    *("results", "progress", "pictures", "on_existing", "threads", "plugins", "logger.loggers"),
    *("head.cache_dir", "data.cache", "data.cache_bytes", "data.allow_missing_masks"),
    *("raster.memory_budget", "trainer.checkpoint_every", "trainer.log_every"),
    *(f"augment.extractor.{part}.pretrained.{key}" for part in ("segmenter", "encoder") for key in ("device", "weights")),
)  # fmt: skip
"""Beside ``features``, all of which stands in `augment` too. Written out again: what joins these in `vlgs.identity` joins here, with a test
that it moves nothing."""

NAMES = {
    "augment": "none offline",
    "blend": "beta fixed gaussian none uniform",
    "head": "autoencoder classifier codebook identity linear lookup principal quantised",
    "data": "colmap synthetic",
    "encoder": "clip maps",
    "fusion": "cross mlp none self",
    "gaussians": "default",
    "indicator": "fixed learned opacity per_level",
    "protocol": "auto dense lerf_ovs mipnerf360_goi ovs3d_argmax ovs3d_threshold select3d",
    "query": "hyperplane lerf_relevancy objects vocab_softmax",
    "raster": "default",
    "segmenter": "sam superpixels",
    "sharing": "pos_cov",
    "lift": "consensus direction mean robust solve squared top_k",
    "stages": "associate lift train train_color train_hash_features train_language_field train_radiance",
    "text": "clip vocabulary",
    "trainer": "base",
}
"""What classes are called in ids. A name that changes orphans every run that has it."""

IDS = {
    "data.scene=mirrors gaussians.near_share=0 trainer.codes_apart=0 trainer.codes_faint=0 trainer.indicator_reach=0 trainer.language_weight=1 trainer.language_error=mse trainer.language_support=0 gaussians.background_opacity=null gaussians.max_angle=0 gaussians.densify.by_error=false gaussians.densify.long_axis=false raster.eps2d=0.3 raster.near_sigmas=0 trainer.dropout=0": (
        "cbb48f3055c16f1d",
        "fcbc1c6958b88ef0",
        "3c63531ff24cf4fc",
    ),
    "levels=joint indicator=per_level fusion=none trainer=paper": (
        "cda3757fe9b527a0",
        "3c2fbaea7010648d",
        "3c63531ff24cf4fc",
    ),
    "data=colmap data.root=here head=identity sharing=pos protocol=lerf_ovs_v2 gaussians.near_share=0 trainer.indicator_reach=0 trainer.language_weight=1 trainer.language_error=mse trainer.language_support=0 gaussians.background_opacity=null gaussians.max_angle=0 gaussians.densify.by_error=false gaussians.densify.long_axis=false raster.eps2d=0.3 raster.near_sigmas=0 trainer.dropout=0": (
        "fa59105e142c0918",
        "42c26c1806e27e11",
        "361e0f7e8b0ed906",
    ),
}
"""Overrides -> run id for a content called f, recipe, data recipe. Where numbers change too, `RESULTS_VERSION` is raised and these are
written anew; else a change of one orphans every run that there is."""


@pytest.fixture(scope="module")
def every_option() -> list[DictConfig]:
    """Configurations that between them have every option of a run."""
    chosen = {group: options(group) for group in groups() if "/" not in group}
    del chosen["features"]
    rules = chosen.pop("lift")  # what method=lift alone has
    chosen |= {"data": ["synthetic", "colmap"], "logger": ["csv"]}
    found = []
    for index in range(max(map(len, chosen.values()))):
        picked = [f"{group}={names[index % len(names)]}" for group, names in chosen.items()]
        if "augment=offline_sam" in picked:
            parts = ("sam", "clip") if index < 3 else ("superpixels", "maps")
            picked += [f"features/{kind}={part}" for kind, part in zip(("segmenter", "encoder"), parts, strict=True)]  # fmt: skip
            picked += ["features.extractor.encoder.folder=maps"] * ("maps" in parts)
        picked += ["data.root=here"] if "data=colmap" in picked else []
        plain: Any = OmegaConf.to_container(composed(*picked), resolve=True)
        if index == 0:
            stages = [
                CONF / "method" / "stages" / f"{name}.yaml" for name in options("method/stages")
            ]
            plain["stages"] = [contents(path) for path in stages]
        found.append(OmegaConf.create(plain))
    return found + [composed("method=lift", f"lift={rule}") for rule in rules]


def ids(config: DictConfig) -> tuple[object, ...]:
    return run_id(config, "f"), identity(config)


def leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    for name, child in node.items():
        full = f"{key}.{name}".lstrip(".")
        if isinstance(child, dict) and child:
            yield from leaves(child, full)
        else:
            yield full, child


def other(value: Any) -> Any:
    """Another value, whatever it was."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, list):
        return [*value, "another"]
    return 1 if value is None else value + 1 if isinstance(value, int | float) else f"{value}_"


@pytest.mark.usefixtures("unchecked")
def test_every_value_that_can_move_a_number_moves_the_id_and_no_other_does(
    every_option: list[DictConfig],
):
    seen, still = set(), set()
    for config in every_option:
        plain: Any = OmegaConf.to_container(config)
        whole, told = ids(config)
        for key, value in leaves(plain):
            group = plain[key.partition(".")[0]]
            once = (key, group.get("_target_") if isinstance(group, dict) else None)
            if once in seen or last(key) == "_partial_":
                continue
            seen.add(once)
            OmegaConf.update(config, key, other(value))
            if run_id(config, "f") == whole and identity(config) == told:
                still.add(key)
            OmegaConf.update(config, key, value)
    assert len(seen) > 300
    assert {key for key in still if not key.startswith("features.")} == {
        *MOVING_NOTHING,
        *SAID_ELSEWHERE,
        *(f"data.{name}" for name in PLACES),
    }
    still -= {*SAID_ELSEWHERE, *(f"data.{n}" for n in PLACES)}
    assert {key for key, _ in seen if not moves(key)} == still


AS_PAPER = (
    *("trainer.codes_apart=0", "trainer.codes_faint=0"),
    *("trainer.indicator_reach=0", "trainer.language_weight=1", "trainer.language_error=mse"),
    "trainer.language_support=0",
)
"""What the recipes for everyday use have otherwise than the paper's budgets, and say for other groups."""


def test_what_a_trainer_says_for_other_groups_counts_through_these():
    of_language = {one.partition("=")[0] for one in AS_PAPER}
    assert of_language | {"trainer.best_rates_for", "trainer.best_shN"} == SAID_ELSEWHERE
    assert all(moves(key) for key in SAID_ELSEWHERE), "a benchmark records them"
    own = (
        *("head.training.spread=32", "head.training.faint=0.35"),
        *("indicator.reach=10", "loss.language.weight=0.3", "loss.language.error=l1"),
        "loss.language.support=0.1",
    )
    assert ids(composed()) == ids(composed(*AS_PAPER, *own))
    rest = [tuple(one for one in AS_PAPER if one is not left) for left in AS_PAPER]
    assert len({ids(composed(*given)) for given in ((), AS_PAPER, *rest)}) == 8
    assert ids(composed("method=best")) == ids(composed("method=best", *AS_PAPER))
    for trainer in ("paper", "benchmark", "released"):
        assert ids(composed(f"trainer={trainer}")) == ids(composed(f"trainer={trainer}", *AS_PAPER))


def test_rates_that_a_trainer_says_for_best_count_with_it_alone():
    said = ("trainer.best_rates_for=7", "trainer.best_shN=0.25")
    given = ("trainer.rates_for=7", "trainer.learning_rates.shN=0.25")
    assert ids(composed(*said)) == ids(composed())
    assert ids(composed("method=best", *said)) == ids(composed("method=best", *given))
    assert ids(composed("method=best", *said)) != ids(composed("method=best"))
    for trainer in ("trainer=photos", "trainer=fast_photos"):
        own, best = (
            OmegaConf.to_container(composed(trainer, *method).trainer, resolve=True)
            for method in ((), ("method=best",))
        )
        assert own == best, trainer


def test_what_moves_nothing_and_what_may_be_left_out_are_keys_that_are_there(
    every_option: list[DictConfig],
):
    keys = {key for config in every_option for key, _ in leaves(OmegaConf.to_container(config))}
    for name in (*MOVES_NOTHING - {"hydra"}, *AS_WITHOUT):
        name = name.removeprefix("stages.")  # a stage's lift is the one that is chosen: conf/lift
        assert any(key == name or key.startswith(f"{name}.") for key in keys), name


@pytest.mark.parametrize("key", ["gaussians.background"])
def test_a_key_changes_no_id_where_it_has_the_value_that_is_as_without(key: str):
    plain: Any = OmegaConf.to_container(composed(f"{key}=0"), resolve=True)
    without: Any = OmegaConf.create(plain)
    above, _, name = key.rpartition(".")
    del OmegaConf.select(without, above)[name]
    given: Any = OmegaConf.create(plain)
    want = ids(given)
    assert ids(without) == want
    OmegaConf.update(without, key, 1, force_add=True)
    assert ids(without) != want


@pytest.mark.parametrize(
    ("had", "clean"),
    [
        ("trainer=paper", "trainer=paper gaussians.densify.prune_large=false"),
        ("trainer=paper", "trainer=default"),
        ("sharing=pos trainer=fast", "sharing=pos_cov trainer=fast"),
        ("sharing=pos trainer.rates_for=900", "sharing=pos trainer=default"),
    ],
)
def test_a_mended_defect_moves_the_ids_of_the_runs_that_had_it(
    had: str, clean: str, monkeypatch: pytest.MonkeyPatch
):
    moved, still = composed(*had.split()), composed(*clean.split())
    now, same = ids(moved), ids(still)
    monkeypatch.setattr("vlgs.identity.MENDED", {})
    assert ids(moved)[0] != now[0]
    assert ids(moved)[1] != now[1]
    assert ids(still) == same


def test_ids_stay():
    for overrides, want in IDS.items():
        config = composed(*overrides.split())
        assert (run_id(config, "f"), identity(config).recipe, identity(config).data) == want


def test_names_of_classes_stay(every_option: list[DictConfig]):
    found: dict[str, set[str]] = {}
    for config in every_option:
        for key, node in nodes(OmegaConf.to_container(config, resolve=True)):
            if "_target_" in node and moves(key) and is_group(key):
                found.setdefault(last(key), set()).add(str(option(key, node["_target_"])))
            elif "_target_" in node and moves(key):
                # What has no name is told by its key, or by the names of its arguments.
                classes = [get_object(path) for path in targets(last(key)) - {"???"}]
                told = {frozenset(inspect.signature(one).parameters) for one in classes}
                assert len(told) == len(classes), key
    assert found == {group: set(names.split()) for group, names in NAMES.items()}


def test_where_a_class_lies_and_what_it_is_called_change_no_id(tmp_path: Path):
    package = Path(__file__).parents[2] / "vlgs"
    shutil.copytree(
        package, tmp_path / "vlgs", ignore=shutil.ignore_patterns("*.so", "__pycache__", "conf")
    )
    shutil.copytree(CONF, tmp_path / "conf")
    chosen = [
        "fusion=mlp",
        "fusion=none head=identity blend=none",
        "augment=offline_sam features/encoder=dinov2",
    ]
    # The finder of an editable install would lead to the package here instead of to the copy.
    code = f"""if True:
        import json, sys
        sys.meta_path[:] = [f for f in sys.meta_path if f.__module__.startswith("_frozen_importlib")]
        from vlgs.command import composed
        from vlgs.identity import identity, run_id
        configs = [composed(overrides.split()) for overrides in {chosen}]
        print(json.dumps([[run_id(c, "f"), identity(c).recipe, identity(c).data, c.fusion._target_] for c in configs]))
    """

    def told() -> list[list[str]]:
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return json.loads(done.stdout)

    before = told()
    for path in (tmp_path / "conf").rglob("*.yaml"):
        text = path.read_text()
        moved = re.sub(r"(_target_: )vlgs\.([\w.]+)\.(\w+)", r"\1vlgs.elsewhere.\2.New\3", text)
        path.write_text(moved if "hydra" not in path.parts else text)
    after = told()
    assert [row[:3] for row in after] == [row[:3] for row in before]
    assert after[0][3] == "vlgs.elsewhere.fusion.mlp.NewMLP"


def test_what_the_command_line_puts_in_place_of_a_class_is_no_option_but_its_own():
    named = ids(composed("fusion=cross"))
    assert (
        ids(composed("fusion=self", "fusion._target_=vlgs.fusion.attention.CrossAttention"))
        == named
    )
    foreign = {
        ids(composed(f"fusion={name}", "fusion._target_=my_lab.Gated"))
        for name in ("self", "cross")
    }
    assert len(foreign) == 1  # the same keys, the same class
    assert not foreign & {named, ids(composed("fusion=self"))}
    inner = ids(composed("gaussians.densify._target_=my_lab.Densify"))
    assert inner != ids(composed())


@pytest.mark.parametrize("given", ["query=vocab_softmax", "protocol=lerf_ovs", "text=clip"])
def test_models_are_the_same_whatever_is_asked_or_scored(given: str):
    assert trained_id(composed(given), "f") == trained_id(composed(), "f")
    assert run_id(composed(given), "f") != run_id(composed(), "f")


@pytest.mark.parametrize("given", ["seed=1", "fusion=none", "levels=joint", "method=langsplat", "trainer.iterations=7"])  # fmt: skip
def test_models_are_others_whatever_else_is_said(given: str):
    assert len({trained_id(composed(*words), "f") for words in ((), (given,))}) == 2
    assert trained_id(composed(given), "g") != trained_id(composed(given), "f")


def test_one_and_one_point_zero_are_one_run():
    assert ids(composed("blend=fixed", "blend.value=1")) == ids(
        composed("blend=fixed", "blend.value=1.0")
    )
    assert ids(composed("raster=fast")) == ids(composed("raster.transmittance_min=0.01"))


def test_an_option_of_a_folder_of_ones_own_has_its_name_unless_ours_has_it(tmp_path: Path):
    (tmp_path / "fusion").mkdir()
    for name, target in (("gated", "my_lab.Gated"), ("self", "my_lab.Self")):
        (tmp_path / "fusion" / f"{name}.yaml").write_text(f"_target_: {target}\n")
    assert option("fusion", "my_lab.Gated", [tmp_path]) == "gated"
    assert option("fusion", "my_lab.Self", [tmp_path]) is None
    (tmp_path / "fusion" / "wide.yaml").write_text("_target_: my_lab.Gated\n")
    with pytest.raises(
        ValueError, match=r"named by one file.*gated\.yaml and wide\.yaml.*defaults: \[gated"
    ):
        option("fusion", "my_lab.Gated", [tmp_path])


def test_a_folder_of_second_maps_counts_by_its_content_and_not_by_its_place():
    def ids(*folder: str) -> tuple[str, str]:
        given = (f"stages.1.second.folder={path}" for path in folder)
        config = composed(
            "method=fmgs",
            "gaussians.near_share=0",
            "gaussians.background_opacity=null",
            "gaussians.max_angle=0",
            "gaussians.densify.by_error=false",
            "gaussians.densify.long_axis=false",
            "raster.eps2d=0.3",
            "raster.near_sigmas=0",
            "trainer.dropout=0",
            *AS_PAPER,
            *given,
        )
        return run_id(config, "content"), identity(config).recipe

    without, here, there, other = ids(), ids("here/dino"), ids("/there/dino"), ids("here/edges")
    assert without == ("6e1ea819e1be7be3", "d9a4985ae2811b90")
    assert here == there != without
    assert here[0] == other[0], "the content stands in the fingerprint"
    assert here[1] != other[1], "a table tells them apart by their names"
    given = given_folders(composed("method=fmgs", "stages.1.second.folder=/there/dino"))
    assert given == {"stages.1.second.folder": "/there/dino"}
