"""Which images saw a sparse point."""

from collections.abc import Set
from dataclasses import replace

import numpy as np

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.sparse.model import SparseModel
from vlgs.data.sparse.write import reread

_LEAST = 2
"""Images that a point is triangulated from."""


def seen_by(model: SparseModel, names: Set[str]) -> SparseModel:
    """The model without the points that fewer than two of some images saw; as it is where its format does not say who saw a point, or nobody did.

    Args:
        model: As from `vlgs.data.sparse.read_sparse`, without a fault.
        names: Of the images.

    Raises:
        SceneError: If COLMAP refuses the tracks of its files.
    """
    if model.suffix not in (".bin", ".txt"):
        return model
    try:
        whole = reread(model)
    except ValueError as error:
        what = str(error).removeprefix("colmap: ")
        advice = "data.train_views needs the tracks: write the model again with COLMAP, or train on all views"
        raise SceneError(Fault(str(model.file("points3D")), what, advice)) from error
    ids = {image.image_id for image in model.images if image.name in names}
    tracks = [whole.point3D(int(point)).track.elements for point in model.point_ids]
    if not any(tracks):
        return model
    kept = np.array([len(ids & {e.image_id for e in track}) >= _LEAST for track in tracks])
    return replace(
        model,
        point_ids=model.point_ids[kept],
        points=model.points[kept],
        point_colors=model.point_colors[kept],
    )
