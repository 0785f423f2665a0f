"""Training of networks over single samples, members side by side, as a phase of `vehest.training.sequences`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from vehest.data.errors import ConfigurationError
from vehest.training.sequences import Phase, PhaseSettings


class Samples(NamedTuple):
    """What is learnt from, as a network sees it.

    Attributes:
        inputs: (N, C).
        targets: (N,).
    """

    inputs: Tensor
    targets: Tensor


class Draw(NamedTuple):
    """A batch: which samples each member sees, int64 (M, B), and the seed of each member's dropout, int64 (M,)."""

    rows: Tensor
    seeds: Tensor


@dataclass(frozen=True)
class SampleSettings:
    """Training on samples in random order (Bertipaglia et al. 2024, Section IV-C).

    Args:
        phase: step size, epochs, patience.
        batch_size: samples in a batch.
        dtype: ``float32`` or ``float64``.
        checkpoint_seconds: time between two checkpoints [s].

    Raises:
        ConfigurationError: a value that makes no sense.
    """

    version: ClassVar[str] = "1"
    phase: PhaseSettings = PhaseSettings(learning_rate=1e-3, max_epochs=300, patience=20)  # noqa: RUF009
    batch_size: int = 1024
    dtype: Literal["float32", "float64"] = "float32"
    checkpoint_seconds: float = 15.0

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ConfigurationError(f"training.batch_size must be at least 1, not {self.batch_size}")
        if self.dtype not in ("float32", "float64"):
            raise ConfigurationError(f"training.dtype '{self.dtype}' is not one of: float32, float64")


def sample_phase(
    name: str,
    module: nn.Module,
    settings: PhaseSettings,
    batch_size: int,
    n_samples: int,
    members: int,
    losses: Callable[[Draw], Tensor],
    judge: Callable[[], Tensor],
) -> Phase:
    """Members learn from all samples, each in an order of its own; what is judged is their mean.

    Args:
        name: of the phase.
        module: of all members; what happens in one member's parameters must not touch another's.
        settings: step size, epochs, patience.
        batch_size: samples that a member sees at a time.
        n_samples: how many there are.
        members: M.
        losses: of a batch, one a member, (M,).
        judge: on validation samples, (M,).
    """

    def batches(generator: torch.Generator) -> Iterator[Draw]:
        order = torch.stack([torch.randperm(n_samples, generator=generator) for _ in range(members)])
        for rows in order.split(batch_size, dim=1):
            yield Draw(rows, torch.randint(2**62, (members,), generator=generator))

    return Phase(name, settings, module, batches, lambda draw: losses(draw).sum(), lambda: float(judge().double().mean()))
