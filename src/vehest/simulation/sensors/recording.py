"""Channels that the simulated sensors show of a true motion, and how provenance describes the
sensors.

true motion -> tilt, mounting and vibration of the inertial unit -> errors of each sensor
(errors.py), as large as levels.py has them
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.data.derived import derivative
from vehest.simulation.plant.motion import WHEELS, Motion
from vehest.simulation.sensors.errors import sensor_signal, stream
from vehest.simulation.sensors.levels import Reference, SensorLevels, Tilt, Vibration

OF_MOTOR = ("motor_speed", "motor_current")  # channels of an electric motor


def measure(motion: Motion, levels: SensorLevels, seed: int) -> dict[str, FloatArray]:
    """Channels (canonical name -> (T,), SI units) that the sensors show of a motion; the same
    arguments give the same samples.

    Parameters
    ----------
    motion : Motion
        True motion of the centre of gravity, (T,).
    levels : SensorLevels
        Sizes of the errors.
    seed : int
        Of the errors; each error of each sensor draws from a stream of its own, so that changing
        one level leaves the rest alone.

    Returns
    -------
    dict
        Channels of speed, steering, inertial unit, wheels, motor (where there is one) and
        reference.
    """
    speed = _speed_of_wheels(motion) if levels.speed_of_wheels else motion.vx
    true = {"vx": speed, "steer": motion.steer, **_inertial(motion, levels, seed)}
    wheels = {
        "wheel_speed": motion.wheel_speed,
        "fx": motion.tyre_fx,
        "fy": motion.tyre_fy,
        "fz": motion.tyre_fz,
    }
    true_signals = [(name, name, values) for name, values in true.items()]
    true_signals += [
        (f"{sensor}_{wheel}", sensor, wheel_values)
        for sensor, values in wheels.items()
        for wheel, wheel_values in zip(WHEELS, values.T, strict=True)
    ]
    true_signals += [
        (name, name, values) for name in OF_MOTOR if (values := getattr(motion, name)) is not None
    ]
    channels = {
        name: sensor_signal(values, getattr(levels, sensor), motion.rate_hz, seed, name)
        for name, sensor, values in true_signals
    }
    return channels | _reference(motion, levels.reference, seed)


def described(levels: SensorLevels, motion: Motion) -> dict[str, Any]:
    """Errors of the sensors that measured a motion, for provenance.

    Sensors of the motor are left out where the car has none, and the vibration where there is none.

    Parameters
    ----------
    levels : SensorLevels
        Levels that were used.
    motion : Motion
        What was measured; it shows whether the car has a motor.

    Returns
    -------
    dict
        Sensor -> error -> size; gains, biases and roll shares that have no effect are left out.
    """
    idle_names = {name for name in OF_MOTOR if getattr(motion, name) is None}
    if levels.vibration == Vibration():
        idle_names.add("vibration")
    if not levels.speed_of_wheels:
        idle_names.add("speed_of_wheels")
    return {
        name: _without_idle(value)
        for name, value in asdict(levels).items()
        if name not in idle_names
    }


_IDLE = {"gain": 0.0, "bias": 0.0, "roll_share": 1.0}  # values without effect, left out


def _without_idle(value: Any) -> Any:
    """A mapping, and those inside it, without entries that have a value of `_IDLE`."""
    if not isinstance(value, dict):
        return value
    return {
        name: _without_idle(inner)
        for name, inner in value.items()
        if name not in _IDLE or inner != _IDLE[name]
    }


def _speed_of_wheels(motion: Motion) -> FloatArray:
    """Mean speed of the front wheels times the radius that fits where the car goes straight [m/s],
    (T,).
    """
    turning = motion.wheel_speed[:, :2].mean(axis=1)
    straight = np.abs(motion.steer) <= np.quantile(np.abs(motion.steer), 0.3)
    rolling = float(np.dot(turning[straight], turning[straight]))
    radius = (
        float(np.dot(motion.vx[straight], turning[straight])) / rolling if rolling > 0.0 else 0.0
    )
    return turning * radius


def specific_force(motion: Motion, tilt: Tilt) -> FloatArray:
    """Specific force at the centre of gravity in the axes of the tilted body, forward, left and up
    [m/s²], (3, T).

    The road's axes follow from level ones by grade, then bank, the body's from the road's by pitch,
    then roll. Accelerations of the body along its vertical axis are left out.

    Parameters
    ----------
    motion : Motion
        Accelerations in level axes that yaw with the car, and the angles of road and body.
    tilt : Tilt
        Which of the angles act.
    """
    grade = motion.grade * tilt.grade
    bank = motion.bank * tilt.bank
    road = np.stack(
        [
            motion.ax - GRAVITY * np.sin(grade),
            motion.ay + GRAVITY * np.cos(grade) * np.sin(bank),
            GRAVITY * np.cos(grade) * np.cos(bank),
        ]
    )
    return _turned(road, motion.roll * (tilt.roll * tilt.roll_share), motion.pitch * tilt.pitch)


def body_rates(motion: Motion, tilt: Tilt) -> FloatArray:
    """Angular velocity about the body's forward, left and upward axes [rad/s], (3, T).

    ``motion`` has the rates of roll, pitch and yaw angle. In a steady turn a rolled body also turns
    about its own lateral axis.

    Parameters
    ----------
    motion : Motion
        Angles and their rates.
    tilt : Tilt
        Whether roll and pitch turn the axes; bank and grade are left out.
    """
    roll = motion.roll * tilt.roll
    pitch = motion.pitch * tilt.pitch
    sin_roll = np.sin(roll)
    cos_roll = np.cos(roll)
    sin_pitch = np.sin(pitch)
    cos_pitch = np.cos(pitch)
    return np.stack(
        [
            motion.roll_rate - motion.yaw_rate * sin_pitch,
            motion.pitch_rate * cos_roll + motion.yaw_rate * cos_pitch * sin_roll,
            motion.yaw_rate * cos_pitch * cos_roll - motion.pitch_rate * sin_roll,
        ]
    )


def _inertial(motion: Motion, levels: SensorLevels, seed: int) -> dict[str, FloatArray]:
    """True angular velocities and specific forces where the inertial unit sits, along its axes."""
    mounting = levels.imu
    rates = body_rates(motion, levels.tilt)
    force = specific_force(motion, levels.tilt)
    lever = np.array([[mounting.lever_x], [mounting.lever_y], [mounting.lever_z]])
    if lever.any():  # dω/dt × l + ω × (ω × l), as of a rigid body
        angular = np.stack([derivative(rate, motion.rate_hz) for rate in rates])
        force = force + (
            np.cross(angular, lever, axis=0)
            + np.cross(rates, np.cross(rates, lever, axis=0), axis=0)
        )
    angles = np.array([mounting.roll, mounting.pitch, mounting.yaw])
    if mounting.misalignment:
        errors = stream(seed, "imu.misalignment").standard_normal(3)
        angles = angles + mounting.misalignment * errors
    roll_rate, pitch_rate, yaw_rate = _turned(rates, *angles)
    ax, ay, _ = _turned(force, *angles)
    true_signals = {
        "yaw_rate": yaw_rate,
        "roll_rate": roll_rate,
        "pitch_rate": pitch_rate,
        "ax": ax,
        "ay": ay,
    }
    for name, by_speed in vars(levels.vibration).items():
        if by_speed:
            shaking = stream(seed, f"vibration.{name}").standard_normal(len(motion))
            size = by_speed * np.abs(motion.wheel_speed.mean(axis=1))
            true_signals[name] = true_signals[name] + size * shaking
    return true_signals


def _turned(
    vector: FloatArray,
    roll: FloatArray | float,
    pitch: FloatArray | float,
    yaw: FloatArray | float = 0.0,
) -> FloatArray:
    """A vector (3, T) along axes that are turned by yaw, then pitch, then roll; the angles are
    numbers or (T,).
    """
    x, y, z = vector
    x, y = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
    x, z = x * np.cos(pitch) - z * np.sin(pitch), z * np.cos(pitch) + x * np.sin(pitch)
    y, z = y * np.cos(roll) + z * np.sin(roll), z * np.cos(roll) - y * np.sin(roll)
    return np.stack([x, y, z])


def _reference(motion: Motion, reference: Reference, seed: int) -> dict[str, FloatArray]:
    """Reference channels: velocity where the sensor sits, in its axes, moved to the centre of
    gravity.
    """
    rate_hz = motion.rate_hz
    forward = (
        motion.vx - motion.yaw_rate * reference.lever_y + motion.pitch_rate * reference.lever_z
    )
    left = motion.vy + motion.yaw_rate * reference.lever_x - motion.roll_rate * reference.lever_z
    heading = sensor_signal(np.zeros(len(motion)), reference.heading, rate_hz, seed, "heading_ref")
    cosine = np.cos(heading)
    sine = np.sin(heading)
    true = {
        "yaw_rate": motion.yaw_rate,
        "vx": forward * cosine + left * sine,
        "vy": left * cosine - forward * sine,
    }
    yaw_rate, forward_signal, left_signal = (
        sensor_signal(values, getattr(reference, name), rate_hz, seed, f"{name}_ref")
        for name, values in true.items()
    )
    lever = np.array([reference.lever_x, reference.lever_y])
    if reference.lever_error:
        errors = stream(seed, "reference.lever_error").standard_normal(2)
        lever = lever + reference.lever_error * errors
    vx = forward_signal + yaw_rate * lever[1]
    vy = left_signal - yaw_rate * lever[0]
    return {
        "vx_ref": vx,
        "vy_ref": vy,
        "yaw_rate_ref": yaw_rate,
        "sideslip_ref": np.arctan2(vy, vx),
    }
