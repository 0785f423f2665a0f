"""Report of a study of recordings alone: data sets that were ingested, or simulated, to tables, figures and pages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import MissingError
from vehest.sources.base import kind_of
from vehest.stages.artefacts import Artefact, StagePlan, find, provenance
from vehest.stages.config import Config
from vehest.stages.ingest import plan_ingest
from vehest.stages.publishing import PROVENANCE
from vehest.stages.report import STAGE, code_of_report
from vehest.stages.workshop import NotThereYet, Workshop
from vehest.studies.artefacts import AbsentDataset, StoredDataset, SurveyArtefacts
from vehest.studies.registry import study_module


@dataclass(frozen=True)
class SurveyJob:
    """A report to draw.

    Args:
        study: name of the study.
        title: its title.
        about: a paragraph on it.
        command: the command that makes it.
        module: name of the module that draws it, as `vehest.studies.registry` knows it.
        configs: configuration of each ingest.
        ingested: what these made.
        absent: data sets that the study goes on without.
    """

    study: str
    title: str
    about: str
    command: str
    module: str
    configs: Sequence[Config]
    ingested: Sequence[Artefact]
    absent: Sequence[AbsentDataset]


def ingest_all(
    configs: Sequence[Config], optional: Sequence[str], workshop: Workshop, *, only_report: bool = False
) -> tuple[list[Config], list[Artefact], list[AbsentDataset]]:
    """Ingest data sets, those left out whose raw files are not here though the study can go on without them.

    Args:
        configs: of the ingests.
        optional: names of data sets that the study can go on without.
        workshop: where stages run.
        only_report: take what is there, ingest nothing.

    Returns:
        Configurations and artefacts of those that are here, and those that are not.

    Raises:
        MissingError: raw files are not here, or ``only_report`` and recordings are not there.
        NotThereYet: in a dry run, after all were looked at.
        Stopped: a signal came; what was ingested stays.
    """
    here: list[Config] = []
    ingested: list[Artefact] = []
    absent: list[AbsentDataset] = []
    waits = False
    for config in configs:
        dataset = config["dataset"]
        try:
            plan = plan_ingest(config)
        except MissingError as error:
            if dataset["name"] not in optional:
                raise
            workshop.messages.warn(f"{error}; the study goes on without it")
            absent.append(AbsentDataset(dataset["name"], *(_prose(dataset, key) for key in ("title", "licence", "citation"))))
            continue
        if only_report and find(plan) is None:
            raise MissingError(f"data set '{plan.label}' has not been ingested; run 'vehest run' first")
        try:
            ingested.append(workshop.ingest(config))
            here.append(config)
        except NotThereYet:
            waits = True
    if waits:
        raise NotThereYet
    return here, ingested, absent


def plan_survey(job: SurveyJob, output: Path) -> StagePlan:
    """What a report is made from."""
    config = {key: getattr(job, key) for key in ("study", "title", "about", "command", "module")}
    about = {own["dataset"]["name"]: [_prose(own["dataset"], "title"), _kind(own["dataset"])] for own in job.configs}
    return StagePlan(
        stage=STAGE,
        label=job.study,
        config={**config, "datasets": about, "absent": [asdict(dataset) for dataset in job.absent]},
        inputs={artefact.label: artefact.digest for artefact in job.ingested},
        code=code_of_report(job.module, __name__),
        output=output,
    )


def write_survey(job: SurveyJob, folder: Path) -> None:
    """Draw the study into ``folder``: report.md, a page each part of it, the same as HTML, tables, figures, provenance."""
    from vehest.report.document import write_documents

    write_documents(study_module(job.module).documents(_artefacts(job)), folder)
    about = {key: value for key, value in provenance(0.0).items() if key != "seconds"}
    about |= {"study": job.study, "command": job.command}
    about["kinds"] = {own["dataset"]["name"]: _kind(own["dataset"]) for own in job.configs}
    about["absent"] = [dataset.name for dataset in job.absent]
    about["recordings"] = {
        f"{artefact.label}/{Path(name).stem}": digest for artefact in job.ingested for name, digest in artefact.outputs.items()
    }
    (folder / PROVENANCE).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8", errors="backslashreplace")


def _artefacts(job: SurveyJob) -> SurveyArtefacts:
    datasets = [
        StoredDataset(
            name=config["dataset"]["name"],
            title=_prose(config["dataset"], "title"),
            kind=_kind(config["dataset"]),
            config=artefact.config,
            files={Path(name).stem: artefact.folder / name for name in artefact.outputs},
        )
        for config, artefact in zip(job.configs, job.ingested, strict=True)
    ]
    return SurveyArtefacts(job.study, job.title, job.about, job.command, datasets, job.absent)


def _prose(dataset: Mapping[str, Any], key: str) -> str:
    return " ".join(str(dataset.get(key, dataset["name"])).split())


def _kind(dataset: Mapping[str, Any]) -> str:
    return kind_of(dataset)
