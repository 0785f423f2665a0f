"""Functions that a limited process calls as readers: one that answers, and one for each way of
ending otherwise.
"""

import os

import numpy as np

from vehest.data.errors import MissingError
from vehest.data.limits import current_limits


def answers(file, factor):
    """Numbers of the file, times a factor."""
    print("what a library prints is no answer")
    return {"vx": factor * np.fromfile(file), "n": np.arange(3)}, {
        "limit": current_limits().samples
    }


def hangs(file):
    while True:
        pass


def takes_memory(file):
    return {"vx": np.ones(100_000_000)}, {}


def crashes(file):
    os.abort()


def writes(file):
    file.with_name("written").write_text("x")
    return {}, {}


def misses(file):
    raise MissingError(f"'{file}' needs another one")


def fails(file):
    raise KeyError("vx\x1b[2J\nsecond line")
