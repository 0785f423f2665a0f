"""Drives of a linear single track with noise on every channel, and with wheel speeds where they are
wanted.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from single_track_drive import linear_drive

RATE = 50.0
CHANNELS = ("yaw_rate", "vx", "ay", "ax", "steer")
WHEELS = ("wheel_speed_fl", "wheel_speed_fr", "wheel_speed_rl", "wheel_speed_rr")
RADIUS = 0.3
HALF_TRACK = 0.75
QUIET = {"yaw_rate": 0.005, "ay": 0.2, "steer": 0.0005}
ADDED = {"vx": 0.02, "ax": 0.1, "steer": 0.0005}
WHEEL_NOISE = 0.1  # rad/s


@cache
def measured_drive(seed=0, seconds=120.0):
    """Swerves at 19 to 37 m/s; channels of `CHANNELS` and `WHEELS`."""
    generator = np.random.default_rng(seed + 1000)
    drive = linear_drive(seconds, RATE, seed, QUIET)[0]
    channels = {name: np.array(drive[name]) for name in CHANNELS}
    channels["ax"] -= drive["vy_ref"] * drive["yaw_rate_ref"]
    side = {name: HALF_TRACK if name.endswith("r") else -HALF_TRACK for name in WHEELS}
    for name in WHEELS:
        channels[name] = (
            channels["vx"] + side[name] * channels["yaw_rate"]
        ) / RADIUS + WHEEL_NOISE * generator.standard_normal(len(drive))
    for name, level in ADDED.items():
        channels[name] = channels[name] + level * generator.standard_normal(len(drive))
    return replace(drive, channels=channels)
