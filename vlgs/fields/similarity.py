"""Cosines between language features and text, for single features or for a view, which is decoded in chunks."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages
from vlgs.types import Camera

SMALLEST_NORM = 1e-6
"""Vectors shorter than this count as having no direction: their cosines fade to 0 instead of being 0/0."""

CHUNK = 1024
"""Pixels that are decoded at once: 2 MB of 512-d float32 features, which stay in cache, whatever the size of the view."""


def rendered_feature(
    field: Field,
    camera: Camera,
    seen: FieldImages | None,
    pixels: Int[Tensor, " p"] | None,
) -> Float[Tensor, "levels h w d"]:
    """What a field knows of language from a camera: taken from `seen` if that has it, and of the pixels that are asked, as an image of one row.

    Arguments are those of `Field.similarity`.
    """
    if seen is None or seen.feature is None:
        seen = field.render(camera, frozenset({"feature"}))
    assert seen.feature is not None  # it was asked for
    return seen.feature if pixels is None else seen.feature.flatten(1, 2)[:, None, pixels]


def require_one_space(features: int, text: int) -> None:
    """Refuse text vectors of another width than the embeddings'.

    Raises:
        ValueError: Names both.
    """
    if features != text:
        raise ValueError(
            f"query: text vectors must be as wide as the decoded features ({features}), "
            f"got {text}; both must come from one embedding space"
        )


def cosines(
    features: Float[Tensor, "*p e"], text: Float[Tensor, "k _"], least: float = SMALLEST_NORM
) -> Float[Tensor, " k *p"]:
    """Cosine of every text vector with every feature; a zero vector has cosine 0 with everything.

    The product is taken first and divided by the norms after, which spares a normalised copy of the features.

    Args:
        features: Of any length.
        text: Likewise.
        least: Features shorter than this are divided by it: their cosines fade to 0 with their length.

    Raises:
        ValueError: If text and features have different widths.

    Example:
        >>> cosines(torch.tensor([[3.0, 4.0], [0.0, 0.0]]), torch.tensor([[2.0, 0.0]]))
        tensor([[0.6000, 0.0000]])
    """
    require_one_space(features.shape[-1], text.shape[-1])
    flat = features.reshape(-1, features.shape[-1])
    norms = torch.linalg.vector_norm(flat, dim=-1).clamp_min(least)  # [p]
    products = unit_words(text.to(flat.dtype)) @ flat.T  # [k, p]
    return (products / norms).reshape(text.shape[0], *features.shape[:-1])


def decoded_cosines(
    decode: Callable[[Tensor], Tensor],
    codes: Float[Tensor, "h w d"],
    text: Float[Tensor, "k e"],
    chunk: int = CHUNK,
    least: float = SMALLEST_NORM,
) -> Float[Tensor, "k h w"]:
    """Cosine of every text vector with every pixel of a rendered map of language codes.

    Codes are decoded before they are compared (conf/README.md, D.24). A view of one million pixels would be 2 GB of 512-d features;
    here only `chunk` pixels are decoded at a time.

    Args:
        decode: Codes ``[p, d]`` to embeddings ``[p, e]``, see `vlgs.heads.Head.decode`.
        codes: Rendered, not normalised.
        text: Text vectors in the embedding space of the decoder.
        chunk: Pixels per call of `decode`.
        least: See `cosines`.
    """
    h, w, _ = codes.shape
    flat = codes.reshape(h * w, -1)
    unit = unit_words(text.to(codes.dtype))
    out = codes.new_empty(text.shape[0], h * w)
    for start in range(0, h * w, chunk):
        out[:, start : start + chunk] = cosines(decode(flat[start : start + chunk]), unit, least)
    return out.reshape(-1, h, w)


def unit_words(vectors: Float[Tensor, "k e"]) -> Float[Tensor, "k e"]:
    """Words at unit length; zero ones stay zero."""
    norms = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return vectors / norms.clamp_min(SMALLEST_NORM)
