"""A comparison of estimators on one split: sweeps of trainings and the evaluations they feed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, MissingError
from vehest.run.config import Config
from vehest.run.evaluate import protocol_from_config
from vehest.run.failures import Failure, failure_of
from vehest.run.faults import all_of, check_channels, faults_of
from vehest.run.fitting import Fitted, fitted
from vehest.run.group import Evaluation, Group, Member, existing, is_finished
from vehest.run.starting import plan_training
from vehest.run.train import TrainJob, new_estimator
from vehest.run.workshop import NotThereYet, Workshop


@dataclass(frozen=True)
class Compared:
    """A comparison that has been run.

    Args:
        members: trained and evaluated, in the order of the pipeline.
        evaluation: split, references and protocol.
        data_titles: data set -> title, for people.
        facts: how recordings were prepared and what each training scheme was allowed, a line each.
        n_groups: groups of jobs there were.
        failures: name of a group that failed, and why; its members are missing.
        unfinished: jobs for which no time was left, by name.
    """

    members: Sequence[Member]
    evaluation: Evaluation
    data_titles: dict[str, str]
    facts: Sequence[str]
    n_groups: int
    failures: Sequence[tuple[str, Failure]]
    unfinished: Sequence[str] = ()


def prepare(configs: Sequence[Config], workshop: Workshop) -> Fitted:
    """Fit the jobs of a comparison to its recordings, and say which of them lack something, before anything is trained.

    Raises:
        ConfigurationError: the jobs do not fit one comparison, or a setting makes no sense.
        DataError: no job can be done, or the evaluation asks for more than the rate of the recordings.
        NotThereYet: in a dry run, after saying what would be trained.
    """
    for config in configs:
        for key in ("split", "evaluation", "downsample"):
            if config[key] != configs[0][key]:
                raise ConfigurationError(f"the sweeps of a study must agree in '{key}'; put what differs into a pipeline of its own")
    try:
        found = fitted(configs, workshop)
    except NotThereYet:
        _say_plan(configs, workshop)
        raise
    lacking = _lacking(found)
    for name, failure in lacking:
        workshop.messages.line("fail", "train", name, failure.message)
    if len(found.failures) == len(configs):
        reasons = dict.fromkeys(failure.message for _, failure in lacking)
        raise DataError(
            f"none of these estimators can be used with the recordings of split '{configs[0]['split']['name']}'; {'; '.join(reasons)}"
        )
    return found


def _lacking(found: Fitted) -> list[tuple[str, Failure]]:
    """Jobs that cannot be done, those that differ in their seed alone under one name, as a group of them is called."""
    named: dict[tuple[str, Failure], list[str]] = {}
    for position, failure in found.failures.items():
        config = found.configs[position]
        estimator = new_estimator(config["estimator"])
        named.setdefault((f"{estimator.name}-{estimator.variant}", failure), []).append(str(config["seed"]))
    return [(f"{name} seed{'s' if len(seeds) > 1 else ''} {', '.join(seeds)}", failure) for (name, failure), seeds in named.items()]


def _say_plan(configs: Sequence[Config], workshop: Workshop) -> None:
    """What a dry run would train, where there are no recordings yet to plan with."""
    for config in configs:
        estimator = new_estimator(config["estimator"])
        workshop.messages.line("plan", "train", f"{estimator.name}-{estimator.variant}-seed{config['seed']}", "then evaluate")


def compare(prepared: Fitted, workshop: Workshop, command: str, *, only_report: bool = False) -> Compared:
    """Train and evaluate every job; what is there is skipped, and what fails keeps no other from running.

    Args:
        prepared: its jobs, which agree in split, evaluation and downsampling; from `prepare`.
        workshop: where stages run.
        command: the command that would train what is missing, for messages.
        only_report: take what is there, train and evaluate nothing.

    Raises:
        ConfigurationError: the jobs do not fit one comparison.
        DataError: recordings cannot be brought to the evaluation's rate, or to that of any estimator.
        MissingError: ``only_report`` and something is missing, or raw files are not here.
        NotThereYet: in a dry run.
        Stopped: a signal came.
    """
    configs = [config for position, config in enumerate(prepared.configs) if position not in prepared.failures]
    first = configs[0]
    try:
        groups, unplanned = groups_of(configs, workshop)
    except NotThereYet:
        _say_plan(configs, workshop)
        raise
    missing = [*_lacking(prepared), *unplanned]
    n_groups = len(groups) + len(missing)
    wanted = groups
    if only_report:
        wanted, absent = _finished(groups, command)
        missing += absent
    found, failures = workshop.run_groups(wanted)
    members = [member for member in found if member.evaluation is not None]
    order = {job.plan.key: position for position, job in enumerate(job for group in groups for job in group.jobs)}
    members.sort(key=lambda member: order[member.job.plan.key])
    evaluation = groups[0].evaluation
    assert evaluation is not None
    titles = {name: str(workshop.dataset_config(name, first)["dataset"].get("title", name)) for name in evaluation.split.datasets}
    facts = [*training_facts(configs), resampling_fact(configs), *prepared.facts]
    unfinished = _unfinished(wanted, members, failures)
    return Compared(members, evaluation, titles, facts, n_groups, [*failures, *missing], unfinished)


def _unfinished(groups: Sequence[Group], members: Sequence[Member], failures: Sequence[tuple[str, Failure]]) -> list[str]:
    """Jobs that were neither done nor failed, since the time was up, by name."""
    done = {member.job.plan.key for member in members}
    failed = {name for name, _ in failures}
    return [job.plan.label for group in groups if group.name not in failed for job in group.jobs if job.plan.key not in done]


def _finished(groups: Sequence[Group], command: str) -> tuple[list[Group], list[tuple[str, Failure]]]:
    """What of the groups is there, and what is missing, by name.

    Raises:
        MissingError: nothing is there.
    """
    found, missing = [], []
    for group in groups:
        there = [member for member in existing(group) if is_finished(group, member)]
        if there:
            found.append(replace(group, jobs=[member.job for member in there]))
        for job in group.jobs:
            if all(member.job is not job for member in there):
                missing.append((job.plan.label, Failure(f"has not been trained and evaluated; run '{command}' first", exit_code=4)))
    if not found:
        raise MissingError(f"{missing[0][0]} {missing[0][1].message}")
    return found, missing


def failed_in(compared: Iterable[Compared], workshop: Workshop) -> JobsFailedError | None:
    """Say in full what failed; returns what the command ends with, if anything did."""
    counted = list(compared)
    failures = [failure for own in counted for failure in own.failures]
    if not failures:
        return None
    for name, failure in failures:
        if failure.detail:
            workshop.messages.warn(f"{name}:\n{failure.detail}")
    listed = "; ".join(f"{name}: {failure.message}" for name, failure in failures)
    return JobsFailedError(
        f"{len(failures)} of {sum(own.n_groups for own in counted)} groups of jobs failed, the others are kept; {listed}"
    )


def groups_of(configs: Sequence[Config], workshop: Workshop) -> tuple[list[Group], list[tuple[str, Failure]]]:
    """Jobs that fit one batch, with the data they need, which is made on the way; and those whose data cannot be made, by name.

    Raises:
        DataError: there are no data for any.
    """
    groups: dict[tuple[Any, ...], list[TrainJob]] = {}
    evaluations: dict[tuple[Any, ...], Evaluation] = {}
    labels: dict[str, str] = {}
    unplanned: dict[int, Failure] = {}
    faults = all_of(map(faults_of, configs))  # all jobs of a comparison are scored under the same conditions
    for position, config in enumerate(configs):
        split = workshop.split(config)
        if not any(split.tests.values()):
            raise ConfigurationError(f"split '{split.name}' has no test ranges; a study needs some")
        protocol = protocol_from_config(config["evaluation"])
        references = workshop.data_for(split, protocol.rate_hz, plain_resampling(config))
        try:
            data = workshop.data_for(split, new_estimator(config["estimator"]).settings.rate_hz, config)
        except DataError as error:
            unplanned[position] = failure_of(error)
            continue
        job = plan_training(config, split, data)
        if labels.setdefault(job.plan.label, job.plan.key) != job.plan.key:
            raise ConfigurationError(
                f"two jobs are both called {job.plan.label}: they differ in what its name does not say; sweep that in a pipeline of its own"
            )
        check_channels(faults, split, data)
        own = groups.setdefault(job.group, [])
        if all(job.plan.key != other.plan.key for other in own):  # which another job with another fault may be
            own.append(job)
        evaluations[job.group] = Evaluation(split, data, references, workshop.kinds_of(split, config), protocol, workshop.output, faults)
    if not groups:
        raise DataError(next(iter(unplanned.values())).message)
    failures = _lacking(Fitted(configs, unplanned))
    for name, failure in failures:
        workshop.messages.line("fail", "train", name, failure.message)
    return [Group(jobs, evaluations[key], workshop.force) for key, jobs in groups.items()], failures


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


def plain_resampling(config: Config) -> Config:
    """The configuration for references: resampled like everything, but never filtered further."""
    return {**config, "downsample": {**config["downsample"], "transforms": []}}


def training_facts(configs: Sequence[Config]) -> list[str]:
    """What each training scheme was allowed, a line each."""
    facts = []
    for config in configs:
        training = config["training"]
        options = ", ".join(f"{key} {value}" for key, value in training.items() if key not in {"name", "checkpoint_seconds", "compiled"})
        names = sorted({c["estimator"]["name"] for c in configs if c["training"] == training})
        fact = f"{', '.join(names)}: {training['name']} ({options})" if options else f"{', '.join(names)}: nothing is trained"
        if fact not in facts:
            facts.append(fact)
    return facts
