"""The shipped cars and their plants, each made once."""

from functools import cache
from pathlib import Path

import numpy as np
import yaml

from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import vehicle_from_configuration

FOLDER = Path(__file__).parents[2] / "conf" / "vehicle"
OURS = ("corvette_grand_sport", "ferrari_250_lm", "bmw_545i", "heavy_truck")
ALL = sorted(
    path.stem for path in FOLDER.glob("*.yaml") if "plant:" not in path.read_text(encoding="utf-8")
)
"""Multi-body cars."""


@cache
def shipped(name):
    """A vehicle of conf/vehicle."""
    return vehicle_from_configuration(
        yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    )


@cache
def plant_of(name):
    """Multi-body plant of a vehicle of conf/vehicle."""
    return MultiBodyPlant(shipped(name))


def rolling(plant, speed):
    """State at the origin, straight ahead at a speed."""
    return plant.initial_state(0.0, 0.0, 0.0, speed)


def inputs_of(steering=0.0, acceleration=0.0, moment=0.0, along=0.0, across=0.0):
    """Inputs of a plant."""
    return np.array([steering, acceleration, moment, along, across])
