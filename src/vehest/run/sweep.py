"""A sweep: all combinations of overrides trained and evaluated over their seeds, and a table and heat maps of what came out."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, VehestError
from vehest.data.limits import use_limits
from vehest.data.schema import settings_from_config
from vehest.data.splits import VALIDATION, Split, check_name
from vehest.evaluation.under_fault import FAULTED
from vehest.run.artefacts import Artefact, StagePlan
from vehest.run.comparison import plain_resampling, resampling_fact, training_facts
from vehest.run.config import Config, check_jobs, compose_config, count, expand, key_of, limits_of, parse, value_of
from vehest.run.evaluate import COLUMNS, METRICS, protocol_from_config
from vehest.run.faults import FaultSettings, all_of, check_channels, chosen_fault, faults_of
from vehest.run.fitting import Fitted, fitted
from vehest.run.group import Evaluation, Group, Member
from vehest.run.pipeline import content_overrides
from vehest.run.starting import plan_training
from vehest.run.train import new_estimator
from vehest.run.workshop import NotThereYet, Workshop
from vehest.studies.artefacts import read_frame
from vehest.studies.sweep import DONE, FAILED, SweepArtefacts, Value, build, is_of_fault, short_names, shown_value, summary

STAGE = "sweep"
VERSION = "1"
JOBS = "sweep.csv"
SUMMARY = "summary.csv"
ONE_VALUE = ("split", "evaluation", "faults", "root", "output", "tracking", "limits")
SCORES = ("rmse_sideslip", "rmse_vy", "fvu")


@dataclass(frozen=True)
class Combination:
    """Settings that are trained over all seeds.

    Args:
        label: for people, ``n_local=2, bias=true``; unique in its sweep.
        values: key that takes several values -> the one it has here.
        config: as composed for ``eval``; the seed is each job's own.
        title: of the estimator.
        refusal: why it cannot be trained; empty if it can.
    """

    label: str
    values: Mapping[str, Value]
    config: Config
    title: str = ""
    refusal: str = ""


@dataclass(frozen=True)
class Sweep:
    """What a sweep is going to do.

    Args:
        name: start of its folder's name.
        command: that makes it, without where data come from and results go.
        keys: those that take several values, the seed aside.
        combinations: in the order of the command.
        seeds: of each combination.
    """

    name: str
    command: str
    keys: Sequence[str]
    combinations: Sequence[Combination]
    seeds: Sequence[Any]

    @property
    def first(self) -> Config:
        """The configuration of the first combination that can be trained: what all have in common is in it."""
        return next(combination.config for combination in self.combinations if not combination.refusal)


@dataclass(frozen=True)
class SweepOutcome:
    """What a sweep made.

    Args:
        folder: artefact of the sweep.
        artefacts: what its tables are made from.
        summary: one row a combination.
        failures: what failed -> why.
        n_failed: jobs that failed.
    """

    folder: Artefact
    artefacts: SweepArtefacts
    summary: pd.DataFrame
    failures: Mapping[str, str]
    n_failed: int

    def raise_failures(self) -> None:
        """Say what failed.

        Raises:
            JobsFailedError: something did.
        """
        if self.failures:
            raise JobsFailedError(_failed_line(self.n_failed, len(self.artefacts.jobs), self.failures))


def plan_sweep(overrides: Sequence[str], name: str | None = None) -> Sweep:
    """Expand overrides; a combination that its estimator refuses stays in the list with the reason.

    Raises:
        ConfigurationError: a key is named twice, a key takes several values that cannot, the name is none for files, or no combination can
            be trained.
    """
    with use_limits(limits_of(overrides)):
        check_jobs(count(overrides), "these overrides stand")
        return _planned(overrides, name)


def _planned(overrides: Sequence[str], name: str | None) -> Sweep:
    parsed = parse(overrides)
    keys = [str(override.key_or_group) for override in parsed]
    for key in keys:
        if keys.count(key) > 1:
            raise ConfigurationError(f"'{key}' is named twice; give all its values at once: {key}=1,2")
    several = [key for key, override in zip(keys, parsed, strict=True) if override.is_sweep_override()]
    for key in several:
        if key.split(".")[0] in ONE_VALUE:
            raise ConfigurationError(
                f"'{key}' takes one value in a sweep, whose combinations are compared with each other; run one sweep a value"
            )
    swept = [key for key in several if key != "seed"]
    seeds = [override for override, key in zip(overrides, keys, strict=True) if key == "seed"]
    others = [override for override, key in zip(overrides, keys, strict=True) if key != "seed"]
    combinations = _combinations(expand(others), swept)
    refused = {combination.label: combination.refusal for combination in combinations if combination.refusal}
    if len(refused) == len(combinations):
        reasons = set(refused.values())
        raise ConfigurationError(reasons.pop() if len(reasons) == 1 else f"no combination can be trained; {_listed(refused)}")
    first = next(combination.config for combination in combinations if not combination.refusal)
    values = list({repr(seed): seed for seed in (value_of(job[0]) for job in expand(seeds))}.values()) if seeds else [first["seed"]]
    estimators = dict.fromkeys(str(combination.config["estimator"]["name"]) for combination in combinations if not combination.refusal)
    own_name = name or f"{'_'.join(estimators)}-{first['split']['name']}"
    check_name(own_name, "--name")
    words = [*(shlex.quote(override) for override in content_overrides(overrides)), *(["--name", own_name] if name else [])]
    return Sweep(own_name, " ".join(["vehest sweep", *words]), swept, combinations, values)


def run_sweep(sweep: Sweep, workshop: Workshop) -> SweepOutcome:
    """Train and evaluate every job, then draw tables and heat maps; what is there is skipped, a failed job stops no other.

    Raises:
        JobsFailedError: every job failed.
        DataError: recordings lack what every job needs.
        ConfigurationError: the split has no test ranges.
        NotThereYet: in a dry run.
        Stopped: a signal came; what was finished stays.
    """
    workshop.tags = {"vehest.study": sweep.name}
    refused = {combination.label: combination.refusal for combination in sweep.combinations if combination.refusal}
    for label, reason in refused.items():
        workshop.messages.line("fail", "sweep", label, reason)
    try:
        sweep, found = _fitted(sweep, workshop)
        evaluation = _evaluation(sweep, workshop)
        groups, unplanned = _groups(sweep, evaluation, workshop)
    except NotThereYet:
        _say_plan(sweep, workshop)
        workshop.messages.line("plan", STAGE, sweep.name)
        raise
    try:
        members, untrained = _run(groups, workshop)
    except NotThereYet:
        workshop.messages.line("plan", STAGE, sweep.name)
        raise
    refused = {combination.label: combination.refusal for combination in sweep.combinations if combination.refusal}
    failures = {**refused, **unplanned, **untrained}
    if not members:
        n_jobs = len(sweep.combinations) * len(sweep.seeds)
        raise JobsFailedError(_failed_line(n_jobs, n_jobs, failures))
    jobs = _job_table(sweep, groups, members, failures, evaluation.split)
    artefacts = _artefacts(sweep, jobs, evaluation, failures, found.facts, workshop)
    folder = workshop.ensure(_plan(artefacts, members, workshop.output), lambda aside: _write(artefacts, aside))
    table = summary(jobs, sweep.keys, artefacts.sets)
    return SweepOutcome(folder, artefacts, table, failures, int((jobs["status"] == FAILED).sum()))


def _combinations(jobs: Sequence[Sequence[str]], swept: Sequence[str]) -> list[Combination]:
    names = short_names(swept)
    combinations = []
    for job in jobs:
        values = {key_of(override): _value(override) for override in job if key_of(override) in swept}
        label = ", ".join(f"{names[key]}={shown_value(value)}" for key, value in values.items())
        try:
            config = compose_config("eval", job)
            estimator = new_estimator(config["estimator"])
            settings_from_config(estimator.training_type, config["training"], "training")
            faults_of(config)
        except ConfigurationError as error:
            combinations.append(Combination(label or "this", values, {}, refusal=str(error)))
            continue
        combinations.append(Combination(label or estimator.full_title, values, config, estimator.full_title))
    return combinations


def _fitted(sweep: Sweep, workshop: Workshop) -> tuple[Sweep, Fitted]:
    """The sweep at rates that its recordings have; a combination that lacks something is refused with the reason."""
    open_ones = [position for position, combination in enumerate(sweep.combinations) if not combination.refusal]
    found = fitted([sweep.combinations[position].config for position in open_ones], workshop)
    combinations = list(sweep.combinations)
    for position, own in enumerate(open_ones):
        failure = found.failures.get(position)
        refusal = "" if failure is None else failure.message
        combinations[own] = replace(combinations[own], config=found.configs[position], refusal=refusal)
        if refusal:
            workshop.messages.line("fail", "sweep", combinations[own].label, refusal)
    if len(found.failures) == len(open_ones):
        raise DataError(f"no combination can be trained; {_listed({own.label: own.refusal for own in combinations})}")
    return replace(sweep, combinations=combinations), found


def _value(override: str) -> Value:
    """A plain value, or the text of any other."""
    value = value_of(override)
    return value if isinstance(value, bool | int | float | str) else override.split("=", 1)[-1]


def _evaluation(sweep: Sweep, workshop: Workshop) -> Evaluation:
    """How all jobs are scored; the recordings at their estimators' rates are each job's own."""
    first = sweep.first
    split = workshop.split(first)
    if not any(split.tests.values()):
        raise ConfigurationError(f"split '{split.name}' has no test ranges; a sweep needs some")
    protocol = protocol_from_config(first["evaluation"])
    references = workshop.data_for(split, protocol.rate_hz, plain_resampling(first))
    return Evaluation(split, {}, references, workshop.kinds_of(split, first), protocol, workshop.output)


def _groups(sweep: Sweep, evaluation: Evaluation, workshop: Workshop) -> tuple[dict[int, Group], dict[str, str]]:
    """Position of a combination -> its jobs, which train together; and what cannot be trained -> why.

    Combinations that differ in their fault alone share one group: it is trained once, and evaluated under the faults of all.
    """
    groups: dict[int, Group] = {}
    failures: dict[str, str] = {}
    owners: dict[tuple[str, ...], list[int]] = {}
    for position, combination in enumerate(sweep.combinations):
        if combination.refusal:
            continue
        try:
            data = workshop.data_for(evaluation.split, new_estimator(combination.config["estimator"]).settings.rate_hz, combination.config)
            jobs = [plan_training({**combination.config, "seed": seed}, evaluation.split, data) for seed in sweep.seeds]
            faults = faults_of(combination.config)
            check_channels(faults, evaluation.split, data)
            together = owners.setdefault(tuple(job.plan.key for job in jobs), [])
            for other in together:
                if _fault_values(combination) == _fault_values(sweep.combinations[other]):
                    raise ConfigurationError(f"it is the same training as {sweep.combinations[other].label}")
            if together:
                faults = all_of([groups[together[0]].evaluation.faults, faults])  # type: ignore[union-attr]
        except VehestError as error:
            failures[combination.label] = str(error)
            workshop.messages.line("fail", "sweep", combination.label, str(error))
            continue
        together.append(position)
        group = Group(jobs, replace(evaluation, data=data, faults=faults), workshop.force, _label_of(combination))
        groups |= dict.fromkeys(together, group)
    return groups, failures


def _fault_values(combination: Combination) -> dict[str, Value]:
    return {key: value for key, value in combination.values.items() if is_of_fault(key)}


def _label_of(combination: Combination) -> str:
    """What is trained for a combination, for people: its label without its fault."""
    if not _fault_values(combination):
        return combination.label
    trained = {key: value for key, value in combination.values.items() if not is_of_fault(key)}
    names = short_names(list(trained))
    return ", ".join(f"{names[key]}={shown_value(value)}" for key, value in trained.items()) or combination.title


def _run(groups: Mapping[int, Group], workshop: Workshop) -> tuple[list[Member], dict[str, str]]:
    """Train and evaluate; where seeds that train together fail, each is tried alone, so that one takes no other with it."""
    members, failed = workshop.run_groups(list({id(group): group for group in groups.values()}.values()))
    finished = {member.job.plan.key for member in members}
    failures: dict[str, str] = {}
    alone: list[Group] = []
    for name, failure in failed:
        group = next(group for group in groups.values() if name.startswith(f"{group.label} seed"))
        missing = [job for job in group.jobs if job.plan.key not in finished]
        if failure.detail:
            workshop.messages.warn(f"{name}:\n{failure.detail}")
        if failure.detail or len(missing) == 1:
            failures[name] = failure.message
        else:
            alone += [replace(group, jobs=[job]) for job in missing]
    if alone:
        more, failed = workshop.run_groups(alone)
        members += more
        for name, failure in failed:
            failures[name] = failure.message
            if failure.detail:
                workshop.messages.warn(f"{name}:\n{failure.detail}")
    return members, failures


def _job_table(
    sweep: Sweep, groups: Mapping[int, Group], members: Sequence[Member], failures: Mapping[str, str], split: Split
) -> pd.DataFrame:
    """One row a job, in the order of the command."""
    done = {member.job.plan.key: member for member in members}
    sets = [*([VALIDATION] if split.validation else []), *split.tests]
    rows = []
    for position, combination in enumerate(sweep.combinations):
        jobs = groups[position].jobs if position in groups else [None] * len(sweep.seeds)
        for seed, job in zip(sweep.seeds, jobs, strict=True):
            member = done.get(job.plan.key) if job is not None else None
            row: dict[str, Any] = {"combination": position, "title": combination.title, **combination.values, "seed": seed}
            label = groups[position].label if position in groups else combination.label
            row |= {"status": DONE if member else FAILED, "error": "" if member else _reason(failures, label, seed)}
            row |= _figures(member, sets, None if combination.refusal else chosen_fault(combination.config))
            rows.append(row)
    return pd.DataFrame(rows)


def _reason(failures: Mapping[str, str], label: str, seed: Any) -> str:
    """Why a job failed: alone, with its whole combination, or in a group that a defect ended."""
    own = (label, f"{label} seed {seed}")
    return next((reason for name, reason in failures.items() if name in own or name.startswith(f"{label} seeds ")), "")


def _figures(member: Member | None, sets: Sequence[str], fault: FaultSettings | None) -> dict[str, Any]:
    """Figures of a job, ``METRIC.SET``, while its fault lasts where it has one; NaN where it failed."""
    columns = ["n_parameters", "epochs", *(f"{metric}.{name}" for name in sets for metric in SCORES)]
    if member is None or member.model is None or member.evaluation is None:
        return dict.fromkeys(columns, float("nan"))
    table = read_frame(member.evaluation.folder / METRICS, COLUMNS, numbers=("value",))
    found = _found(table, "all", "nominal")
    own = {metric: next(value for name, value in found.items() if name.startswith(f"{metric}.")) for metric in ("n_parameters", "epochs")}
    found = found if fault is None else _found(table, FAULTED, fault.condition)
    return {**own, **{column: found.get(column, float("nan")) for column in columns[2:]}, "model": member.model.folder.name}


def _found(table: pd.DataFrame, subset: str, condition: str) -> dict[str, float]:
    """``METRIC.SET`` -> value, of an evaluation's samples in a subset under a condition."""
    own = table[(table["subset"] == subset) & (table["condition"] == condition)]
    return {f"{metric}.{name}": float(value) for metric, name, value in zip(own["metric"], own["test_set"], own["value"], strict=True)}


