"""Members: networks of one shape that train together as one batched computation.

Each member's parameters are one row of a matrix, so that everything elementwise (Adam, best
weights, stopping) works on rows, and what happens in one row never touches another: a member trains
exactly as it would alone.

A network is any ``nn.Module`` whose forward maps prepared windows to the lateral velocity [m/s] one
step after them, (B, N, C) -> (B,) or (B, 1). It may have besides:

- ``prepared(series)``: the series as the network consumes it, for example scaled, (T, C) -> (T, C),
  called once; else as it was measured, in SI;
- ``reset(generator)``: draws initial weights; else they are those that torch draws when it is
  built, under the member's seed;
- ``constrain(parameters)``: brings parameters (M, ...) back into their admissible range, in place;
  else all are admissible;
- ``compiled_members(parameters, prepared, starts)``: forward of M members on their own windows,
  (M, B), by a compiled recursion;
- ``compiled_descent(...)``: several steps of Adam on the mean squared error, see
  `vehest.estimators.networks.compiled.CompiledNetwork`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError

# windows of a member that are evaluated at once without gradients, since each is copied in memory
MAX_WINDOWS_TOGETHER = 1024


def prepare(network: nn.Module, series: Tensor) -> Tensor:
    """Series (T, C) as a network consumes it: by its ``prepared``, otherwise unchanged."""
    hook = getattr(network, "prepared", None)
    return series if hook is None else hook(series)


def constrain(network: nn.Module, parameters: Mapping[str, Tensor]) -> None:
    """Bring parameters of shape (M, ...) back into their admissible range, in place.

    Nothing is done for a network without ``constrain``.
    """
    hook = getattr(network, "constrain", None)
    if hook is not None:
        hook(parameters)


def is_plain(network: nn.Module) -> bool:
    """Whether a network has no compiled recursion."""
    return not hasattr(network, "compiled_members")


@contextmanager
def random_numbers(seed: int) -> Iterator[None]:
    """Context in which torch draws from a seed on the CPU; its random state is restored afterwards.

    Parameters
    ----------
    seed : int
        Seed of torch's default generator on the CPU.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield


def fixed_state(modules: Sequence[nn.Module]) -> dict[str, Tensor]:
    """Stack the buffers and the parameters that are not trained, by name, (M, ...).

    Parameters
    ----------
    modules : Sequence[nn.Module]
        M modules with equal names and shapes.
    """
    frozen = [
        {name: p.detach() for name, p in module.named_parameters() if not p.requires_grad}
        for module in modules
    ]
    states = [
        parameters | dict(module.named_buffers())
        for parameters, module in zip(frozen, modules, strict=True)
    ]
    return {name: torch.stack([state[name] for state in states]) for name in states[0]}


class FlatParameters:
    """Layout of the trained parameters of a module as a row of K numbers.

    Parameters
    ----------
    module : nn.Module
        Whose parameters that require a gradient are laid out, in the order of ``named_parameters``.

    Attributes
    ----------
    shapes : dict[str, torch.Size]
        Shape of each parameter by name.
    size : int
        K, numbers in a row.
    """

    def __init__(self, module: nn.Module) -> None:
        self.shapes = {name: parameter.shape for name, parameter in _trained(module)}
        self.size = sum(shape.numel() for shape in self.shapes.values())

    def pack(self, modules: Sequence[nn.Module]) -> Tensor:
        """The trained parameters of M modules as rows, (M, K)."""
        return torch.stack(
            [torch.cat([p.detach().reshape(-1) for _, p in _trained(module)]) for module in modules]
        )

    def views(self, flat: Tensor) -> dict[str, Tensor]:
        """Parameters by name, each of shape (M, ...), as views of ``flat`` (M, K)."""
        pieces = flat.split([shape.numel() for shape in self.shapes.values()], dim=1)
        return {
            name: piece.view(len(flat), *shape)
            for (name, shape), piece in zip(self.shapes.items(), pieces, strict=True)
        }

    def unpack(self, row: Tensor, module: nn.Module) -> None:
        """Copy one row, (K,), into the parameters of a module."""
        with torch.no_grad():
            for (_, parameter), values in zip(
                _trained(module), self.views(row.unsqueeze(0)).values(), strict=True
            ):
                parameter.copy_(values[0])


