"""Training of a filter's model: as a one-step predictor, and through the filter, on sequences that
start at the true state.

    drives --sequences_of, placed--> batches --filtering.estimated--> errors --loss--> gradients

`one_step_phase` and `filter_phases` return `Phase`s, which `vehest.training.sequences.train_phases`
runs.

The module uses no property of cars or of a certain filter: ``filtering`` is a module with
``mirror``, ``moved``, ``begin_noise``, ``estimated`` and ``estimate_for_validation``, as
`vehest.estimators.filtering.car_filter.CarFilter` has them.

Source: Węgrzynowski et al. 2024, Section III-B.4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from vehest.data.errors import ConfigurationError, DataError
from vehest.declared import Group, setting
from vehest.training.sequences import Phase, PhaseSettings


class Drive(NamedTuple):
    """An uninterrupted drive, sampled, or several of one length."""

    states: Tensor  # true states, (..., T, n)
    inputs: Tensor  # inputs of the model, (..., T, p)
    measurements: Tensor  # measurements of the filter, (..., T, m); NaN: not measured


@dataclass(frozen=True)
class ThroughFilterSettings(Group):
    """Settings of the training of a filter's model (Węgrzynowski et al. 2024, Section IV-A, and its
    authors' code).
    """

    group = "training"
    version: ClassVar[str] = "1"
    one_step: PhaseSettings = setting(
        PhaseSettings(learning_rate=2e-3, max_epochs=500, validate_every=10, schedule="cosine"),
        "the model as a one-step predictor; paper: constant step size 5e-4, 1000 epochs",
    )
    one_step_batch: int = setting(2048, "pairs of samples in a batch", least=1)
    through: PhaseSettings = setting(
        PhaseSettings(learning_rate=2e-3, max_epochs=300, validate_every=5, schedule="cosine"),
        "model and noise together, through the filter, for models that learn so; paper: constant "
        "step size 5e-4, 1000 epochs of one batch each",
    )
    noise: PhaseSettings = setting(
        PhaseSettings(learning_rate=1e-2, max_epochs=40, validate_every=5, schedule="cosine"),
        "noise alone, through the filter, with the model as it is; for the others",
    )
    steps: int = setting(500, "samples T of a training sequence", least=1)
    drop_steps: int = setting(0, "first samples of a sequence that do not count", least=0)
    batch_size: int = setting(
        6, "sequences in a batch; paper: 256, which is all of them at once", least=1
    )
    placing: Literal["fixed", "random"] = setting(
        "random", "fixed: the same sequences every epoch, as in the paper; random: starts are drawn"
    )
    curriculum: tuple[int, ...] = setting(
        (),
        "lengths of shorter sequences to begin with, such as [100, 250], each for "
        "curriculum_epochs",
    )
    curriculum_epochs: int = setting(100, "epochs with each length of curriculum", least=1)
    truncate_steps: int = setting(
        0, "samples that gradients reach back; 0: to the start of the sequence", least=0
    )
    validation_steps: int = setting(1000, "samples of a validation sequence", least=1)
    validation_drop_steps: int = setting(
        200, "first samples of a validation sequence that do not count", least=0
    )
    start_spread: float = setting(
        0.2,
        "by how much the last state (friction) is off at the start of a training sequence, at "
        "most, up or down; paper: 0",
        least=0.0,
    )
    mirrored: float = setting(
        0.5,
        "share of sequences and pairs that are mirrored, left for right; paper: 0",
        least=0.0,
        most=1.0,
    )
    likelihood: float = setting(
        0.0,
        "weight of the mean negative log-likelihood of the errors of those states that epochs are "
        "judged by, under the filter's own covariance [nat], in the loss: it teaches a filter how "
        "sure to be; 0 leaves it out, as in the paper",
        least=0.0,
    )
    start_noise: Literal["residuals", "given"] = setting(
        "residuals",
        "residuals: noise starts from those of the pre-trained model and learns in units of them; "
        "given: the authors' values",
    )
    dtype: Literal["float32", "float64"] = setting("float32", "precision of the weights")
    checkpoint_seconds: float = setting(15.0, "time between two checkpoints", unit="s")

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for sequences of which nothing would count."""
        super().__post_init__()
        if self.drop_steps >= self.steps or self.validation_drop_steps >= self.validation_steps:
            raise ConfigurationError(
                "training: more steps are dropped than a sequence has; lower drop_steps or "
                "validation_drop_steps"
            )
        if any(steps <= self.drop_steps for steps in self.curriculum):
            raise ConfigurationError(
                f"training.curriculum must hold lengths above drop_steps ({self.drop_steps}), not "
                f"{self.curriculum}"
            )


class Weights(NamedTuple):
    """Weight of each state's squared error, (n,): of the one-step prediction, through the filter,
    and when judging epochs.
    """

    one_step: Tensor  # weights of the one-step prediction, (n,)
    training: Tensor  # weights of the estimate through the filter, (n,)
    validation: Tensor  # weights of the estimate when epochs are judged, (n,)


