"""Check a scene: `python -m vlgs.check data=colmap data.root=PATH` lists all its faults; exit status 1 if one is an error."""

import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import hydra
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from torch import Tensor

from vlgs.arguments import take_command_line
from vlgs.command import check_command
from vlgs.config import CONF, check_config, instantiate
from vlgs.data.colmap import load_scene, survey
from vlgs.data.diagnostics import Fault, SceneError, errors, listing, warning
from vlgs.data.scene_warnings import plausibility_warnings
from vlgs.data.source import ColmapSource
from vlgs.demands import has
from vlgs.experiment import Experiment, construct
from vlgs.prepare import doubts, prepare, rehearse
from vlgs.text import screen
from vlgs.types import IGNORE_ID, Scene, View


@dataclass(frozen=True)
class Report:
    """What is wrong with a scene and, where it can be loaded, what it holds."""

    faults: tuple[Fault, ...]
    summary: tuple[str, ...]


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> None:
    """Print the report; see the module."""
    # What it would say of its warnings while it loads a scene stands in the report.
    logging.getLogger("vlgs.data.colmap").setLevel(logging.ERROR)
    try:
        check_config(config)
        report = start(config, check(config.data))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    print_report(report)
    if errors(report.faults):
        sys.exit(1)


def command() -> None:
    """The command line, from reading it to the exit status."""
    take_command_line()
    try:
        check_command([*sys.argv[1:], "hydra/help=check"])
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    main()


def start(config: DictConfig, report: Report) -> Report:
    """Construct what is configured and, if the scene can be used, begin the run for a few steps, so that an error at its start is found here."""
    found, summary = list(report.faults), list(report.summary)
    try:
        experiment = construct(config)
        if not errors(report.faults):
            line, doubtful = training_memory(experiment)
            summary += filter(None, [line])
            found += [*doubtful, *doubts(experiment)]
            rehearse(prepare(experiment))
    except SceneError as error:
        found.append(error.fault)
    except (ValueError, OSError, FloatingPointError) as error:
        who, _, what = str(error).partition(": ")
        found.append(Fault(who, what))
    return Report(tuple(found), tuple(summary))


def check(data: DictConfig) -> Report:
    """Check everything that a `data` group names, and decode every file once.

    A COLMAP scene that is at fault in one place is still looked at in all others; another source has files of its own only
    if its loader says so, and one that does not load is one fault.

    Raises:
        FileNotFoundError: If there is no scene.
        ValueError: If an option is out of range.
    """
    if get_object(data._target_) is not load_scene:
        scene = instantiate(data)
        return Report(tuple(check_scene(scene)), tuple(summarize(scene)))
    options = OmegaConf.to_container(data, resolve=True, throw_on_missing=True)
    assert isinstance(options, dict)
    found = survey(ColmapSource(**{str(k): v for k, v in options.items() if k != "_target_"}))
    if found.scene is not None:
        faults = (*found.faults, *check_scene(found.scene))
        return Report(faults, tuple(summarize(found.scene)))
    contents = (fault for source in found.views for fault in view_faults(source.view()))
    return Report((*found.faults, *contents), ())


def check_scene(scene: Scene) -> Iterator[Fault]:
    """What is wrong with the contents of a scene that has been loaded, whatever it was loaded from."""
    for view in _views(scene):
        yield from view_faults(view)
    if not scene.test:
        yield warning(
            scene.name, "test views should be at least 1, got 0", "nothing will be measured"
        )
    yield from plausibility_warnings(scene, _views(scene))
    known = set(scene.vocabulary.names) if scene.vocabulary else set()
    if scene.vocabulary and (unknown := [name for name in scene.classes if name not in known]):
        what = f"vocabulary should know every class, got none for {listing(unknown)}"
        yield warning(scene.name, what, "these cannot be asked for")


def view_faults(view: View) -> Iterator[Fault]:
    """Decode all files of one view, and compare their sizes with its camera."""
    size = (view.camera.height, view.camera.width)
    for what, read in _readers(view):
        try:
            for pixels in read():  # one at a time: there may be thousands of labelled categories
                got = tuple(pixels.shape[:2])
                if got != size:
                    expected = f"{size} (height, width) as its camera"
                    yield Fault(view.name, f"{what} must be {expected}, got {got}")
                if what == "mask map" and not (pixels >= 0).any():
                    yield warning(view.name, "mask map should reach a pixel, got -1 everywhere")
                if what == "dense labels" and (pixels == IGNORE_ID).all():
                    expected = "dense labels should name a class"
                    yield warning(view.name, f"{expected}, got ignored pixels only")
        except SceneError as error:
            yield error.fault


