"""Fit of a filter on rational tyres: axle curves by least squares, noise levels by a search.

    recordings --fit_axle_curves--> curves and the covariance of their logarithms
    recordings, filter --`LevelSearch`--> noise levels

Axle curves are fitted to the reference sideslip (`tyre_fit`). Noise levels are those with the
smallest error of sideslip. The levels of ay and steer are searched as ratios to the level of the
yaw rate; that level follows from the innovations, which are scaled to be as large as the filter
expects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Literal, NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.estimators.filtering.rational_model import CURVES
from vehest.estimators.filtering.sideslip_filter import FilteredStates
from vehest.estimators.filtering.tyre_fit import (
    NORMAL_95,
    AxleMotion,
    TyreFit,
    axle_motion,
    fit_motion,
)
from vehest.training.context import FitContext
from vehest.training.noise_tuning import NoiseTuningSettings
from vehest.training.search import SearchRecord
from vehest.vehicle.parameters import SingleTrackParameters

# Standard deviation of axle forces from accelerations, relative: scale of the accelerometer and
# body roll.
FORCE_SCALE_DEVIATION = 0.05
# Standard deviation of slip angles from the reference [rad]: mounting of the reference sensor.
SLIP_OFFSET_DEVIATION = math.radians(0.15)
# Powers of ten that are searched: levels of ay and steer over that of the yaw rate, and that of
# tyres.
BOXES = {"ay": (-1.0, 5.0), "steer": (-4.0, 4.0), "tyres": (-8.0, 1.0)}
# Powers of ten from which searches start.
STARTS = {"ay": (1.5, 2.0), "steer": (0.0, 1.5), "tyres": (-3.5, -2.0)}
# largest distance from a limit at which a search ended on it, over the width of the box
LIMIT_MARGIN = 0.01
START_YAW_RATE_LEVEL = 0.01  # rad/s, level of the yaw rate before it is scaled
N_CALIBRATIONS = 2  # number of times that the level of the yaw rate is scaled

Drive = tuple[FloatArray, FloatArray]
"""Samples (T, 4) of a filter's channels, and the reference sideslip [rad], (T,)."""


class CurveFit(NamedTuple):
    """Fitted force curves of both axles."""

    curves: FloatArray  # parameters, (4,), in the order of `CURVES`; c₁ = ∞ where tyres are linear
    covariance: FloatArray  # covariance of the logarithms of the parameters, (4, 4)
    metrics: dict[str, float]  # curves, halves of their 95 % intervals, rms of residual forces [N]


def fit_axle_curves(
    recordings: Sequence[Recording],
    car: SingleTrackParameters,
    minimum_speed: float,
    kind: Literal["linear", "rational"],
    deviation: float,
) -> CurveFit:
    """Fit axle curves to the reference sideslip of recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        With a reference of sideslip, see `axle_motion`.
    car : SingleTrackParameters
        Mass, inertia and places of the axles.
    minimum_speed : float
        Slower samples do not count [m/s].
    kind : str
        ``linear`` (c₂ alone) or ``rational``.
    deviation : float
        Standard deviation of the logarithms that is added to that of the fit.

    Raises
    ------
    DataError
        A channel is missing, hardly any samples are left, or forces run against slip angles.
    """
    motion = axle_motion(recordings, car, minimum_speed)
    fit = fit_motion(motion, kind)
    rows = [1, 3] if kind == "linear" else [0, 1, 2, 3]
    curves = np.full(len(CURVES), math.inf)
    curves[rows] = [*fit.front, *fit.rear]
    covariance = np.zeros((len(CURVES), len(CURVES)))
    for axle, block in enumerate(_covariances_of_logarithms(motion, kind, fit)):
        axle_rows = rows[axle * len(block) : (axle + 1) * len(block)]
        covariance[np.ix_(axle_rows, axle_rows)] = block
    half = NORMAL_95 * curves[rows] * np.sqrt(np.diagonal(covariance)[rows])
    metrics = {CURVES[row]: float(curves[row]) for row in rows}
    metrics |= {
        f"{CURVES[row]}_interval": float(width) for row, width in zip(rows, half, strict=True)
    }
    metrics |= dict(
        zip(("residual_front", "residual_rear"), fit.residual_rms.tolist(), strict=True)
    )
    covariance[np.ix_(rows, rows)] += deviation**2 * np.eye(len(rows))
    return CurveFit(curves, covariance, metrics)


def _covariances_of_logarithms(
    motion: AxleMotion, kind: Literal["linear", "rational"], fit: TyreFit
) -> list[FloatArray]:
    """Covariance of the logarithms of each axle's parameters, one matrix an axle.

    It has three parts: that of least squares, a common scale of all forces, and an offset of all
    slip angles, whose effect is the difference to a fit to shifted angles.
    """
    shifted = fit_motion(replace(motion, slip=motion.slip + SLIP_OFFSET_DEVIATION), kind)
    covariances = []
    for parameters, shifted_parameters, covariance in zip(
        (fit.front, fit.rear), (shifted.front, shifted.rear), fit.covariance, strict=True
    ):
        offset = np.log(shifted_parameters / parameters)
        scale = np.eye(len(parameters))[-1] * FORCE_SCALE_DEVIATION
        covariances.append(
            covariance / np.outer(parameters, parameters)
            + np.outer(offset, offset)
            + np.outer(scale, scale)
        )
    return covariances


