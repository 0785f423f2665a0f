"""Recurrent networks in C: over windows, and over all samples so far."""

from __future__ import annotations

import numpy as np

from vehest.estimators.gru import Gru
from vehest.estimators.lstm import Lstm
from vehest.estimators.networks.recurrent import RecurrentEstimator
from vehest.estimators.networks.velocity_recurrent import RecurrentVelocityEstimator
from vehest.estimators.velocity_gru import VelocityGru
from vehest.estimators.velocity_lstm import VelocityLstm
from vehest.export.method import MethodTemplate
from vehest.export.rendering import Precision


def gru(estimator: Gru, precision: Precision) -> MethodTemplate:
    """Gated recurrent unit over a window."""
    return _windowed(estimator)


def lstm(estimator: Lstm, precision: Precision) -> MethodTemplate:
    """Long short-term memory over a window."""
    return _windowed(estimator)


def _windowed(estimator: RecurrentEstimator) -> MethodTemplate:
    weights = {name: values.astype(np.float64) for name, values in estimator.weights().items()}
    gates, states, _ = weights["input_weight"].shape
    return MethodTemplate("window_recurrent", {**weights, "window": estimator.settings.window, "gates": gates, "states": states})


def velocity_gru(estimator: VelocityGru, precision: Precision) -> MethodTemplate:
    """Gated recurrent unit over all samples."""
    return _velocities(estimator, {"slope": estimator.settings.negative_slope, "dense": 0})


def velocity_lstm(estimator: VelocityLstm, precision: Precision) -> MethodTemplate:
    """Long short-term memory over all samples, with fed-back velocities."""
    return _velocities(estimator, {"dense": estimator.settings.n_dense})


def _velocities(estimator: RecurrentVelocityEstimator, values: dict[str, float]) -> MethodTemplate:
    s, w = estimator.settings, {name: array.astype(np.float64) for name, array in estimator.weights().items()}
    layers = {name.replace(".", "_"): array for name, array in w.items()}
    starts = [name if name in estimator.channels and name != "vy" else None for name in s.outputs]
    sizes = {"states": s.n_states, "gates": len(w["recurrent.weight_ih_l0"]) // s.n_states}
    return MethodTemplate("velocity_recurrent", {**layers, **values, **sizes, "inputs": s.inputs, "outputs": s.outputs, "starts": starts})
