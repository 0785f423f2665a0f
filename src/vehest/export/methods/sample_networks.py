"""Networks over single samples in C."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.estimators.networks.sample_network import STEEPEST, SampleNetwork
from vehest.estimators.sideslip_ffnn import SideslipFfnn
from vehest.export.method import MethodTemplate
from vehest.export.rendering import Precision


def sideslip_ffnn(estimator: SideslipFfnn, precision: Precision) -> MethodTemplate:
    """The network, and v = u tan β."""
    return MethodTemplate("sideslip_ffnn", network_values(estimator.network))


def network_values(network: SampleNetwork) -> dict[str, Any]:
    """Weights and ranges of a network, and what is believed of its angle."""
    weights = {name: tensor.detach().numpy().astype(np.float64) for name, tensor in network.state_dict().items()}
    return {**weights, "steepest": STEEPEST}
