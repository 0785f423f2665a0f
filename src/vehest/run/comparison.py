"""A comparison of estimators on one split, from its jobs to what the report stage draws.

jobs -> `check` (rates, required channels) -> `plan` (trainings in groups) -> `Runner.run` -> `collect` -> Compared
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, MissingError, VehestError
from vehest.data.split_files import dataset_names
from vehest.data.splits import Split
from vehest.run.artefacts import Artefact
from vehest.run.config import Config
from vehest.run.estimate import find_model, model_artefact
from vehest.run.evaluate import Evaluation, protocol_from_config
from vehest.run.failures import Failure, failure_of
from vehest.run.faults import all_of, check_channels, faults_of
from vehest.run.group import Group, Member, existing, is_finished
from vehest.run.rates import Note, at_estimator_rate, at_evaluation_rate, slowest
from vehest.run.runner import Runner
from vehest.run.signals import DryRunStop
from vehest.run.study import Job
from vehest.run.train import TrainJob, new_estimator, plan_train
from vehest.run.usable import lack

NO_TIME = "not done yet: no time was left, the same command goes on"


@dataclass(frozen=True)
class CheckedJobs:
    """Jobs of one split at rates that its recordings have.

    Args:
        jobs: all of them.
        failures: position of a job that cannot be done -> why.
        notes: rates that were lowered, each once.
    """

    jobs: Sequence[Job]
    failures: Mapping[int, Failure]
    notes: Sequence[Note] = ()

    @property
    def usable(self) -> dict[int, Config]:
        """Position -> configuration of the jobs that can be done."""
        return {position: job.config for position, job in enumerate(self.jobs) if position not in self.failures}


@dataclass(frozen=True)
class Planned:
    """Trainings of a comparison.

    Args:
        checked: its jobs.
        trainings: position of a job -> its training.
        failures: position of a job that cannot be done -> why.
        groups: trainings that fit one batch, with their evaluation.
        evaluation: split, references and protocol of all of them.
    """

    checked: CheckedJobs
    trainings: Mapping[int, TrainJob]
    failures: Mapping[int, Failure]
    groups: Sequence[Group]
    evaluation: Evaluation


@dataclass(frozen=True)
class Compared:
    """A comparison that has been run.

    Args:
        title: for people; none in a study that is not in parts.
        planned: its jobs and trainings.
        found: key of a training -> its member.
        failures: position of a job -> why it failed.
        data_titles: data set -> title, for people.
        training: how recordings were prepared and the budget of each training scheme, a line each.
    """

    title: str
    planned: Planned
    found: Mapping[str, Member]
    failures: Mapping[int, Failure]
    data_titles: Mapping[str, str]
    training: Sequence[str]

    @property
    def evaluation(self) -> Evaluation:
        """Split, references and protocol."""
        return self.planned.evaluation

    @property
    def members(self) -> list[Member]:
        """Trained and evaluated members in the order of the jobs."""
        keys = dict.fromkeys(training.plan.key for training in self.planned.trainings.values())
        return [self.found[key] for key in keys if key in self.found]

    @property
    def unfinished(self) -> list[str]:
        """Trainings for which no time was left, by name."""
        left = [training.plan for at, training in self.planned.trainings.items() if at not in self.failures]
        return list(dict.fromkeys(plan.label for plan in left if plan.key not in self.found))

    @property
    def failed(self) -> dict[str, str]:
        """Name of what is left out -> why."""
        return {name: failure.message for name, failure in named(self.failures, self.planned.checked.jobs)} | dict.fromkeys(
            self.unfinished, NO_TIME
        )


def check(jobs: Sequence[Job], runner: Runner) -> CheckedJobs:
    """Fit jobs to the recordings of their split, which are ingested for it, and find jobs that lack something; no samples are read.

    Args:
        jobs: of one split; those that are refused already count as failed.
        runner: prints rates that are lowered, and failures.

    Raises:
        ConfigurationError: a setting makes no sense.
        DataError: no job can be done, or the evaluation is to read estimates more often than recordings are sampled.
        DryRunStop: in a dry run, if recordings would have to be made, after printing what would be trained.
    """
    failures = {at: Failure(job.refusal, exit_code=ConfigurationError.exit_code) for at, job in enumerate(jobs) if job.refusal}
    _print_failures(failures, jobs, runner)
    first = next(job.config for job in jobs if not job.refusal)
    try:
        split, contents = runner.split(first), runner.contents(first)
    except DryRunStop:
        runner.print_trainings(_names(job for job in jobs if not job.refusal), ["evaluate"])
        raise
    limit, notes, reasons = slowest(contents), dict[Note, None](), dict[str, str]()
    lacking: dict[int, Failure] = {}
    checked = list(jobs)
    for position, job in enumerate(jobs):
        if job.refusal:
            continue
        config, lowered = at_evaluation_rate(job.config, limit)
        try:
            config, more = at_estimator_rate(config, limit)
            same = json.dumps([config["estimator"], config["training"]], sort_keys=True, default=str)
            if same not in reasons:
                reasons[same] = lack(config, split, contents)
            if reasons[same]:
                raise DataError(reasons[same])
            notes |= dict.fromkeys((*lowered, *more))
        except DataError as error:
            lacking[position] = failure_of(error)
        checked[position] = replace(job, config=config)
    for note in notes:
        runner.print_note(note)
    _print_failures(lacking, checked, runner)
    if lacking and len(failures) + len(lacking) == len(jobs):
        reasons_of_all = dict.fromkeys(failure.message for failure in lacking.values())
        raise DataError(f"none of these estimators can be used with the recordings of split '{split.name}'; {'; '.join(reasons_of_all)}")
    return CheckedJobs(checked, failures | lacking, tuple(notes))


def check_job(config: Config, runner: Runner) -> Config:
    """Fit one job to the recordings of its split.

    Raises:
        DataError: recordings lack what its estimator needs, or an override asks for more than their rate.
        DryRunStop: in a dry run, if recordings would have to be made.
    """
    try:
        return check([Job(config)], runner).jobs[0].config
    except DataError as error:
        names = ", ".join(f"'vehest data usable {name}'" for name in dataset_names(config["split"]))
        raise DataError(f"{error}; {names} says what each estimator needs") from None


def check_evaluation(config: Config, runner: Runner) -> Config:
    """Fit the evaluation alone, of a model that has its rate.

    Raises:
        DataError: an override asks for more than the rate of the recordings.
        DryRunStop: in a dry run, if recordings would have to be made.
    """
    config, notes = at_evaluation_rate(config, slowest(runner.contents(config)))
    for note in notes:
        runner.print_note(note)
    return config


def plan_training(config: Mapping[str, Any], split: Split, data: Mapping[str, Artefact]) -> TrainJob:
    """A training, be it from scratch or from another model's weights, whose digest is then one of its inputs; see `plan_train`.

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


