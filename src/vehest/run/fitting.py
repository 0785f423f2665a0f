"""Trains and scores models on recordings of Python (`vehest.api`)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vehest.data.recording import Recording
from vehest.data.schema import settings_from_config
from vehest.data.splits import Span
from vehest.estimators.base import Estimator, FitData
from vehest.evaluation.metrics import accuracy, score
from vehest.run.calibrate import Stretch, learn_trust
from vehest.run.config import compose_config
from vehest.run.downsample import resampled
from vehest.run.estimate import find_model, prepared_recording, require_estimate
from vehest.run.evaluate import protocol_from_config
from vehest.run.train import new_estimator
from vehest.trust.record import Trust


def train_on(
    name: str, train: Sequence[Recording], validation: Sequence[Recording], overrides: Sequence[str], seed: int
) -> tuple[Estimator, Trust]:
    """Fit an estimator as conf/train.yaml and overrides describe it, and calibrate it; see `vehest.api.train`."""
    config = compose_config("train", [f"estimator={name}", *overrides])
    model, training = new_estimator(config["estimator"]), config["training"]
    if training.get("start_from") is not None:
        training["start_from"] = str(find_model(str(training["start_from"]), Path(config["output"]), warnings.warn))
    settings: Any = settings_from_config(model.training_type, training, "training")
    model.preparation = {"method": config["downsample"]["method"], "transforms": list(config["downsample"]["transforms"] or [])}
    model.seed(seed)
    parts = [[resampled(recording, model.settings.rate_hz, model.preparation) for recording in part] for part in (train, validation)]
    model.fit(FitData(*parts), settings)
    learnt, stopped = ([Stretch(recording, recording.start_time, "", recording.id) for recording in part] for part in parts)
    return model, learn_trust(model, learnt, stopped)


def score_on(model: Estimator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Metrics of a model on whole recordings under the protocol of conf/eval.yaml; see `vehest.api.score`."""
    evaluation = compose_config("eval")["evaluation"]
    protocol = protocol_from_config({**evaluation, "warm_up_seconds": 0.0, "sequence_seconds": None, "initial_state": False})
    parts = []
    for recording in recordings:
        needed = prepared_recording(model, recording.without_references())
        estimate = require_estimate(model, recording, model.estimate([needed])[0])
        parts.append(score(estimate, resampled(recording, protocol.rate_hz, model.preparation), Span("", recording.id), protocol))
    return accuracy(parts)
