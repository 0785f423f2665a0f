"""Last stage: evaluations, or recordings alone, to tables, figures and pages.

A study has parts, comparisons on a split each, or data sets that it shows. A study that is one comparison has one part without a name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from vehest.data.errors import ConfigurationError
from vehest.estimators.kernels.blas import one_blas_thread
from vehest.estimators.registry import estimator_class
from vehest.run.artefacts import TIMINGS, Artefact, StagePlan, provenance
from vehest.run.comparison import Compared
from vehest.run.config import Config
from vehest.run.evaluate import COLUMNS, METRICS, scored_spans
from vehest.run.publishing import PROVENANCE
from vehest.run.study import Part, Study
from vehest.run.train import read_fit_metrics, recording_file
from vehest.sources.base import kind_of
from vehest.studies.artefacts import (
    METRIC_COLUMNS,
    AbsentDataset,
    EvaluatedModel,
    PartArtefacts,
    StoredDataset,
    StudyArtefacts,
    of_parts,
    read_frame,
)
from vehest.studies.kit.reference_minutes import start_in_words
from vehest.studies.kit.timings import timings_of_study
from vehest.studies.registry import study_module

STAGE = "report"
VERSION = "1"
OVERVIEW = "tables/overview.csv"


@dataclass(frozen=True)
class ShownDatasets:
    """Recordings to draw.

    Args:
        configs: configuration of each ingest.
        ingested: what these made.
        absent: data sets that the study goes on without.
    """

    configs: Sequence[Config] = ()
    ingested: Sequence[Artefact] = ()
    absent: Sequence[AbsentDataset] = ()


@dataclass(frozen=True)
class ReportJob:
    """A report to draw.

    Args:
        study: that was run.
        command: that makes it.
        parts: part -> its comparison.
        absent: parts that the study goes on without.
        datasets: of a study of recordings alone.
    """

    study: Study
    command: str
    parts: Mapping[str, Compared]
    absent: Sequence[Part] = ()
    datasets: ShownDatasets = ShownDatasets()

    @property
    def titles(self) -> dict[str, str]:
        """Part -> title, of all parts of the pipeline."""
        return {part.name: part.title for part in self.study.parts}


def plan_report(job: ReportJob, output: Path) -> StagePlan:
    """What a report is made from."""
    study, shown = job.study, job.datasets
    config: dict[str, Any] = {
        "study": study.study,
        "title": study.title,
        "about": study.about,
        "command": job.command,
        "module": study.report,
        "titles": job.titles,
        "absent": [{"name": part.name, "title": part.title} for part in job.absent],
        "parts": {
            name: {
                "training": list(part.training),
                "failed": part.failed,
                "data_titles": dict(part.data_titles),
                "protocol": asdict(part.evaluation.protocol),
            }
            for name, part in job.parts.items()
        },
        "datasets": {own["dataset"]["name"]: [prose_of(own["dataset"], "title"), kind_of(own["dataset"])] for own in shown.configs},
        "absent_datasets": [asdict(dataset) for dataset in shown.absent],
    }
    inputs = {artefact.label: artefact.digest for artefact in shown.ingested}
    for name, part in job.parts.items():
        prefix = f"{name}: " if name else ""
        for member in part.members:
            assert member.model is not None
            assert member.evaluation is not None
            made = (member.model, member.evaluation, *([member.calibration] if member.calibration is not None else []))
            inputs |= {f"{prefix}{artefact.label}": artefact.digest for artefact in made}
    return StagePlan(stage=STAGE, label=study.study, config=config, inputs=inputs, code=code_of_report(study.report), output=output)


def code_of_report(study: str) -> str:
    """Version of what a report runs.

    Args:
        study: name of the module that draws it, as `vehest.studies.registry` knows it.

    Raises:
        ConfigurationError: the name is unknown.
    """
    return f"report={VERSION} {study}={getattr(study_module(study), 'VERSION', '1')}"


def write_report(job: ReportJob, folder: Path) -> None:
    """Draw the study into ``folder``: report.md, report.html, tables, figures, provenance; of a comparison metrics.csv and timings.csv.

    On one thread, as groups are trained, so that it has the same last digits whether trainings came before or not.
    """
    from vehest.report.document import write_documents

    torch.set_num_threads(1)
    artefacts = study_artefacts(job)
    timings = {name: _timings_of(part, job.study.study) for name, part in job.parts.items()}
    times = [(job.titles[name] if name else "", timings[name], titles_of(part)) for name, part in artefacts.parts.items()]
    module = study_module(job.study.report)
    with one_blas_thread():
        write_documents(module.documents(artefacts), folder, on_page=timings_of_study(times) if times else ())
    if not hasattr(module, "leaderboard") and not (folder / OVERVIEW).is_file():
        raise ConfigurationError(f"the study module '{job.study.report}' gives no table 'overview', which the terminal shows")
    if job.parts:
        table, kept = artefacts.metrics, getattr(module, "METRICS", None)
        if kept is not None:
            table = table[table["metric"].isin(kept) & (table["subset"] == "all")]
        write_metrics(table, folder / METRICS)
        write_metrics(of_parts(timings), folder / TIMINGS)
    about: dict[str, Any] = {key: value for key, value in provenance(0.0).items() if key != "seconds"}
    about |= {"study": job.study.study, "command": job.command} | _made_from(job)
    (folder / PROVENANCE).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8", errors="backslashreplace")


def _made_from(job: ReportJob) -> dict[str, Any]:
    """Which parts and data sets a report shows, and the digests of all recordings that it reads."""
    kinds = {name: kind for part in job.parts.values() for name, kind in part.evaluation.kinds.items()}
    kinds |= {str(own["dataset"]["name"]): kind_of(own["dataset"]) for own in job.datasets.configs}
    recordings = {name: digest for part in job.parts.values() for name, digest in _recording_digests(part).items()}
    recordings |= {
        f"{artefact.label}/{Path(name).stem}": digest for artefact in job.datasets.ingested for name, digest in artefact.outputs.items()
    }
    absent = [*(part.name for part in job.absent), *(dataset.name for dataset in job.datasets.absent)]
    return {"parts": [name for name in job.parts if name], "absent": absent, "kinds": kinds, "recordings": recordings}


def write_metrics(table: pd.DataFrame, path: Path) -> None:
    """Write figures of a study, the same bytes for the same figures."""
    table.to_csv(path, index=False, lineterminator="\n", errors="backslashreplace")


def leaderboard(job: ReportJob) -> pd.DataFrame | None:
    """The study's leaderboard, one row an estimator and test set; none where its module gives an overview instead."""
    module = study_module(job.study.report)
    return module.leaderboard(study_artefacts(job).first) if hasattr(module, "leaderboard") else None


