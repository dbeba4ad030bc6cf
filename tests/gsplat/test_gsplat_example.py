"""The example, as its reader runs it."""

import sys
from pathlib import Path

import pytest

from tests.colmap_scenes import write_scene
from vlgs.data import synthetic
from vlgs.gsplat.example import main, start, train


@pytest.mark.slow
def test_it_learns_a_scene():
    scene = synthetic.load_scene(width=48, height=36, train_views=6, test_views=2, points=300)
    splats, losses = train(scene, 40)
    assert len(splats["means"]) == len(start(scene)["means"]) == len(scene.points)
    assert sum(losses[-5:]) < 0.6 * sum(losses[:5])


def test_it_trains_photographs_and_says_how_near_it_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "gsplat", None)  # as where it is not installed
    write_scene(tmp_path)
    main(["--root", str(tmp_path), "--resize", "1", "--steps", "3"])
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "no densification: that takes gsplat (pip install gsplat==1.5.3)"
    assert said[1].startswith("6 Gaussians, PSNR of held-out views ")


def test_a_folder_that_is_no_scene_is_one_line(tmp_path: Path):
    with pytest.raises(SystemExit, match=r"error: .*none"):
        main(["--root", str(tmp_path / "none")])
