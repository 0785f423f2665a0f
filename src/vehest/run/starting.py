"""Trainings that start from another model's weights: the model is found, and counts as an input of what is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vehest.data.splits import Split
from vehest.run.artefacts import Artefact
from vehest.run.estimate import find_model, model_artefact
from vehest.run.train import TrainJob, plan_train


def plan_training(config: Mapping[str, Any], split: Split, data: Mapping[str, Artefact]) -> TrainJob:
    """What a training would make, be it from scratch or from a model; see `plan_train`.

    Raises:
        ConfigurationError: a setting that makes no sense.
        DataError: the split names a recording that the data set does not have.
        MissingError: the model to start from is not there.
    """
    job = plan_train(config, split, data)
    start = config["training"].get("start_from")
    if start is None:
        return job
    folder = find_model(str(start), job.plan.output, lambda _: None)
    plan = replace(job.plan, inputs={**job.plan.inputs, f"start from {start}": model_artefact(folder).digest})
    return replace(job, plan=plan, training={**job.training, "start_from": str(folder.resolve())})
