"""Last stage: evaluations to tables, figures and a page; and what of it is published in results/."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.data.errors import ConfigurationError
from vehest.data.files import sha256_of, written_aside
from vehest.estimators.registry import estimator_class
from vehest.stages.artefacts import MANIFEST, Artefact, StagePlan, provenance
from vehest.stages.code_version import code_version
from vehest.stages.evaluate import METRICS, scored_spans
from vehest.stages.group import Evaluation, Member
from vehest.stages.train import recording_file
from vehest.studies.artefacts import METRIC_COLUMNS, EvaluatedModel, StudyArtefacts

STAGE = "report"
PAGE_ENDING = ".html"
PROVENANCE = "provenance.json"
OVERVIEW = "tables/overview.csv"


@dataclass(frozen=True)
class ReportJob:
    """A report to draw.

    Args:
        study: name of the study.
        title: its title.
        about: a paragraph on it.
        command: the command that makes it.
        module: module of `vehest.studies`.
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
        code=code_version([f"vehest.studies.{job.module}", "vehest.studies.artefacts"], own=[__name__], files=["report/templates"]),
        output=output,
    )


def write_report(job: ReportJob, folder: Path) -> None:
    """Draw the study into ``folder``: report.md, report.html, metrics.csv, tables, figures, provenance."""
    from vehest.report.document import write_document

    artefacts = study_artefacts(job)
    write_document(_module(job).build(artefacts), folder)
    artefacts.metrics.to_csv(folder / METRICS, index=False, lineterminator="\n")
    about = {key: value for key, value in provenance(0.0).items() if key != "seconds"}
    about |= {"study": job.study, "command": job.command, "kinds": dict(job.evaluation.kinds)}
    about["recordings"] = recording_digests(job)
    (folder / PROVENANCE).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


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
        table = pd.read_csv(member.evaluation.folder / METRICS, float_precision="round_trip")
        table.insert(0, "study", job.study)
        tables.append(table)
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
        metrics=pd.concat(tables, ignore_index=True)[list(METRIC_COLUMNS)],
        models=models,
        references={(s.dataset, s.recording): recording_file(e.references[s.dataset], s) for s in scored_spans(e.split)},
        facts=list(job.training),
    )


def publish(report: Artefact, folder: Path) -> bool:
    """Copy a report without its pages to ``folder``; returns whether anything there changed.

    Raises:
        MissingError: it cannot be written.
        ConfigurationError: the folder holds something else.
    """
    wanted = {name: digest for name, digest in report.outputs.items() if name != MANIFEST and not name.endswith(PAGE_ENDING)}
    if folder.is_dir():
        present = {file.relative_to(folder).as_posix(): sha256_of(file) for file in folder.rglob("*") if file.is_file()}
        if present == wanted:
            return False
        if present and PROVENANCE not in present:
            raise ConfigurationError(f"'{folder}' holds files that vehest did not publish; move them away or set publish: false")
    with written_aside(folder, replace_folder=True) as aside:
        for name in wanted:
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(report.folder / name, aside / name)
    return True


def recording_digests(job: ReportJob) -> dict[str, str]:
    """Data set and recording -> digest, of every recording that is scored, at the evaluation rate."""
    references = job.evaluation.references
    return {
        f"{span.dataset}/{span.recording}": references[span.dataset].outputs[f"{span.recording}.parquet"]
        for span in scored_spans(job.evaluation.split)
    }


def overview_of(report: Artefact) -> pd.DataFrame:
    """The overview of a study that has one, as the report shows it."""
    return pd.read_csv(report.folder / OVERVIEW, float_precision="round_trip")


def shown_in(folder: Path) -> set[str]:
    """Data sets and parts that a published study shows; none where nothing is published."""
    try:
        about = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
        return {*about.get("kinds", {}), *about.get("parts", [])}
    except (OSError, ValueError, TypeError, AttributeError):
        return set()


def _module(job: ReportJob) -> Any:
    return importlib.import_module(f"vehest.studies.{job.module}")
