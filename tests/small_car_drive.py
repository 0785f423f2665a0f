"""Drives of a small car that slides, with the channels of the F1TENTH recordings."""

import math
from functools import cache

import numpy as np

from vehest.data.recording import Recording

RATE = 100.0
WHEEL_RADIUS = 0.05
MASS = 5.1
TO_FRONT = 0.175
TO_REAR = 0.155
INERTIA = 0.15
NOISE = {"ax": 0.4, "ay": 0.4, "yaw_rate": 0.02, "motor_speed": 0.4}


@cache
def small_car_drive(seconds=4.0, seed=0):
    """Swerves at 2 to 4 m/s, tyres that saturate.

    Measurements with noise of a small car's sensors.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    phase = generator.uniform(0.0, 2.0 * np.pi, 4)
    steer = 0.15 * np.sin(2.1 * time + phase[0]) + 0.06 * np.sin(5.3 * time + phase[1])
    current = 1.7 + 1.5 * np.sin(0.9 * time + phase[2]) + 0.8 * np.sin(2.9 * time + phase[3])
    state = (3.0, 0.0, 0.0, 3.0)
    states = []
    accelerations = []
    for delta, ampere in zip(steer.tolist(), current.tolist(), strict=True):
        states.append(state)
        accelerations.append(_motion(state, delta, ampere)[1])
        for _ in range(5):
            state = tuple(
                x + rate / RATE / 5
                for x, rate in zip(state, _motion(state, delta, ampere)[0], strict=True)
            )
    vx, vy, turning, rim = np.array(states).T
    ax, ay = np.array(accelerations).T
    true = {"ax": ax, "ay": ay, "yaw_rate": turning, "motor_speed": rim / WHEEL_RADIUS}
    measured = {
        name: values + NOISE[name] * generator.standard_normal(len(time))
        for name, values in true.items()
    }
    channels = {
        **measured,
        "vx": measured["motor_speed"] * WHEEL_RADIUS,
        "steer": steer,
        "motor_current": current,
    }
    references = {"vx_ref": vx.copy(), "vy_ref": vy.copy(), "yaw_rate_ref": turning.copy()}
    return Recording(
        f"small car {seed}", "small car", RATE, 0.0, {**channels, **references}, "simulated"
    )


def _motion(state, steer, current):
    """Rates of vx, vy, yaw rate and rim speed; ax and ay."""
    vx, vy, turning, rim = state
    driving = 12.5 * math.tanh(4.0 * (rim - vx) / vx)
    front = -15.0 * math.tanh(5.0 * (math.atan((vy + TO_FRONT * turning) / vx) - steer))
    rear = -19.0 * math.tanh(5.0 * math.atan((vy - TO_REAR * turning) / vx))
    ax = (2.0 * driving - front * math.sin(steer) - 0.1 - 0.1 * vx * vx) / MASS
    ay = (front * math.cos(steer) + rear) / MASS
    spinning = 0.25 * (0.9 * current - 2.0 * WHEEL_RADIUS * driving - 0.3 * rim - 0.5)
    turned = (TO_FRONT * front * math.cos(steer) - TO_REAR * rear) / INERTIA
    return (ax + vy * turning, ay - vx * turning, turned, spinning), (ax, ay)
