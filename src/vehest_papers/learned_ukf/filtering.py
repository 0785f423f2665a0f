"""Trained filters at work on the sequences of a test set, beyond their stored estimates:
unrepaired, as predictors, with swapped models.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.store import read_recording
from vehest.estimators.learned_ukf import LearnedUkf
from vehest.estimators.model_files import load_model
from vehest.evaluation.metrics import WEIGHTS, sequences
from vehest.filters.gaussian import Gaussian
from vehest.filters.unscented_scan import NonlinearFiltered, PointModel
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.training.through_filter import Drive
from vehest.vehicle.dynamics import STATES

MOVING = STATES[:4]  # states that are measured or referenced: all but the friction


class Swapped(PointModel):
    """Moves points by one model and expects measurements by another; without adjoints, so it cannot
    be trained.
    """

    def __init__(self, predicting: PointModel, observing: PointModel) -> None:
        self.working = predicting.working  # type: ignore[method-assign]
        self.lower = predicting.lower  # type: ignore[method-assign]
        self.entries = [_with_its_car(predicting, 0), _with_its_car(observing, 1)]


def _with_its_car(model: PointModel, entry: int) -> Callable[..., None]:
    """An entry of a model, whatever car it is called with."""
    return lambda points, inputs, _, out, first, end: model.entries[entry](
        points, inputs, model.car, out, first, end
    )


def loaded(model: EvaluatedModel) -> LearnedUkf:
    """The filter of an evaluated model; raises `MissingError` where there is none, `DataError`
    where it is damaged or another's.
    """
    estimator = load_model(model.model_folder)
    if not isinstance(estimator, LearnedUkf):
        raise DataError(
            f"'{model.model_folder}' holds a model of '{estimator.name}', not of "
            f"'{LearnedUkf.name}'"
        )
    return estimator


def drives_of(part: PartArtefacts, estimator: LearnedUkf, test: str) -> Drive:
    """The sequences of a test set, as the filter takes them, side by side: (B, T, ...).

    Raises
    ------
    ConfigurationError
        The part is not scored in sequences, or at another rate than the filter's.
    MissingError, DataError
        A recording is missing; one is damaged.
    """
    if (
        part.protocol.sequence_seconds is None
        or part.protocol.rate_hz != estimator.settings.rate_hz
    ):
        raise ConfigurationError(
            f"study '{part.study}' needs evaluation.sequence_seconds, and "
            f"evaluation.rate_hz={estimator.settings.rate_hz:g} as its filters have it, not "
            f"{part.protocol.rate_hz:g}"
        )
    names = dict.fromkeys((span.dataset, span.recording) for span in part.split.tests[test])
    recordings = {key: read_recording(part.references[key]) for key in names}
    pieces = sequences(
        part.split.tests[test], lambda span: recordings[span.dataset, span.recording], part.protocol
    )
    dtype = next(estimator.filter.parameters()).dtype
    drives = [
        estimator.drive(
            recordings[piece.dataset, piece.recording].cut(piece.start, piece.stop), dtype
        )
        for piece in pieces
    ]
    return Drive(*(torch.stack([drive[position] for drive in drives]) for position in range(3)))


def filtered(
    estimator: LearnedUkf,
    drives: Drive,
    model: PointModel | None = None,
    *,
    repair: bool = True,
    friction: float | None = None,
    deviation: float | None = None,
) -> NonlinearFiltered:
    """All sequences filtered together from the true state of their first sample, as the protocol
    has it.

    Parameters
    ----------
    estimator
        Its noise is used, and its models unless another is given.
    drives
        Sequences side by side, (B, T, ...).
    model
        Moves points and expects measurements instead of the estimator's models.
    repair
        Whether covariances that lose definiteness are repaired; otherwise their sequences become
        NaN.
    friction
        Friction that the filter starts from; None: as its settings say.
    deviation
        Standard deviation of the friction at the start; None: as it was trained.
    """
    s = estimator.settings
    start = drives.states[:, 0].clone()
    start[:, -1] = friction or (s.friction if s.start_friction is None else s.start_friction)
    kalman = estimator.filter
    repaired = kalman.repair
    kalman.repair = repair
    try:
        with torch.no_grad():
            covariance = kalman.initial_covariance().clone()
            if deviation is not None:
                covariance[-1, :] = covariance[:, -1] = 0.0
                covariance[-1, -1] = deviation**2
            return kalman.filtered(
                drives.measurements, drives.inputs, Gaussian(start, covariance), model=model
            )
    finally:
        kalman.repair = repaired


def lost_sequences(estimator: LearnedUkf, drives: Drive) -> NDArray[np.bool_]:
    """Whether the covariance of each sequence loses definiteness without repair, (B,)."""
    means = filtered(estimator, drives, repair=False).steps.filtered.mean
    return np.asarray(torch.isnan(means).flatten(1).any(1).numpy(), dtype=np.bool_)


def swapped(predicting: LearnedUkf, observing: LearnedUkf, drives: Drive) -> NonlinearFiltered:
    """Filter all sequences with the model and the noise of one filter in the prediction, and the
    model of another in the observation (Figure 6).
    """
    with torch.no_grad():
        model = Swapped(predicting.filter.point_model(), observing.filter.point_model())
    return filtered(predicting, drives, model)


def squares_of(means: torch.Tensor, drives: Drive, skip: int) -> FloatArray:
    """Mean squared error of each of `MOVING` in each sequence.

    Parameters
    ----------
    means : Tensor
        Filtered states, (B, T, n).
    drives
        Sequences with their true states.
    skip
        Number of first samples of each sequence that are not scored.

    Returns
    -------
    array, shape (B, 4)
        In the squared units of the states.
    """
    errors = (means - drives.states)[:, skip:, : len(MOVING)].double()
    return np.asarray(errors.square().mean(dim=1).numpy(), dtype=np.float64)


def weighted(squares: FloatArray) -> FloatArray:
    """The weighted MSE of mean squares in the order of `MOVING`, (..., 4) -> (...)."""
    return squares @ np.array([WEIGHTS.get(name, 0.0) for name in MOVING])


def one_step_squares(estimator: LearnedUkf, drives: Drive) -> FloatArray:
    """Mean squared error of the prediction of the next sample from each true state; of `MOVING` in
    each sequence, (B, 4).
    """
    states, inputs = (
        part[:, :-1].reshape(-1, part.shape[-1]) for part in (drives.states, drives.inputs)
    )
    with torch.no_grad():
        after = estimator.filter.moved(states, inputs).reshape(drives.states[:, 1:].shape)
    errors = (after - drives.states[:, 1:])[..., : len(MOVING)].double()
    return np.asarray(errors.square().mean(1).numpy(), dtype=np.float64)