def _artefacts(
    sweep: Sweep, jobs: pd.DataFrame, evaluation: Evaluation, failures: Mapping[str, str], facts: Sequence[str], workshop: Workshop
) -> SweepArtefacts:
    configs = [combination.config for combination in sweep.combinations if not combination.refusal]
    titles = {name: str(workshop.dataset_config(name, sweep.first)["dataset"].get("title", name)) for name in evaluation.split.datasets}
    return SweepArtefacts(
        name=sweep.name,
        command=sweep.command,
        keys=sweep.keys,
        jobs=jobs,
        split=evaluation.split,
        protocol=evaluation.protocol,
        kinds=evaluation.kinds,
        data_titles=titles,
        facts=[*training_facts(configs), resampling_fact(configs), *facts, *_fault_facts(configs)],
        failures=failures,
        patented=any(config["estimator"]["name"] == "ksnn" for config in configs),
    )


def _fault_facts(configs: Sequence[Config]) -> list[str]:
    """What errors count where there are faults; nothing where there are none."""
    faults = dict.fromkeys(fault.condition for config in configs if (fault := chosen_fault(config)) is not None)
    return [f"Faults: {', '.join(faults)}; RMSE(β) under one counts the samples while it lasts"] if faults else []


def _plan(artefacts: SweepArtefacts, members: Sequence[Member], output: Path) -> StagePlan:
    inputs = {}
    for member in members:
        assert member.model is not None
        assert member.evaluation is not None
        inputs[f"train/{member.model.folder.name}"] = member.model.digest
        inputs[f"evaluate/{member.evaluation.folder.name}"] = member.evaluation.digest
    jobs = artefacts.jobs[["combination", "title", *artefacts.keys, "seed", "status"]]
    return StagePlan(
        stage=STAGE,
        label=artefacts.name,
        config={
            "command": artefacts.command,
            "keys": list(artefacts.keys),
            "jobs": jobs.astype(object).to_dict("records"),
            "failures": dict(artefacts.failures),
            "protocol": asdict(artefacts.protocol),
            "kinds": dict(artefacts.kinds),
            "data_titles": dict(artefacts.data_titles),
            "facts": list(artefacts.facts),
        },
        inputs=inputs,
        code=code_of_sweep(),
        output=output,
    )


