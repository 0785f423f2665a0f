"""Intervals of one estimate's figures over blocks of the drive, from the sums that an evaluation keeps."""

from __future__ import annotations

from vehest.evaluation.blocks import LEAST_BLOCKS, Segments, block_labels, block_sums
from vehest.evaluation.significance import root_interval, unexplained_interval


def figure_intervals(segments: Segments) -> dict[str, tuple[float, float]]:
    """95 % intervals over blocks of the drive, of one training: what another drive of this kind would give.

    Returns:
        Metric -> lower and upper end, as `accuracy` has the metrics; nothing where there are fewer than `LEAST_BLOCKS` blocks.
    """
    labels = block_labels(segments, (segments.squared_error_sideslip / segments.samples)[None])
    if labels.max() + 1 < LEAST_BLOCKS:
        return {}
    sizes = block_sums(segments.samples, labels)
    summed = {
        name: block_sums(getattr(segments, name), labels)
        for name in ("squared_error_vy", "squared_error_sideslip", "error_vy", "squared_vy_ref", "vy_ref")
    }
    vy, sideslip = (root_interval(summed[name][None], sizes) for name in ("squared_error_vy", "squared_error_sideslip"))
    found = {"rmse_vy": (vy.low, vy.high), "rmse_sideslip": (sideslip.low, sideslip.high)}
    found["mse_sideslip"] = (sideslip.low**2, sideslip.high**2)
    if summed["squared_vy_ref"].sum() > 0:
        fvu = unexplained_interval(summed["squared_error_vy"], summed["error_vy"], summed["squared_vy_ref"], summed["vy_ref"], sizes)
        found |= {"fvu": (fvu.low, fvu.high), "r2": (1.0 - fvu.high, 1.0 - fvu.low)}
    return found
