"""Members: networks of one shape that train together as one batched computation.

Each member's parameters are one row of a matrix, so that everything elementwise (Adam, best weights, stopping) works on
rows, and what happens in one row never touches another: a member trains exactly as it would alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor, nn


class WindowNetwork(Protocol):
    """A network that maps a window of measurements to the lateral velocity one step after it."""

    def prepared(self, series: Tensor) -> Tensor:
        """Series as the network consumes it (scaled, say), (T, C) -> (T, C); once, before training."""
        ...

    def forward(self, prepared_windows: Tensor) -> Tensor:
        """Prediction from prepared windows, (..., N, C) -> (...), in m/s."""
        ...

    def compiled_members(self, parameters: Mapping[str, Tensor], prepared: Tensor, starts: Tensor) -> Tensor:
        """The same for M members on their own windows by a compiled recursion; see `predict_members`."""
        ...

    def constrain(self, parameters: Mapping[str, Tensor]) -> None:
        """Bring parameters of shape (M, ...) back into their admissible range, in place."""
        ...


class FlatParameters:
    """Where each parameter of a module sits in a row of a (members, K) matrix."""

    def __init__(self, module: nn.Module) -> None:
        self.shapes = {name: tuple(parameter.shape) for name, parameter in module.named_parameters()}
        self.sizes = {name: parameter.numel() for name, parameter in module.named_parameters()}

    @property
    def n_parameters(self) -> int:
        """Number K of parameters of one member."""
        return sum(self.sizes.values())

    def pack(self, modules: Sequence[nn.Module]) -> Tensor:
        """Rows of parameters, shape (M, K)."""
        return torch.stack([torch.cat([p.detach().reshape(-1) for p in module.parameters()]) for module in modules])

    def views(self, flat: Tensor) -> dict[str, Tensor]:
        """Parameters by name, each of shape (M, ...), as views of ``flat`` (M, K)."""
        pieces = torch.split(flat, list(self.sizes.values()), dim=1)
        members = flat.shape[0]
        return {name: piece.view(members, *shape) for (name, shape), piece in zip(self.shapes.items(), pieces, strict=True)}

    def unpack(self, row: Tensor, module: nn.Module) -> None:
        """Copy one row, shape (K,), into a module."""
        views = self.views(row.reshape(1, -1))
        with torch.no_grad():
            for name, parameter in module.named_parameters():
                parameter.copy_(views[name][0])


def predict_members(
    network: nn.Module, parameters: Mapping[str, Tensor], prepared: Tensor, starts: Tensor, n_window: int, *, compiled: bool
) -> Tensor:
    """Predictions of M members, each on its own windows.

    Args:
        network: a `WindowNetwork`, whose own parameters are not used.
        parameters: name -> (M, ...).
        prepared: (T, C), what ``network.prepared`` returned.
        starts: first row of each window, (M, B), int64.
        n_window: samples N in a window.
        compiled: use the compiled recursion instead of PyTorch.

    Returns:
        (M, B) [m/s].
    """
    if compiled:
        result: Tensor = network.compiled_members(parameters, prepared, starts)  # type: ignore[operator]
        return result
    windows = prepared[starts.unsqueeze(-1) + torch.arange(n_window, device=starts.device)]
    return torch.func.vmap(lambda row, batch: torch.func.functional_call(network, row, (batch,)))(dict(parameters), windows)
