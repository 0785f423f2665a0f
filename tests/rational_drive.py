"""Drives of a single track with rational tyres, integrated finely, with known curves, states and
noise.
"""

from dataclasses import replace

import numpy as np

from vehest.data.recording import Recording
from vehest.vehicle.parameters import FERRARI_250LM as CAR
from vehest.vehicle.rational_tyres import rational_axle

CURVES = {"c1_front": 0.008, "c2_front": 6.7e4, "c1_rear": 0.005, "c2_rear": 1.15e5}
NOISE = {"yaw_rate": 0.005, "ay": 0.1}
FINER = 20


def rational_drive(seconds=60.0, seed=0, stiffness=1.0, friction=1.0, rate_hz=20.0):
    """A lively drive; both cornering stiffnesses are multiplied by a factor."""
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate_hz * FINER)) / (rate_hz * FINER)
    phases = generator.uniform(0, 6, 3)
    speed = 28.0 + 8.0 * np.sin(0.11 * time + phases[0])
    steer = 0.045 * np.sin(0.7 * time + phases[1]) + 0.02 * np.sin(2.3 * time + phases[2])
    sideslip = 0.0
    yaw_rate = 0.0
    rows = np.empty((len(time), 3))
    step = 1.0 / (rate_hz * FINER)
    for k, (u, angle) in enumerate(zip(speed.tolist(), steer.tolist(), strict=True)):
        turn = yaw_rate / u
        front = rational_axle(
            angle - sideslip - CAR.cg_to_front_axle * turn,
            CURVES["c1_front"],
            stiffness * CURVES["c2_front"],
            friction,
        ).force
        rear = rational_axle(
            CAR.cg_to_rear_axle * turn - sideslip,
            CURVES["c1_rear"],
            stiffness * CURVES["c2_rear"],
            friction,
        ).force
        rows[k] = sideslip, yaw_rate, (front + rear) / CAR.mass
        sideslip += step * (rows[k, 2] / u - yaw_rate)
        yaw_rate += (
            step * (CAR.cg_to_front_axle * front - CAR.cg_to_rear_axle * rear) / CAR.yaw_inertia
        )
    rows = rows[::FINER]
    speed = speed[::FINER]
    steer = steer[::FINER]
    channels = {
        "vx": speed,
        "yaw_rate": rows[:, 1] + NOISE["yaw_rate"] * generator.standard_normal(len(rows)),
        "ay": rows[:, 2] + NOISE["ay"] * generator.standard_normal(len(rows)),
        "steer": steer,
        "vx_ref": speed,
        "vy_ref": speed * np.tan(rows[:, 0]),
        "sideslip_ref": rows[:, 0],
    }
    return Recording(
        f"rational{seed}", "rational single track", rate_hz, 0.0, channels, "simulated"
    )


def changed(drive, channels):
    """The same drive with other samples of some channels; NaN is not measured."""
    return replace(drive.with_channels(channels), gappy=frozenset(("ay", "yaw_rate")))