def _trained(module: nn.Module) -> list[tuple[str, nn.Parameter]]:
    """Parameters of a module that require a gradient, with their names, in its order."""
    return [
        (name, parameter)
        for name, parameter in module.named_parameters()
        if parameter.requires_grad
    ]


def predict_members(
    network: nn.Module,
    parameters: Mapping[str, Tensor],
    prepared: Tensor,
    starts: Tensor,
    n_window: int,
    *,
    compiled: bool,
    seeds: Sequence[int] = (),
) -> Tensor:
    """Predictions of M members, each on its own windows.

    Without a compiled recursion members are one batched computation by ``torch.func.vmap`` where
    torch can batch every layer, and one computation a member where it cannot (``nn.LSTM``,
    ``nn.GRU``) or where a layer draws random numbers (dropout).

    Parameters
    ----------
    network : nn.Module
        Whose own parameters and buffers are used where ``parameters`` does not name them.
    parameters : Mapping[str, Tensor]
        Name -> (M, ...).
    prepared : Tensor
        (T, C), what `prepare` returned.
    starts : Tensor
        First row of each window, (M, B), int64.
    n_window : int
        Samples N in a window.
    compiled : bool
        Use the compiled recursion where the network has one; PyTorch otherwise.
    seeds : Sequence[int], default ()
        Seed of each member for layers that draw random numbers; empty: these draw from torch's
        global state.

    Returns
    -------
    Tensor
        Lateral velocity one step after each window, (M, B) [m/s].

    Raises
    ------
    ConfigurationError
        The network returns another shape.
    """
    if compiled and not is_plain(network):
        compiled_members: Any = network.compiled_members
        predictions: Tensor = compiled_members(parameters, prepared, starts)
        return predictions
    offsets = torch.arange(n_window, device=starts.device)
    pieces = [starts] if torch.is_grad_enabled() else starts.split(MAX_WINDOWS_TOGETHER, dim=1)
    return torch.cat(
        [
            _plain(network, parameters, prepared[piece.unsqueeze(-1) + offsets], seeds)
            for piece in pieces
        ],
        dim=1,
    )


_UNBATCHABLE: WeakSet[nn.Module] = WeakSet()
"""Networks that have been found to have a layer that torch cannot batch over members."""


def _plain(
    network: nn.Module, parameters: Mapping[str, Tensor], windows: Tensor, seeds: Sequence[int]
) -> Tensor:
    """Predictions of M members by PyTorch alone, windows (M, B, N, C) -> (M, B)."""

    def predict(member_parameters: Mapping[str, Tensor], batch: Tensor) -> Tensor:
        """Predictions (B,) of one member on its windows (B, N, C); raises `ConfigurationError`."""
        predicted = torch.func.functional_call(network, dict(member_parameters), (batch,))
        if predicted.shape not in (batch.shape[:1], (*batch.shape[:1], 1)):
            raise ConfigurationError(
                f"{type(network).__name__} maps windows of shape {tuple(batch.shape)} to "
                f"{tuple(predicted.shape)}; it must return one lateral velocity a window, "
                f"({len(batch)},)"
            )
        return predicted.reshape(len(batch))

    if len(windows) > 1 and network not in _UNBATCHABLE:
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings(
                    "ignore", message="There is a performance drop"
                )  # one layer goes member by member: still right
                return torch.func.vmap(predict)(dict(parameters), windows)
        except RuntimeError:  # what is wrong with the network itself is raised again below
            _UNBATCHABLE.add(network)
    predictions = []
    for member, batch in enumerate(windows):
        with random_numbers(seeds[member]) if seeds else nullcontext():
            predictions.append(
                predict({name: values[member] for name, values in parameters.items()}, batch)
            )
    return torch.stack(predictions)