def plan(checked: CheckedJobs, runner: Runner, *, sweep: bool = False) -> Planned:
    """The trainings of a comparison in groups that fit one batch, with the data they need, which are made on the way.

    Args:
        checked: its jobs, from `check`.
        runner: makes data.
        sweep: whether jobs are those of a sweep, each of which is evaluated under its own faults and may fail alone; those of a study
            are all evaluated under the faults of all.

    Raises:
        ConfigurationError: the split has no test ranges, or two trainings have one name.
        DataError: there are no data for any job.
        DryRunStop: in a dry run, if data would have to be made, after printing what would be trained.
    """
    first = next(iter(checked.usable.values()))
    split, protocol = runner.split(first), protocol_from_config(first["evaluation"])
    if not any(split.tests.values()):
        raise ConfigurationError(f"split '{split.name}' has no test ranges; a {'sweep' if sweep else 'study'} needs some")
    trainings: dict[int, TrainJob] = {}
    failures: dict[int, Failure] = {}
    names: dict[Any, Any] = {}
    try:
        references = runner.references_for(split, protocol.rate_hz, first)
        for position, config in checked.usable.items():
            try:
                data = runner.data_for(split, new_estimator(config["estimator"]).settings.rate_hz, config)
                training = plan_training(config, split, data)
                check_channels(faults_of(config), split, data)
                _check_name(checked.jobs[position], training, names, sweep=sweep)
                trainings[position] = training
            except VehestError as error:
                if not sweep and not isinstance(error, DataError):
                    raise
                failures[position] = failure_of(error)
    except DryRunStop:
        runner.print_trainings(_names(checked.jobs[position] for position in checked.usable), ["evaluate"])
        raise
    if not trainings:
        raise DataError("; ".join(dict.fromkeys(failure.message for failure in failures.values())))
    _print_failures(failures, checked.jobs, runner)
    evaluation = Evaluation(split, {}, references, runner.kinds_of(split, first), protocol, runner.output)
    groups = _groups(checked.jobs, trainings, evaluation, runner.force, sweep=sweep)
    return Planned(checked, trainings, {**checked.failures, **failures}, groups, evaluation)


