"""Random streams of a drive: every draw has one of its own, so that a change in one place moves no
other samples.
"""

from __future__ import annotations

import numpy as np

# first key of the streams of
STYLE = 0  # the driver's style
SENSORS = 1  # errors of the sensors
SURFACE = 2  # patches of the surface
MANOEUVRE = 3  # the manoeuvre
FLEET = 4  # the vehicle's parameters and the sensors' levels
TRAFFIC = 5  # slower cars ahead


def random_stream(seed: int, *keys: int) -> np.random.Generator:
    """The random stream of a drive's seed that some keys select."""
    return np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=keys))
