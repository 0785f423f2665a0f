"""Finds a car's numbers on its drives with the self-calibrating filter, without any reference.

drives, each from the filter's priors -> means and deviations at its end -> what the drives add to
the priors, together -> `CarRecord`
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from vehest.api import read_recording
from vehest.configuration.estimate_options import estimate_options
from vehest.configuration.files import files_and_overrides
from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.files import written_aside
from vehest.data.recording import Recording
from vehest.estimators.kernels import self_calibrating as kernel
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.inference.car_values import (
    FORMAT,
    LIMITS,
    CarRecord,
    Number,
    adapted,
    read_car,
    settings_for_channels,
    with_settings,
)
from vehest.inference.estimation import prepared_recording
from vehest.inference.models import SELF_CALIBRATING, open_model
from vehest.run.estimate import findings_of
from vehest.run.printing import TerminalTable, complain, describe_finding, note
from vehest.sources.base import car_of

# share of the prior's variance; a parameter is identified on a drive after which less remains
IDENTIFIED_SHARE = 0.5
# parameter -> index of its state in the filter
STATE_ROWS = {"leakage": kernel.LEAKAGE, "rear_axle": kernel.REAR, "compliance": kernel.COMPLIANCE}
# channel -> index of the state that is its offset
OFFSETS = {"ay": kernel.OFFSET_Y, "ax": kernel.OFFSET_X}
UNITS = {"leakage": "1", "rear_axle": "m", "compliance": "rad s²/m"}  # parameter -> unit
# parameter -> its meaning
MEANINGS = {
    "leakage": "share of ay that is gravity of the rolling body",
    "rear_axle": "distance of the inertial unit from the rear axle, negative behind it",
    "compliance": "slip angle of the rear axle over its lateral acceleration",
    "grip": "lateral acceleration at the rear axle's limit",
}
AGREEMENT_QUANTILE = 0.95
"""Quantile of χ² within which the values of several drives count as those of one car.

