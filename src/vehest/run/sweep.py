"""A sweep: a study of all combinations of overrides over their seeds; its tables and heat maps."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.data.errors import ConfigurationError
from vehest.data.limits import use_limits
from vehest.data.schema import settings_from_config
from vehest.data.splits import VALIDATION, check_name
from vehest.evaluation.under_fault import FAULTED
from vehest.run.artefacts import Artefact, StagePlan
from vehest.run.comparison import Compared, failed_in, named
from vehest.run.config import Config, check_jobs, compose_config, count, expand, key_of, limits_of, parse, value_of
from vehest.run.evaluate import COLUMNS, METRICS
from vehest.run.faults import FaultSettings, chosen_fault, faults_of
from vehest.run.group import Member
from vehest.run.runner import Runner
from vehest.run.study import Job, Value, content_overrides
from vehest.run.train import new_estimator
from vehest.studies.artefacts import read_frame
from vehest.studies.sweep import DONE, FAILED, SweepArtefacts, build, is_of_fault, short_names, shown_value, summary

STAGE = "sweep"
VERSION = "1"
JOBS = "sweep.csv"
SUMMARY = "summary.csv"
ONE_VALUE = ("split", "evaluation", "faults", "root", "output", "tracking", "limits")
SCORES = ("rmse_sideslip", "rmse_vy", "fvu")


@dataclass(frozen=True)
class Sweep:
    """A study with one sweep.

    Args:
        name: start of its folder's name.
        command: that makes it, without where data come from and results go.
        keys: those that take several values, the seed aside.
        jobs: every combination over all seeds, in the order of the command.
        n_seeds: of each combination.
    """

    name: str
    command: str
    keys: Sequence[str]
    jobs: Sequence[Job]
    n_seeds: int


@dataclass(frozen=True)
class SweepOutcome:
    """What a sweep made.

    Args:
        folder: artefact of the sweep.
        artefacts: what its tables are made from.
        summary: one row a combination.
    """

    folder: Artefact
    artefacts: SweepArtefacts
    summary: pd.DataFrame


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
    combinations = [_combination(job, swept) for job in expand(others)]
    refused: dict[str, list[str]] = {}
    for job in combinations:
        if job.refusal:
            refused.setdefault(job.refusal, []).append(job.label)
    if all(job.refusal for job in combinations):
        listed = "; ".join(f"{' and '.join(labels)}: {reason}" for reason, labels in refused.items())
        raise ConfigurationError(next(iter(refused)) if len(refused) == 1 else f"no combination can be trained; {listed}")
    usable = [job.config for job in combinations if not job.refusal]
    values = list({repr(seed): seed for seed in (value_of(job[0]) for job in expand(seeds))}.values()) if seeds else [usable[0]["seed"]]
    estimators = dict.fromkeys(str(config["estimator"]["name"]) for config in usable)
    own_name = name or f"{'_'.join(estimators)}-{usable[0]['split']['name']}"
    check_name(own_name, "--name")
    words = [*(shlex.quote(override) for override in content_overrides(overrides)), *(["--name", own_name] if name else [])]
    jobs = [replace(job, config={**job.config, "seed": seed}) for job in combinations for seed in values]
    return Sweep(own_name, " ".join(["vehest sweep", *words]), swept, jobs, len(values))


def _combination(overrides: Sequence[str], swept: Sequence[str]) -> Job:
    """A combination of values; the seed is each job's own."""
    values = {key_of(override): _value(override) for override in overrides if key_of(override) in swept}
    label = _label(values)
    try:
        config = compose_config("eval", overrides)
        estimator = new_estimator(config["estimator"])
        settings_from_config(estimator.training_type, config["training"], "training")
        faults_of(config)
    except ConfigurationError as error:
        return Job({}, label or "this", values=values, refusal=str(error))
    trained = _label({key: value for key, value in values.items() if not is_of_fault(key)})
    return Job(config, label or estimator.full_title, trained or estimator.full_title, values)


def _label(values: Mapping[str, Value]) -> str:
    """Settings for people, ``n_local=2, bias=true``."""
    names = short_names(list(values))
    return ", ".join(f"{names[key]}={shown_value(value)}" for key, value in values.items())


def _value(override: str) -> Value:
    """A plain value, or the text of any other."""
    value = value_of(override)
    return value if isinstance(value, bool | int | float | str) else override.split("=", 1)[-1]


def draw_sweep(sweep: Sweep, compared: Compared, runner: Runner) -> SweepOutcome:
    """Write the tables and heat maps of a sweep that was run; a failed job has a row with its reason.

    Raises:
        JobsFailedError: every job failed.
    """
    if not compared.members:
        error = failed_in([compared], runner)
        assert error is not None
        raise error
    artefacts = _artefacts(sweep, compared)
    folder = runner.ensure(_plan(artefacts, compared.members, runner.output), lambda aside: _write(artefacts, aside))
    return SweepOutcome(folder, artefacts, summary(artefacts.jobs, sweep.keys, artefacts.sets))


def _job_table(sweep: Sweep, compared: Compared) -> pd.DataFrame:
    """One row a job, in the order of the command."""
    split, trainings = compared.evaluation.split, compared.planned.trainings
    sets = [*([VALIDATION] if split.validation else []), *split.tests]
    rows = []
    for position, job in enumerate(compared.planned.checked.jobs):
        failure = compared.failures.get(position)
        member = None if failure is not None else compared.found.get(trainings[position].plan.key)
        title = "" if job.refusal else new_estimator(job.config["estimator"]).full_title
        row: dict[str, Any] = {"combination": position // sweep.n_seeds, "title": title, **job.values, "seed": job.config["seed"]}
        row |= {"status": DONE if member else FAILED, "error": failure.message if failure is not None else ""}
        rows.append(row | _figures(member, sets, None if job.refusal else chosen_fault(job.config)))
    return pd.DataFrame(rows)


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


def _artefacts(sweep: Sweep, compared: Compared) -> SweepArtefacts:
    evaluation, jobs = compared.evaluation, compared.planned.checked.jobs
    configs = [job.config for position, job in enumerate(jobs) if position % sweep.n_seeds == 0 and not job.refusal]
    return SweepArtefacts(
        name=sweep.name,
        command=sweep.command,
        keys=sweep.keys,
        jobs=_job_table(sweep, compared),
        split=evaluation.split,
        protocol=evaluation.protocol,
        kinds=evaluation.kinds,
        data_titles=compared.data_titles,
        facts=[*compared.training, *_fault_facts(configs)],
        failures={name: failure.message for name, failure in named(compared.failures, jobs)},
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
