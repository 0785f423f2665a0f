"""Summary that `vehest estimate` prints for people: what was estimated, how reliably, where in the
car, and in which file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.configuration.composition import compose_config
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import read_description
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.inference.tables import LOG_SUFFIXES
from vehest.trust.health import HOLD_SECONDS
from vehest.trust.health_kernel import CLEAR

LABEL_WIDTH = 10  # characters before the text of a line
NO_CALIBRATION = "the model has no calibration"  # text of a model without bands and health


def point_of_estimate(model: Estimator, model_folder: Path) -> str:
    """Text of the point of the car to which v and β belong.

    A trained model estimates them at the reference point of its training data, which is the centre
    of gravity unless a data set states that it is unknown. The self-calibrating filter has a
    setting for the point.

    Parameters
    ----------
    model : Estimator
        As it estimates, with the settings of the car.
    model_folder : Path
        Of its description, which names the data sets of its training.
    """
    if isinstance(model, SelfCalibrating):
        return describe_point(model)
    unknown = [
        name
        for name in read_description(model_folder).about.datasets
        if has_unknown_reference_point(name)
    ]
    if unknown:
        return (
            f"reference sensor of data set {' and '.join(unknown)}, whose place in the car is not "
            "known (reference_point in conf/dataset)"
        )
    return "centre of gravity"


def describe_point(model: SelfCalibrating) -> str:
    """Text of the reference point of the self-calibrating filter, with its place in the car."""
    if model.point == "rear_axle":
        return "rear axle"
    if model.point == "cg":
        assumed = "" if model.cg_to_rear_axle is not None else "assumed "
        remedy = "; state yours by estimator.cg_to_rear_axle=…" if assumed else ""
        return f"centre of gravity, {assumed}{model.rear:.4g} m ahead of the rear axle{remedy}"
    place = model.imu_to_rear_axle
    if place is None:
        return (
            "inertial unit, whose place is identified on the drive; state it by "
            "estimator.imu_to_rear_axle=…, or the centre of gravity by estimator.cg_to_rear_axle=…"
        )
    side = "ahead of" if place >= 0.0 else "behind"
    return f"inertial unit, {abs(place):g} m {side} the rear axle"


def has_unknown_reference_point(dataset: str) -> bool:
    """Whether a file of conf/dataset states that the place of its reference sensor is unknown."""
    with suppress(ConfigurationError):
        config = compose_config("ingest", [f"dataset={dataset}"])
        return bool(config["dataset"].get("reference_point") == "unknown")
    return False


def summary_lines(outcome: Mapping[str, Any]) -> list[str]:
    """Lines for a terminal from the outcome of `vehest.run.estimate.estimate_file`.

    Parameters
    ----------
    outcome : mapping
        Figures, verdict and findings; entries that are missing have no line.
    """
    rows = {
        "estimate": f"{outcome['recording']} by {outcome['model']}: {outcome['seconds']:.4g} s, "
        f"{outcome['estimated']} of {outcome['samples']} samples at {outcome['rate_hz']:g} Hz",
        "sideslip": f"{_sideslip(outcome)}{_band(outcome)}",
        "bands": outcome.get("band", ""),
        "valid": _valid(outcome),
        "range": _range(outcome),
        "point": f"v and β at the {outcome['point']}",
        "warnings": f"{len(outcome['findings'])}, printed above" if outcome["findings"] else "none",
        "file": f"{outcome['out']}{_columns(Path(outcome['out']))}",
        "picture": outcome.get("plot", ""),
        "note": outcome.get("note", ""),
        "use": describe_use(outcome),
    }
    return [f"{label:<{LABEL_WIDTH}}{text}" for label, text in rows.items() if text]


def _valid(outcome: Mapping[str, Any]) -> str:
    """Text of the share of valid samples, and of what it rests on where the model has no
    calibration.
    """
    share = f"{outcome['valid_percent']:.3g} % of the estimated samples"
    if not outcome["has_calibration"]:
        has_band = bool(outcome.get("band"))
        cause = "health is not calibrated for these channels" if has_band else NO_CALIBRATION
        return f"{share}, by gaps and speeds alone: {cause}"
    return share


def describe_use(outcome: Mapping[str, Any]) -> str:
    """Text on which samples may be used, how large their errors may be, and what limits the others.

    Returns
    -------
    str
        ``only the samples with health 0 (97 %); …``: which samples, how large their errors are, and
        why others are left out.
    """
    if not outcome["has_calibration"] and not outcome.get("band"):
        return (
            f"not before a comparison with a reference: {NO_CALIBRATION}, so that "
            "neither its error nor its range is known"
        )
    condition = "once the warnings above are settled, " if outcome["findings"] else ""
    limits = "; ".join(_grouped(outcome["invalid_reasons"]))
    valid_percent = outcome["valid_percent"]
    if not valid_percent:
        return f"no sample: health is 0 at none{limits and f'; {limits}'}"
    where = (
        "all samples"
        if valid_percent == 100.0
        else f"only the samples with health 0 ({valid_percent:.3g} %)"
    )
    band = outcome.get("band_sideslip_deg")
    error = (
        "the band is made to contain 9 of 10 errors of β, and is at most "
        f"±{band['median']:.2f}° in half of all samples"
        if band
        else "no band says how large their errors are"
    )
    unmarked = (
        ""
        if outcome["has_calibration"]
        else "; faults and samples outside the range of the training are not marked"
    )
    return f"{condition}{where}; {error}{limits and f'; the others: {limits}'}{unmarked}"


def _grouped(reasons: Sequence[str]) -> list[str]:
    """Merge reasons that differ only in the channel into one: ``outside the range of the training:
    |vx|, |ay|``.
    """
    channels: dict[str, list[str]] = {}
    for reason in reasons:
        cause, _, channel = reason.partition(": ")
        channels.setdefault(cause, []).append(channel)
    return [
        f"{cause}: {', '.join(names)}" if any(names) else cause for cause, names in channels.items()
    ]


def _range(outcome: Mapping[str, Any]) -> str:
    """Text on the share of the drive outside the range of the training, and on when a sample is
    valid again; empty if there is none.
    """
    if not outcome["outside_training"]:
        return ""
    return (
        f"{outcome['outside_training']}; a sample is valid again once all signals have been below "
        f"{100.0 * CLEAR:g} % of their limits for {HOLD_SECONDS:g} s"
    )


def _columns(out: Path) -> str:
    """Text on the columns of a written table, after its name; empty for a log with further
    channels.
    """
    if out.suffix.lower() in LOG_SUFFIXES:
        return ""
    return " (vy [m/s], sideslip [rad], sideslip_deg [deg], half widths of the band, health)"


def _sideslip(outcome: Mapping[str, Any]) -> str:
    """Text of the range of the sideslip angle where the car moves forward and fast enough."""
    low, high = (outcome["sideslip_deg"][end] for end in ("min", "max"))
    if low is None:
        return f"never forward at {outcome['min_sideslip_speed']:.3g} m/s or more"
    return f"{low:.2f}° to {high:.2f}°"


def _band(outcome: Mapping[str, Any]) -> str:
    """Text of the half width of the 90 % band, appended to the range of the sideslip angle."""
    band = outcome.get("band_sideslip_deg")
    if not band:
        return ", without a band"
    return f", 90 % band ±{band['median']:.2f}° (median), ±{band['largest']:.2f}° (largest)"