def one_step_phase(
    filtering: Any,
    train: Sequence[Drive],
    validation: Sequence[Drive],
    weights: Weights,
    settings: ThroughFilterSettings,
    trainable: Callable[[str], bool],
) -> Phase:
    """Phase that trains the model as a predictor of the next sample, without the filter.

    Loss: mean over pairs of samples of Σ_i w_i (f(x, u)_i - x⁺_i)², with w = ``weights.one_step``.

    Each pair is mirrored with the probability ``settings.mirrored``: signs of states and inputs
    that change under a reflection at the car's longitudinal plane are those of
    ``filtering.mirror``.

    Parameters
    ----------
    filtering : Any
        Module with ``moved(states (N, n), inputs (N, p)) -> (N, n)`` and ``mirror``.
    train, validation : Sequence[Drive]
        True states (T, n) and inputs (T, p); pairs are of consecutive samples within a drive.
    weights : Weights
        Of which those of the one-step prediction count.
    settings : ThroughFilterSettings
        Batch size, share of mirrored pairs, and settings of the phase.
    trainable : Callable[[str], bool]
        Which parameters of ``filtering`` learn, by name.
    """
    before, inputs, after = _pairs(train)
    judged = _pairs(validation)
    signs = [before.new_tensor(list(filtering.mirror[part])) for part in (0, 1)]

    def batches(generator: torch.Generator) -> Iterable[tuple[Tensor, Tensor]]:
        """Rows of all pairs in random order, and which of them are mirrored."""
        for rows in torch.randperm(len(before), generator=generator).split(settings.one_step_batch):
            yield rows, _chosen(len(rows), settings.mirrored, generator)

    def loss(batch: tuple[Tensor, Tensor]) -> Tensor:
        rows, turned = batch
        states = torch.where(turned, signs[0], 1.0)
        input_signs = torch.where(turned, signs[1], 1.0)
        return _weighted(
            filtering.moved(states * before[rows], input_signs * inputs[rows])
            - states * after[rows],
            weights.one_step,
        )

    def judge() -> float:
        return float(_weighted(filtering.moved(judged[0], judged[1]) - judged[2], weights.one_step))

    return Phase("one_step", settings.one_step, filtering, batches, loss, judge, trainable)


def filter_phases(
    filtering: Any,
    train: Sequence[Drive],
    validation: Sequence[Drive],
    weights: Weights,
    settings: ThroughFilterSettings,
    phase_settings: PhaseSettings,
    trainable: Callable[[str], bool],
    name: str,
) -> list[Phase]:
    """Phases that train through the filter: one for each length of the curriculum, then full
    length.

    Loss of a batch: mean over its samples of Σ_i w_i (x̂_i - x_i)², with w = ``weights.training``,
    plus ``settings.likelihood`` times `gaussian_surprise`.

    A sequence starts at its true state with the initial covariance of ``filtering``; the last state
    may be off by up to ``settings.start_spread``. Validation uses fixed sequences of
    ``settings.validation_steps`` from true states, of which the first ones do not count.

    Parameters
    ----------
    filtering : Any
        See the module.
    train, validation : Sequence[Drive]
        Drives of any length.
    weights : Weights
        Weights of the squared errors of states.
    settings : ThroughFilterSettings
        Sequences, curriculum, mirroring, likelihood.
    phase_settings : PhaseSettings
        Settings of each phase; epochs of the curriculum's phases are
        ``settings.curriculum_epochs``.
    trainable : Callable[[str], bool]
        Which parameters learn, by name.
    name : str
        Name of the last phase; to those of the curriculum their length is appended.

    Returns
    -------
    list[Phase]
        The first may start noise from the residuals of the model before its first validation.

    Raises
    ------
    DataError
        No training or validation drive is long enough.
    """
    judged = sequences_of(validation, settings.validation_steps)
    judged_by = torch.nonzero(weights.validation).flatten()

    def judge() -> float:
        """Weighted mean squared error of estimates on validation sequences, as in use."""
        estimated = filtering.estimate_for_validation(judged)
        error = (estimated - judged.states)[:, settings.validation_drop_steps :]
        return float(_weighted(error, weights.validation))

    def prepare() -> None:
        if settings.start_noise == "residuals":
            filtering.begin_noise(train, settings.start_spread)

    def phase(steps: int, epochs: int, label: str, first: bool) -> Phase:
        """Phase of sequences of ``steps`` samples for ``epochs`` epochs."""
        fixed = sequences_of(train, steps)

        def batches(generator: torch.Generator) -> Iterable[tuple[Drive, Tensor]]:
            """Mirrored sequences (B, T, ...) with the states that they start from, (B, n)."""
            drives = fixed if settings.placing == "fixed" else placed(train, steps, generator)
            order = torch.randperm(len(drives.states), generator=generator)
            for rows in order.split(settings.batch_size):
                turned = _chosen(len(rows), settings.mirrored, generator).unsqueeze(-1)
                signs = [
                    torch.where(turned, part.new_tensor(list(mirror_signs)), 1.0)
                    for part, mirror_signs in zip(drives, filtering.mirror, strict=True)
                ]
                batch = Drive(
                    *(part[rows] * sign for part, sign in zip(drives, signs, strict=True))
                )
                start = batch.states[:, 0].clone()
                if settings.start_spread:
                    offset = (
                        2.0 * torch.rand(len(rows), generator=generator, dtype=start.dtype) - 1.0
                    )
                    start[:, -1] = start[:, -1] + settings.start_spread * offset
                yield batch, start

        def loss(batch: tuple[Drive, Tensor]) -> Tensor:
            """Weighted squared errors through the filter, plus the likelihood where it has a
            weight.
            """
            drives, start = batch
            truncated = settings.truncate_steps or None
            scored = slice(settings.drop_steps, None)
            estimated, covariance = filtering.estimated(drives, start, truncated)
            error = (estimated - drives.states)[:, scored]
            squares = _weighted(error, weights.training)
            if not settings.likelihood:
                return squares
            covariance = covariance[:, scored][..., judged_by, :][..., judged_by]
            return squares + settings.likelihood * gaussian_surprise(
                error[..., judged_by], covariance
            )

        length_settings = PhaseSettings(**{**vars(phase_settings), "max_epochs": epochs})
        return Phase(
            label,
            length_settings,
            filtering,
            batches,
            loss,
            judge,
            trainable,
            prepare if first else None,
        )

    lengths = [
        (steps, settings.curriculum_epochs, f"{name}_{steps}") for steps in settings.curriculum
    ]
    lengths.append((settings.steps, phase_settings.max_epochs, name))
    return [phase(*length, first=number == 0) for number, length in enumerate(lengths)]


