"""Settings of the supervised training of windowed networks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from vehest.declared import Group, setting


@dataclass(frozen=True)
class SupervisedSettings(Group):
    """Supervised training of windowed networks (Da Lio et al. 2023, Section VI-B)."""

    group = "training"
    version: ClassVar[str] = "1"
    learning_rate: float = setting(1e-3, "Adam's step size", positive=True)
    batch_size: int = setting(64, "windows in a batch", least=1)
    max_epochs: int = setting(1000, "epochs after which training ends in any case", least=1)
    patience: int = setting(
        25, "epochs without a better validation loss after which a training stops", least=1
    )
    epoch_steps: int = setting(
        0,
        "steps of an epoch, on windows drawn anew without replacement; 0: as many as use every "
        "window once",
        least=0,
    )
    averaging: float = setting(
        0.0,
        "decay a step of an exponential moving average of the weights, corrected for its start, "
        "which is then validated and kept; 0: none",
        least=0.0,
        below=1.0,
    )
    dtype: Literal["float32", "float64"] = setting("float32", "precision of the weights")
    compiled: bool = setting(
        True, "use the compiled recursion where the network has one; plain PyTorch otherwise"
    )
    start_from: str | None = setting(
        None, "model to start from, by its folder or the start of its name, or pretrained"
    )
    checkpoint_seconds: float = setting(15.0, "time between two checkpoints", unit="s")
