"""The command: what it refuses, in one line, and how it ends."""

import shutil
import socket
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from serving import serving

from vlgs.extras import require_extra
from vlgs.opened import open_run
from vlgs.runs import STOPPED, RunFolder
from vlgs.view.__main__ import main
from vlgs.view.save import first_picture
from vlgs.view.shown import Shown
from vlgs.view.watch import Watch

needs_viser = pytest.mark.skipif(
    find_spec("viser") is None, reason="needs viser: pip install 'vlgs[viewer]'"
)


def refused(*arguments: str) -> str:
    """What the command says in the end."""
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert isinstance(ended.value.code, str)  # which is exit status 1
    assert ended.value.code.startswith("error: ")
    assert "\n" not in ended.value.code
    return ended.value.code


def test_only_one_module_knows_the_web_server():
    files = (Path(__file__).parents[2] / "vlgs").rglob("*.py")
    knowing = [path.name for path in files if "import viser" in path.read_text()]
    assert knowing == ["server.py"]


def test_a_missing_package_is_named_with_the_command_that_brings_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(
        "vlgs.view.__main__.require_extra", lambda _, extra: require_extra("no_such_module", extra)
    )
    assert "pip install 'vlgs[viewer]'" in refused(str(folder))


@needs_viser
def test_what_is_no_run_is_refused(tmp_path: Path, folder: Path):
    assert "must be the folder of a run" in refused(str(tmp_path))
    assert "runs must be one or two, got 3" in refused(*3 * [str(folder)])
    assert "port must be" in refused(str(folder), "--port", "70000")


@needs_viser
def test_a_port_in_use_is_refused(folder: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refused(str(folder), "--port", str(port))
    assert f"port {port} of 127.0.0.1 must be free" in said
    assert "--port" in said
    assert "203.0.113.9 must be free" in refused(str(folder), "--host", "203.0.113.9")


@pytest.mark.slow
def test_the_first_picture_needs_no_browser_and_no_server(folder: Path, tmp_path: Path):
    out = tmp_path / "first.png"
    main([str(folder), "--word", "mug", "--picture", str(out)])
    shown = Shown(open_run(folder, within=0.0))
    shown.learn("mug")
    want = first_picture([shown], "mug").pixels
    assert torch.equal(torch.from_numpy(np.asarray(Image.open(out)).copy()), want)
    assert "must end in .png" in refused(str(folder), "--picture", "first.jpg")
    assert "'zeppelin'" in refused(str(folder), "--word", "zeppelin", "--picture", str(out))


def test_it_serves_this_machine_only_and_ends_with_ctrl_c(folder: Path):
    with serving(str(folder)) as server:
        assert server.url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(server.url, timeout=10) as page:
            assert page.status == 200
        port = int(server.url.rpartition(":")[2])
        with socket.socket() as other, pytest.raises(ConnectionRefusedError):
            other.connect(("127.0.0.2", port))  # would be heard by a server of all addresses
        assert server.interrupt() == (STOPPED, "")


def test_a_run_that_trains_is_opened_again(folder: Path, tmp_path: Path):
    """Only when there is a newer checkpoint; words keep their vectors, and one that cannot be read leaves what is shown."""
    copied = Path(shutil.copytree(folder, tmp_path / folder.name))
    RunFolder(copied).field.unlink()
    opened, broken = list[Path](), [True]

    def open_again(path: Path):
        opened.append(path)
        if broken.pop():
            raise OSError("it is being replaced")
        broken.append(False)
        return open_run(path)

    runs = [Shown(open_run(copied)), Shown(open_run(folder))]
    training, finished = runs
    assert training.run.step is not None
    training.learn("mug")
    watch = Watch(runs, open_again)
    assert not watch.poll()
    newest = max(copied.rglob("step_*.safetensors"))
    newest.touch()
    assert not watch.poll()
    assert runs == [training, finished]
    broken.append(False)
    assert watch.poll()
    assert not watch.poll()
    assert runs[0] is not training
    assert runs[1] is finished
    assert set(runs[0].asked) == {"mug"}
    shutil.copy(RunFolder(folder).field, RunFolder(copied).field)  # training is over
    assert watch.poll()
    assert runs[0].run.step is None
    before = len(opened)
    newest.touch()
    assert not watch.poll()
    assert len(opened) == before
