"""Last stage: evaluations, or recordings alone, to tables, figures and pages.

comparisons, data sets -> StudyArtefacts -> the study's module -> report.md, report.html, tables,
figures, metrics.csv comparison of a sweep -> table of jobs -> SweepArtefacts ->
`vehest.studies.sweep` -> report.md, sweep.csv, summary.csv, heat maps
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from vehest.artefacts.artefact import TIMINGS, Artefact, StagePlan, provenance
from vehest.artefacts.keys import changed_options
from vehest.data.errors import ConfigurationError
from vehest.data.files import sha256_of
from vehest.data.splits import VALIDATION
from vehest.data.text_files import write_json
from vehest.estimators.kernels.blas import single_blas_thread
from vehest.estimators.registry import new_estimator
from vehest.evaluation.under_fault import FAULTED
from vehest.run.comparison import NOT_TRAINED, Comparison, name_in_part
from vehest.run.evaluate import METRICS, read_metrics, scored_spans
from vehest.run.evaluate_faults import FaultSettings, chosen_fault
from vehest.run.group import Member
from vehest.run.ingest import STAGE as INGEST
from vehest.run.next_commands import command_line, location_overrides
from vehest.run.printing import (
    TerminalSummary,
    summary_of_leaderboard,
    summary_of_overview,
    summary_of_sweep,
)
from vehest.run.publishing import PROVENANCE, PUBLISHED_WEIGHTS
from vehest.run.runner import Runner
from vehest.run.searches import SEARCHES, write_trials
from vehest.run.study import Study
from vehest.run.train import read_fit_metrics, stored_recording
from vehest.run.training_differences import difference_suffix, difference_text
from vehest.run.versions import code_of
from vehest.run.weights import (
    FORMAT,
    PublishedWeights,
    WeightsTooLargeError,
)
from vehest.studies.artefacts import (
    METRIC_COLUMNS,
    AbsentDataset,
    EvaluatedModel,
    PartArtefacts,
    StoredDataset,
    StudyArtefacts,
    Trial,
    nominal_rows,
    of_parts,
    read_frame,
    write_frame,
)
from vehest.studies.kit.timings import timings_of_study
from vehest.studies.reference_minutes import describe_start
from vehest.studies.registry import study_module
from vehest.studies.sweep import DONE, FAILED, SweepArtefacts, build

STAGE = "report"  # name of the stage
SWEEP = "sweep"  # name of the stage for sweeps
OVERVIEW = "tables/overview.csv"  # file of a report's overview, for the terminal
SCORES = ("rmse_sideslip", "rmse_vy", "fvu")  # metrics of a sweep's table


def draw_report(
    study: Study,
    comparisons: Mapping[str, Comparison],
    datasets: Sequence[StoredDataset | AbsentDataset],
    runner: Runner,
    trials: Sequence[Trial],
    search_remarks: Sequence[str],
) -> tuple[Artefact, TerminalSummary]:
    """Draw a study's report, unless it exists, and return it with a summary for the terminal; parts
    without a comparison are named as absent.

    Trials of searches are in no part, so that a report is the same whether they were trained here
    or published before. The weights of an incomplete study include all that were published before,
    so that no training is lost.

    Parameters
    ----------
    study : Study
        The pipeline.
    comparisons : mapping
        Part -> its comparison, trained and evaluated; trials of searches among them.
    datasets : sequence
        Of a study of recordings alone.
    runner : Runner
        Makes the artefact.
    trials : sequence of Trial
        Of finished searches.
    search_remarks : sequence of str
        Of parts that do not use what a search chose.

    Returns
    -------
    tuple
        The report's artefact, and tables and figures for the terminal.

    Raises
    ------
    ConfigurationError
        The study's module makes no table for the terminal.
    """
    is_complete = not any(part.unfinished for part in comparisons.values())
    comparisons = {name: part for name, part in comparisons.items() if name not in study.trials}
    drawn = {name: part for name, part in comparisons.items() if part.members}
    left_out = {
        name_in_part(part_name, name, drawn): reason
        for part_name, part in drawn.items()
        for name, reason in part.failed.items()
        if reason != NOT_TRAINED  # the run prints how many these are
    }
    drawn_parts = [name for name in study.parts if name not in study.trials]
    artefacts = StudyArtefacts(
        study=study.study,
        title=study.title,
        about=study.about,
        command=study.command,
        titles={name: study.parts[name].title for name in drawn_parts},
        parts={
            name: _part_artefacts(study, study.parts[name].title, part)
            for name, part in drawn.items()
        },
        absent=[name for name in drawn_parts if name not in comparisons],
        not_trained={
            name: part.unfinished for name, part in comparisons.items() if part.unfinished
        },
        datasets=[dataset for dataset in datasets if isinstance(dataset, StoredDataset)],
        absent_datasets=[dataset for dataset in datasets if isinstance(dataset, AbsentDataset)],
        trials=trials,
        search_remarks=search_remarks,
        report_command=command_line("report", study.words),
        location=shlex.join(location_overrides(study.words[1:])),
    )
    config: dict[str, Any] = {
        **{
            key: getattr(artefacts, key) for key in ("study", "title", "about", "command", "titles")
        },
        "module": study.report,
        "absent": [{"name": name, "title": artefacts.titles[name]} for name in artefacts.absent],
        "parts": {
            name: {
                "training": list(part.facts),
                "failed": part.failed,
                "data_titles": part.data_titles,
                "protocol": changed_options(part.protocol),
            }
            for name, part in artefacts.parts.items()
        },
        "datasets": {dataset.name: [dataset.title, dataset.kind] for dataset in artefacts.datasets},
        "absent_datasets": [asdict(dataset) for dataset in artefacts.absent_datasets],
        **({"trials": [asdict(trial) for trial in trials]} if trials else {}),
        **({"search_remarks": list(search_remarks)} if search_remarks else {}),
        **({"not_trained": artefacts.not_trained} if artefacts.not_trained else {}),
        **({"weights": FORMAT} if study.publish else {}),
        **({"templates": templates} if (templates := template_digests(study.report)) else {}),
    }
    ingested = [
        artefact
        for artefact in runner.artefacts.values()
        if study.datasets and artefact.stage == INGEST
    ]
    inputs = {artefact.label: artefact.digest for artefact in ingested}
    for name, part in drawn.items():
        artefacts_of_part = [artefact for member in part.members for artefact in member.made]
        inputs |= {
            f"{name}: {artefact.label}" if name else artefact.label: artefact.digest
            for artefact in artefacts_of_part
        }
    models = [
        member.model
        for part in drawn.values()
        for member in part.members
        if member.model is not None
    ]

    def write(folder: Path) -> None:
        _write(artefacts, study.report, _recordings(drawn, ingested), folder)
        if trials:
            write_trials(trials, folder / SEARCHES)
        if study.publish and models:
            if not is_complete and runner.weights is not None and runner.weights.path.is_file():
                shutil.copyfile(runner.weights.path, folder / PUBLISHED_WEIGHTS)
            try:
                PublishedWeights(folder / PUBLISHED_WEIGHTS).add(models, runner.origins)
            except WeightsTooLargeError as error:
                runner.messages.warn(f"the report is published without weights: {error}")

    report = runner.ensure(
        StagePlan(STAGE, study.study, config, inputs, code_of(STAGE, study.report), runner.output),
        write,
    )
    module = study_module(study.report)
    if not hasattr(module, "leaderboard"):
        return report, summary_of_overview(read_frame(report.folder / OVERVIEW), left_out)
    verdict: list[str] = module.verdict(artefacts) if hasattr(module, "verdict") else []
    return report, summary_of_leaderboard(
        study.title, module.leaderboard(artefacts.first), left_out, verdict
    )


def template_digests(name: str) -> dict[str, str]:
    """File name -> SHA-256 of each Markdown template beside the module of a study.

    A report is drawn again where one of them changed; no published study becomes stale by it.
    """
    folder = Path(str(study_module(name).__file__)).parent
    return {file.name: sha256_of(file) for file in sorted(folder.glob("*.md.j2"))}


def _write(
    artefacts: StudyArtefacts, name: str, recordings: Mapping[str, str], folder: Path
) -> None:
    """Draw the study into ``folder``: report.md, report.html, tables, figures and provenance; of a
    comparison also metrics.csv and timings.csv.

    It runs on one thread, as trainings do, so that the last digits do not depend on whether
    trainings came before.
    """
    from vehest.report.document import write_documents

    torch.set_num_threads(1)
    module = study_module(name)
    timings = {name: _timings_of(part) for name, part in artefacts.parts.items()}
    times = [
        (artefacts.titles[name], timings[name], {model.name: model.title for model in part.models})
        for name, part in artefacts.parts.items()
    ]
    with single_blas_thread():
        write_documents(module.documents(artefacts), folder, on_page=timings_of_study(times))
    if not hasattr(module, "leaderboard") and not (folder / OVERVIEW).is_file():
        raise ConfigurationError(
            f"the study module '{name}' gives no table 'overview', which the terminal shows"
        )
    if artefacts.parts:
        table = artefacts.metrics
        metric_names = getattr(module, "METRICS", None)
        if metric_names is not None:
            table = table[table["metric"].isin(metric_names) & (table["subset"] == "all")]
        for file, written in ((METRICS, table), (TIMINGS, of_parts(timings))):
            write_frame(written, folder / file)
    kinds = {name: kind for part in artefacts.parts.values() for name, kind in part.kinds.items()}
    about = provenance()
    about |= {
        "study": artefacts.study,
        "command": artefacts.command,
        "parts": [name for name in artefacts.parts if name],
        "absent": [*artefacts.absent, *(dataset.name for dataset in artefacts.absent_datasets)],
        "kinds": kinds | {dataset.name: dataset.kind for dataset in artefacts.datasets},
        "recordings": recordings,
    }
    write_json(folder / PROVENANCE, about)


def _recordings(
    comparisons: Mapping[str, Comparison], ingested: Sequence[Artefact]
) -> dict[str, str]:
    """``DATASET/RECORDING`` -> digest of every recording that is scored, at the evaluation rate, or
    shown.
    """
    digests = {}
    for part in comparisons.values():
        for span in scored_spans(part.evaluation.split):
            outputs = part.evaluation.references[span.dataset].outputs
            digests[f"{span.dataset}/{span.recording}"] = outputs[f"{span.recording}.parquet"]
    return digests | {
        f"{artefact.label}/{Path(name).stem}": digest
        for artefact in ingested
        for name, digest in artefact.outputs.items()
    }


def _part_artefacts(study: Study, title: str, part: Comparison) -> PartArtefacts:
    """Input of a study's module for one part: models, metrics, references and facts."""
    models = []
    tables = []
    for member in part.members:
        assert member.model is not None
        assert member.evaluation is not None
        estimator = new_estimator(member.job.estimator)
        differences = part.differences.get(member.job.plan.key, {})
        variant = estimator.variant + difference_suffix(differences)
        tables.append(read_metrics(member.evaluation.folder).assign(variant=variant))
        models.append(
            EvaluatedModel(
                estimator=estimator.name,
                variant=variant,
                title=estimator.full_title
                + describe_start(member.job.training)
                + difference_text(differences),
                seed=member.job.seed,
                model_folder=member.model.folder,
                evaluation_folder=member.evaluation.folder,
                training=dict(member.job.training),
                calibration_folder=member.calibration.folder
                if member.calibration is not None
                else None,
            )
        )
    models = with_distinct_titles(models)
    e = part.evaluation
    return PartArtefacts(
        study=study.study,
        title=title or study.title,
        about=study.about,
        command=study.command,
        split=e.split,
        protocol=e.protocol,
        kinds=e.kinds,
        data_titles=part.data_titles,
        metrics=_together(tables, study.study),
        models=models,
        references={
            (s.dataset, s.recording): stored_recording(e.references, s)
            for s in (*e.split.train, *scored_spans(e.split))
        },
        facts=part.facts,
        failed=part.failed,
    )


