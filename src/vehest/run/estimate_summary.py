"""Summary that `vehest estimate` prints for people: what was estimated, how reliably, where in the car, and in which file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import read_description
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.run.config import compose_config
from vehest.run.estimate_log import LOGS

LABEL_WIDTH = 10


def point_of_estimate(model: Estimator, model_folder: Path) -> str:
    """The point of the car to which v and β belong.

    A trained model estimates them at the reference point of its training data, which is the centre
    of gravity unless a data set states that it is unknown. The self-calibrating filter uses the
    centre of gravity only where it is given.

    Parameters
    ----------
    model : Estimator
        As it estimates, with the settings of the car.
    model_folder : Path
        Of its description, which names the data sets of its training.
    """
    if isinstance(model, SelfCalibrating):
        if model.cg_to_rear_axle is not None:
            return f"centre of gravity, {model.cg_to_rear_axle:g} m ahead of the rear axle"
        return (
            f"point {100 * model.rear_share:.0f} % of the way from the accelerometer to a typical centre of gravity, which is "
            f"assumed {model.rear:.2f} m ahead of the rear axle; state yours by estimator.cg_to_rear_axle=…"
        )
    unknown = [
        name
        for name in read_description(model_folder).about.datasets
        if has_unknown_reference_point(name)
    ]
    if unknown:
        return (
            f"reference sensor of data set {' and '.join(unknown)}, whose place in the car is not known "
            "(reference_point in conf/dataset)"
        )
    return "centre of gravity"


def has_unknown_reference_point(dataset: str) -> bool:
    """Whether a file of conf/dataset states that the place of its reference sensor is not known."""
    with suppress(ConfigurationError):
        config = compose_config("ingest", [f"dataset={dataset}"])
        return bool(config["dataset"].get("reference_point") == "unknown")
    return False


def summary_lines(outcome: Mapping[str, Any]) -> list[str]:
    """Lines for a terminal from the outcome of `vehest.run.estimate.estimate_file`."""
    sideslip = outcome["sideslip_deg"]
    rows = {
        "estimate": f"{outcome['recording']} by {outcome['model']}: {outcome['seconds']:.4g} s, "
        f"{outcome['estimated']} of {outcome['samples']} samples at {outcome['rate_hz']:g} Hz",
        "sideslip": f"{sideslip['min']:.2f}° to {sideslip['max']:.2f}°{_band(outcome)}",
        "bands": outcome.get("band", ""),
        "valid": _valid(outcome),
        "range": outcome["outside_training"],
        "point": f"v and β at the {outcome['point']}",
        "warnings": f"{len(outcome['findings'])}, printed above" if outcome["findings"] else "none",
        "file": f"{outcome['out']}{_columns(Path(outcome['out']))}",
        "note": outcome.get("note", ""),
    }
    return [f"{label:<{LABEL_WIDTH}}{text}" for label, text in rows.items() if text]


def _valid(outcome: Mapping[str, Any]) -> str:
    """Share of valid samples, and the most frequent reasons for the others."""
    share = f"{outcome['valid_percent']:.3g} % of the estimated samples"
    if not outcome["has_calibration"]:
        return f"{share}, by gaps and speeds alone: the model has no calibration"
    reasons = "; ".join(outcome["invalid_reasons"])
    return f"{share}{reasons and f'; the others: {reasons}'}"


def _columns(out: Path) -> str:
    """What a table has, after its name; empty for a log with further channels."""
    if out.suffix.lower() in LOGS:
        return ""
    return " (vy [m/s], sideslip [rad], sideslip_deg [deg], half widths of the band, health)"


def _band(outcome: Mapping[str, Any]) -> str:
    """The half width of the 90 % band, after the range of the sideslip angle."""
    band = outcome.get("band_sideslip_deg")
    if not band:
        return ", without a band"
    return f", 90 % band ±{band['median']:.2f}° (median), ±{band['largest']:.2f}° (largest)"
