"""Runs studies, sweeps, single trainings and evaluations, from a command's overrides to what is
printed and published.

jobs (`study`) -> `Comparison.plan` -> `Runner.run` -> `collect` -> report -> results/ and
`RunCache.save`
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import Artefact, find
from vehest.configuration.composition import Config, compose_config, key_of
from vehest.data.errors import (
    ConfigurationError,
    DataError,
    JobsFailedError,
    MissingError,
    VehestError,
    abbreviated,
)
from vehest.data.files import stamp_of
from vehest.data.limits import limits_from_config, use_limits
from vehest.inference.models import calibration_of, find_model, preparation_of
from vehest.run.calibrate import plan_calibrate
from vehest.run.comparison import (
    NOT_TRAINED,
    Comparison,
    lower_rate,
    name_in_part,
    named_failures,
    print_notes,
    slowest,
)
from vehest.run.console import PLAN, Messages
from vehest.run.evaluate import Evaluation, fault_figures, test_figures
from vehest.run.evaluate_faults import check_channels, faults_of
from vehest.run.ingest import STAGE as INGEST
from vehest.run.ingest import plan_ingest
from vehest.run.launchers.base import RunOptions, chosen_launcher
from vehest.run.launchers.local import default_jobs
from vehest.run.next_commands import command_line, overrides_of_config
from vehest.run.published import keys_of_study
from vehest.run.publishing import (
    PUBLISHED_WEIGHTS,
    RESULTS,
    Publication,
    check_results_folder,
    publish_study,
    published_in,
    uncommitted_changes,
)
from vehest.run.report import STAGE as REPORT
from vehest.run.report import SWEEP, draw_report, draw_sweep
from vehest.run.run_cache import Ran, RunCache
from vehest.run.runner import Runner
from vehest.run.searches import SEARCHES, published_values, remarks_on, trials_of
from vehest.run.signals import DryRunStop, StopSignals
from vehest.run.study import (
    Job,
    Jobs,
    Study,
    content_overrides,
    failure_messages,
    jobs_of,
    read_study,
    sweep_of,
)
from vehest.run.tracking import Tracker
from vehest.run.train import STAGE as TRAIN
from vehest.run.train import learnt_spans, model_artefact, read_fit_metrics, trained_rate
from vehest.run.weights import PublishedWeights
from vehest.sources.base import kind_of
from vehest.studies.artefacts import AbsentDataset, StoredDataset

MAX_NAMED = 6  # trainings in one message


@contextmanager
def open_runner(
    config: Config,
    options: RunOptions,
    stages: Collection[str],
    study: str = "",
    messages: Messages | None = None,
) -> Iterator[Runner]:
    """Context with a runner that listens to signals, runs ``stages`` anew under ``options.force``,
    and logs runs under a study, if there is one.

    Parameters
    ----------
    config : Config
        For output root, limits and tracking.
    options : RunOptions
        Of the command.
    stages : collection of str
        Stages that ``force`` is about.
    study : str
        Name of the study; empty for a single training or evaluation.
    messages : Messages or None
        By default new ones.

    Yields
    ------
    Runner
        Its launcher is closed, and signal handlers are restored, at the end.
    """
    messages = messages or Messages(quiet=options.quiet)
    stop = StopSignals()
    output = Path(config["output"])
    tracker = Tracker(
        config["tracking"] if options.track or study else {},
        output,
        messages.warn,
        stop.requested,
        study,
    )
    forced = frozenset(stages if options.force else ())
    launcher = chosen_launcher(options, output, messages)
    runner = Runner(
        output,
        messages,
        stop,
        options.jobs or default_jobs(),
        forced,
        options.dry_run,
        tracker=tracker,
        launcher=launcher,
    )
    with closing(launcher), use_limits(limits_from_config(config["limits"])), stop.installed():
        try:
            yield runner
        finally:
            messages.close()


def run_study(
    name: str | None,
    overrides: Sequence[str],
    options: RunOptions,
    cache: RunCache,
    messages: Messages,
    *,
    sweep: bool,
    only_report: bool,
) -> Ran:
    """Run every stage of a pipeline, or of a sweep; existing artefacts are reused. A study that
    overrides changed is not published.

    Parameters
    ----------
    name : str or None
        Of the pipeline, or its path; of a sweep the start of its folder's name, none for the
        estimators and the split.
    overrides : Sequence[str]
        For all jobs that have their key; of a sweep, with several values.
    options : RunOptions
        Of the command.
    cache : RunCache
        Keeps the finished study.
    messages : Messages
        Of the run, in which the stage `PLAN` may have begun; it ends before the first training.
    sweep : bool
        Whether the overrides make a sweep.
    only_report : bool
        Train and evaluate nothing.

    Returns
    -------
    Ran
        Summary for the terminal, folder of the report, and the error to end with where jobs failed.

    Raises
    ------
    JobsFailedError
        Some jobs of a study in parts, or all of another, failed; finished artefacts are kept.
    DataError
        Recordings lack what some job of a study in parts, or all of another, needs; nothing was
        trained.
    MissingError
        Raw files are missing, or ``only_report`` and a training is.
    DryRunStop
        In a dry run.
    """
    begun = time.monotonic()
    if sweep:
        study, jobs = sweep_of(overrides, name)
    else:
        study = read_study(str(name), overrides)
        jobs = jobs_of(study, overrides)
    first = _first(next(iter(jobs.values())))
    stages = {
        "train",
        "calibrate",
        "evaluate",
        *((SWEEP,) if sweep else ("ingest", "downsample", REPORT)),
    }
    with open_runner(
        first,
        options,
        {REPORT} if only_report else stages,
        study.study if study.parts else "",
        messages,
    ) as runner:
        runner.until = _until(options.minutes, begun)
        if study.publish and not options.retrain:
            runner.weights = PublishedWeights(RESULTS / study.study / PUBLISHED_WEIGHTS)
        if options.publish_weights:
            runner.publishes_to = _weights_to_add_to(study, overrides)
        runner.evaluates_trained = not (only_report or _trains_missing(study, overrides, options))
        if only_report or runner.evaluates_trained:
            runner.train_first = command_line("run", study.words)
        dataset_configs = [job.config for job in jobs[""]] if study.datasets else []
        datasets_read = [config["dataset"] for config in dataset_configs]
        for part in study.parts:
            datasets_read += runner.datasets_of(_first(jobs[part]))
        raw = {
            path: stamp_of(Path(path).expanduser())
            for path in dict.fromkeys(
                str(dataset["path"]) for dataset in datasets_read if "path" in dataset
            )
        }
        datasets: list[StoredDataset | AbsentDataset] = []
        for config in dataset_configs:
            with suppress(DryRunStop):
                datasets.append(_dataset(config, study, runner))
        planned = _planned(study, jobs, runner)
        messages.end(PLAN, name or SWEEP)
        values = {}
        if study.publish and not (options.retrain or TRAIN in runner.force):
            values = published_values(
                study, planned, runner.origin, RESULTS / study.study / SEARCHES
            )
        if values:
            runner.messages.line(
                "note",
                "search",
                f"{len(values)} of {len(study.trials)} trials",
                f"taken from {RESULTS / study.study / SEARCHES}; --retrain trains them",
            )
        comparisons = {
            name: comparison for name, comparison in planned.items() if name not in values
        }
        _note_missing(comparisons, runner)
        for comparison in comparisons.values():
            if runner.evaluates_trained:
                comparison.reason_unfinished = NOT_TRAINED
            with suppress(DryRunStop):
                comparison.collect(*runner.run(comparison.groups))
        if any(status == "plan" for status, *_ in runner.messages.printed):
            runner.messages.line("plan", SWEEP if sweep else REPORT, study.study)
            raise DryRunStop
        error = _error_of(study, comparisons, runner)
        if sweep:
            report, summary = draw_sweep(study, comparisons[""], runner)
        else:
            trials = trials_of(study, planned, runner.origin, values)
            remarks = remarks_on(study, planned, trials)
            for remark in remarks:
                runner.messages.warn(remark)
            report, summary = draw_report(study, comparisons, datasets, runner, trials, remarks)
        published = None
        n_not_trained = sum(len(comparison.unfinished) for comparison in comparisons.values())
        if error is None and not runner.dry_run and (runner.evaluates_trained or not n_not_trained):
            publication = None
            if study.publish and not content_overrides(overrides):
                gone = {name: f"part '{name}'" for name in study.parts if name not in planned}
                gone |= {
                    dataset.name: f"data set '{dataset.name}'"
                    for dataset in datasets
                    if isinstance(dataset, AbsentDataset)
                }
                inputs = {
                    artefact.label: artefact.inputs
                    for artefact in runner.artefacts.values()
                    if artefact.stage == INGEST
                }  # raw files as they were
                publication = Publication(
                    study.study,
                    gone,
                    keys_of_study(study, jobs, gone, runner, inputs),
                    n_not_trained,
                )
            if not n_not_trained:  # a later run looks for trainings again
                cache.save(runner, report, summary, raw, publication)
            published = publish_study(publication, report, runner.messages)
    return Ran(
        summary,
        report.folder,
        report.skipped,
        published,
        None if sweep and runner.dry_run else error,
    )


def _weights_to_add_to(study: Study, overrides: Sequence[str]) -> PublishedWeights:
    """The published weights of a study, to which each training is added.

    Raises `ConfigurationError` where the study is not published with its overrides.
    """
    changes = content_overrides(overrides)
    if not study.publish or changes:
        why = f"leave out '{changes[0]}'" if changes else "it needs publish: true"
        raise ConfigurationError(
            f"--publish-weights publishes what '{study.file}' says, unchanged; {why}"
        )
    if changes_of_tree := uncommitted_changes():
        raise ConfigurationError(f"--publish-weights: {changes_of_tree}")
    folder = RESULTS / study.study
    check_results_folder(folder)
    return PublishedWeights(folder / PUBLISHED_WEIGHTS)


def _trains_missing(study: Study, overrides: Sequence[str], options: RunOptions) -> bool:
    """Whether a run trains what is missing: as its option says, else unless the study is published
    without some trainings.
    """
    if options.train_missing is not None:
        return options.train_missing
    trains = options.force or options.retrain or options.publish_weights
    if trains or not study.publish or content_overrides(overrides):
        return True
    published = published_in(RESULTS / study.study)
    return published is None or not published.n_not_trained


def _note_missing(comparisons: Mapping[str, Comparison], runner: Runner) -> None:
    """Print how many trainings neither exist here nor are published, before the first of them
    begins.
    """
    if runner.weights is None or not runner.weights.path.is_file() or runner.train_first:
        return
    jobs = {
        job.plan.key: job
        for comparison in comparisons.values()
        for group in comparison.groups
        for job in group.jobs
        if not job.is_learnt_at_once
    }
    missing = [
        job
        for key, job in jobs.items()
        if runner.weights.published_key(key, runner.origin(job)) is None and find(job.plan) is None
    ]
    if missing:
        runner.messages.line(
            "note",
            TRAIN,
            f"{len(missing)} of {len(jobs)}",
            "are neither here nor published, and are trained; --no-train-missing leaves them out",
        )


def _until(minutes: float | None, begun: float) -> float | None:
    """Reading of ``time.monotonic`` at which trainings have to end, so that the report is drawn in
    time.
    """
    if minutes is None:
        return None
    if not minutes > 0:
        raise ConfigurationError(f"--minutes must be positive, not {minutes:g}")
    seconds = 60.0 * minutes
    return begun + seconds - min(max(30.0, 0.06 * seconds), 0.5 * seconds)


def _first(jobs: Sequence[Job]) -> Config:
    """Configuration of the first job that did not fail."""
    return next(job.config for job in jobs if job.failure is None)


def _planned(study: Study, jobs: Jobs, runner: Runner) -> dict[str, Comparison]:
    """Plan the jobs of all parts, before anything is trained: part -> comparison.

    Optional parts whose raw files are missing are left out.
    """
    comparisons: dict[str, Comparison] = {}
    for name, part in study.parts.items():
        try:
            runner.look_for_files(_first(jobs[name]))
            comparisons[name] = Comparison(
                [replace(job) for job in jobs[name]]
            )  # published keys hold rates before they are lowered
        except MissingError as error:
            if not part.optional:
                raise
            runner.messages.warn(f"{error}; the study goes on without part '{name}'")
    if study.parts and not comparisons:
        raise MissingError(
            f"nothing that '{study.file.name}' compares is here; set VEHEST_DATA, or give "
            "root=FOLDER"
        )
    for comparison in comparisons.values():
        with suppress(DryRunStop):
            comparison.plan(runner)
            if not comparison.evaluation.split.test_spans:
                raise ConfigurationError(
                    f"split '{comparison.evaluation.split.name}' has no test ranges to compare "
                    "estimators on"
                )
    reasons = failure_messages(
        job for comparison in comparisons.values() for job in comparison.jobs
    )
    if reasons and not study.shows_failed:
        raise DataError(f"a study in parts needs all of its jobs; {reasons}")
    return comparisons


def _dataset(config: Config, study: Study, runner: Runner) -> StoredDataset | AbsentDataset:
    """Ingest a data set of a study of recordings alone; an optional one whose raw files are missing
    is an `AbsentDataset`.
    """
    dataset = config["dataset"]
    title, licence, citation = (
        " ".join(str(dataset.get(key, dataset["name"])).split())
        for key in ("title", "licence", "citation")
    )
    try:
        planned = plan_ingest(config)
    except MissingError as error:
        if dataset["name"] not in study.optional_datasets:
            raise
        runner.messages.warn(f"{error}; the study goes on without it")
        return AbsentDataset(dataset["name"], title, licence, citation)
    is_only_drawn = runner.train_first and not runner.evaluates_trained
    if is_only_drawn and find(planned, runner.messages.warn) is None:
        raise MissingError(
            f"data set '{planned.label}' has not been ingested; run '{runner.train_first}' first"
        )
    artefact = runner.ingest(config)
    files = {Path(name).stem: artefact.folder / name for name in artefact.outputs}
    return StoredDataset(
        dataset["name"], title, kind_of(dataset), artefact.config, files, licence, citation
    )


def _error_of(
    study: Study, comparisons: Mapping[str, Comparison], runner: Runner
) -> JobsFailedError | None:
    """The error with which a study ends after its report; None if nothing failed.

    It is raised at once where there is nothing to report, or the report cannot leave out what
    failed.
    """
    reasons: dict[str, list[str]] = {}
    for name, failure in (
        pair for comparison in comparisons.values() for pair in named_failures(comparison.jobs)
    ):
        if failure.detail:
            runner.messages.warn(f"{name}:\n{failure.detail}")
        reasons.setdefault(failure.message, []).append(name)
    jobs = [job for comparison in comparisons.values() for job in comparison.jobs]
    error = None
    if reasons:
        listed = "; ".join(f"{' and '.join(names)}: {reason}" for reason, names in reasons.items())
        n_failed = sum(job.failure is not None for job in jobs)
        error = JobsFailedError(
            f"{n_failed} of {len(jobs)} jobs failed, the others are kept; {listed}"
        )
    nothing = bool(study.parts) and not any(
        comparison.members for comparison in comparisons.values()
    )
    unfinished = [
        name_in_part(part, name, comparisons)
        for part, comparison in comparisons.items()
        for name in comparison.unfinished
    ]
    if unfinished and runner.train_first and (nothing or not study.shows_failed):
        option = " --train-missing" if runner.evaluates_trained else ""
        raise MissingError(
            f"{unfinished[0]} has not been trained and evaluated; "
            f"run '{runner.train_first}{option}' first"
        )
    if error is not None and (nothing or not study.shows_failed):
        raise error
    if nothing:
        raise DataError(
            "no estimator was done in this time; the same command goes on with: "
            f"{', '.join(unfinished)}"
        )
    if unfinished and not runner.dry_run:
        going_on = command_line("run" if study.file.name else "sweep", study.words)
        option = " --train-missing" if runner.evaluates_trained else ""
        runner.messages.line(
            "note",
            REPORT,
            f"{len(unfinished)} of {len(jobs)} not done",
            f"{abbreviated(unfinished, MAX_NAMED)}; '{going_on}{option}' goes on with them",
        )
    return error


def train_estimator(overrides: Sequence[str], options: RunOptions) -> dict[str, Any]:
    """Train and calibrate one estimator, by overrides of conf/train.yaml.

    Returns
    -------
    dict
        Folder, status and figures of the fit; empty where it was stopped before its first epoch was
        over.

    Raises
    ------
    VehestError
        The training cannot be done, with its exit code.
    """
    config = compose_config("train", overrides)
    with open_runner(config, options, ("train", "calibrate")) as runner:
        members, failures = runner.run(Comparison([Job(config)]).plan(runner))
        for failure in failures.values():
            if failure.detail:
                runner.messages.warn(failure.detail)
            error = VehestError(failure.message)
            error.exit_code = failure.exit_code
            raise error
    model = next((member.model for member in members.values()), None)
    if model is None:
        return {}
    return {
        "model": str(model.folder),
        "status": model.status,
        "skipped": model.skipped,
        **read_fit_metrics(model.folder),
    }


def evaluate_model(
    overrides: Sequence[str], model: str | None, options: RunOptions, note: Callable[[str], None]
) -> dict[str, Any]:
    """Evaluate a model, or the one that overrides train, on the tests of a split.

    Parameters
    ----------
    overrides : sequence of str
        Of conf/eval.yaml.
    model : str or None
        Folder of a model, or start of its name; None for the one that the overrides train.
    options : RunOptions
        Of the command.
    note : callable
        Takes a remark on which model was chosen.

    Returns
    -------
    dict
        Folder, and figures of the tests, with and without faults.

    Raises
    ------
    MissingError
        The model is not there or not trained.
    VehestError
        It cannot be evaluated on this split.
    """
    config = compose_config("eval", overrides)
    with open_runner(config, options, ("calibrate", "evaluate")) as runner:
        split = runner.split(config)
        if model is not None:
            runner.warn_of_references(split, config)
            config, notes = lower_rate(config, "evaluation", slowest(runner.contents(config)))
            print_notes(notes, runner)
            trained = model_artefact(find_model(model, runner.output, note))
            if not any(key_of(override).split(".")[0] == "downsample" for override in overrides):
                config["downsample"] = preparation_of(trained.folder)
            evaluation = runner.evaluation(
                config, runner.data_for(split, trained_rate(trained), config), faults_of(config)
            )
            check_channels(evaluation.faults, split, evaluation.data)
        else:
            (group,) = Comparison([Job(config)]).plan(runner)
            plan = group.jobs[0].plan
            if (existing_model := find(plan, runner.messages.warn)) is None:
                training = overrides_of_config(overrides, compose_config("train"))
                raise MissingError(
                    f"{plan.label} has not been trained; run '{command_line('train', training)}' "
                    "first"
                )
            assert group.evaluation is not None
            trained = existing_model
            evaluation = group.evaluation
        calibration = _calibration(trained, evaluation, runner)
        artefact = runner.ensure(*evaluation.of(trained, calibration))
        runner.tracker.log(calibration, artefact)
    return {
        "folder": str(artefact.folder),
        "skipped": artefact.skipped,
        **test_figures(artefact.folder),
        **fault_figures(artefact.folder),
    }


def _calibration(model: Artefact, evaluation: Evaluation, runner: Runner) -> Artefact | None:
    """The calibration of a model: made on the split that it is evaluated on if it was trained
    there, else searched in the output root; None where there is none.
    """
    learnt = learnt_spans(model)
    calibration = None
    if model.status == "complete" and (
        not learnt or set(learnt) == {*evaluation.split.train, *evaluation.split.validation}
    ):
        job = plan_calibrate(
            model, evaluation.split, evaluation.data, runner.output, evaluation.cars
        )
        if job is not None:
            calibration = runner.ensure(*job)
    elif learnt:  # a calibration of a model without training may have used these tests
        calibration = calibration_of(model.folder, runner.output)
    if calibration is None:
        runner.messages.line(
            "note", "calibrate", model.label, "has no calibration, so its estimates have no bands"
        )
    return calibration