def with_distinct_titles(models: Sequence[EvaluatedModel]) -> list[EvaluatedModel]:
    """The models of one part; estimators that share a title have their variant behind it, so that
    tables, legends and verdicts distinguish them.
    """
    names: dict[str, set[tuple[str, str]]] = {}
    for model in models:
        names.setdefault(model.title, set()).add(model.name)
    return [
        replace(model, title=f"{model.title} ({model.variant})")
        if len(names[model.title]) > 1
        else model
        for model in models
    ]


def _timings_of(part: PartArtefacts) -> pd.DataFrame:
    """Times of trainings, their phases and online steps of one part, a table with `METRIC_COLUMNS`
    [s]; they are in no published file.
    """
    tables = []
    for model in part.models:
        times = read_metrics(model.evaluation_folder, TIMINGS).assign(variant=model.variant)
        fit = {
            name: value
            for name, value in read_fit_metrics(model.model_folder).items()
            if name.endswith("_seconds")
        }
        phases = {name: value for name, value in fit.items() if name not in set(times["metric"])}
        tables += [
            times,
            *(times.head(1).assign(metric=name, value=value) for name, value in phases.items()),
        ]
    return _together(tables, part.study)


def _together(tables: Sequence[pd.DataFrame], study: str) -> pd.DataFrame:
    """Concatenate the tables of models into one with METRIC_COLUMNS."""
    return pd.concat(tables, ignore_index=True).assign(study=study)[list(METRIC_COLUMNS)]


