"""One training or one evaluation, as `vehest train` and `vehest eval` ask for it: a study with one job and no report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from vehest.data.errors import MissingError, VehestError
from vehest.run.artefacts import find
from vehest.run.comparison import check_evaluation, check_job, plan_training
from vehest.run.config import Config, compose_config, key_of, positive_rate
from vehest.run.estimate import find_model, model_artefact, preparation_of
from vehest.run.evaluate import Evaluation, fault_figures, protocol_from_config, write_evaluation
from vehest.run.faults import check_channels, faults_of
from vehest.run.group import Group
from vehest.run.run_cache import RunOptions
from vehest.run.runner import Runner
from vehest.run.study_run import open_runner
from vehest.run.tracked_runs import log_calibration, log_evaluation, test_figures
from vehest.run.train import TrainJob, read_fit_metrics, trained_rate


def train_one(overrides: Sequence[str], options: RunOptions) -> dict[str, Any]:
    """Train and calibrate one estimator; empty where it was stopped before its first epoch was over.

    Raises:
        VehestError: the training failed, in its own words.
        DryRunStop: in a dry run.
    """
    config = compose_config("train", overrides)
    with open_runner(config, options, frozenset({"train", "calibrate"})) as runner:
        config, job = _training(config, runner)
        members, failures = runner.run([Group([job], None, runner.force, split=runner.split(config))])
        for failure in failures.values():
            if failure.detail:
                runner.messages.warn(failure.detail)
            error = VehestError(failure.message)
            error.exit_code = failure.exit_code
            raise error
    model = next((member.model for member in members.values()), None)
    if model is None:
        return {}
    return {"model": str(model.folder), "status": model.status, "skipped": model.skipped, **read_fit_metrics(model.folder)}


def evaluate_one(overrides: Sequence[str], model: str | None, options: RunOptions, note: Callable[[str], None]) -> dict[str, Any]:
    """Evaluate one model on the tests of a split.

    Args:
        overrides: of ``eval``.
        model: folder or start of its name; none for the one that the overrides train.
        options: of the command.
        note: takes remarks on how the model was found.

    Raises:
        MissingError: the model is not there.
        DryRunStop: in a dry run.
    """
    config = compose_config("eval", overrides)
    faults = faults_of(config)
    with open_runner(config, options, frozenset({"calibrate", "evaluate"})) as runner:
        split = runner.split(config)
        if model is not None:
            config = check_evaluation(config, runner)
            trained = model_artefact(find_model(model, runner.output, note))
            rate = trained_rate(trained)
            if not any(key_of(override).split(".")[0] == "downsample" for override in overrides):
                config["downsample"] = preparation_of(trained.folder)
        else:
            config, job = _training(config, runner)
            found, rate = find(job.plan), float(config["estimator"]["rate_hz"])
            if found is None:
                raise MissingError(f"{job.plan.label} has not been trained; run 'vehest train {' '.join(overrides)}' first")
            trained = found
        protocol = protocol_from_config(config["evaluation"])
        data, references = runner.data_for(split, rate, config), runner.references_for(split, protocol.rate_hz, config)
        check_channels(faults, split, data)
        calibration = runner.calibration(trained, split, data)
        how = Evaluation(split, data, references, runner.kinds_of(split, config), protocol, runner.output, faults)
        scoring = how.of(trained, calibration)
        artefact = runner.ensure(scoring.plan, lambda folder: write_evaluation(scoring, folder))
        if runner.tracker is not None:
            if calibration is not None:
                log_calibration(runner.tracker, calibration)
            log_evaluation(runner.tracker, artefact, trained, how)
    return {"folder": str(artefact.folder), "skipped": artefact.skipped, **test_figures(artefact), **fault_figures(artefact.folder)}


def _training(config: Config, runner: Runner) -> tuple[Config, TrainJob]:
    """The configuration at a rate that the recordings have, and its training."""
    positive_rate(config["estimator"].get("rate_hz"), "estimator.rate_hz")
    split, config = runner.split(config), check_job(config, runner)
    return config, plan_training(config, split, runner.data_for(split, float(config["estimator"]["rate_hz"]), config))