def _check_name(job: Job, training: TrainJob, names: dict[Any, Any], *, sweep: bool) -> None:
    """Refuse a training that cannot be told from another.

    Raises:
        ConfigurationError: two combinations of a sweep are one training, or two trainings of a study have one name.
    """
    key = training.plan.key
    if sweep:
        twin = names.setdefault((key, faults_of(job.config)), job.label)
        if twin != job.label:
            raise ConfigurationError(f"it is the same training as {twin}")
    elif names.setdefault(training.plan.label, key) != key:
        raise ConfigurationError(
            f"two jobs are both called {training.plan.label}: they differ in what its name does not say; "
            "sweep that in a pipeline of its own"
        )


def _groups(
    jobs: Sequence[Job], trainings: Mapping[int, TrainJob], evaluation: Evaluation, force: frozenset[str], *, sweep: bool
) -> list[Group]:
    """Trainings that fit one batch; combinations of a sweep that differ in their fault alone share a training."""
    faults = {position: faults_of(jobs[position].config) for position in trainings}
    of_training: dict[str, list[int]] = {}
    for position, training in trainings.items():
        of_training.setdefault(training.plan.key, []).append(position)
    groups: dict[tuple[Any, ...], Group] = {}
    for positions in of_training.values():
        first, training = jobs[positions[0]], trainings[positions[0]]
        how = replace(evaluation, data=training.data, faults=all_of(faults[at] for at in (positions if sweep else trainings)))
        key = (training.group, how.faults, first.batch)
        group = groups.get(key, Group([], how, force, first.batch))
        groups[key] = replace(group, jobs=[*group.jobs, training])
    return list(groups.values())


def only_there(planned: Planned, command: str) -> tuple[Planned, dict[str, Failure]]:
    """A comparison without the trainings that are missing, and key of a training -> that it is missing.

    Raises:
        MissingError: nothing is there.
    """
    groups: list[Group] = []
    missing: dict[str, Failure] = {}
    labels = []
    for group in planned.groups:
        found = existing(group)
        there = [member.job for member in found if is_finished(group, member)]
        if there:
            groups.append(replace(group, jobs=there))
        for member in found:
            if not is_finished(group, member):
                labels.append(member.job.plan.label)
                missing[member.job.plan.key] = Failure(f"has not been trained and evaluated; run '{command}' first", exit_code=4)
    if not groups:
        raise MissingError(f"{labels[0]} has not been trained and evaluated; run '{command}' first")
    return replace(planned, groups=groups), missing


