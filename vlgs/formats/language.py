"""LangSplat's ``language_features`` -> ``language_features_dim3``: the codes of an autoencoder in place of the embeddings."""

from pathlib import Path

import torch

from vlgs.data.language import find_mask_files, read_mask_map, read_mask_vectors, write_mask_files
from vlgs.files import new_folder
from vlgs.heads.autoencoder import Autoencoder


def compress_language(source: Path, target: Path, head: Autoencoder) -> int:
    """Write the maps of a folder again, with codes for vectors.

    Args:
        source: With ``<stem>_s.npy`` and ``<stem>_f.npy``.
        target: A folder that is not there or empty: all of it is written, or nothing.
        head: Fitted to the width of the vectors.

    Returns:
        How many views were written.

    Raises:
        FileNotFoundError: If there are no maps.
        ValueError: If the target has files, a file is damaged, or its vectors have another width than the head.
        OSError: If a file cannot be written.
    """
    stems = sorted(path.name.removesuffix("_s.npy") for path in source.glob("*_s.npy"))
    pairs = [(stem, find_mask_files(source, stem)) for stem in stems]
    if not stems or any(files is None for _, files in pairs):
        lone = next((stem for stem, files in pairs if files is None), "nothing")
        what = "must hold <stem>_s.npy and <stem>_f.npy"
        raise FileNotFoundError(f"language {source}: {what}, got {lone} of it")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ValueError(f"language: OUT must be a new or empty folder, got {target}")
    with new_folder(target) as out:
        for stem, files in pairs:
            assert files is not None
            vectors = torch.from_numpy(read_mask_vectors(files))
            with torch.no_grad():
                try:
                    codes = head.encode(vectors)
                except RuntimeError as error:
                    what = "vectors must be as wide as the autoencoder's input"
                    raise ValueError(f"language {files.vectors}: {what}, got {error}") from None
            write_mask_files(out, stem, read_mask_map(files), codes.numpy())
    return len(pairs)
