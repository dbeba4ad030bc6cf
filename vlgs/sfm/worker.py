"""COLMAP's pipeline, run as a script in a process of its own: ``python worker.py FOLDER``.

A crash of the native code then ends this process only; it imports neither vlgs nor Pillow. FOLDER has ``settings.json``. The
script writes the database, ``sparse/<n>`` for each model, ``stage.txt`` and ``registered.txt`` there. Features and matches that are
in the database already are not computed again.
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    """Extract, match, map; undistort if that is wanted."""
    import pycolmap

    folder = Path(sys.argv[1])
    settings = json.loads((folder / "settings.json").read_text(encoding="utf-8"))
    database, images = folder / "database.db", Path(settings["images"])
    threads, seed = settings["threads"], settings["seed"]
    pycolmap.set_random_seed(seed)

    _stage(folder, "features")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = threads, False
    extraction.max_image_size = settings["max_size"]
    extraction.sift.max_num_features = settings["max_features"]
    apart = settings["single_camera"] is False
    for names in [settings["names"]] if apart else settings["groups"]:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = settings["camera_model"]
        if not apart and (known := _camera(pycolmap, database, names)) is not None:
            # Taken up again, COLMAP would calibrate one camera more for what is left.
            reader.existing_camera_id = known
        pycolmap.extract_features(
            database,
            images,
            names,
            camera_mode=pycolmap.CameraMode.AUTO if apart else pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )

    _stage(folder, "matches")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = threads, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    options = {
        "matching_options": matching,
        "verification_options": verification,
        "device": pycolmap.Device.cpu,
    }
    if settings["matching"] == "sequential":
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = settings["overlap"], True
        pycolmap.match_sequential(database, pairing_options=pairing, **options)
    else:
        pycolmap.match_exhaustive(database, **options)

    _stage(folder, "mapping")
    sparse, registered = folder / "sparse", folder / "registered.txt"
    for old in (sparse, folder / "undistorted"):
        shutil.rmtree(old, ignore_errors=True)
    sparse.mkdir()
    registered.write_bytes(b"")

    def count() -> None:
        with registered.open("ab") as stream:
            stream.write(b".")

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.random_seed = threads, seed
    mapping.min_model_size = 3
    models = pycolmap.incremental_mapping(
        database,
        images,
        sparse,
        mapping,
        initial_image_pair_callback=count,
        next_image_callback=count,
    )
    if models and settings["undistort"]:
        _stage(folder, "undistortion")
        best = max(models, key=lambda k: models[k].num_reg_images())
        pycolmap.undistort_images(
            folder / "undistorted", sparse / str(best), images, num_threads=threads
        )
    found = [
        {
            "folder": str(key),
            "registered": sorted(model.image(i).name for i in model.reg_image_ids()),
            "points": model.num_points3D(),
            "cameras": len({model.image(i).camera_id for i in model.reg_image_ids()}),
            "reprojection_error": model.compute_mean_reprojection_error(),
        }
        for key, model in models.items()
    ]
    (folder / "models.json").write_text(json.dumps(found), encoding="utf-8")
    _stage(folder, "done")


def _camera(pycolmap: Any, database: Path, names: list[str]) -> int | None:
    """Camera that some of the photographs have already."""
    if not database.is_file():
        return None
    with pycolmap.Database.open(database) as base:
        there = {image.name: image.camera_id for image in base.read_all_images()}
    return next((there[name] for name in names if name in there), None)


def _stage(folder: Path, name: str) -> None:
    (folder / "stage.txt").write_text(name, encoding="utf-8")


if __name__ == "__main__":
    main()
