"""Drives of a car that is the linear single track itself, noise included, with known states."""

from dataclasses import replace

import numpy as np

from vehest.data.recording import Recording
from vehest.vehicle.parameters import FERRARI_250LM
from vehest.vehicle.single_track import lateral_model

NOISE = {"yaw_rate": 0.01, "ay": 0.5, "steer": 0.01}


def linear_drive(seconds=20.0, rate_hz=100.0, seed=0, noise=NOISE):
    """A recording of the model's own equations and its states (β, r), (T, 2).

    The steering angle that acts between samples is the measured one plus white noise; ay and yaw
    rate are measured with noise.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    vx = 28.0 + 9.0 * np.sin(0.3 * time + generator.uniform(0, 6))
    steer = 0.05 * np.sin(0.8 * time + generator.uniform(0, 6)) + 0.02 * np.sin(2.9 * time)
    model = lateral_model(FERRARI_250LM, vx).in_steps(1.0 / rate_hz)
    states = np.zeros((len(time), 2))
    disturbed = steer + noise["steer"] * generator.standard_normal(len(time))
    for k in range(len(time) - 1):
        states[k + 1] = model.A[k] @ states[k] + model.B[k] * disturbed[k]
    channels = {
        "vx": vx,
        "yaw_rate": states[:, 1] + noise["yaw_rate"] * generator.standard_normal(len(time)),
        "ay": np.einsum("ti,ti->t", model.C, states)
        + model.D * steer
        + noise["ay"] * generator.standard_normal(len(time)),
        "steer": steer,
        "ax": np.gradient(vx, 1.0 / rate_hz),
        "vx_ref": vx,
        "vy_ref": vx * np.tan(states[:, 0]),
        "yaw_rate_ref": states[:, 1],
        "sideslip_ref": states[:, 0],
    }
    return Recording("linear", "single track", rate_hz, 0.0, channels, "simulated"), states


def with_gaps(drive, gaps):
    """The same drive where some samples of some channels were not measured."""
    channels = {name: samples.copy() for name, samples in drive.channels.items()}
    for name, gap in gaps.items():
        channels[name][gap] = np.nan
    return replace(drive, channels=channels, gappy=frozenset(gaps))
