"""LangSplat's autoencoder weights (``best_ckpt.pth``) as our head, and back."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from vlgs.formats.plain import load_plain, save_plain
from vlgs.heads import FittedHead
from vlgs.heads.autoencoder import Autoencoder


def read_autoencoder(path: str | Path) -> Autoencoder:
    """A head with the weights of a ``best_ckpt.pth``, or of our own state dict as safetensors, whatever its widths.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not the state dict of such an autoencoder; names the layer that does not fit.
    """
    who = f"autoencoder {path}"
    state = _load(Path(path))
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise ValueError(f"{who}: must be a state dict of tensors, got a {type(state).__name__}")
    encoder, decoder = _widths(who, state, "encoder"), _widths(who, state, "decoder")
    if len(encoder) < 3 or len(decoder) < 3:
        what = "must have encoder.0.weight, ... and decoder.0.weight, ... of two layers or more"
        raise ValueError(f"{who}: {what}, got {len(encoder)} and {len(decoder)} widths")
    if encoder[-1] != decoder[0] or encoder[0] != decoder[-1]:
        raise ValueError(f"{who}: decoder must undo {encoder}, got {decoder}")
    head = Autoencoder(encoder[-1], encoder[1:-1], decoder[1:-1], center="mean" in state)
    head.build(encoder[0])
    own = {"mean": head.mean, "fitted_reconstruction": head.fitted_reconstruction}
    try:
        head.load_state_dict({**own, **state})
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:300]
        raise ValueError(f"{who}: layers must be LangSplat's, got {reason}") from None
    weights = (item for item in state.items() if item[0] != "fitted_reconstruction")
    bad = [name for name, value in weights if not value.isfinite().all()]
    if bad:
        raise ValueError(f"{who}: weights must be finite, got {bad[0]} that is not")
    head.requires_grad_(False)
    return head


def load_weights(head: FittedHead, path: str | Path) -> None:
    """Give a head the weights of a file, in place of a fit.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no autoencoder, or one of other widths.
    """
    read = read_autoencoder(path)
    own = (head.encoder_widths, head.dim, head.decoder_widths)
    widths = (read.encoder_widths, read.dim, read.decoder_widths)
    if own != widths:
        raise ValueError(f"autoencoder {path}: widths must be {own} as configured, got {widths}")
    head.load_state_dict(read.state_dict())
    head.requires_grad_(False)


def _load(path: Path) -> Any:
    if path.suffix != ".safetensors":
        return load_plain(path)
    if not path.is_file():  # nor a pipe, which would be waited for without end
        raise FileNotFoundError(f"autoencoder {path}: file must exist, got none")
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"autoencoder {path}: must be safetensors, got {error}") from None


def write_autoencoder(path: str | Path, head: Autoencoder) -> None:
    """Write a fitted head as LangSplat reads it.

    LangSplat subtracts no mean: ours goes into the first and the last bias, which gives the same codes and embeddings up to
    float32 rounding.

    Raises:
        ValueError: If the head is not fitted.
        OSError: If the file cannot be written.
    """
    state = dict(head.state_dict())
    if "encoder.0.weight" not in state:
        raise ValueError(f"autoencoder {path}: head must be fitted, got one that is not")
    mean = state.pop("mean").double()
    state.pop("fitted_reconstruction")
    last = max(int(name.split(".")[1]) for name in state if name.startswith("decoder."))
    weight, bias = state["encoder.0.weight"].double(), state["encoder.0.bias"].double()
    state["encoder.0.bias"] = (bias - weight @ mean).float()
    state[f"decoder.{last}.bias"] = (state[f"decoder.{last}.bias"].double() + mean).float()
    save_plain(path, {name: value.detach().clone() for name, value in state.items()})


def _widths(who: str, state: Mapping[str, Any], part: str) -> list[int]:
    """Widths from input to output: those of the weights that are matrices, in the order of the layers."""
    matrices = {
        int(name.split(".")[1]): value
        for name, value in state.items()
        if isinstance(value, torch.Tensor)
        and value.dim() == 2
        and name.startswith(f"{part}.")
        and name.split(".")[1].isdecimal()
    }
    shapes = [matrices[index].shape for index in sorted(matrices)]
    # Before a network is laid out: empty matrices may have any width and take no byte of the file.
    fits = all(before[0] == after[1] for before, after in pairwise(shapes))
    if not fits or any(0 in shape for shape in shapes):
        got = [list(shape) for shape in shapes[:12]]
        raise ValueError(f"{who}: layers of the {part} must follow each other, got {got}")
    return [shapes[0][1], *(shape[0] for shape in shapes)] if shapes else []