Beyond it the number is not identified.
"""
# s: standard deviation of the yaw rate's lateness behind ay, which drives cannot distinguish from b
# and C
YAW_RATE_LATENESS_SECONDS = 0.03


class Normal(NamedTuple):
    """Mean and standard deviation of a parameter, and the change of the mean by a yaw rate that is
    late by `YAW_RATE_LATENESS_SECONDS`.
    """

    mean: Any  # mean, in the parameter's unit
    deviation: Any  # standard deviation
    of_lateness: Any = 0.0  # change of the mean by the lateness of the yaw rate


def identify_files(words: Sequence[str], out: Path) -> CarRecord:
    """Run the filter that comes with vehest over drives of one car; write the car's record and
    return it.

    Parameters
    ----------
    words : sequence of str
        Recordings, then overrides of conf/estimate.yaml and settings of the filter,
        ``estimator.KEY=VALUE``.
    out : Path
        YAML file; an earlier record is replaced, nothing else.

    Raises
    ------
    VehestError
        No recording is named, two have one id, one cannot be used, or ``out`` is no record.
    """
    files, overrides = files_and_overrides(words)
    if not files or out.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigurationError(
            f"'{out}' must end in .yaml"
            if files
            else "no recording is named: vehest identify lap*.csv -o car.yaml"
        )
    if out.exists():
        read_car(out)  # refuses to write over anything else
    options = estimate_options(overrides)
    _, shipped, _ = open_model(SELF_CALIBRATING, options.output, lambda _: None)
    model, _, remarks = adapted(shipped, None, car_of(options.dataset), options.settings)
    assert isinstance(model, SelfCalibrating)
    if options.preparation is not None:
        model.preparation = options.preparation
    drives: dict[str, dict[str, Normal]] = {}
    for file in files:
        drive = read_recording(Path(file), overrides)
        if drive.id in drives:
            raise ConfigurationError(f"two recordings are called '{drive.id}'; rename one")
        for finding in findings_of(drive, model, options.dataset.get("accept") or ()):
            complain(f"warning: {drive.id}: {describe_finding(finding)}")
        drives[drive.id] = posterior_of(
            with_settings(model, settings_for_channels(model, drive)), drive
        )
    record = record_of(model, drives)
    for remark in remarks:
        note(remark)
    with written_aside(out) as aside:
        aside.write_text(
            yaml.safe_dump(
                {"format": FORMAT, **asdict(record)}, sort_keys=False, allow_unicode=True
            ),
            encoding="utf-8",
        )
    return record


def record_table(record: CarRecord) -> TerminalTable:
    """Table of a car's record for a terminal, with a row for each parameter: value, deviation,
    unit, how much the drives excited it, on which drives it was identified, and what it means.
    """
    numbers = {name: getattr(record, name) for name in LIMITS}
    numbers |= {
        f"offset of {channel}, {drive}": number
        for drive, numbers_of_drive in record.offsets.items()
        for channel, number in numbers_of_drive.items()
    }
    car = {"wheelbase": record.wheelbase, "cg_to_rear_axle": record.cg_to_rear_axle}
    prior = prior_of(with_settings(SelfCalibrating.from_config({}), car))
    at_start = {name: prior[name].deviation for name in LIMITS}
    at_start["grip"] *= record.grip.value
    rows = [
        (
            name,
            f"{number.value:.4g}",
            f"{number.deviation:.2g}",
            UNITS.get(name, "m/s²"),
            _excitation(number.deviation, at_start[name]) if name in at_start else "",
            ", ".join(number.identified_on) or "not identified",
            MEANINGS.get(name, "mean error of the accelerometer"),
        )
        for name, number in numbers.items()
    ]
    heads = ("quantity", "value", "deviation", "unit", "seen", "identified on", "meaning")
    return TerminalTable(heads, rows)


def _excitation(deviation: float, at_start: float) -> str:
    """Text of how much the drives have excited a parameter: the share of the prior's variance that
    they removed.
    """
    return f"{100.0 * max(0.0, 1.0 - (deviation / at_start) ** 2):.0f} %"


def posterior_of(model: SelfCalibrating, recording: Recording) -> dict[str, Normal]:
    """Run the filter over a drive: the parameters at its end, grip by its logarithm, and mean
    offsets.

    Parameters
    ----------
    model : SelfCalibrating
        With the settings of the car.
    recording : Recording
        One drive without gaps in the model's channels; it is brought to the model's rate.

    Returns
    -------
    dict
        Name -> mean and deviation at the end (offsets: mean over the drive), with half of the
        difference that a yaw rate early or late by YAW_RATE_LATENESS_SECONDS makes.

    Raises
    ------
    DataError
        It is too short or has gaps.
    """
    drive = prepared_recording(model, recording)
    samples = np.column_stack([drive[name] for name in model.channels])
    if len(samples) < 2:
        raise DataError(f"recording '{recording.id}' is too short to identify anything")
    if not np.isfinite(samples).all():
        raise DataError(
            f"recording '{recording.id}' has gaps in {', '.join(model.channels)}; identify on a "
            "part without them"
        )
    turning = YAW_RATE_LATENESS_SECONDS * model.rate_hz * np.gradient(samples[:, 0])
    on_time, early, late = (
        _final_state(model, np.column_stack([samples[:, 0] + shift, samples[:, 1:]]))
        for shift in (0.0, turning, -turning)
    )
    return {
        name: Normal(*normal, (late[name][0] - early[name][0]) / 2.0)
        for name, normal in on_time.items()
    }


def _final_state(model: SelfCalibrating, samples: FloatArray) -> dict[str, tuple[float, float]]:
    """Run the filter over samples of the model's channels, (T, C): parameter -> mean and standard
    deviation at the end.
    """
    _, states, last = model.trace(samples, model.first_state(samples[0], {}))
    mean, variance = np.split(states, 2, axis=1)
    numbers = {
        name: (float(mean[-1, at]), math.sqrt(variance[-1, at])) for name, at in STATE_ROWS.items()
    }
    numbers |= {
        name: (float(mean[:, at].mean()), math.sqrt(variance[:, at].mean()))
        for name, at in OFFSETS.items()
    }
    numbers["grip"] = _grip(model, last.log_weights)
    if int(np.argmax(last.weights)) == kernel.STEADY:  # the filter fell back on the priors
        numbers |= {name: (numbers[name][0], math.inf) for name in LIMITS}
    return numbers


def prior_of(model: SelfCalibrating) -> dict[str, Normal]:
    """The numbers of `posterior_of` before any drive: the priors of a model with the settings of
    the car.
    """
    mean, deviation = model.prior
    start = model.first_state(np.zeros(len(model.channels)), {}).log_weights
    numbers = {
        name: Normal(float(mean[at]), float(deviation[at]))
        for name, at in (STATE_ROWS | OFFSETS).items()
    }
    return numbers | {"grip": Normal(*_grip(model, start))}


def _grip(model: SelfCalibrating, log_weights: FloatArray) -> tuple[float, float]:
    """Mean and standard deviation of log a_max over the filters of the bank, by their weights; the
    bank resolves half a step between its limits.
    """
    logs = np.log(model.grips)
    weights = np.exp(log_weights[: len(model.grips)] - log_weights.max())
    mean = float(weights @ logs / weights.sum())
    return mean, math.sqrt(
        weights @ (np.square(logs - mean) + np.square(np.gradient(logs) / 2.0)) / weights.sum()
    )


def record_of(model: SelfCalibrating, drives: Mapping[str, Mapping[str, Normal]]) -> CarRecord:
    """The record of a car from `posterior_of` its drives.

    Parameters
    ----------
    model : SelfCalibrating
        Gives the prior, wheelbase and centre of gravity.
    drives : mapping
        Recording -> its numbers.

    Returns
    -------
    CarRecord
        Grip in m/s², no longer by its logarithm; offsets for each drive.

    Raises
    ------
    DataError
        A number is not of a car.
    """
    prior = prior_of(model)
    combined = {
        name: together(prior[name], {drive: numbers[name] for drive, numbers in drives.items()})
        for name in LIMITS
    }
    grip = math.exp(combined["grip"].value)
    combined["grip"] = Number(
        grip, grip * combined["grip"].deviation, combined["grip"].identified_on
    )
    offsets = {
        drive: {name: together(prior[name], {drive: numbers[name]}) for name in OFFSETS}
        for drive, numbers in drives.items()
    }
    return CarRecord(model.wheelbase, model.cg_to_rear_axle, **combined, offsets=offsets)


def together(prior: Normal, drives: Mapping[str, Normal]) -> Number:
    """The prior and what each drive adds to it, weighted by information; deviations hold the yaw
    rate's lateness, which drives share.

    The deviation grows where drives contradict each other, and where they do so beyond
    `AGREEMENT_QUANTILE` none of them identifies the number.

    Parameters
    ----------
    prior : Normal
        Before any drive.
    drives : mapping
        Drive -> mean and deviation after it, the prior included. A drive whose deviation is not
        below the prior's adds nothing.

    Returns
    -------
    Number
        With the drives that identify it: those that leave less than IDENTIFIED_SHARE of the prior's
        variance.
    """
    mean, deviation, of_lateness = (
        np.array([normal for normal in drives.values() if normal.deviation < prior.deviation])
        .reshape(-1, 3)
        .T
    )
    from scipy.stats import chi2  # slow to import

    alone, of_alone = without_prior(prior, Normal(mean, deviation))
    total = prior.deviation**-2.0 + float(np.sum(of_alone**-2.0))
    shares = deviation**-2.0 / total
    value = prior.mean + float(shares @ (mean - prior.mean))
    squares = float(np.sum(np.square((alone - value) / of_alone)))
    n_degrees = max(len(alone) - 1, 1)
    scatter = squares / n_degrees if len(alone) > 1 else 1.0
    agree = len(alone) < 2 or squares < float(chi2.ppf(AGREEMENT_QUANTILE, n_degrees))
    max_deviation = math.sqrt(IDENTIFIED_SHARE) * prior.deviation
    identified = tuple(
        drive
        for drive, normal in drives.items()
        if agree and math.hypot(normal.deviation, normal.of_lateness) < max_deviation
    )
    return Number(
        value,
        math.hypot(math.sqrt(max(scatter, 1.0) / total), float(shares @ of_lateness)),
        identified,
    )


def without_prior(prior: Normal, posterior: Normal) -> tuple[Any, Any]:
    """Mean and deviation, also of arrays, that a drive adds without the prior, where its deviation
    is below the prior's.

    Information is the inverse of the variance; that of the prior is subtracted.
    """
    information = 1.0 / posterior.deviation**2 - 1.0 / prior.deviation**2
    return prior.mean + (
        posterior.mean - prior.mean
    ) / posterior.deviation**2 / information, information**-0.5
