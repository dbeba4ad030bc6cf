"""Reads and writes the files of other systems: Gaussians, checkpoints, autoencoders, language maps, cameras.

Nothing here runs code from a file: pickles are read by torch's restricted reader, which accepts only tensors and plain values.
"""

from vlgs.formats.autoencoder import load_weights, read_autoencoder, write_autoencoder
from vlgs.formats.gaussians import FORMATS, Imported, read_gaussians, write_gaussians
from vlgs.formats.language import compress_language
from vlgs.formats.start import file_digest, folder_digest, start_from

__all__ = [
    "FORMATS",
    "Imported",
    "compress_language",
    "file_digest",
    "folder_digest",
    "load_weights",
    "read_autoencoder",
    "read_gaussians",
    "start_from",
    "write_autoencoder",
    "write_gaussians",
]
