"""Runs studies, sweeps, single trainings and evaluations, from a command's overrides to what is printed and published.

jobs (`study`) -> `Comparison.check`, `plan` -> `Runner.run` -> `collect` -> report -> results/ and `RunCache.save`
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, MissingError, VehestError
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.split_files import dataset_names
from vehest.data.splits import Split
from vehest.run.artefacts import Artefact, find
from vehest.run.calibrate import calibration_of, plan_calibrate
from vehest.run.comparison import Comparison, failed_in, lower_rate, plan_training, print_notes, slowest
from vehest.run.config import Config, compose_config, key_of, positive_rate
from vehest.run.console import Messages
from vehest.run.estimate import find_model, model_artefact, preparation_of
from vehest.run.evaluate import fault_figures, write_evaluation
from vehest.run.evaluate_faults import check_channels, faults_of
from vehest.run.group import Group
from vehest.run.ingest import STAGE as INGEST
from vehest.run.ingest import plan_ingest
from vehest.run.launchers.base import chosen_launcher
from vehest.run.launchers.local import default_jobs
from vehest.run.published import keys_of_study
from vehest.run.publishing import Publication, publish_study
from vehest.run.report import STAGE as REPORT
from vehest.run.report import draw_report
from vehest.run.run_cache import Ran, RunCache, RunOptions, stamps_of
from vehest.run.runner import Runner
from vehest.run.signals import DryRunStop, StopSignals
from vehest.run.study import Job, Jobs, Study, content_overrides, jobs_of, read_study, sweep_of
from vehest.run.sweep import STAGE as SWEEP
from vehest.run.sweep import draw_sweep
from vehest.run.tracking import Tracker, log_calibration, log_evaluation, test_figures
from vehest.run.train import TrainJob, learnt_spans, read_fit_metrics, trained_rate
from vehest.sources.base import kind_of
from vehest.studies.artefacts import AbsentDataset, StoredDataset

SWEEP_STAGES = frozenset({"train", "calibrate", "evaluate", SWEEP})
STUDY_STAGES = frozenset({"ingest", "downsample", "train", "calibrate", "evaluate", REPORT})


@contextmanager
def open_runner(config: Config, options: RunOptions, stages: Collection[str], study: str = "") -> Iterator[Runner]:
    """A runner that listens to signals, runs ``stages`` anew under ``options.force``, and logs runs under a study, if there is one."""
    messages, stop, output = Messages(quiet=options.quiet), StopSignals(), Path(config["output"])
    tracker = Tracker(config["tracking"], output, messages.warn, stop.requested, study) if options.track or study else None
    forced = frozenset(stages if options.force else ())
    runner = Runner(output, messages, stop, options.jobs or default_jobs(), forced, options.dry_run, tracker)
    if options.launcher is not None:
        runner.launcher = chosen_launcher(options.launcher, options.jobs, output, messages)
    try:
        with use_limits(limits_from_config(config["limits"])), stop.installed():
            yield runner
    finally:
        if runner.launcher is not None:
            runner.launcher.close()


def run_study(
    name: str | None, overrides: Sequence[str], options: RunOptions, cache: RunCache, *, sweep: bool = False, only_report: bool = False
) -> Ran:
    """Run every stage of a pipeline, or of a sweep; what is there is skipped. A study that overrides changed is not published.

    Args:
        name: of the pipeline, or its path; of a sweep the start of its folder's name, none for the estimators and the split.
        overrides: for all jobs that have their key; of a sweep, with several values.
        options: of the command.
        cache: keeps the finished study.
        sweep: whether the overrides make a sweep.
        only_report: draw the report from what is there, train and evaluate nothing.

    Raises:
        ConfigurationError: an override that suits no job, or overrides that make no sweep.
        JobsFailedError: some jobs of a study in parts, or all of another, failed; finished artefacts are kept.
        DataError: recordings lack what some job of a study in parts, or all of another, needs; nothing was trained.
        MissingError: raw files are missing, or ``only_report`` and a training is.
        DryRunStop: in a dry run.
        Stopped: a signal came; finished artefacts stay.
    """
    begun = time.monotonic()
    if sweep:
        study, jobs = sweep_of(overrides, name)
        command = study.command
    else:
        study = read_study(str(name))
        jobs = jobs_of(study, overrides)
        command = " ".join([f"vehest run pipelines/{study.file.name}", *content_overrides(overrides)])
    first = _first(next(iter(jobs.values())))
    stages = {REPORT} if only_report else SWEEP_STAGES if sweep else STUDY_STAGES
    with open_runner(first, options, stages, study.study if study.parts else "") as runner:
        runner.until = _until(options.minutes, begun)
        runner.train_first = f"vehest run {study.file}" if only_report else ""
        configs = {str(own["dataset"]["name"]): own["dataset"] for own in (job.config for job in jobs.get("", ())) if study.datasets}
        for part in study.parts:
            configs |= runner.datasets_of(_first(jobs[part.name]))
        raw = stamps_of(configs)
        datasets: list[StoredDataset | AbsentDataset] = []
        for job in jobs[""] if study.datasets else ():
            with suppress(DryRunStop):
                datasets.append(_dataset(job.config, study, runner))
        comparisons = _checked(study, jobs, runner)
        done = 0
        for comparison in comparisons.values():
            if comparison.notes is not None:
                with suppress(DryRunStop):
                    comparison.plan(runner)
                    comparison.collect(*runner.run(comparison.groups))
                    done += 1
        if done < len(comparisons) or len(datasets) < len(study.datasets) + len(study.optional_datasets):
            runner.messages.line("plan", SWEEP if sweep else REPORT, study.study)
            raise DryRunStop
        error = _error_of(study, list(comparisons.values()), runner)
        if sweep:
            report, summary = draw_sweep(study, comparisons[""], runner)
        else:
            report, summary = draw_report(study, command, comparisons, datasets, runner)
        complete = error is None and not any(own.unfinished for own in comparisons.values())
        publication = None
        if study.publish and complete and not content_overrides(overrides):
            publication = _publication(study, jobs, comparisons, datasets, runner)
        if complete and not runner.dry_run:
            cache.save(runner, report, summary, raw, publication)
        published = None if runner.dry_run else publish_study(publication, report, runner.messages)
    return Ran(summary, report.folder, report.skipped, published, None if sweep and runner.dry_run else error)


def _until(minutes: float | None, begun: float) -> float | None:
    """Reading of ``time.monotonic`` at which trainings have to end, so that the report is drawn in time."""
    if minutes is None:
        return None
    if not minutes > 0:
        raise ConfigurationError(f"--minutes must be positive, not {minutes:g}")
    seconds = 60.0 * minutes
    return begun + seconds - min(max(30.0, 0.06 * seconds), 0.5 * seconds)


def _first(jobs: Sequence[Job]) -> Config:
    return next(job.config for job in jobs if job.failure is None)


def _checked(study: Study, jobs: Jobs, runner: Runner) -> dict[str, Comparison]:
    """Part -> its checked jobs, before anything is trained; optional parts whose raw files are missing are left out."""
    found: dict[str, Comparison] = {}
    for part in study.parts:
        try:
            runner.look_for_files(_first(jobs[part.name]))
            own = [replace(job) for job in jobs[part.name]]  # keys of published results hold rates before they are lowered
            found[part.name] = Comparison(part.title, own)
        except MissingError as error:
            if not part.optional:
                raise
            runner.messages.warn(f"{error}; the study goes on without part '{part.name}'")
    if study.parts and not found:
        raise MissingError(f"nothing that '{study.file.name}' compares is here; set VEHEST_DATA, or give root=FOLDER")
    for comparison in found.values():
        with suppress(DryRunStop):
            comparison.check(runner)
    lacking = dict.fromkeys(job.failure.message for own in found.values() for job in own.jobs if job.failure is not None)
    if lacking and not study.shows_failed:
        raise DataError(f"a study in parts needs all of its jobs; {'; '.join(lacking)}")
    return found


def _dataset(config: Config, study: Study, runner: Runner) -> StoredDataset | AbsentDataset:
    """An ingested data set of a study of recordings alone, or an optional one whose raw files are missing."""
    own = config["dataset"]
    title, licence, citation = (" ".join(str(own.get(key, own["name"])).split()) for key in ("title", "licence", "citation"))
    try:
        planned = plan_ingest(config)
    except MissingError as error:
        if own["name"] not in study.optional_datasets:
            raise
        runner.messages.warn(f"{error}; the study goes on without it")
        return AbsentDataset(own["name"], title, licence, citation)
    if runner.train_first and find(planned) is None:
        raise MissingError(f"data set '{planned.label}' has not been ingested; run '{runner.train_first}' first")
    made = runner.ingest(config)
    files = {Path(name).stem: made.folder / name for name in made.outputs}
    return StoredDataset(own["name"], title, kind_of(own), made.config, files, licence, citation)


def _error_of(study: Study, comparisons: Sequence[Comparison], runner: Runner) -> JobsFailedError | None:
    """The error that a study ends with after its report; raised at once where there is nothing to report, or not without what failed."""
    error, nothing = failed_in(comparisons, runner), bool(study.parts) and not any(own.members for own in comparisons)
    if error is not None and (nothing or not study.shows_failed):
        raise error
    if nothing:
        left = [name for own in comparisons for name in own.unfinished]
        raise DataError(f"no estimator was done in this time; the same command goes on with: {', '.join(left)}")
    return error


def _publication(
    study: Study, jobs: Jobs, comparisons: Collection[str], datasets: Sequence[StoredDataset | AbsentDataset], runner: Runner
) -> Publication:
    """What is published, with what determined it: raw files as they were ingested."""
    gone = {part.name: f"part '{part.name}'" for part in study.parts if part.name not in comparisons}
    gone |= {own.name: f"data set '{own.name}'" for own in datasets if isinstance(own, AbsentDataset)}
    inputs = {artefact.label: artefact.inputs for artefact in runner.artefacts.values() if artefact.stage == INGEST}
    keys = keys_of_study(study, jobs, gone, runner.dataset_config, lambda config: inputs[str(config["dataset"]["name"])])
    return Publication(study.study, gone, keys)


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
    """Evaluate a model by folder or start of its name, or the one that the overrides train, on the tests of a split.

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
        artefact = runner.ensure(scoring.plan, partial(write_evaluation, scoring))
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
    """The calibration of a model: made on the split that it is evaluated on if it was trained there, else looked for."""
    learnt, found = learnt_spans(model), None
    if model.status == "complete" and (not learnt or set(learnt) == {*split.train, *split.validation}):
        job = plan_calibrate(model, split, data, runner.output)
        if job is not None:
            found = runner.ensure(*job)
    elif learnt:  # one of a model that learns nothing may have seen these tests
        found = calibration_of(model.folder, runner.output)
    if found is None:
        runner.messages.line("note", "calibrate", model.label, "has no calibration, so its estimates have no bands")
    return found
