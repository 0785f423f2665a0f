"""One training or one evaluation, for `vehest train` and `vehest eval`: a study with one job and no report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from vehest.data.errors import DataError, MissingError, VehestError
from vehest.data.split_files import dataset_names
from vehest.data.splits import Split
from vehest.run.artefacts import Artefact, find
from vehest.run.calibrate import calibration_of, plan_calibrate, write_calibration
from vehest.run.comparison import Comparison, plan_training, print_notes
from vehest.run.config import Config, compose_config, key_of, positive_rate
from vehest.run.estimate import find_model, model_artefact, preparation_of
from vehest.run.evaluate_faults import fault_figures, write_faulted
from vehest.run.faults import check_channels, faults_of
from vehest.run.group import Group
from vehest.run.rates import lower_rate, slowest
from vehest.run.run_cache import RunOptions
from vehest.run.runner import Runner
from vehest.run.study import Job
from vehest.run.study_run import open_runner
from vehest.run.tracked_runs import log_calibration, log_evaluation, test_figures
from vehest.run.train import TrainJob, learnt_spans, read_fit_metrics, trained_rate


def train_one(overrides: Sequence[str], options: RunOptions) -> dict[str, Any]:
    """Train and calibrate one estimator; empty where it was stopped before its first epoch was over.

    Raises:
        VehestError: the training failed, in its own words.
        DryRunStop: in a dry run.
    """
    config = compose_config("train", overrides)
    with open_runner(config, options, ("train", "calibrate")) as runner:
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
    with open_runner(config, options, ("calibrate", "evaluate")) as runner:
        split = runner.split(config)
        if model is not None:
            config, notes = lower_rate(config, "evaluation", slowest(runner.contents(config)))
            print_notes(notes, runner)
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
        how = runner.evaluation(config, runner.data_for(split, rate, config), faults)
        check_channels(faults, split, how.data)
        calibration = _calibration(trained, split, how.data, runner)
        scoring = how.of(trained, calibration)
        artefact = runner.ensure(scoring.plan, partial(write_faulted, scoring))
        if runner.tracker is not None:
            if calibration is not None:
                log_calibration(runner.tracker, calibration)
            log_evaluation(runner.tracker, artefact, trained, how)
    return {"folder": str(artefact.folder), "skipped": artefact.skipped, **test_figures(artefact), **fault_figures(artefact.folder)}


def _training(config: Config, runner: Runner) -> tuple[Config, TrainJob]:
    """The configuration at a rate that the recordings have, and its training."""
    positive_rate(config["estimator"].get("rate_hz"), "estimator.rate_hz")
    split, comparison = runner.split(config), Comparison("", [Job(config)])
    try:
        comparison.check(runner)
    except DataError as error:
        names = ", ".join(f"'vehest data usable {name}'" for name in dataset_names(config["split"]))
        raise DataError(f"{error}; {names} says what each estimator needs") from None
    config = comparison.jobs[0].config
    return config, plan_training(config, split, runner.data_for(split, float(config["estimator"]["rate_hz"]), config))


def _calibration(model: Artefact, split: Split, data: Mapping[str, Artefact], runner: Runner) -> Artefact | None:
    """The calibration of a model: made on the split that it is evaluated on if it was trained there, else looked for.

    Raises:
        DryRunStop: in a dry run, if it would have to be made.
    """
    learnt, found = learnt_spans(model), None
    if model.status == "complete" and (not learnt or set(learnt) == {*split.train, *split.validation}):
        job = plan_calibrate(model, split, data, runner.output)
        if job is not None:
            found = runner.ensure(job.plan, partial(write_calibration, job))
    elif learnt:  # one of a model that learns nothing may have seen these tests
        found = calibration_of(model.folder, runner.output)
    if found is None:
        runner.messages.line("note", "calibrate", model.label, "has no calibration, so its estimates have no bands")
    return found
