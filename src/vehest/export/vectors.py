"""Test vectors of an export: a short drive with everything that goes wrong on a bus, and what Python makes of it."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.estimators.base import Estimator
from vehest.trust.contract import GuardedStepper

SECONDS = 12.0
COLUMNS = ("vy", "sideslip", "band_vy", "band_sideslip", "health", "reason")
UNDERSTEER = 0.002  # s²/m, of the drive's car
WHEELBASE = 2.6  # m
RADIUS = 0.3  # m


def replayed(stepper: GuardedStepper, times: FloatArray, samples: Mapping[str, FloatArray]) -> FloatArray:
    """What a stepper says after each row: `COLUMNS`, (T, 6); NaN where it says nothing.

    Args:
        stepper: in its initial state.
        times: of the rows, (T,) [s]; where one is NaN the row follows the last one without a gap.
        samples: channel -> (T,).
    """
    found = np.full((len(times), len(COLUMNS)), np.nan)
    for k, time in enumerate(times.tolist()):
        sample = {name: float(values[k]) for name, values in samples.items()}
        said = stepper.step(sample, None if math.isnan(time) else time)
        found[k] = [said.get("health_reason" if name == "reason" else name, math.nan) for name in COLUMNS]
    return found


def in_float64(estimator: Estimator) -> Estimator:
    """The same estimator with weights that compute in float64, which networks that were trained in float32 do not."""
    twin = type(estimator)(estimator.settings)
    twin.preparation = estimator.preparation
    twin.load_weights(
        {name: values.astype(np.float64) if np.issubdtype(values.dtype, np.floating) else values for name, values in estimator.weights().items()}
    )
    return twin


def drive_for(stepper: GuardedStepper) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Times (T,) [s] and samples, channel -> (T,), that a stepper is tried on: swerves at the speed that its limits allow, and faults.

    The faults: values that are NaN, infinite or beyond physics, one channel after another; a channel that stands still; an offset; rows
    that are lost for 0.03 s and for 0.7 s; a row that comes twice.
    """
    rate = stepper._rate
    steps = round(SECONDS * rate)
    times = np.arange(steps) / rate
    samples = _motion(stepper, times, rate)
    names = list(samples)
    for at, name in enumerate(names):
        first = round((3.0 + 0.3 * at / len(names)) * rate)
        samples[name][first : first + 2] = (math.nan, math.inf)
        samples[name][first + 3] = -1e30
        if name in stepper.estimator.skippable or at == 0:
            samples[name][round(4.0 * rate) : round(4.3 * rate)] = math.nan
    samples[names[0]][round(5.0 * rate) : round(5.6 * rate)] = samples[names[0]][round(5.0 * rate)]
    samples[names[-1]][round(6.5 * rate) : round(7.5 * rate)] *= 1.6
    kept = np.ones(steps, bool)
    kept[round(8.0 * rate) : round(8.03 * rate) + 1] = False
    kept[round(9.0 * rate) : round(9.7 * rate)] = False
    kept_rows = np.flatnonzero(kept)
    again = np.sort(np.append(kept_rows, round(2.0 * rate)))
    return times[again], {name: values[again] for name, values in samples.items()}


def _motion(stepper: GuardedStepper, times: FloatArray, rate: float) -> dict[str, FloatArray]:
    """Steady cornering of a car with a wheel's radius of 0.3 m, and noise that is the same on every machine."""
    top, limits = stepper._watch._settings[0], dict(zip(stepper._channels, stepper._guard._limits[:, :2].tolist(), strict=True))
    u = min(0.25 * top, 20.0) * (1.0 + 0.2 * np.sin(0.7 * times))
    steer = 0.05 * np.sin(2.0 * times) * np.sin(0.3 * times)
    yaw_rate = u * steer / (WHEELBASE + UNDERSTEER * np.square(u))
    ax = np.gradient(u, times)
    known = {"vx": u, "yaw_rate": yaw_rate, "ax": ax, "ay": u * yaw_rate, "steer": steer, "handwheel": 15.0 * steer}
    size = {"vx": 20.0, "yaw_rate": 0.5, "ax": 3.0, "ay": 5.0, "steer": 0.05, "handwheel": 0.75}
    found = {}
    for number, name in enumerate(stepper._channels):
        if name.startswith("wheel_speed") or name == "motor_speed":
            values, scale = u / RADIUS, 60.0
        elif name in known:
            values, scale = known[name], size[name]
        else:
            scale = 0.02 * min(abs(CHANNELS[name].low), abs(CHANNELS[name].high))
            values = scale * np.sin(1.3 * times + number)
        low, high = limits[name]
        found[name] = np.clip(values + 0.002 * scale * _noise(len(times), number), 0.9 * low, 0.9 * high)
    return found


def _noise(n: int, seed: int) -> FloatArray:
    """Uniform between -1 and 1, (n,), by a linear congruential generator (Numerical Recipes, 2007, Section 7.1)."""
    state, found = (1664525 * seed + 1013904223) % 2**32, np.empty(n)
    for k in range(n):
        state = (1664525 * state + 1013904223) % 2**32
        found[k] = state / 2**31 - 1.0
    return found


def table_text(columns: Sequence[str], rows: FloatArray) -> str:
    """A table as CSV, every number so that it reads back to the same."""
    out = io.StringIO()
    out.write(",".join(columns) + "\n")
    for row in rows.tolist():
        out.write(",".join("nan" if math.isnan(value) else f"{value:.17g}" for value in row) + "\n")
    return out.getvalue()
