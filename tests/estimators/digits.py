"""Prints a digest of value and gradient of the compiled kernels named on the command line: ``digits.py networks`` or ``digits.py cars``."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable

import torch
from torch import Tensor


def _digest(tensors: Iterable[Tensor]) -> str:
    return hashlib.sha256(b"".join(tensor.detach().numpy().tobytes() for tensor in tensors)).hexdigest()


def _networks() -> None:
    from test_kernels import STRUCTURES, _problem

    for estimator in STRUCTURES[2:5]:  # KS-NN and GRU; an LSTM is compiled as a GRU is
        print(estimator.name, estimator.variant, _digest(_problem(estimator, torch.float32)(True)))


def _cars() -> None:
    from test_planar_car import CARS, a_car, through_the_filter

    for kind in CARS:
        mean, gradients = through_the_filter(a_car(kind, torch.float32), True, torch.float32)
        print(kind, _digest([mean, *gradients.values()]))


if __name__ == "__main__":
    {"networks": _networks, "cars": _cars}[sys.argv[1]]()
