"""Identification of a filter on Dugoff's tyres.

Tyres, levels of sensors, and process noise, in this order.

    recordings for tyres --identify_tyres--> tyres of both axles
    training recordings --read_sensor_levels--> standard deviations of sensors
    filter, training recordings --search_levels--> process noise, force factor

Source: Bertipaglia et al. 2024, Section III-B.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.filtering.dugoff_filter import WHEEL_FORCES, Curve, DugoffFilter
from vehest.estimators.filtering.dugoff_fit import DugoffFit, fit_dugoff
from vehest.filters.noise_levels import quiet_level
from vehest.training.context import FitContext
from vehest.training.noise_tuning import MIN_PROCESS_YAW_RATE, IdentificationSettings
from vehest.training.search import SearchRecord
from vehest.vehicle.dugoff import LoadedCar

# Powers of ten that are searched; that of process_yaw_rate is a setting.
BOXES = {"process_vy": (-5.0, 0.0), "force_factor": (0.0, 2.0)}
# Powers of ten from which searches start.
STARTS = {"process_vy": (-4.0, -2.0), "process_yaw_rate": (-4.0, -2.0), "force_factor": (0.3, 1.0)}
# Length of the segments, those in which the steering angle deviates least from a straight line over
# time, by which levels of sensors are read [s].
QUIET_SECONDS = 0.5


def identify_tyres(
    recordings: Sequence[Recording],
    car: LoadedCar,
    curve: Curve,
    training: IdentificationSettings,
    *,
    minimum_speed: float,
    has_forces: bool,
    seed: int,
) -> DugoffFit:
    """Fit the tyres to those recordings whose ids match ``training.tyres_from``.

    Parameters
    ----------
    minimum_speed : float
        Slower samples do not count [m/s].
    has_forces : bool
        Whether tyre forces are measured; otherwise they follow from accelerations.

    Returns
    -------
    DugoffFit
        Parameters (2, 3) of `DugoffAxle`, of the front, then of the rear axle.

    Raises
    ------
    DataError
        No recording matches.
    """
    matching = [
        recording for recording in recordings if fnmatch.fnmatch(recording.id, training.tyres_from)
    ]
    if not matching:
        raise DataError(
            f"no training recording is called '{training.tyres_from}', which tyres are to be "
            "identified on; set tyres_from in the identification's settings to another pattern "
            "('*' for all), or give estimator.tyres"
        )
    return fit_dugoff(
        matching,
        car,
        curve,
        minimum_speed=minimum_speed,
        measured_forces=has_forces,
        seed=seed,
        restarts=training.restarts,
        generations=training.generations,
    )


def read_sensor_levels(
    recordings: Sequence[Recording], names: Sequence[str], minimum_speed: float, rate_hz: float
) -> dict[str, float]:
    """Standard deviations of sensors where the steering angle deviates least from a straight line.

    Samples below ``minimum_speed`` [m/s] do not count. Raises `DataError`: a channel has too many
    gaps, or no noise.
    """
    piece_samples = max(3, round(QUIET_SECONDS * rate_hz))
    levels = {}
    for name in names:
        series = [
            np.where(
                recording["vx"] < minimum_speed,
                np.nan,
                recording.stack(WHEEL_FORCES.get(name, (name,))).sum(1),
            )
            for recording in recordings
        ]
        try:
            levels[name] = quiet_level(
                series, [recording["steer"] for recording in recordings], piece_samples
            )
        except ValueError as error:
            raise DataError(
                f"noise of '{name}' in the training recordings: {error}; give "
                f"estimator.noise.{name}"
            ) from None
        if not levels[name] > 0.0:
            raise DataError(
                f"channel '{name}' of the training recordings has no noise that could be read off "
                "it; give estimator.noise"
            )
    return levels


def search_levels(
    estimator: DugoffFilter,
    names: Sequence[str],
    recordings: Sequence[Recording],
    training: IdentificationSettings,
    seed: int,
    context: FitContext,
) -> SearchRecord:
    """Search the noise levels with the smallest error of sideslip; the result has them as powers of
    ten, (K,).

    Parameters
    ----------
    estimator : DugoffFilter
        With tyres and sensor levels; it is not changed.
    names : sequence of str
        Levels that are searched, of `BOXES` and ``process_yaw_rate``.
    recordings : sequence of Recording
        Training recordings with ``vy_ref``.
    training : IdentificationSettings
        Method, limits, and how errors are combined.
    seed : int
        Of Optuna's sampler.
    context : FitContext
        Progress and the wish to stop.

    Raises
    ------
    DataError
        A recording has no ``vy_ref``.
    """
    for recording in recordings:
        if "vy_ref" not in recording:
            raise DataError(
                f"recording '{recording.id}' has no vy_ref to tune noise levels on; set "
                "method=data in the identification's settings"
            )

    def cost(powers: FloatArray) -> float:
        """Error of sideslip [rad²] with levels at these powers of ten, (K,)."""
        levels = estimator.levels | dict(zip(names, (10.0**powers).tolist(), strict=True))
        return estimator.mean_squared_error(
            recordings, training.skip_seconds, levels, training.error, limit=training.error_limit
        )

    limits = BOXES | {
        "process_yaw_rate": (
            math.log10(MIN_PROCESS_YAW_RATE),
            math.log10(training.most_process_yaw_rate),
        )
    }
    return training.search(
        cost, [limits[name] for name in names], [STARTS[name] for name in names], seed, context
    )
