"""Runs studies and sweeps, from a command's overrides to what is printed and published.

jobs (`study`, `sweep`) -> `comparison.check`, `plan` -> `Runner.run` -> `collect` -> report -> results/ and `RunCache.save`
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, MissingError
from vehest.data.limits import limits_from_config, use_limits
from vehest.run.artefacts import Artefact, find
from vehest.run.comparison import NO_TIME, CheckedJobs, Compared, check, collect, failed_in, only_there, plan
from vehest.run.config import Config
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.ingest import STAGE as INGEST
from vehest.run.ingest import plan_ingest
from vehest.run.launchers.base import chosen_launcher
from vehest.run.launchers.local import default_jobs
from vehest.run.published import Keys, keys_of_study
from vehest.run.publishing import Publication, publish_study
from vehest.run.report import ReportJob, ShownDatasets, absent_dataset, leaderboard, overview, plan_report, verdict, write_report
from vehest.run.run_cache import Outcome, Ran, RunCache, RunOptions, stamps_of
from vehest.run.runner import Runner
from vehest.run.signals import DryRunStop, StopSignals
from vehest.run.study import Job, Jobs, Part, Study, content_overrides, jobs_of, read_study
from vehest.run.sweep import STAGE as SWEEP
from vehest.run.sweep import draw_sweep, plan_sweep
from vehest.run.terminal import summary_of_leaderboard, summary_of_overview, summary_of_sweep
from vehest.run.tracking import Tracker
from vehest.studies.artefacts import AbsentDataset

STUDY_STAGES = frozenset({"ingest", "downsample", "train", "calibrate", "evaluate", "report"})
SWEEP_STAGES = frozenset({"train", "calibrate", "evaluate", SWEEP})


@contextmanager
def open_runner(config: Config, options: RunOptions, stages: frozenset[str] = frozenset()) -> Iterator[Runner]:
    """A runner that listens to signals.

    Args:
        config: of any command; its output root, limits and tracking count.
        options: of the command.
        stages: that are run anew under ``options.force``.
    """
    messages, stop, output = Messages(quiet=options.quiet), StopSignals(), Path(config["output"])
    tracker = Tracker(config["tracking"], output, messages.warn, stop.requested) if options.track else None
    forced = stages if options.force else frozenset()
    runner = Runner(output, messages, stop, options.jobs or default_jobs(), forced, options.dry_run, tracker)
    if options.launcher is not None:
        runner.launcher = chosen_launcher(options.launcher, options.jobs, output, messages)
    try:
        with use_limits(limits_from_config(config["limits"])), stop.installed():
            yield runner
    finally:
        if runner.launcher is not None:
            runner.launcher.close()


def run_study(name: str, overrides: Sequence[str], options: RunOptions, cache: RunCache, *, only_report: bool = False) -> Ran:
    """Run every stage of a pipeline; what is there is skipped. A study that overrides changed is not published.

    Args:
        name: of the pipeline, or its path.
        overrides: for all jobs that have their key.
        options: of the command.
        cache: keeps the finished study.
        only_report: draw the report from what is there, train and evaluate nothing.

    Raises:
        ConfigurationError: an override that suits no job.
        JobsFailedError: some jobs of a study in parts, or all of another, failed; finished artefacts are kept.
        DataError: recordings lack what some job of a study in parts, or all of another, needs; nothing was trained.
        MissingError: raw files are missing, or ``only_report`` and a training is.
        DryRunStop: in a dry run.
        Stopped: a signal came.
    """
    begun = time.monotonic()
    study = read_study(name)
    jobs = jobs_of(study, overrides)
    first = next(iter(jobs.values()))[0].config
    with open_runner(first, options, frozenset({"report"}) if only_report else STUDY_STAGES) as runner:
        runner.until = _until(options.minutes, begun)
        if study.parts:
            runner.tracker = Tracker(first["tracking"], runner.output, runner.messages.warn, runner.stop.requested, study.study)
        raw = stamps_of(_datasets_of(study, jobs, runner))
        shown = _ingest_all(study, jobs[""], runner, only_report=only_report) if study.datasets else ShownDatasets()
        absent, checked = _check_parts(study, jobs, runner)
        compared: dict[str, Compared] = {}
        waits = len(checked) < len(study.parts) - len(absent)
        for part in study.parts:
            if part.name in checked:
                try:
                    planned, missing = plan(checked[part.name], runner), dict[str, Failure]()
                    if only_report:
                        planned, missing = only_there(planned, f"vehest run {study.file}")
                    found, failed = runner.run(planned.groups)
                    compared[part.name] = collect(part.title, planned, found, failed | missing, runner)
                except DryRunStop:
                    waits = True
        if waits:
            runner.messages.line("plan", "report", study.study)
            raise DryRunStop
        error = _error_of(study, list(compared.values()), runner)
        command = " ".join([f"vehest run pipelines/{study.file.name}", *content_overrides(overrides)])
        job = ReportJob(study, command, {key: own for key, own in compared.items() if own.members}, absent, shown)
        report = runner.ensure(plan_report(job, runner.output), lambda folder: write_report(job, folder))
        left_out = {key: reason for own in job.parts.values() for key, reason in own.failed.items()}
        unfinished = NO_TIME in left_out.values()
        publication = None
        if study.publish and not content_overrides(overrides) and error is None and not unfinished:
            gone = {own.name: f"part '{own.name}'" for own in absent} | {own.name: f"data set '{own.name}'" for own in shown.absent}
            publication = Publication(study.study, gone, _keys(study, jobs, gone, runner))
        lines = list(runner.messages.printed)
        published = None if runner.dry_run else publish_study(publication, report, runner.messages)
        table = leaderboard(job)
        if table is None:
            summary = summary_of_overview(overview(report), left_out)
        else:
            summary = summary_of_leaderboard(study.title, table, left_out, verdict(job))
        if error is None and not unfinished and not runner.dry_run:
            made = [*(own for own in runner.artefacts.values() if own.folder != report.folder), report]
            outcome = Outcome(runner.output, made, lines, summary, publication, first.get("tracking", {}), raw)
            cache.save(outcome, runner.messages.warn)
    return Ran(summary, report.folder, report.skipped, published, error)


def run_sweep(overrides: Sequence[str], name: str | None, options: RunOptions, cache: RunCache) -> Ran:
    """Run a study with one sweep: train and evaluate every job, draw tables and heat maps; a failed job stops no other.

    Args:
        overrides: several values allowed.
        name: start of the folder's name; none for the estimators and the split.
        options: of the command.
        cache: keeps the finished sweep.

    Raises:
        ConfigurationError: overrides that make no sweep, or a split without test ranges.
        JobsFailedError: every job failed.
        DataError: recordings lack what every job needs.
        DryRunStop: in a dry run.
        Stopped: a signal came; finished artefacts stay.
    """
    sweep = plan_sweep(overrides, name)
    first = next(job.config for job in sweep.jobs if not job.refusal)
    with open_runner(first, replace(options, track=False), SWEEP_STAGES) as runner:
        runner.tracker = Tracker(first["tracking"], runner.output, runner.messages.warn, runner.stop.requested, sweep.name)
        raw = stamps_of(runner.datasets_of(first))
        try:
            planned = plan(check(sweep.jobs, runner), runner, sweep=True)
            found, failed = runner.run(planned.groups)
        except DryRunStop:
            runner.messages.line("plan", SWEEP, sweep.name)
            raise
        compared = collect("", planned, found, failed, runner)
        swept = draw_sweep(sweep, compared, runner)
        summary = summary_of_sweep(swept.artefacts, swept.summary)
        error = None if runner.dry_run else failed_in([compared], runner)
        if error is None and not runner.dry_run:
            made = [*(own for own in runner.artefacts.values() if own.folder != swept.folder.folder), swept.folder]
            outcome = Outcome(runner.output, made, list(runner.messages.printed), summary, None, first["tracking"], raw)
            cache.save(outcome, runner.messages.warn)
    return Ran(summary, swept.folder.folder, swept.folder.skipped, failed=error)


def _until(minutes: float | None, begun: float) -> float | None:
    """Reading of ``time.monotonic`` at which trainings have to end, so that the report is drawn in time.

    Raises:
        ConfigurationError: no positive time.
    """
    if minutes is None:
        return None
    if not minutes > 0:
        raise ConfigurationError(f"--minutes must be positive, not {minutes:g}")
    seconds = 60.0 * minutes
    return begun + seconds - min(max(30.0, 0.06 * seconds), 0.5 * seconds)


def _check_parts(study: Study, jobs: Jobs, runner: Runner) -> tuple[list[Part], dict[str, CheckedJobs]]:
    """Parts that are left out since their raw files are missing, and the checked jobs of all others, before anything is trained.

    Raises:
        MissingError: raw files of a part that is not optional, or of all parts, are missing.
        DataError: a study in parts lacks a job.
    """
    absent: list[Part] = []
    for part in study.parts:
        try:
            runner.look_for_files(jobs[part.name][0].config)
        except MissingError as error:
            if not part.optional:
                raise
            runner.messages.warn(f"{error}; the study goes on without part '{part.name}'")
            absent.append(part)
    if study.parts and len(absent) == len(study.parts):
        raise MissingError(f"nothing that '{study.file.name}' compares is here; set VEHEST_DATA, or give root=FOLDER")
    checked: dict[str, CheckedJobs] = {}
    for part in study.parts:
        if part not in absent:
            with suppress(DryRunStop):
                checked[part.name] = check(jobs[part.name], runner)
    lacking = [failure.message for own in checked.values() for failure in own.failures.values()]
    if lacking and not study.shows_failed:
        raise DataError(f"a study in parts needs all of its jobs; {'; '.join(dict.fromkeys(lacking))}")
    return absent, checked


def _error_of(study: Study, compared: Sequence[Compared], runner: Runner) -> JobsFailedError | None:
    """The error that a study ends with after its report.

    Raises:
        JobsFailedError: the report cannot do without what failed.
        DataError: nothing was done in time.
    """
    error = failed_in(compared, runner)
    if not study.parts or any(own.members for own in compared):
        if error is not None and not study.shows_failed:
            raise error
        return error
    if error is not None:
        raise error
    left = [name for own in compared for name in own.unfinished]
    raise DataError(f"no estimator was done in this time; the same command goes on with: {', '.join(left)}")


def _datasets_of(study: Study, jobs: Jobs, runner: Runner) -> dict[str, Config]:
    """The configuration of every data set of a study, by its name."""
    if study.datasets:
        return {str(job.config["dataset"]["name"]): job.config["dataset"] for job in jobs[""]}
    return {name: own for part in jobs.values() for name, own in runner.datasets_of(part[0].config).items()}


def _ingest_all(study: Study, jobs: Sequence[Job], runner: Runner, *, only_report: bool) -> ShownDatasets:
    """Ingest the data sets of a study of recordings alone; optional ones are left out where their raw files are missing.

    Raises:
        MissingError: raw files are missing, or ``only_report`` and recordings are not there.
        DryRunStop: in a dry run, after all were looked at.
        Stopped: a signal came; finished ingests stay.
    """
    here: list[Config] = []
    ingested: list[Artefact] = []
    absent: list[AbsentDataset] = []
    for job in jobs:
        dataset = job.config["dataset"]
        try:
            planned = plan_ingest(job.config)
        except MissingError as error:
            if dataset["name"] not in study.optional_datasets:
                raise
            runner.messages.warn(f"{error}; the study goes on without it")
            absent.append(absent_dataset(dataset))
            continue
        if only_report and find(planned) is None:
            raise MissingError(f"data set '{planned.label}' has not been ingested; run 'vehest run' first")
        here.append(job.config)
        with suppress(DryRunStop):
            ingested.append(runner.ingest(job.config))
    if len(ingested) < len(here):
        runner.messages.line("plan", "report", study.study)
        raise DryRunStop
    return ShownDatasets(here, ingested, absent)


def _keys(study: Study, jobs: Jobs, absent: Mapping[str, str], runner: Runner) -> Keys:
    """What determined the results: raw files as they were ingested."""
    inputs = {artefact.label: artefact.inputs for artefact in runner.artefacts.values() if artefact.stage == INGEST}
    return keys_of_study(study, jobs, absent, runner.dataset_config, lambda config: inputs[str(config["dataset"]["name"])])
