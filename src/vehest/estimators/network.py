"""Base of estimators whose weights are those of a network.

Initial weights, parameters, saving, training member by member.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from vehest.estimators.base import (
    Estimator,
    FitData,
    FitRecord,
    require_positive,
    require_shapes,
)
from vehest.training.context import FitContext

SCALES = ("input_scale", "output_scale", "input_span", "unit", "yaw_rate_max")
"""Buffers of networks by which inputs and outputs are scaled; every fit makes them positive."""


class Network(Estimator):
    """An estimator with a ``network``, any ``nn.Module``.

    A family has either its own `run`, or is a `WindowedEstimator`; and either `fit_member` or its
    own `fit_members`.

    Weights that were loaded stay as arrays until the network is first used, so that families with a
    compiled `predict` can estimate without torch.
    """

    learns = True  # always
    fits_seeds_together = False

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._loaded: dict[str, np.ndarray[Any, Any]] = {}

    @cached_property
    def network(self) -> Any:
        """The network, built and loaded when it is first used, since it needs torch."""
        import torch

        from vehest.training.members import random_numbers

        with random_numbers(0):
            network = self.new_network()
        if self._loaded:
            tensors = {name: torch.from_numpy(values) for name, values in self._loaded.items()}
            network = network.to(next(iter(tensors.values())).dtype)
            network.load_state_dict(tensors)
        return network

    @abstractmethod
    def new_network(self) -> Any:
        """Build the ``nn.Module`` of these settings, to be trained or to receive stored weights."""

    def fit_member(
        self, data: FitData, training: Any, context: FitContext, index: int
    ) -> FitRecord:
        """Train one estimator; ``index`` is its index among the members, see `fit_members`.

        Parameters
        ----------
        data : FitData
            Recordings at the estimator's rate.
        training : any
            Of ``training_type``.
        context : FitContext
            Checkpoints, progress, the wish to stop.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method 'fit_member'")

    @classmethod
    def fit_members(
        cls, members: Sequence[Any], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Train members one after the other."""
        return [
            member.fit_member(data, training, context, index)
            for index, member in enumerate(members)
        ]

    @property
    def n_parameters(self) -> int:
        """Number of values that training determines; scales taken from the data do not count."""
        return sum(
            parameter.numel() for parameter in self.network.parameters() if parameter.requires_grad
        )

    def min_weights(self) -> int:
        """Number of parameters, computed without allocating them."""
        import torch

        with torch.device("meta"):
            return type(self)(self.settings).n_parameters

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of what `weights` returns, by name."""
        return {
            name: tuple(tensor.shape) for name, tensor in self.new_network().state_dict().items()
        }

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Parameters and scales (persistent buffers) of the network, by name."""
        if self._loaded and "network" not in vars(self):
            return {name: values.copy() for name, values in self._loaded.items()}
        return {
            name: tensor.detach().numpy().copy()
            for name, tensor in self.network.state_dict().items()
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set parameters and scales from stored weights, in the precision of the training.

        Raises `DataError`: a name or shape does not fit the settings, or a scale is not positive.
        """
        expected = self.weight_shapes()
        require_shapes(self, weights, expected)
        for name, values in weights.items():
            if name.rpartition(".")[2] in SCALES:
                require_positive(name, float(values.min()))
        dtype = next(iter(weights.values())).dtype
        self._loaded = {name: np.array(weights[name], dtype=dtype) for name in expected}
        vars(self).pop("network", None)
