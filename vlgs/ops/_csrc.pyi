"""The compiled kernel (csrc/bindings.cpp).

Arrays are contiguous CPU tensors of one dtype, or what `vlgs.ops.arrays` makes of them; outputs are written in place.
"""

from collections.abc import Sequence

from torch import Tensor

def isa() -> str:
    """The instruction set in use: ``v4`` (AVX-512), ``v3`` (AVX2) or ``base``; lowered by the environment's VLGS_ISA."""

def isas() -> str:
    """The instruction sets that were compiled and run on this machine, best first, separated by blanks."""

def peak_fma(packs: int) -> int: ...
def keep_freed_memory(on: bool) -> None: ...

class Camera:
    def __init__(
        self,
        viewmat: Sequence[float],
        intrinsics: Sequence[float],
        slopes: Sequence[float],
        near: float,
        near_sigmas: float,
        blur: float,
    ) -> None: ...

class RasterizeConfig:
    def __init__(
        self,
        alpha_min: float,
        alpha_max: float,
        transmittance_min: float,
        stop_before: bool,
        memory_budget: int,
        tile_test: bool,
        block_masks: bool,
        opacity_extent: bool,
    ) -> None: ...

def project(
    camera: Camera,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    mean2d: Tensor,
    ellipse: Tensor,
    depth: Tensor,
    threads: int,
) -> None: ...
def project_backward(
    camera: Camera,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    depth: Tensor,
    d_mean2d: Tensor,
    d_ellipse: Tensor,
    d_means: Tensor,
    d_quats: Tensor,
    d_scales: Tensor,
    threads: int,
) -> None: ...

class RasterizedFloat:
    def __init__(
        self,
        mean2d: Tensor,
        ellipse: Tensor,
        depth: Tensor,
        weights: Sequence[Tensor],
        shape_grads: Sequence[bool],
        values: Sequence[Tensor],
        groups: Sequence[int],
        chain_of: Sequence[int],
        config: RasterizeConfig,
        images: Sequence[Tensor],
        alphas: Sequence[Tensor],
        visible: Tensor,
        keep: bool,
        threads: int,
    ) -> None: ...
    def backward(
        self,
        values: Sequence[Tensor],
        d_images: Sequence[Tensor | None],
        d_alphas: Sequence[Tensor | None],
        d_mean2d: Tensor | None,
        d_ellipse: Tensor | None,
        d_weights: Sequence[Tensor | None],
        d_values: Sequence[Tensor | None],
        threads: int,
    ) -> None: ...
    def median_rows(self, rows: Tensor, threads: int) -> None:
        """Rows [height, width] (int64) of what takes half of the light of the first weight, -1 without; needs ``keep``."""

    def work(self) -> tuple[int, int]:
        """Entries of all tile lists, and (Gaussian, 4x4 block, chain) triples weighed; needs ``keep`` and ``stop="after"``."""

class RasterizedDouble(RasterizedFloat): ...

def attention(
    color: Tensor,
    feature: Tensor,
    layers: Sequence[Tensor],
    heads: int,
    width: int,
    self_attention: bool,
    out_color: Tensor | None,
    out_feature: Tensor,
    threads: int,
) -> None: ...
def attention_backward(
    color: Tensor,
    feature: Tensor,
    layers: Sequence[Tensor],
    heads: int,
    width: int,
    self_attention: bool,
    d_out_color: Tensor | None,
    d_out_feature: Tensor,
    d_color: Tensor,
    d_feature: Tensor,
    d_layers: Sequence[Tensor],
    threads: int,
) -> None: ...
def view_color(
    color: Tensor,
    sh: Tensor,
    means: Tensor,
    eye: Sequence[float],
    degree: int,
    out: Tensor,
    threads: int,
) -> None: ...
def view_color_backward(
    color: Tensor,
    sh: Tensor,
    means: Tensor,
    eye: Sequence[float],
    degree: int,
    d_out: Tensor,
    d_color: Tensor,
    d_sh: Tensor,
    d_means: Tensor,
    threads: int,
) -> None: ...
def ssim_map(
    a: Tensor, b: Tensor, taps: Tensor, floors: tuple[float, float], map: Tensor, threads: int
) -> None: ...
def ssim_map_backward(
    a: Tensor,
    b: Tensor,
    taps: Tensor,
    floors: tuple[float, float],
    d_map: Tensor,
    d_a: Tensor,
    d_b: Tensor | None,
    threads: int,
) -> None: ...
def ssim_sums(
    a: Tensor,
    b: Tensor,
    valid: Tensor | None,
    taps: Tensor,
    floors: tuple[float, float],
    threads: int,
) -> tuple[float, float, int]:
    """Sums of |a - b| and of 1 - similarity over the pixels that count, and the number of these."""

def ssim_sums_backward(
    a: Tensor,
    b: Tensor,
    valid: Tensor | None,
    taps: Tensor,
    floors: tuple[float, float],
    d_distance: float,
    d_dissimilarity: float,
    d_a: Tensor,
    d_b: Tensor | None,
    threads: int,
) -> None: ...
def squared_error(a: Tensor, b: Tensor, valid: Tensor | None, threads: int) -> tuple[float, int]:
    """Sum of squared differences over the pixels that count, and their number."""

def squared_error_backward(
    a: Tensor,
    b: Tensor,
    valid: Tensor | None,
    scale: float,
    d_a: Tensor,
    threads: int,
) -> None: ...
def code_table(
    codes: Tensor,
    low: float,
    per_unit: float,
    places: Tensor,
    rows: Tensor,
    out: Tensor,
    threads: int,
) -> int:
    """How many codes lack a node."""

def radam_moments(
    weight: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    decay: float,
    to_mean: float,
    kept: float,
    to_square: float,
    threads: int,
) -> None: ...
def radam_weights(
    mean: Tensor,
    root: Tensor | None,
    weight: Tensor,
    bias: float,
    rate: float,
    eps: float,
    scale: float,
    rectified: float,
    threads: int,
) -> None: ...
def mapped_error(
    made: Tensor, bias: Tensor, wanted: Tensor, which: Tensor, scale: float, threads: int
) -> float: ...
def huber(
    image: Tensor, target: Tensor, valid: Tensor, delta: float, clamped: Tensor, threads: int
) -> float: ...
def neighbours_backward(
    image: Tensor, d_products: Tensor, d_image: Tensor, threads: int
) -> None: ...
def row_sums_backward(
    weights: Tensor, rows: Tensor, begins: Tensor, d_sums: Tensor, d_table: Tensor, threads: int
) -> int:
    """How many rows are those of another grid."""

class CachedWeightsFloat:
    def __init__(self, picture: RasterizedFloat, threads: int) -> None: ...
    def keep(self, picture: RasterizedFloat, threads: int) -> None: ...
    @property
    def bytes(self) -> int: ...
    def render(self, values: Tensor, image: Tensor, threads: int) -> None: ...
    def backward(self, d_image: Tensor, d_values: Tensor, threads: int) -> None: ...

class CachedWeightsDouble(CachedWeightsFloat): ...
