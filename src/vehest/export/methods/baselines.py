"""The baselines in C."""

from __future__ import annotations

import math

from vehest.constants import GRAVITY
from vehest.estimators.data_sheet import DataSheet
from vehest.estimators.kinematic import Kinematic
from vehest.estimators.static_map import StaticMap
from vehest.estimators.zero import Zero
from vehest.export.method import MethodTemplate
from vehest.export.rendering import Precision


def zero(estimator: Zero, precision: Precision) -> MethodTemplate:
    """v = 0."""
    return MethodTemplate("static", {"about": "v = 0."}, estimator.channels)


def static_map(estimator: StaticMap, precision: Precision) -> MethodTemplate:
    """v = r (b - k u²)."""
    about = "Steady cornering of a linear single track, its two numbers by least squares."
    return MethodTemplate("static", {"about": about, **estimator.values}, estimator.channels)


def data_sheet(estimator: DataSheet, precision: Precision) -> MethodTemplate:
    """v = r (l_r - u² / (c g))."""
    s = estimator.settings
    assert s.wheelbase is not None
    rear = s.wheelbase / 2.0 if s.cg_to_rear_axle is None else s.cg_to_rear_axle
    about = "Steady cornering of a linear single track from a data sheet."
    values = {"about": about, "rear": rear, "stiffness": s.cornering_coefficient * GRAVITY}
    return MethodTemplate("static", values, estimator.channels)


def kinematic(estimator: Kinematic, precision: Precision) -> MethodTemplate:
    """Leaky integration of a_y - u r."""
    time_constant = estimator.values["time_constant"]
    kept = math.exp(-1.0 / (estimator.settings.rate_hz * time_constant))
    values = {"time_constant": time_constant, "kept": kept, "gain": (1.0 - kept) * time_constant}
    return MethodTemplate("kinematic", values, estimator.channels)
