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
    margin: float | None = None
    """In printed units: differences below it are called equivalent where that can be shown."""
    judged: bool = True
    """Whether a difference is a claim. Times are not: they depend on what else the machine did."""

    @property
    def title(self) -> str:
        """Header with its unit."""
        return f"{self.header} ({self.unit})" if self.unit else self.header


QUANTITIES: dict[str, Quantity] = {
    "miou": Quantity("miou", "mIoU", "%", 100.0, 1, True, 1.0),
    "miou_translucent_reflective": Quantity(
        "miou_translucent_reflective", "mIoU of glass, steel", "%", 100.0, 1, True, 1.0
    ),
    "loc_acc": Quantity("loc_acc", "Accuracy", "%", 100.0, 1, True),
    "miou_lerf_ovs": Quantity("miou_lerf_ovs", "mIoU of LERF-OVS", "%", 100.0, 1, True, 1.0),
    "loc_acc_lerf_ovs": Quantity("loc_acc_lerf_ovs", "Accuracy of LERF-OVS", "%", 100.0, 1, True),
    "per_category": Quantity("per_category", "IoU", "%", 100.0, 1, True, 1.0),
    "psnr": Quantity("psnr", "PSNR", "dB", 1.0, 2, True),
    "ssim": Quantity("ssim", "SSIM", "", 1.0, 3, True),
    "train_minutes": Quantity(
        "train_seconds", "Training", "min", 1.0 / 60.0, 2, False, judged=False
    ),
    "memory_mib": Quantity("peak_rss_bytes", "Memory", "MiB", 2.0**-20, 0, False, judged=False),
    "fps_query": Quantity("fps_query", "Query", "1/s", 1.0, 1, True, judged=False),
    "n_gaussians_k": Quantity("n_gaussians", "Gaussians", "10^3", 1e-3, 1, False),
    "storage_mb": Quantity("ply_bytes", "Storage", "MB", 1e-6, 1, False),
}
"""Name in a table's `metrics` -> quantity."""
