"""Last stage: evaluations to tables, figures and a page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.estimators.registry import estimator_class
from vehest.stages.artefacts import TIMINGS, Artefact, StagePlan, provenance
from vehest.stages.code_version import code_version
from vehest.stages.evaluate import COLUMNS, METRICS, scored_spans
from vehest.stages.group import Evaluation, Member
from vehest.stages.publishing import PROVENANCE
from vehest.stages.train import read_fit_metrics, recording_file
from vehest.studies.artefacts import METRIC_COLUMNS, EvaluatedModel, StudyArtefacts, read_frame
from vehest.studies.kit.timings import timings_of_study
from vehest.studies.registry import study_module, study_module_name

STAGE = "report"
OVERVIEW = "tables/overview.csv"


@dataclass(frozen=True)
class ReportJob:
    """A report to draw.

    Args:
        study: name of the study.
        title: its title.
        about: a paragraph on it.
        command: the command that makes it.
        module: name of the module that draws it, as `vehest.studies.registry` knows it.
        members: trained and evaluated, in the order of the pipeline.
        evaluation: split, references and protocol.
        data_titles: data set -> title.
        training: how recordings were prepared and what each training scheme was allowed, a line each.
    """

    study: str
    title: str
    about: str
    command: str
    module: str
    members: Sequence[Member]
    evaluation: Evaluation
    data_titles: Mapping[str, str]
    training: Sequence[str]


def plan_report(job: ReportJob, output: Path) -> StagePlan:
    """What a report is made from."""
    inputs = {}
    for member in job.members:
        assert member.model is not None
        assert member.evaluation is not None
        inputs[member.model.label] = member.model.digest
        inputs[member.evaluation.label] = member.evaluation.digest
    config = {key: getattr(job, key) for key in ("study", "title", "about", "command", "module", "training")}
    return StagePlan(
        stage=STAGE,
        label=job.study,
        config={**config, "data_titles": dict(job.data_titles), "protocol": asdict(job.evaluation.protocol)},
        inputs=inputs,
        code=code_of_report(job.module, __name__),
        output=output,
    )


def code_of_report(study: str, drawn_by: str) -> str:
    """Version of what a report runs.

    Args:
        study: name of the module that draws it, as `vehest.studies.registry` knows it.
        drawn_by: module that hands artefacts to it.
    """
    drawn_with = [study_module_name(study), "vehest.studies.artefacts", "vehest.studies.kit.timings"]
    return code_version(drawn_with, own=[drawn_by], files=["report/templates"])


def write_report(job: ReportJob, folder: Path) -> None:
    """Draw the study into ``folder``: report.md, report.html, metrics.csv, timings.csv, tables, figures, provenance."""
    from vehest.report.document import write_document

    artefacts, timings = study_artefacts(job), timings_of(job)
    write_document(_module(job).build(artefacts), folder, on_page=timings_of_study([("", timings, titles_of(artefacts))]))
    write_metrics(artefacts.metrics, folder / METRICS)
    write_metrics(timings, folder / TIMINGS)
    about = {key: value for key, value in provenance(0.0).items() if key != "seconds"}
    about |= {"study": job.study, "command": job.command, "kinds": dict(job.evaluation.kinds)}
    about["recordings"] = recording_digests(job)
    (folder / PROVENANCE).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8", errors="backslashreplace")


def write_metrics(table: pd.DataFrame, path: Path) -> None:
    """Write figures of a study, the same bytes for the same figures."""
    table.to_csv(path, index=False, lineterminator="\n", errors="backslashreplace")


def leaderboard_of(job: ReportJob) -> pd.DataFrame:
    """The study's leaderboard, one row an estimator and test set."""
    table: pd.DataFrame = _module(job).leaderboard(study_artefacts(job))
    return table


def study_artefacts(job: ReportJob) -> StudyArtefacts:
    """What the study module sees."""
    models, tables = [], []
    for member in job.members:
        assert member.model is not None
        assert member.evaluation is not None
        tables.append(_table_of(member.evaluation, METRICS))
        estimator = estimator_class(str(member.job.estimator["name"])).from_config(member.job.estimator)
        models.append(
            EvaluatedModel(
                estimator=estimator.name,
                variant=estimator.variant,
                title=estimator.full_title,
                seed=member.job.seed,
                model_folder=member.model.folder,
                evaluation_folder=member.evaluation.folder,
                training=dict(member.job.training),
            )
        )
    e = job.evaluation
    return StudyArtefacts(
        study=job.study,
        title=job.title,
        about=job.about,
        command=job.command,
        split=e.split,
        protocol=e.protocol,
        kinds=e.kinds,
        data_titles=job.data_titles,
        metrics=_together(tables, job.study),
        models=models,
        references={(s.dataset, s.recording): recording_file(e.references[s.dataset], s) for s in (*e.split.train, *scored_spans(e.split))},
        facts=list(job.training),
    )


def timings_of(job: ReportJob) -> pd.DataFrame:
    """What trainings, their phases and online steps took, with `METRIC_COLUMNS` [s]; in no published file."""
    tables = []
    for member in job.members:
        assert member.model is not None
        assert member.evaluation is not None
        own = _table_of(member.evaluation, TIMINGS)
        fit = {name: value for name, value in read_fit_metrics(member.model.folder).items() if name.endswith("_seconds")}
        phases = {name: value for name, value in fit.items() if name not in set(own["metric"])}
        tables += [own, *(own.head(1).assign(metric=name, value=value) for name, value in phases.items())]
    return _together(tables, job.study)


def titles_of(artefacts: StudyArtefacts) -> dict[tuple[str, str], str]:
    """(estimator, variant) -> title, in the order of the models."""
    return {(model.estimator, model.variant): model.title for model in artefacts.models}


def _table_of(evaluation: Artefact, file: str) -> pd.DataFrame:
    return read_frame(evaluation.folder / file, COLUMNS, numbers=("value",))


def _together(tables: Sequence[pd.DataFrame], study: str) -> pd.DataFrame:
    return pd.concat(tables, ignore_index=True).assign(study=study)[list(METRIC_COLUMNS)]


def recording_digests(job: ReportJob) -> dict[str, str]:
    """Data set and recording -> digest, of every recording that is scored, at the evaluation rate."""
    references = job.evaluation.references
    return {
        f"{span.dataset}/{span.recording}": references[span.dataset].outputs[f"{span.recording}.parquet"]
        for span in scored_spans(job.evaluation.split)
    }


def overview_of(report: Artefact) -> pd.DataFrame:
    """The overview of a study that has one, as the report shows it."""
    return read_frame(report.folder / OVERVIEW)


def _module(job: ReportJob) -> Any:
    return study_module(job.module)
