"""Test vectors of an export.

A short drive with everything that goes wrong on a bus, and what Python makes of it.

    limits of the guard, sizes in training --drive_for--> times, samples with faults
    --replayed: `GuardedStepper.step` row by row--> expected outputs

The drive depends on the model's limits and on no random number generator of a library, so that it
is the same on every machine.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.estimators.base import Estimator
from vehest.export.program import health_table
from vehest.trust.contract import GuardedStepper

DRIVE_SECONDS = 12.0  # s, length of the drive that test vectors are made of
# names of the outputs, columns of the expected values
COLUMNS = ("vy", "sideslip", "band_vy", "band_sideslip", "health", "reason")
RADIUS = 0.3  # m, radius of a wheel where nothing was fitted


def replayed(
    stepper: GuardedStepper, times: FloatArray, samples: Mapping[str, FloatArray]
) -> FloatArray:
    """Outputs of a stepper after each row: `COLUMNS`, (T, 6); NaN where there is none.

    Parameters
    ----------
    stepper : GuardedStepper
        In its initial state.
    times : array
        Of the rows, (T,) [s]; where one is NaN the row follows the last one without a gap.
    samples : mapping
        Channel -> (T,).
    """
    outputs = np.full((len(times), len(COLUMNS)), np.nan)
    for k, time in enumerate(times.tolist()):
        sample = {name: float(values[k]) for name, values in samples.items()}
        output = stepper.step(sample, None if math.isnan(time) else time)
        outputs[k] = [
            output.get("health_reason" if name == "reason" else name, math.nan) for name in COLUMNS
        ]
    return outputs


def in_float64(estimator: Estimator) -> Estimator:
    """The estimator with weights in float64, also where it was trained in float32.

    The expected outputs are then as exact as C in double.
    """
    twin = type(estimator)(estimator.settings)
    twin.preparation = estimator.preparation
    twin.load_weights(
        {
            name: values.astype(np.float64) if np.issubdtype(values.dtype, np.floating) else values
            for name, values in estimator.weights().items()
        }
    )
    return twin


def drive_for(stepper: GuardedStepper) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Times (T,) [s] and samples, channel -> (T,), that a stepper is tried on.

    The drive has swerves at the speed that its limits allow. Its faults are values that are NaN,
    infinite or beyond physics, one channel after another; a channel that stands still; an offset;
    rows that are lost for 0.03 s and for 0.7 s; a row that comes twice.
    """
    rate = stepper.input_rate_hz
    steps = round(DRIVE_SECONDS * rate)
    times = np.arange(steps) / rate
    samples = _motion(stepper, times)
    names = list(samples)
    for at, name in enumerate(names):
        first = round((3.0 + 0.3 * at / len(names)) * rate)
        samples[name][first : first + 2] = (math.nan, math.inf)
        samples[name][first + 3] = -1e30
        if name in stepper.estimator.skippable or at == 0:
            samples[name][round(4.0 * rate) : round(4.3 * rate)] = math.nan
    if stepper.front_end is None or not len(stepper.front_end.sections):
        # behind a low-pass it stands still once digits run out: sooner in float
        first = round(5.0 * rate)
        samples[names[0]][first : round(5.6 * rate)] = samples[names[0]][first]
    samples[names[-1]][round(6.5 * rate) : round(7.5 * rate)] *= 1.6
    is_received = np.ones(steps, bool)
    is_received[round(8.0 * rate) : round(8.03 * rate) + 1] = False
    is_received[round(9.0 * rate) : round(9.7 * rate)] = False
    received_rows = np.flatnonzero(is_received)
    rows = np.sort(np.append(received_rows, round(2.0 * rate)))
    return times[rows], {name: values[rows] for name, values in samples.items()}


def _motion(stepper: GuardedStepper, times: FloatArray) -> dict[str, FloatArray]:
    """Channels of a drive of swerves at a varying speed, (T,) each, with noise that is the same on
    every machine.

    They are as large as 0.3 of the largest values in training.
    """
    names = list(stepper.channels)
    limits = stepper.guard.limits[:, :2]
    sizes, usual = _sizes(stepper)
    speed = 1.0 + 0.2 * np.sin(0.7 * times)
    swerve = np.sin(2.0 * times) * np.sin(0.3 * times)
    motion = {}
    for number, name in enumerate(names):
        size = sizes[name]
        if name in ("vx", "motor_speed") or name.startswith("wheel_speed"):
            values = usual[name] * speed
        elif name == "ax" and "vx" in names:
            values = np.gradient(usual["vx"] * speed, times)
        elif name == "ay" and {"vx", "yaw_rate"} <= set(names):
            values = usual["vx"] * speed * 0.3 * sizes["yaw_rate"] * swerve
        elif name in ("yaw_rate", "ay", "steer", "handwheel", "roll_rate"):
            values = 0.3 * size * swerve
        else:
            values = usual[name] + 0.05 * size * np.sin(1.3 * times + number)
        low, high = limits[number]
        motion[name] = np.clip(
            values + 0.002 * size * _noise(len(times), number), 0.9 * low, 0.9 * high
        )
    return motion


def _sizes(stepper: GuardedStepper) -> tuple[dict[str, float], dict[str, float]]:
    """Largest and usual magnitudes of channels in training, each by name.

    Round ones of a passenger car where nothing was fitted.
    """
    names = stepper.channels
    table = health_table(stepper.monitor.packed_health)
    if table is not None:
        return dict(zip(names, table["largest"].tolist(), strict=True)), dict(
            zip(names, table["usual"].tolist(), strict=True)
        )
    car_sizes = {"vx": 20.0, "yaw_rate": 0.5, "ax": 3.0, "ay": 8.0, "steer": 0.1, "handwheel": 1.5}
    sizes = {
        name: car_sizes.get(name, 0.02 * min(abs(CHANNELS[name].low), abs(CHANNELS[name].high)))
        for name in names
    }
    speeds = {
        name: car_sizes["vx"] / RADIUS
        for name in names
        if name == "motor_speed" or name.startswith("wheel_speed")
    }
    return {**sizes, **speeds}, {
        name: speeds.get(name, car_sizes["vx"] if name == "vx" else 0.0) for name in names
    }


def _noise(n: int, seed: int) -> FloatArray:
    """Noise, uniform between -1 and 1, (n,), by a linear congruential generator.

    Source: Numerical Recipes, 2007, Section 7.1.
    """
    state = (1664525 * seed + 1013904223) % 2**32
    noise = np.empty(n)
    for k in range(n):
        state = (1664525 * state + 1013904223) % 2**32
        noise[k] = state / 2**31 - 1.0
    return noise


def table_text(columns: Sequence[str], rows: FloatArray) -> str:
    """A table as CSV, every number so that it reads back to the same.

    Parameters
    ----------
    columns : sequence of str
        Header.
    rows : array
        (T, C); NaN becomes ``nan``.
    """
    out = io.StringIO()
    np.savetxt(out, rows, fmt="%.17g", delimiter=",", header=",".join(columns), comments="")
    return out.getvalue()
