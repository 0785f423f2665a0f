"""Training and scoring on recordings at hand, for Python: the same configuration and arithmetic as the stages, and no artefacts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.schema import settings_from_config
from vehest.data.splits import Span
from vehest.estimators.base import Estimator, FitData
from vehest.evaluation.metrics import accuracy, score
from vehest.run.calibrate import Stretch, learn_trust
from vehest.run.config import compose_config
from vehest.run.downsample import transforms_of
from vehest.run.estimate import find_model, prepared_recording, require_estimate
from vehest.run.evaluate import protocol_from_config
from vehest.run.train import new_estimator
from vehest.trust.record import Trust


def train_on(
    name: str, train: Sequence[Recording], validation: Sequence[Recording], overrides: Sequence[str], seed: int
) -> tuple[Estimator, Trust]:
    """Fit an estimator as conf/train.yaml and overrides describe it, and calibrate it; see `vehest.api.train`."""
    config = compose_config("train", [f"estimator={name}", *overrides])
    model = new_estimator(config["estimator"])
    if config["training"].get("start_from") is not None:
        config["training"]["start_from"] = str(find_model(str(config["training"]["start_from"]), Path(config["output"]), warnings.warn))
    training: Any = settings_from_config(model.training_type, config["training"], "training")
    model.preparation = {"method": config["downsample"]["method"], "transforms": list(config["downsample"]["transforms"] or [])}
    model.seed(seed)
    learnt, stopped = ([_at_rate(recording, model) for recording in part] for part in (train, validation))
    model.fit(FitData(learnt, stopped), training)
    first, second = ([Stretch(recording, recording.start_time, "", recording.id) for recording in part] for part in (learnt, stopped))
    return model, learn_trust(model, first, second)


def score_on(model: Estimator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Metrics of a model on whole recordings under the protocol of conf/eval.yaml; see `vehest.api.score`."""
    evaluation = compose_config("eval")["evaluation"]
    protocol = protocol_from_config({**evaluation, "warm_up_seconds": 0.0, "sequence_seconds": None, "initial_state": False})
    parts = []
    for recording in recordings:
        if "vy_ref" not in recording:
            raise DataError(f"recording '{recording.id}' has no channel 'vy_ref' to score an estimate against")
        needed = prepared_recording(model, recording.without_references(), dict(model.preparation))
        estimate = require_estimate(model, recording, model.estimate([needed])[0])
        reference = _resampled(recording, protocol.rate_hz, model)
        parts.append(score(estimate, reference, Span("", recording.id), protocol))
    return accuracy(parts)


def _at_rate(recording: Recording, model: Estimator) -> Recording:
    for name in (*model.channels, "vy_ref"):
        if name not in recording:
            raise DataError(f"recording '{recording.id}' has no channel '{name}', which training '{model.name}' needs")
    return _resampled(recording, model.settings.rate_hz, model)


def _resampled(recording: Recording, rate_hz: float, model: Estimator) -> Recording:
    """A recording at another rate, in the way of the model's preparation.

    Raises:
        DataError: it is sampled more slowly.
    """
    if recording.rate_hz < rate_hz * (1 - 1e-9):
        raise DataError(f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, below the {rate_hz:g} Hz asked for")
    for transform in transforms_of({"rate_hz": rate_hz, **model.preparation}):
        recording = transform(recording)
    return recording
