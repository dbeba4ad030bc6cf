"""Images that a reconstruction has a camera pose for, each matched with its file."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from vlgs.data.cache import PixelCache
from vlgs.data.diagnostics import Fault, SceneError, listing, warning
from vlgs.data.images import SUFFIXES, Photograph, is_copy_of, open_photograph
from vlgs.data.labels import DenseFolder, ObjectFolder
from vlgs.data.lens import Lens, make_lens
from vlgs.data.sparse import SparseCamera, SparseImage, SparseModel, camera_faults, image_faults
from vlgs.data.views import ViewSource, map_sizes
from vlgs.types import Camera


@dataclass(frozen=True)
class ImageFolder:
    """Where the photographs lie and at which size they are wanted."""

    path: Path
    resize: float
    """Output size as a fraction of the file's."""
    cache: PixelCache

    def find(self, name: str) -> Path | None:
        """The file of a registered name; scaled copies may have another suffix."""
        path = self.path / name
        if path.is_file():
            return path
        copies = (
            path.with_suffix(suffix) for suffix in sorted(SUFFIXES | {s.upper() for s in SUFFIXES})
        )
        return next((copy for copy in copies if copy.is_file()), None)

    def stems(self) -> set[str]:
        """Stems of all image files in it and below it."""
        return {p.stem for p in self.path.rglob("*") if p.suffix.lower() in SUFFIXES}


def open_views(
    model: SparseModel, folder: ImageFolder
) -> tuple[tuple[ViewSource, ...], tuple[Fault, ...]]:
    """Find and open the photograph of every registered image, in order of name.

    Images whose camera or pose is at fault are left out: `vlgs.data.sparse.model_faults` reports those.

    Returns:
        The views that can be read and what is wrong with the files of the others.
    """
    file = str(model.file("images"))
    cameras = {c.camera_id: c for c in model.cameras if not any(camera_faults(c, file))}
    sound = [i for i in model.images if not any(image_faults(i, cameras.keys(), file))]
    lenses: dict[tuple[int, tuple[int, int]], Lens] = {}
    views: dict[str, ViewSource] = {}
    faults: list[Fault] = []
    missing: list[str] = []
    for image in sorted(sound, key=lambda i: i.name):
        path = folder.find(image.name)
        if path is None:
            missing.append(image.name)
            continue
        camera = cameras[image.camera_id]
        try:
            photograph = open_photograph(path, (camera.width, camera.height))
            key = (camera.camera_id, (photograph.width, photograph.height))
            if key not in lenses:
                lenses[key] = make_lens(camera, key[1], folder.resize, str(model.file("cameras")))
        except SceneError as error:
            faults.append(error.fault)
            continue
        view = _make_view(image, camera, photograph, lenses[key], folder.cache)
        if view.name in views:
            other = views[view.name].photograph.path
            what = f"image stems must be unique, got {view.name!r} twice: also {other}"
            faults.append(Fault(str(path), what, RENAME))
        views[view.name] = view
    if missing:
        what = f"registered images must all be there, got {len(missing)} of {len(sound)} missing"
        faults.append(Fault(str(folder.path), f"{what}: {listing(missing, 20)}"))
    # A camera that cannot be undistorted is one fault, however many images it took.
    return tuple(views.values()), tuple(dict.fromkeys(faults))


RENAME = (
    "rename it, in the COLMAP model too: labels and language maps find their photograph by its stem"
)


def scale_faults(views: Sequence[ViewSource]) -> Iterator[Fault]:
    """Photographs that are scaled otherwise than most of their camera's: each fits the camera, but a swapped file does that too."""
    by_camera: dict[tuple[int, int], list[Photograph]] = {}
    for view in views:
        by_camera.setdefault(view.camera_size, []).append(view.photograph)
    for photographs in by_camera.values():
        sizes = Counter((photo.width, photo.height) for photo in photographs)
        (width, height), _ = sizes.most_common(1)[0]
        for photo in photographs:
            if max(abs(photo.width - width), abs(photo.height - height)) > 1:
                what = f"size must be {width} x {height} as most of its camera's, got {photo.width} x {photo.height}"
                yield Fault(str(photo.path), what, "is it another photograph?")