def code_of_sweep() -> str:
    """Version of what draws a sweep's tables and figures."""
    return f"sweep={VERSION}"


def _write(artefacts: SweepArtefacts, folder: Path) -> None:
    """Write sweep.csv, summary.csv, report.md, tables and figures into ``folder``."""
    from vehest.report.document import write_document

    write_document(build(artefacts), folder, page=False)
    artefacts.jobs.to_csv(folder / JOBS, index=False, lineterminator="\n", errors="backslashreplace")
    table = summary(artefacts.jobs, artefacts.keys, artefacts.sets)
    table.to_csv(folder / SUMMARY, index=False, lineterminator="\n", errors="backslashreplace")


def _say_plan(sweep: Sweep, workshop: Workshop) -> None:
    """What a dry run would do where there are no recordings yet to plan with."""
    seeds = ", ".join(map(str, sweep.seeds))
    for combination in sweep.combinations:
        if not combination.refusal:
            workshop.messages.line(
                "plan", "train", f"{combination.label} seed{'s' if len(sweep.seeds) > 1 else ''} {seeds}", "then evaluate"
            )


def _failed_line(n_failed: int, n_jobs: int, failures: Mapping[str, str]) -> str:
    return f"{n_failed} of {n_jobs} jobs failed, the others are kept; {_listed(failures)}"


def _listed(failures: Mapping[str, str]) -> str:
    """Failures, those with the same reason together."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in failures.items():
        by_reason.setdefault(reason, []).append(name)
    return "; ".join(f"{' and '.join(names)}: {reason}" for reason, names in by_reason.items())