def draw_sweep(
    study: Study, comparison: Comparison, runner: Runner
) -> tuple[Artefact, TerminalSummary]:
    """Draw the report of a sweep (`sweep_of`), unless it exists, and return it with a summary for
    the terminal.

    A failed job has a row with its reason.
    """
    configs = [job.config for job in comparison.jobs if "estimator" in job.config]
    conditions = dict.fromkeys(
        fault.condition for config in configs if (fault := chosen_fault(config)) is not None
    )
    under = (
        [f"Faults: {', '.join(conditions)}; RMSE(β) under one counts the samples while it lasts"]
        if conditions
        else []
    )
    part = _part_artefacts(study, "", comparison)
    part = replace(part, facts=[*part.facts, *under])
    artefacts = SweepArtefacts(part, list(comparison.jobs[0].values), _job_table(comparison))
    artefacts_of_jobs = [
        artefact
        for member in comparison.members
        for artefact in (member.model, member.evaluation)
        if artefact is not None
    ]
    plan = StagePlan(
        stage=SWEEP,
        label=part.study,
        config={
            "command": part.command,
            "keys": artefacts.keys,
            "jobs": artefacts.jobs[["combination", "title", *artefacts.keys, "seed", "status"]]
            .astype(object)
            .to_dict("records"),
            "failures": part.failed,
            "protocol": changed_options(part.protocol),
            "kinds": part.kinds,
            "data_titles": part.data_titles,
            "facts": part.facts,
        },
        inputs={
            f"{artefact.stage}/{artefact.folder.name}": artefact.digest
            for artefact in artefacts_of_jobs
        },
        code=code_of(SWEEP),
        output=runner.output,
    )

    def write(folder: Path) -> None:
        from vehest.report.document import write_document

        write_document(build(artefacts), folder, page=False)
        for file, written in (("sweep.csv", artefacts.jobs), ("summary.csv", artefacts.table)):
            write_frame(written, folder / file)

    return runner.ensure(plan, write), summary_of_sweep(artefacts)