def coverage_warnings(
    model: SparseModel, views: Sequence[ViewSource], folder: ImageFolder
) -> Iterator[Fault]:
    """What a reconstruction leaves open: images that it did not register, cameras that it could not share."""
    present, registered = folder.stems(), {Path(i.name).stem for i in model.images}
    if left := sorted(present - registered):
        total = len(present | registered)
        what = f"registered images should be all {total}, got {len(registered)} of {total}"
        advice = (
            f"not in the model are {listing(left, 5)}: match more image pairs, or leave them out"
        )
        yield warning(folder.path, what, advice)
    if len(model.cameras) == len(model.images) > 1:
        what = f"images of one device should share a camera, got {len(model.cameras)} cameras"
        advice = "each was calibrated from one image alone: run COLMAP with a single camera (vlgs.sfm --single-camera)"
        yield warning(model.file("cameras"), what, advice)
    tagged = [view.photograph for view in views if view.photograph.tagged]
    outcomes = {
        True: "applied, as only so they fit their cameras",
        False: "ignored, as COLMAP does",
    }
    for turned, outcome in outcomes.items():
        if names := [p.path.name for p in tagged if p.turned == turned]:
            what = f"images should have no EXIF orientation, got one in {listing(names, 5)}"
            yield warning(folder.path, what, f"it is {outcome}")


def attach_labels(
    views: Sequence[ViewSource], labels: DenseFolder | ObjectFolder | None, folder: ImageFolder
) -> tuple[tuple[ViewSource, ...], tuple[Fault, ...]]:
    """Give every view the labels of its stem.

    Returns:
        The views, and labels whose size is not that of their image or that belong to no image.
    """
    if labels is None:
        return tuple(views), ()
    faults = []
    for view in views:
        if view.name not in labels.files:
            continue
        size, file = labels.sizes[view.name], str(labels.files[view.name])
        allowed = map_sizes(view.lens, view.camera_size)
        if isinstance(labels, DenseFolder) and size not in allowed:
            expected = " or ".join(f"{width} x {height}" for width, height in allowed)
            faults.append(
                Fault(file, f"labels must be {expected} as their image, got {size[0]} x {size[1]}")
            )
        if isinstance(labels, ObjectFolder) and not is_copy_of(size, view.lens.file_size):
            expected = f"that of the image ({view.lens.file_size}) or a scaled copy's"
            # A polygon's JSON says its size, a mask has it.
            own = "size" if labels.classes else "info.width and info.height"
            faults.append(Fault(file, f"{own} must be {expected}, got {size}"))
    faults += _stray_labels(views, labels.files, folder)
    labelled = (replace(v, labels=labels) if v.name in labels.files else v for v in views)
    return tuple(labelled), tuple(faults)


def _stray_labels(
    views: Sequence[ViewSource], files: Mapping[str, Path], folder: ImageFolder
) -> Iterator[Fault]:
    """Labels that would silently not be tested."""
    stray = sorted(files.keys() - {view.name for view in views})
    present = folder.stems() if stray else set()
    for stem in stray:
        if stem in present:
            what = "labelled image should be registered, got one that is not in the sparse model"
            yield warning(files[stem], what, "it is not tested")
        else:
            yield Fault(
                str(files[stem]), f"labels must belong to an image, got no image with stem {stem!r}"
            )


def _make_view(
    image: SparseImage, camera: SparseCamera, photograph: Photograph, lens: Lens, cache: PixelCache
) -> ViewSource:
    K = torch.from_numpy(lens.intrinsics())
    return ViewSource(
        name=Path(image.name).stem,
        camera=Camera(image.viewmat().float(), K.float(), *lens.size),
        camera_size=(camera.width, camera.height),
        photograph=photograph,
        lens=lens,
        cache=cache,
    )