def sequences_of(drives: Sequence[Drive], steps: int) -> Drive:
    """Drives cut from their start into sequences of so many steps, without overlap; a remainder is
    left out.

    Returns
    -------
    Drive
        Of sequences (B, steps, ...), in the order of the drives.

    Raises
    ------
    DataError
        No drive is long enough.
    """
    starts = [
        (drive, first)
        for drive in drives
        for first in range(0, len(drive.states) - steps + 1, steps)
    ]
    return _stacked(starts, steps)


def placed(drives: Sequence[Drive], steps: int, generator: torch.Generator) -> Drive:
    """Cut as many sequences of ``steps`` samples from each drive as fit into it, each at a random
    place.


    They may overlap. Raises `DataError` where no drive is long enough.
    """
    starts = []
    for drive in drives:
        count = len(drive.states) // steps
        room = len(drive.states) - steps + 1
        starts += [(drive, int(torch.randint(room, (), generator=generator))) for _ in range(count)]
    return _stacked(starts, steps)


def _stacked(starts: Sequence[tuple[Drive, int]], steps: int) -> Drive:
    """Cut sequences from (drive, first row) pairs and stack them: (B, steps, ...)."""
    if not starts:
        raise DataError(
            f"no drive is {steps} samples long, as a sequence for training through a filter is; "
            "lower training.steps"
        )
    return Drive(
        *(
            torch.stack([drive[part][first : first + steps] for drive, first in starts])
            for part in range(3)
        )
    )


def _chosen(count: int, share: float, generator: torch.Generator) -> Tensor:
    """Random mask (count, 1) of the sequences or pairs that are mirrored, with the probability
    ``share`` each.
    """
    return torch.rand(count, 1, generator=generator) < share


def _pairs(drives: Sequence[Drive]) -> list[Tensor]:
    """All pairs of consecutive samples of drives: states (N, n), inputs (N, p), and states one
    sample later (N, n).
    """
    pairs = [(drive.states[:-1], drive.inputs[:-1], drive.states[1:]) for drive in drives]
    return [torch.cat(parts) for parts in zip(*pairs, strict=True)]


def gaussian_surprise(error: Tensor, covariance: Tensor) -> Tensor:
    """Mean negative log-likelihood of errors under normal distributions.

    ½ (eᵀ P⁻¹ e + ln det P + k ln 2π), by the Cholesky factor of P.

    Parameters
    ----------
    error : Tensor
        e, (..., k).
    covariance : Tensor
        P, (..., k, k); where it is not positive definite the result is not finite or meaningless,
        and nothing is raised.

    Returns
    -------
    Tensor
        Scalar [nat].
    """
    factor = torch.linalg.cholesky_ex(covariance).L
    whitened = torch.linalg.solve_triangular(factor, error.unsqueeze(-1), upper=False).squeeze(-1)
    logarithms = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return (
        0.5 * whitened.square().sum(-1)
        + logarithms
        + 0.5 * error.shape[-1] * math.log(2.0 * math.pi)
    ).mean()


def _weighted(error: Tensor, weights: Tensor) -> Tensor:
    """Mean of the weighted squared error, Σ_i w_i e_i², of errors (..., n) and weights (n,)."""
    return (error.square() @ weights).mean()
