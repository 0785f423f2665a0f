"""Drives of the single track on Dugoff's tyres itself, with known tyres and sensors."""

import numpy as np

from point_models import called
from vehest.data.recording import Recording
from vehest.estimators.kernels.dugoff_track import CompiledDugoffTrack
from vehest.vehicle.dugoff import DugoffAxle, DugoffTrack, LoadedCar

FRONT = DugoffAxle(1.2e5, 1.0, 0.005)
REAR = DugoffAxle(1.7e5, 1.05, 0.004)
TYRES = {
    f"{name}_{axle}": value
    for axle, curve in (("front", FRONT), ("rear", REAR))
    for name, value in curve._asdict().items()
}
NOISE = {"ay": 0.06, "yaw_rate": 0.002, "fy": 70.0}


def dugoff_track(tyres="plain"):
    """Single track with the tyres and the car of `dugoff_drive`."""
    return DugoffTrack(LoadedCar(), FRONT, REAR, 0.01, tyres, 3.0)


def driven(inputs):
    """What the track does at 100 Hz from rest under speed, steering angle and ax, (T, 3): its two
    states and what is measured of them.
    """
    track = CompiledDugoffTrack(dugoff_track())
    states = np.zeros((len(inputs), 1, 2))
    for k in range(len(inputs) - 1):
        states[k + 1] = called(track, 0, states[k : k + 1], inputs[k : k + 1], 2)[0]
    return (*states[:, 0].T, *called(track, 1, states, inputs, 4)[:, 0].T)


def dugoff_drive(seconds=20.0, seed=0, name="drive", *, straight=0.0):
    """A drive up to the limit at 100 Hz, with accelerations and all four lateral forces.

    Its last seconds lead straight ahead.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * 100)) / 100
    phases = generator.uniform(0, 6, 3)
    vx = 24.0 + 6.0 * np.sin(0.4 * time + phases[0])
    ax = 2.4 * np.cos(0.4 * time + phases[0])
    steer = 0.07 * np.sin(0.7 * time + phases[1]) * np.sin(0.2 * time) + 0.01 * np.sin(
        2.9 * time + phases[2]
    )
    if straight:  # the wheel is turned back smoothly before
        steer *= (
            np.cos(0.5 * np.pi * np.clip(1.0 - (seconds - straight - time) / 4.0, 0.0, 1.0)) ** 2
        )
    vy, true_yaw_rate, ay, yaw_rate, front, rear = driven(np.stack([vx, steer, ax], 1))

    def measured(values, level):
        return values + level * generator.standard_normal(len(time))

    channels = {
        "vx": vx,
        "ax": ax,
        "steer": steer,
        "ay": measured(ay, NOISE["ay"]),
        "yaw_rate": measured(yaw_rate, NOISE["yaw_rate"]),
        "fy_fl": measured(0.4 * front, NOISE["fy"]),
        "fy_fr": measured(0.6 * front, NOISE["fy"]),
        "fy_rl": measured(0.4 * rear, NOISE["fy"]),
        "fy_rr": measured(0.6 * rear, NOISE["fy"]),
        "vx_ref": vx,
        "vy_ref": vy,
        "yaw_rate_ref": true_yaw_rate,
        "sideslip_ref": np.arctan2(vy, vx),
    }
    return Recording(name, "Dugoff's single track", 100.0, 0.0, channels, "simulated")
