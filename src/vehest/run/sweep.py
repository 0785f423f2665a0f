"""Draws a sweep, whose report has a row a combination of settings: report.md, sweep.csv, summary.csv and heat maps.

Comparison of labelled jobs -> table of jobs -> SweepArtefacts -> `vehest.studies.sweep`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.data.splits import VALIDATION
from vehest.evaluation.under_fault import FAULTED
from vehest.run.artefacts import Artefact, StagePlan
from vehest.run.comparison import Comparison
from vehest.run.evaluate import COLUMNS, METRICS
from vehest.run.evaluate_faults import FaultSettings, chosen_fault
from vehest.run.group import Member
from vehest.run.printing import TerminalSummary, summary_of_sweep
from vehest.run.runner import Runner
from vehest.run.study import Study
from vehest.run.train import new_estimator
from vehest.studies.artefacts import read_frame
from vehest.studies.sweep import DONE, FAILED, SweepArtefacts, build, summary

STAGE = "sweep"
VERSION = "1"
SCORES = ("rmse_sideslip", "rmse_vy", "fvu")


def draw_sweep(study: Study, comparison: Comparison, runner: Runner) -> tuple[Artefact, TerminalSummary]:
    """Draw a sweep, unless its report is there, and sum it up for the terminal; a failed job has a row with its reason."""
    evaluation, configs = comparison.evaluation, {job.combination: job.config for job in comparison.jobs if "estimator" in job.config}
    conditions = dict.fromkeys(fault.condition for config in configs.values() if (fault := chosen_fault(config)) is not None)
    under = [f"Faults: {', '.join(conditions)}; RMSE(β) under one counts the samples while it lasts"] if conditions else []
    artefacts = SweepArtefacts(
        name=study.study,
        command=study.command,
        keys=list(comparison.jobs[0].values),
        jobs=_job_table(comparison),
        split=evaluation.split,
        protocol=evaluation.protocol,
        kinds=evaluation.kinds,
        data_titles=comparison.data_titles,
        facts=[*comparison.facts, *under],
        failures=comparison.failed,
        patented=any(config["estimator"]["name"] == "ksnn" for config in configs.values()),
    )
    table = summary(artefacts.jobs, artefacts.keys, artefacts.sets)

    def write(folder: Path) -> None:
        from vehest.report.document import write_document

        write_document(build(artefacts), folder, page=False)
        for file, written in (("sweep.csv", artefacts.jobs), ("summary.csv", table)):
            written.to_csv(folder / file, index=False, lineterminator="\n", errors="backslashreplace")

    return runner.ensure(_plan(artefacts, comparison.members, runner.output), write), summary_of_sweep(artefacts, table)


def _job_table(comparison: Comparison) -> pd.DataFrame:
    """One row a job, in the order of the command."""
    split = comparison.evaluation.split
    sets = [*([VALIDATION] if split.validation else []), *split.tests]
    rows = []
    for job in comparison.jobs:
        member = None if job.failure is not None or job.training is None else comparison.found.get(job.training.plan.key)
        title = new_estimator(job.config["estimator"]).full_title if "estimator" in job.config else ""  # else refused
        row: dict[str, Any] = {"combination": job.combination, "title": title, **job.values, "seed": job.config["seed"]}
        row |= {"status": DONE if member else FAILED, "error": job.failure.message if job.failure is not None else ""}
        rows.append(row | _figures(member, sets, chosen_fault(job.config)))
    return pd.DataFrame(rows)


def _figures(member: Member | None, sets: Sequence[str], fault: FaultSettings | None) -> dict[str, Any]:
    """Figures of a job, ``METRIC.SET``, while its fault lasts where it has one; NaN where it failed."""
    columns = [f"{metric}.{name}" for name in sets for metric in SCORES]
    if member is None or member.model is None or member.evaluation is None:
        return dict.fromkeys(["n_parameters", "epochs", *columns], float("nan"))
    table = read_frame(member.evaluation.folder / METRICS, COLUMNS, numbers=("value",))
    nominal = table[(table["subset"] == "all") & (table["condition"] == "nominal")]
    own = {metric: float(nominal.loc[nominal["metric"] == metric, "value"].iloc[0]) for metric in ("n_parameters", "epochs")}
    scored = nominal if fault is None else table[(table["subset"] == FAULTED) & (table["condition"] == fault.condition)]
    found = dict(zip(scored["metric"] + "." + scored["test_set"], map(float, scored["value"]), strict=True))
    return {**own, **{column: found.get(column, float("nan")) for column in columns}, "model": member.model.folder.name}


def _plan(artefacts: SweepArtefacts, members: Sequence[Member], output: Path) -> StagePlan:
    made = [own for member in members for own in (member.model, member.evaluation) if own is not None]
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
        inputs={f"{own.stage}/{own.folder.name}": own.digest for own in made},
        code=code_of_sweep(),
        output=output,
    )


def code_of_sweep() -> str:
    """Version of what draws a sweep's tables and figures."""
    return f"sweep={VERSION}"
