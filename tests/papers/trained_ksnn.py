"""KS-NNs as training leaves them, without the training: weights drawn around typical ones, so that
tests know them.
"""

import torch

from vehest.estimators.ksnn import Ksnn
from vehest.estimators.networks.ksnn import KinematicsStructuredNetwork


def ksnn_with_weights(n_local=3, n_hidden=0, bias=False, seed=0, window=30, yaw_rate_max=0.6):
    """A KS-NN in float64 with γ about 0.95, β about 0.8 and feedback that matters."""
    settings = Ksnn.settings_type(n_local=n_local, n_hidden=n_hidden, bias=bias, window=window)
    network = KinematicsStructuredNetwork(settings, yaw_rate_max).double()
    generator = torch.Generator().manual_seed(seed)
    centre_and_spread = {"gamma": (0.95, 0.02), "beta": (0.8, 0.1), "linear_weight": (0.3, 0.05)}
    centre_and_spread |= {"hidden_weight": (0.0, 1.0), "output_weight": (0.15, 0.05)}
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            centre, spread = centre_and_spread.get(name, (0.0, 0.05))
            parameter.copy_(
                centre
                + spread * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            )
    estimator = Ksnn(settings)
    estimator.network = network
    return estimator
