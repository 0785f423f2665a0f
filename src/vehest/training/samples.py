"""Training of networks over single samples, members side by side, as a phase of
`vehest.training.sequences`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from vehest.declared import Group, setting
from vehest.training.sequences import Phase, PhaseSettings


class Samples(NamedTuple):
    """Samples of a training, scaled as the network takes them."""

    inputs: Tensor  # scaled inputs, (N, C)
    targets: Tensor  # scaled targets, (N,)


class Draw(NamedTuple):
    """Random choice of a batch for each of M members."""

    rows: Tensor  # indices of the samples that each member is trained on, int64 (M, B)
    seeds: Tensor  # seed of each member's dropout, int64 (M,)


@dataclass(frozen=True)
class SampleSettings(Group):
    """Training on samples in random order (Bertipaglia et al. 2024, Section IV-C)."""

    group = "training"
    version: ClassVar[str] = "1"
    phase: PhaseSettings = setting(
        PhaseSettings(learning_rate=1e-3, max_epochs=300, patience=20),
        "step size, epochs, patience",
    )
    batch_size: int = setting(1024, "samples in a batch", least=1)
    loss_limit: float = setting(
        0.0,
        "error of the sideslip angle beyond which its square is continued by its tangent (Huber's "
        "loss); of squared errors only; 0: none",
        unit="deg",
        least=0.0,
    )
    dtype: Literal["float32", "float64"] = setting("float32", "precision of the weights")
    checkpoint_seconds: float = setting(15.0, "time between two checkpoints", unit="s")


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
    """The phase in which members are trained on all samples, each in its own random order; its
    validation loss is their mean.

    An epoch draws one permutation of the samples for each member; the last batch may be smaller.
    The losses of members are added, so that each member's gradient is that of its own loss.

    Parameters
    ----------
    name : str
        Name of the phase.
    module : nn.Module
        Module of all members; what happens in one member's parameters must not touch another's.
    settings : PhaseSettings
        Step size, epochs, patience.
    batch_size : int
        Samples of a member's batch.
    n_samples : int
        Number of training samples.
    members : int
        Number M of members.
    losses : Callable[[Draw], Tensor]
        Returns the loss of each member on a batch, (M,).
    judge : Callable[[], Tensor]
        Returns the loss of each member on the validation samples, (M,).

    Returns
    -------
    Phase
        For `vehest.training.sequences.train_phases`.
    """

    def batches(generator: torch.Generator) -> Iterator[Draw]:
        """All samples once, in an order of its own for each member, with a seed of dropout a
        batch.
        """
        order = torch.stack(
            [torch.randperm(n_samples, generator=generator) for _ in range(members)]
        )
        for rows in order.split(batch_size, dim=1):
            yield Draw(rows, torch.randint(2**62, (members,), generator=generator))

    return Phase(
        name,
        settings,
        module,
        batches,
        lambda draw: losses(draw).sum(),
        lambda: float(judge().double().mean()),
    )