def searched_levels(unknown: Sequence[str]) -> tuple[str, ...]:
    """Those of the ``unknown`` noise levels that are searched: all but that of the yaw rate, which
    is calibrated.
    """
    return tuple(name for name in unknown if name != "yaw_rate")


@dataclass(frozen=True)
class LevelSearch:
    """Search for the noise levels with the smallest error of sideslip on drives."""

    names: tuple[str, ...]  # searched levels
    levels: Mapping[str, float]  # levels by name, `LEVELS`; NaN where they are not given
    tyre_level: float  # drift of tyre parameters where it is not searched [1/√s]
    # filters samples (T, 4) with given noise levels
    filter_samples: Callable[[FloatArray, Mapping[str, float]], FilteredStates]
    drives: Sequence[Drive]  # training drives, on which the error is measured
    minimum_speed: float  # slower samples do not count [m/s]
    skip: int  # first samples of a drive that do not count

    def run(self, training: NoiseTuningSettings, seed: int, context: FitContext) -> SearchRecord:
        """Search the powers of ten of the levels ``names``, (K,), within `BOXES`."""

        def cost(powers: FloatArray) -> float:
            levels = self.levels_at(powers)
            return mean_squared_error(
                self.filter_samples, self.drives, levels, self.minimum_speed, self.skip
            )

        boxes, starts = ([limits[name] for name in self.names] for limits in (BOXES, STARTS))
        return training.search(cost, boxes, starts, seed, context)

    def n_at_limits(self, powers: FloatArray) -> int:
        """Number of levels that lie at a limit of the search, at powers of ten (K,)."""
        boxes = np.array([BOXES[name] for name in self.names])
        distance = np.minimum(powers - boxes[:, 0], boxes[:, 1] - powers)
        return int((distance < LIMIT_MARGIN * np.ptp(boxes, axis=1)).sum())

    def levels_at(self, powers: FloatArray) -> dict[str, float]:
        """Levels by name, at powers of ten of the searched ones.

        Sensors' levels are scaled until the normalised innovations squared are 1 on average.
        """
        searched = dict(zip(self.names, (10.0**powers).tolist(), strict=True))
        tyres = searched.get("tyres", self.tyre_level)
        if "ay" not in searched:
            return {**self.levels, "tyres": tyres}

        def scaled(scale: float) -> dict[str, float]:
            return {
                "yaw_rate": scale,
                "ay": scale * searched["ay"],
                "steer": scale * searched["steer"],
                "tyres": tyres,
            }

        scale = START_YAW_RATE_LEVEL
        for _ in range(N_CALIBRATIONS):
            levels = scaled(scale)
            total = 0.0
            count = 0.0
            for samples, _ in self.drives:
                nis, n_measured = self.filter_samples(samples, levels).nis()
                total = total + float(nis.sum())
                count = count + float(n_measured.sum())
            if not (math.isfinite(total) and total > 0.0):
                break
            scale *= math.sqrt(total / max(count, 1.0))
        return scaled(scale)


def mean_squared_error(
    filter_samples: Callable[[FloatArray, Mapping[str, float]], FilteredStates],
    drives: Sequence[Drive],
    levels: Mapping[str, float],
    minimum_speed: float,
    skip: int,
) -> float:
    """Mean squared error of sideslip [rad²] over samples at ``minimum_speed`` [m/s] or more.

    The first ``skip`` samples of each drive do not count.

    Parameters
    ----------
    filter_samples : callable
        Filter of samples (T, 4) by levels.
    drives : sequence
        Samples, with the speed as the second column, and reference (T,); NaN in it does not count.
    levels : mapping
        Noise levels by name.

    Returns
    -------
    float
        [rad²]; 0 where no sample counts.
    """
    total = 0.0
    count = 0
    for samples, reference in drives:
        error = (filter_samples(samples, levels).mean[:, 0] - reference)[skip:]
        is_counted = (samples[skip:, 1] >= minimum_speed) & np.isfinite(reference[skip:])
        total = total + float(np.square(error[is_counted]).sum())
        count = count + int(is_counted.sum())
    return total / max(count, 1)


def drives_of(recordings: Sequence[Recording], channels: Sequence[str]) -> list[Drive]:
    """Samples of channels, (T, C), and reference sideslip [rad], (T,), of each recording, by which
    the filter's noise levels are searched.

    Raises
    ------
    DataError
        A recording has neither ``sideslip_ref`` nor ``vy_ref``.
    """
    return [(recording.stack(channels), _reference_sideslip(recording)) for recording in recordings]


def _reference_sideslip(recording: Recording) -> FloatArray:
    """Reference sideslip of a recording [rad], (T,): ``sideslip_ref``, else by ``vy_ref``."""
    if "sideslip_ref" not in recording and "vy_ref" not in recording:
        raise DataError(
            f"recording '{recording.id}' has neither sideslip_ref nor vy_ref to tune noise levels "
            "on; set training.method=data"
        )
    return (
        recording["sideslip_ref"]
        if "sideslip_ref" in recording
        else np.arctan2(recording["vy_ref"], recording["vx"])
    )


def recordings_for_curves(recordings: Sequence[Recording], pattern: str) -> list[Recording]:
    """Recordings whose id matches a pattern; raises `ConfigurationError`: none does."""
    matching = [recording for recording in recordings if fnmatchcase(recording.id, pattern)]
    if not matching:
        ids = ", ".join(sorted({recording.id for recording in recordings}))
        raise ConfigurationError(
            f"training.curves_from '{pattern}' matches no training recording ({ids})"
        )
    return matching
