"""Simple sensors: white noise and a constant offset on the true motion; gravity in the accelerometers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from vehest.data.errors import ConfigurationError
from vehest.simulation.motion import Motion

FloatArray = NDArray[np.float64]

GRAVITY = 9.81
"""[m/s²], the plant's value."""

WHEELS = ("fl", "fr", "rl", "rr")


@dataclass(frozen=True)
class SensorLevel:
    """Standard deviations of one sensor, in its channel's unit.

    Args:
        noise: of the white noise of each sample.
        offset: of the constant offset that a drive's sensor has.

    Raises:
        ConfigurationError: one of them is negative or not finite.
    """

    noise: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("noise", self.noise), ("offset", self.offset)):
            if not (math.isfinite(value) and value >= 0.0):
                raise ConfigurationError(f"sensor {name} must be zero or positive, not {value}")


@dataclass(frozen=True)
class SensorLevels:
    """Noise and offset of each sensor, and whether roll and pitch let gravity into the accelerometers.

    ``SensorLevels(ay=SensorLevel())`` switches one sensor's errors off, ``ideal_sensors()`` all of them.

    Args:
        yaw_rate: noise 0.0017 rad/s is the 0.014 °/s/√Hz of Bosch's BMG160 (CISS manual) over 50 Hz; offset assumed.
        ax, ay: assumed; four times the 120 µg/√Hz of Bosch's BMA280 (CISS manual) over 50 Hz, for body vibration.
        vx: assumed.
        steer: assumed; a tenth of a degree.
        wheel_speed: assumed.
        vx_ref, vy_ref: assumed, of the order of a GNSS-aided inertial reference; sideslip_ref follows from them.
        gravity_leak: the accelerometers are fixed to the rolling and pitching body, not held level.
    """

    yaw_rate: SensorLevel = SensorLevel(0.0017, 0.0020)
    ax: SensorLevel = SensorLevel(0.035, 0.03)
    ay: SensorLevel = SensorLevel(0.035, 0.03)
    vx: SensorLevel = SensorLevel(0.05, 0.02)
    steer: SensorLevel = SensorLevel(0.0005, 0.0017)
    wheel_speed: SensorLevel = SensorLevel(0.05)
    vx_ref: SensorLevel = SensorLevel(0.015)
    vy_ref: SensorLevel = SensorLevel(0.015, 0.01)
    gravity_leak: bool = True


def ideal_sensors() -> SensorLevels:
    """Sensors without noise, offset and gravity: they show the true motion in the level body's axes."""
    silent = {entry.name: SensorLevel() for entry in fields(SensorLevels) if entry.name != "gravity_leak"}
    return SensorLevels(**silent, gravity_leak=False)


def measure(motion: Motion, levels: SensorLevels, seed: int) -> dict[str, FloatArray]:
    """Channels (canonical name -> (T,), SI units) that the sensors show of a motion.

    Every channel draws from a stream of its own, so that changing one level leaves the other channels as they were.
    """
    ax, ay = specific_force(motion) if levels.gravity_leak else (motion.ax, motion.ay)
    shown = {"vx": motion.vx, "yaw_rate": motion.yaw_rate, "ax": ax, "ay": ay, "steer": motion.steer}
    level_of = {name: getattr(levels, name) for name in shown}
    for wheel in WHEELS:
        shown[f"wheel_speed_{wheel}"] = getattr(motion, f"wheel_speed_{wheel}")
        level_of[f"wheel_speed_{wheel}"] = levels.wheel_speed
    shown |= {"vx_ref": motion.vx, "vy_ref": motion.vy}
    level_of |= {"vx_ref": levels.vx_ref, "vy_ref": levels.vy_ref}

    channels = {name: true + _error(level_of[name], len(motion), seed, stream) for stream, (name, true) in enumerate(shown.items())}
    channels["sideslip_ref"] = np.arctan2(channels["vy_ref"], channels["vx_ref"])
    return channels


def specific_force(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Longitudinal and lateral specific force in the axes of the rolled and pitched body [m/s²], each (T,).

    The body's axes follow from the level ones by pitch, then roll; vertical acceleration of the body is left out.
    """
    sin_roll, cos_roll = np.sin(motion.roll), np.cos(motion.roll)
    sin_pitch, cos_pitch = np.sin(motion.pitch), np.cos(motion.pitch)
    longitudinal = motion.ax * cos_pitch - GRAVITY * sin_pitch
    lateral = motion.ay * cos_roll + (motion.ax * sin_pitch + GRAVITY * cos_pitch) * sin_roll
    return longitudinal, lateral


def _error(level: SensorLevel, n_samples: int, seed: int, stream: int) -> FloatArray:
    generator = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(1, stream)))
    offset = level.offset * generator.standard_normal()
    return offset + level.noise * generator.standard_normal(n_samples)
