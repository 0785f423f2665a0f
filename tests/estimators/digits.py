"""Prints a digest of value and gradient of the compiled kernels named on the command line:
``digits.py networks`` or ``digits.py cars``.
"""

import hashlib
import sys

import torch


def _digest(tensors):
    """SHA-256 of the bytes of some tensors."""
    return hashlib.sha256(
        b"".join(tensor.detach().numpy().tobytes() for tensor in tensors)
    ).hexdigest()


if sys.argv[1] == "networks":
    from test_kernels import STRUCTURES, _problem

    for estimator in STRUCTURES[2:5]:  # KS-NN and GRU; an LSTM is compiled as a GRU is
        print(estimator.name, estimator.variant, _digest(_problem(estimator, torch.float32)(True)))
else:
    from test_planar_car import CARS, a_car, through_the_filter

    for kind in CARS:
        mean, gradients = through_the_filter(a_car(kind, torch.float32), True, torch.float32)
        print(kind, _digest([mean, *gradients.values()]))
