"""How networks are trained, as conf/training/*.yaml states it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Literal, TypeVar

from vehest.data.errors import ConfigurationError


@dataclass(frozen=True)
class SupervisedSettings:
    """Supervised training of windowed networks (Da Lio et al. 2023, Section VI-B).

    Args:
        learning_rate: Adam's step size.
        batch_size: windows in a batch.
        max_epochs: epochs after which training ends in any case.
        patience: epochs without a better validation loss after which a member stops.
        dtype: ``float32`` or ``float64``.
        compiled: use the compiled recursion where the network has one; the plain PyTorch one otherwise.
        checkpoint_seconds: time between two checkpoints [s].
    """

    learning_rate: float = 1e-3
    batch_size: int = 64
    max_epochs: int = 1000
    patience: int = 25
    dtype: Literal["float32", "float64"] = "float32"
    compiled: bool = True
    checkpoint_seconds: float = 15.0

    def __post_init__(self) -> None:
        if not self.learning_rate > 0:
            raise ConfigurationError(f"training.learning_rate must be positive, not {self.learning_rate}")
        for name in ("batch_size", "max_epochs", "patience"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"training.{name} must be at least 1, not {getattr(self, name)}")
        if self.dtype not in ("float32", "float64"):
            raise ConfigurationError(f"training.dtype '{self.dtype}' is not one of: float32, float64")


@dataclass(frozen=True)
class PhaseSettings:
    """One phase of training by gradient on sequences or pairs (`vehest.training.sequences`).

    Args:
        learning_rate: AdamW's step size.
        max_epochs: epochs after which the phase ends in any case; 0 leaves it out.
        patience: epochs without a better validation loss after which it ends; 0 never ends it early.
        validate_every: epochs between two validations; the last epoch is always validated.
        clip: bound on the magnitude of each element of the gradient; 0 for none.
        weight_decay: AdamW's decoupled weight decay.
        schedule: ``constant`` step size, or ``cosine`` from the full one to zero over ``max_epochs``.

    Raises:
        ConfigurationError: a value that makes no sense.
    """

    learning_rate: float = 5e-4
    max_epochs: int = 1000
    patience: int = 0
    validate_every: int = 1
    clip: float = 1e3
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine"] = "constant"

    def __post_init__(self) -> None:
        if not self.learning_rate > 0:
            raise ConfigurationError(f"training: learning_rate must be positive, not {self.learning_rate}")
        if self.validate_every < 1:
            raise ConfigurationError(f"training: validate_every must be at least 1, not {self.validate_every}")
        for name in ("max_epochs", "patience", "clip", "weight_decay"):
            if getattr(self, name) < 0:
                raise ConfigurationError(f"training: {name} must not be negative, not {getattr(self, name)}")
        if self.schedule not in ("constant", "cosine"):
            raise ConfigurationError(f"training: schedule '{self.schedule}' is not one of: constant, cosine")


@dataclass(frozen=True)
class SequenceSettings:
    """Training of recurrent networks on sequences cut from recordings (Węgrzynowski et al. 2024, Section IV).

    Args:
        phase: the one phase of the training.
        sequence_steps: samples in a training sequence, the dropped ones included.
        validation_steps: samples in a validation sequence, the dropped ones included.
        dropped_steps: first samples of every sequence, on which the hidden state settles; no loss is taken of them.
        batch_size: sequences in a batch.
        weight_vx: of the squared error of vx in the loss; likewise the others.
        weight_vy: of vy.
        weight_yaw_rate: of the yaw rate.
        dtype: ``float32`` or ``float64``.
        checkpoint_seconds: time between two checkpoints [s].

    Raises:
        ConfigurationError: a value that makes no sense.
    """

    phase: PhaseSettings = PhaseSettings()
    sequence_steps: int = 300
    validation_steps: int = 1000
    dropped_steps: int = 200
    batch_size: int = 4
    weight_vx: float = 0.2225
    weight_vy: float = 0.5064
    weight_yaw_rate: float = 0.1566
    dtype: Literal["float32", "float64"] = "float32"
    checkpoint_seconds: float = 15.0

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ConfigurationError(f"training.batch_size must be at least 1, not {self.batch_size}")
        if self.dropped_steps < 0:
            raise ConfigurationError(f"training.dropped_steps must not be negative, not {self.dropped_steps}")
        for name in ("sequence_steps", "validation_steps"):
            if getattr(self, name) <= self.dropped_steps:
                raise ConfigurationError(
                    f"training.{name} must be more than dropped_steps ({self.dropped_steps}), not {getattr(self, name)}"
                )
        for name in ("weight_vx", "weight_vy", "weight_yaw_rate"):
            if getattr(self, name) < 0:
                raise ConfigurationError(f"training.{name} must not be negative, not {getattr(self, name)}")
        if self.dtype not in ("float32", "float64"):
            raise ConfigurationError(f"training.dtype '{self.dtype}' is not one of: float32, float64")


@dataclass(frozen=True)
class DirectSearchSettings:
    """Nelder-Mead from a grid of starts inside a box (Da Lio et al. 2023, Appendix A).

    Args:
        grid: starts along each parameter.
        max_evaluations: evaluations allowed from each start.
        tolerance: relative change of the parameters at which a search ends.
    """

    grid: int = 4
    max_evaluations: int = 400
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        if self.grid < 1 or self.max_evaluations < 1:
            raise ConfigurationError("training.grid and training.max_evaluations must be at least 1")
        if not self.tolerance > 0:
            raise ConfigurationError(f"training.tolerance must be positive, not {self.tolerance}")


@dataclass(frozen=True)
class NoiseTuningSettings:
    """How a filter comes by its noise levels.

    Args:
        method: ``data`` reads sensors' levels off measured signals and takes the rest as assumed; ``nelder_mead`` and ``optuna`` (extra
            ``tuning``) look for the levels with the smallest error of sideslip on the training recordings.
        curves_from: training recordings, by a pattern of their ids, that axle curves are fitted to; levels of noise are found on all.
        grid: starts of Nelder-Mead along each level.
        max_evaluations: evaluations allowed from each start.
        tolerance: relative change of the levels at which a search ends.
        trials: evaluations of Optuna.
        skip_seconds: first seconds of each recording that do not count [s].
    """

    method: Literal["data", "nelder_mead", "optuna"] = "nelder_mead"
    curves_from: str = "*"
    grid: int = 2
    max_evaluations: int = 80
    tolerance: float = 1e-3
    trials: int = 200
    skip_seconds: float = 1.5

    def __post_init__(self) -> None:
        if self.method not in ("data", "nelder_mead", "optuna"):
            raise ConfigurationError(f"training.method '{self.method}' is not one of: data, nelder_mead, optuna")
        if self.trials < 1:
            raise ConfigurationError(f"training.trials must be at least 1, not {self.trials}")
        if self.skip_seconds < 0:
            raise ConfigurationError(f"training.skip_seconds must not be negative, not {self.skip_seconds}")
        self.search  # noqa: B018

    @property
    def search(self) -> DirectSearchSettings:
        """What Nelder-Mead is told."""
        return DirectSearchSettings(self.grid, self.max_evaluations, self.tolerance)


@dataclass(frozen=True)
class IdentificationSettings(NoiseTuningSettings):
    """How a filter comes by its tyres and its noise levels (Bertipaglia et al. 2024, Section III-B).

    Args:
        method: as in `NoiseTuningSettings`; ``data`` searches nothing and takes process noise as the paper has it.
        trials: evaluations of Optuna in all stages together.
        stages: of Optuna; after the first, the box shrinks around the best so far.
        shrink: width of the box of a stage, relative to that of the stage before.
        tyres_from: pattern of the names of those training recordings that tyres are identified on.
        restarts: genetic searches for the tyres, of which the best counts.
        generations: of each, at most.
    """

    method: Literal["data", "nelder_mead", "optuna"] = "optuna"
    trials: int = 60
    stages: int = 2
    shrink: float = 0.3
    tyres_from: str = "*skidpad*"
    restarts: int = 5
    generations: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("stages", "restarts", "generations"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} of an identification must be at least 1, not {getattr(self, name)}")
        if self.stages > self.trials:
            raise ConfigurationError(f"stages of an identification must be at most its trials ({self.trials}), not {self.stages}")
        if not 0.0 < self.shrink <= 1.0:
            raise ConfigurationError(f"shrink of an identification must lie between 0 and 1, not at {self.shrink}")


@dataclass(frozen=True)
class NoTraining:
    """Nothing to set: what the estimator needs is given, or read off the data as it is."""


Settings = TypeVar("Settings")


def settings_from_config(kind: type[Settings], config: Mapping[str, Any], group: str) -> Settings:
    """Build a settings dataclass from plain values; a mapping becomes the dataclass that the field's default is of.

    Raises:
        ConfigurationError: an unknown key, or a value of the wrong type.
    """
    types = {field.name: str(field.type) for field in fields(kind)}  # type: ignore[arg-type]
    nested = {field.name: type(field.default) for field in fields(kind) if is_dataclass(field.default)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in config.items():
        if key == "name":
            continue
        if key not in types:
            raise ConfigurationError(f"{group}.{key} is not an option of {group}; options: {', '.join(types) or 'none'}")
        if key in nested:
            if not isinstance(value, Mapping):
                raise ConfigurationError(f"{group}.{key} must be a group of options, not {value!r}")
            values[key] = settings_from_config(nested[key], value, f"{group}.{key}")
        else:
            values[key] = _converted(f"{group}.{key}", value, types[key])
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"{group}: {error}") from None


def _converted(name: str, value: Any, type_name: str) -> Any:
    if type_name == "bool":
        if not isinstance(value, bool):
            raise ConfigurationError(f"{name} must be true or false, not {value!r}")
        return value
    if type_name == "int":
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value != int(value):
            raise ConfigurationError(f"{name} must be a whole number, not {value!r}")
        return int(value)
    if value is None and "None" in type_name.split(" | "):
        return None
    if "float" in type_name.split(" | "):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigurationError(f"{name} must be a number, not {value!r}")
        return float(value)
    return value