def overview(report: Artefact) -> pd.DataFrame:
    """The overview of a study as its report shows it."""
    return read_frame(report.folder / OVERVIEW)


def verdict(job: ReportJob) -> list[str]:
    """The conclusion of a study, a line each; nothing where its module has none."""
    module = study_module(job.study.report)
    lines: list[str] = module.verdict(study_artefacts(job)) if hasattr(module, "verdict") else []
    return lines


def study_artefacts(job: ReportJob) -> StudyArtefacts:
    """What the study module sees."""
    datasets = [
        StoredDataset(
            name=config["dataset"]["name"],
            title=prose_of(config["dataset"], "title"),
            kind=kind_of(config["dataset"]),
            config=artefact.config,
            files={Path(name).stem: artefact.folder / name for name in artefact.outputs},
            licence=prose_of(config["dataset"], "licence"),
            citation=prose_of(config["dataset"], "citation"),
        )
        for config, artefact in zip(job.datasets.configs, job.datasets.ingested, strict=True)
    ]
    return StudyArtefacts(
        study=job.study.study,
        title=job.study.title,
        about=job.study.about,
        command=job.command,
        titles=job.titles,
        parts={name: _part_artefacts(job.study, job.command, part) for name, part in job.parts.items()},
        datasets=datasets,
        absent=[part.name for part in job.absent],
        absent_datasets=job.datasets.absent,
    )


def _part_artefacts(study: Study, command: str, part: Compared) -> PartArtefacts:
    models, tables = [], []
    for member in part.members:
        assert member.model is not None
        assert member.evaluation is not None
        tables.append(_table_of(member.evaluation, METRICS))
        estimator = estimator_class(str(member.job.estimator["name"])).from_config(member.job.estimator)
        models.append(
            EvaluatedModel(
                estimator=estimator.name,
                variant=estimator.variant,
                title=estimator.full_title + start_in_words(member.job.training),
                seed=member.job.seed,
                model_folder=member.model.folder,
                evaluation_folder=member.evaluation.folder,
                training=dict(member.job.training),
                calibration_folder=member.calibration.folder if member.calibration is not None else None,
            )
        )
    e = part.evaluation
    return PartArtefacts(
        study=study.study,
        title=part.title or study.title,
        about=study.about,
        command=command,
        split=e.split,
        protocol=e.protocol,
        kinds=e.kinds,
        data_titles=part.data_titles,
        metrics=_together(tables, study.study),
        models=models,
        references={(s.dataset, s.recording): recording_file(e.references[s.dataset], s) for s in (*e.split.train, *scored_spans(e.split))},
        facts=list(part.training),
        failed=part.failed,
    )


def _timings_of(part: Compared, study: str) -> pd.DataFrame:
    """What trainings, their phases and online steps took, with `METRIC_COLUMNS` [s]; in no published file."""
    tables = []
    for member in part.members:
        assert member.model is not None
        assert member.evaluation is not None
        own = _table_of(member.evaluation, TIMINGS)
        fit = {name: value for name, value in read_fit_metrics(member.model.folder).items() if name.endswith("_seconds")}
        phases = {name: value for name, value in fit.items() if name not in set(own["metric"])}
        tables += [own, *(own.head(1).assign(metric=name, value=value) for name, value in phases.items())]
    return _together(tables, study)


def titles_of(artefacts: PartArtefacts) -> dict[tuple[str, str], str]:
    """(estimator, variant) -> title, in the order of the models."""
    return {(model.estimator, model.variant): model.title for model in artefacts.models}


def _table_of(evaluation: Artefact, file: str) -> pd.DataFrame:
    return read_frame(evaluation.folder / file, COLUMNS, numbers=("value",))


def _together(tables: Sequence[pd.DataFrame], study: str) -> pd.DataFrame:
    return pd.concat(tables, ignore_index=True).assign(study=study)[list(METRIC_COLUMNS)]


def _recording_digests(part: Compared) -> dict[str, str]:
    """Data set and recording -> digest, of every recording that is scored, at the evaluation rate."""
    references = part.evaluation.references
    return {
        f"{span.dataset}/{span.recording}": references[span.dataset].outputs[f"{span.recording}.parquet"]
        for span in scored_spans(part.evaluation.split)
    }


def prose_of(dataset: Mapping[str, Any], key: str) -> str:
    """A text of a data set's configuration on one line; its name, where there is none."""
    return " ".join(str(dataset.get(key, dataset["name"])).split())


def absent_dataset(dataset: Mapping[str, Any]) -> AbsentDataset:
    """A data set that a study goes on without, as its report names it."""
    return AbsentDataset(dataset["name"], *(prose_of(dataset, key) for key in ("title", "licence", "citation")))
