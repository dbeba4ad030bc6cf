"""The quantities that a table can print: keys of metrics.json, each with its usual unit."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """One kind of number."""

    entry: str
    """Key in metrics.json (`vlgs.report.results.METRICS`)."""
    header: str
    unit: str
    factor: float
    """Printed value = entry * factor."""
    digits: int
    """After the point."""
    higher_is_better: bool


QUANTITIES: dict[str, Quantity] = {
    "miou": Quantity("miou", "mIoU", "%", 100.0, 1, True),
    "miou_translucent_reflective": Quantity(
        "miou_translucent_reflective", "mIoU (glass, steel)", "%", 100.0, 1, True
    ),
    "loc_acc": Quantity("loc_acc", "Accuracy", "%", 100.0, 1, True),
    "miou_lerf_ovs": Quantity("miou_lerf_ovs", "mIoU (LERF-OVS)", "%", 100.0, 1, True),
    "loc_acc_lerf_ovs": Quantity("loc_acc_lerf_ovs", "Accuracy (LERF-OVS)", "%", 100.0, 1, True),
    "per_category": Quantity("per_category", "IoU", "%", 100.0, 1, True),
    "psnr": Quantity("psnr", "PSNR", "dB", 1.0, 2, True),
    "ssim": Quantity("ssim", "SSIM", "", 1.0, 3, True),
    "train_minutes": Quantity("train_seconds", "Training", "min", 1.0 / 60.0, 2, False),
    "fps_query": Quantity("fps_query", "Query", "1/s", 1.0, 1, True),
    "n_gaussians_k": Quantity("n_gaussians", "Gaussians", "10^3", 1e-3, 1, False),
    "storage_mb": Quantity("ply_bytes", "Storage", "MB", 1e-6, 1, False),
}
"""Name in a table's `metrics` -> quantity."""