def _job_table(comparison: Comparison) -> pd.DataFrame:
    """Table of all jobs of a sweep in the layout of `SweepArtefacts.jobs`."""
    split = comparison.evaluation.split
    sets = [*([VALIDATION] if split.validation else []), *split.tests]
    rows = []
    for job in comparison.jobs:
        member = (
            None
            if job.failure is not None or job.training is None
            else comparison.finished.get(job.training.plan.key)
        )
        title = (
            new_estimator(job.config["estimator"]).full_title if "estimator" in job.config else ""
        )  # else refused
        row: dict[str, Any] = {
            "combination": job.combination,
            "title": title,
            **job.values,
            "seed": job.config["seed"],
            "status": DONE if member else FAILED,
            "error": job.failure.message if job.failure is not None else "",
        }
        rows.append(row | _figures(member, sets, chosen_fault(job.config)))
    return pd.DataFrame(rows)


def _figures(
    member: Member | None, sets: Sequence[str], fault: FaultSettings | None
) -> dict[str, Any]:
    """Metrics of a job, ``METRIC.SET`` -> value, while its fault lasts where it has one; NaN where
    the job failed.
    """
    columns = [f"{metric}.{name}" for name in sets for metric in SCORES]
    if member is None or member.model is None or member.evaluation is None:
        return dict.fromkeys(["n_parameters", "epochs", *columns], float("nan"))
    table = read_metrics(member.evaluation.folder)
    nominal = nominal_rows(table)
    figures = {
        metric: float(nominal.loc[nominal["metric"] == metric, "value"].iloc[0])
        for metric in ("n_parameters", "epochs")
    }
    scored = (
        nominal
        if fault is None
        else table[(table["subset"] == FAULTED) & (table["condition"] == fault.condition)]
    )
    scores = dict(
        zip(scored["metric"] + "." + scored["test_set"], map(float, scored["value"]), strict=True)
    )
    return {
        **figures,
        **{column: scores.get(column, float("nan")) for column in columns},
        "model": member.model.folder.name,
    }