def collect(title: str, planned: Planned, found: Mapping[str, Member], failed: Mapping[str, Failure], runner: Runner) -> Compared:
    """The outcome of a comparison.

    Args:
        title: for people.
        planned: what was run.
        found: key of a training -> its member.
        failed: key of a training -> why.
        runner: knows the titles of data sets.
    """
    checked, configs = planned.checked, list(planned.checked.usable.values())
    failures = dict(planned.failures)
    for position, training in planned.trainings.items():
        if training.plan.key in failed:
            failures[position] = failed[training.plan.key]
    evaluated = {key: member for key, member in found.items() if member.evaluation is not None}
    datasets = {name: runner.dataset_config(name, configs[0])["dataset"] for name in planned.evaluation.split.datasets}
    titles = {name: str(dataset.get("title", name)) for name, dataset in datasets.items()}
    facts = [*training_facts(configs), resampling_fact(configs), *(f"{note.what} {note.text}" for note in checked.notes)]
    return Compared(title, planned, evaluated, failures, titles, facts)


def named(failures: Mapping[int, Failure], jobs: Sequence[Job]) -> list[tuple[str, Failure]]:
    """Failures by name; jobs that differ in their seed alone and failed alike have one name."""
    alike: dict[Failure, list[Job]] = {}
    for position, failure in failures.items():
        alike.setdefault(failure, []).append(jobs[position])
    return [(name, failure) for failure, own in alike.items() for name in _names(own)]


def _names(jobs: Iterable[Job]) -> list[str]:
    """Names of jobs; those that differ in their seed alone have one."""
    seeds: dict[str, list[str]] = {}
    for job in jobs:
        estimator = None if job.label else new_estimator(job.config["estimator"])
        stem = job.label if estimator is None else f"{estimator.name}-{estimator.variant}"
        seeds.setdefault(stem, []).append(str(job.config["seed"]))
    return [f"{stem} seed{'s' if len(own) > 1 else ''} {', '.join(own)}" for stem, own in seeds.items()]


def failed_in(compared: Sequence[Compared], runner: Runner) -> JobsFailedError | None:
    """Print tracebacks of defects; returns the error of all failures, if there are any."""
    failures = [pair for own in compared for pair in named(own.failures, own.planned.checked.jobs)]
    if not failures:
        return None
    for name, failure in failures:
        if failure.detail:
            runner.messages.warn(f"{name}:\n{failure.detail}")
    reasons: dict[str, list[str]] = {}
    for name, failure in failures:
        reasons.setdefault(failure.message, []).append(name)
    listed = "; ".join(f"{' and '.join(names)}: {reason}" for reason, names in reasons.items())
    n_failed, n_jobs = sum(len(own.failures) for own in compared), sum(len(own.planned.checked.jobs) for own in compared)
    return JobsFailedError(f"{n_failed} of {n_jobs} jobs failed, the others are kept; {listed}")


def _print_failures(failures: Mapping[int, Failure], jobs: Sequence[Job], runner: Runner) -> None:
    for name, failure in named(failures, jobs) if len(jobs) > 1 else ():
        runner.messages.line("fail", "train", name, failure.message)


def resampling_fact(configs: Sequence[Config]) -> str:
    """How recordings came to the rates that estimators work at."""
    rates = sorted({float(config["estimator"]["rate_hz"]) for config in configs} | {float(configs[0]["evaluation"]["rate_hz"])})
    options = configs[0]["downsample"]
    how = {
        "polyphase": "anti-aliased by a zero-phase polyphase filter (offline: it looks ahead; the estimators themselves are causal)",
        "decimate": "by plain decimation",
    }[options["method"]]
    first = f", after {len(options['transforms'])} further transforms" if options["transforms"] else ""
    return f"Recordings at {' and '.join(f'{rate:g}' for rate in rates)} Hz are made from the native rate {how}{first}"


def training_facts(configs: Sequence[Config]) -> list[str]:
    """The budget of each training scheme, a line each."""
    schemes: dict[str, set[str]] = {}
    for config in configs:
        schemes.setdefault(json.dumps(config["training"], default=str), set()).add(config["estimator"]["name"])
    facts = []
    for text, names in schemes.items():
        training = json.loads(text)
        options = ", ".join(f"{key} {value}" for key, value in training.items() if key not in {"name", "checkpoint_seconds", "compiled"})
        facts.append(f"{', '.join(sorted(names))}: " + (f"{training['name']} ({options})" if options else "nothing is trained"))
    return list(dict.fromkeys(facts))