def summarize(scene: Scene) -> Iterator[str]:
    """What a scene holds, a line each."""
    views = _views(scene)
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    cameras = {tuple(view.camera.K.flatten().tolist()) for view in views}
    labelled = [v for v in scene.test if v.read_dense_labels or v.read_object_labels]
    masked = [v for v in scene.train if v.read_masks]
    pixels = sum(v.camera.width * v.camera.height for v in views)
    mask_pixels = sum(v.camera.width * v.camera.height for v in masked)
    decoded = 3 * pixels + 4 * mask_pixels + scene.mask_vectors.nbytes
    yield f"scene       {scene.name}, fingerprint {scene.fingerprint}"
    yield f"views       {len(scene.train)} train, {len(scene.test)} test (split {scene.split})"
    yield f"sizes       {listing((f'{width} x {height}' for width, height in sizes), 4)}"
    yield f"cameras     {len(cameras)}"
    yield f"points      {len(scene.points)}"
    yield (
        f"language    {len(scene.mask_vectors)} vectors of width {scene.mask_vectors.shape[1]} on {len(masked)} training "
        f"views, {scene.mask_areas.sum().item() / max(1, mask_pixels):.0%} of their pixels"
    )
    yield f"labels      {len(labelled)} of {len(scene.test)} test views, {len(scene.classes)} classes"
    yield f"vocabulary  {len(scene.vocabulary.names) if scene.vocabulary else 0} words"
    yield f"memory      {decoded / 2**20:.0f} MiB for all photographs and masks, decoded"


def training_memory(experiment: Experiment) -> tuple[str, tuple[Fault, ...]]:
    """Memory that a run with this configuration may need for its Gaussians: a line of the summary, and a warning if it is too much.

    Value, gradient and Adam's two moments of every parameter at `gaussians.max_count`; images and activations come on top. The line is empty
    where a method has no Gaussians.
    """
    if has(experiment.method, "without_gaussians"):
        return "", ()
    gaussians, head = experiment.parts.gaussians, experiment.parts.head
    geometry, weights = 3 + 4 + 3, 2  # means, quats, scales; opacity and indicator
    parameters = geometry + weights + 3 * (gaussians.sh_degree + 1) ** 2
    parameters += experiment.levels.codes * head.dim
    needed = gaussians.max_count * parameters * 4 * 4
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    line = f"training    {needed / 2**20:.0f} MiB for {gaussians.max_count} Gaussians at most, with their optimiser"
    if needed <= there / 2:
        return line, ()
    what = f"Gaussians should take at most half of the memory ({there / 2**20:.0f} MiB), got {needed / 2**20:.0f} MiB"
    return line, (warning("gaussians.max_count", what, "lower it"),)


def print_report(report: Report) -> None:
    """Summary, then errors, then warnings, then the verdict."""
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)
    for line in report.summary:
        console.print(screen(line))
    wrong = errors(report.faults)
    doubtful = [fault for fault in report.faults if fault.severity == "warning"]
    for fault in (*wrong, *doubtful):
        style = "bold red" if fault.severity == "error" else "yellow"
        console.print(f"{fault.severity:<8}", style=style, end="")
        console.print(screen(str(fault)))
    verdict = "not usable" if wrong else "usable"
    console.print(f"{verdict}: {len(wrong)} errors, {len(doubtful)} warnings")


def _views(scene: Scene) -> list[View]:
    """Every view once: a split may test what it trains on."""
    return list({view.name: view for view in (*scene.train, *scene.test)}.values())


def _readers(view: View) -> Iterator[tuple[str, Callable[[], Iterable[Tensor]]]]:
    """Name and pixels of everything that a view can read."""
    image, masks, valid = view.read_image, view.read_masks, view.read_valid
    dense, objects = view.read_dense_labels, view.read_object_labels
    yield "image", lambda: [image()]
    if masks is not None:
        yield "mask map", lambda: [masks()]
    if valid is not None:
        yield "valid map", lambda: [valid()]
    if dense is not None:
        yield "dense labels", lambda: [dense().ids]
    if objects is not None:
        yield "object labels", lambda: objects().masks.values()


if __name__ == "__main__":
    command()
