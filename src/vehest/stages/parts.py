"""Report of a study in parts: several comparisons, each on a split of its own, drawn as one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.stages.artefacts import TIMINGS, StagePlan, provenance
from vehest.stages.evaluate import METRICS
from vehest.stages.publishing import PROVENANCE
from vehest.stages.report import (
    OVERVIEW,
    STAGE,
    ReportJob,
    code_of_report,
    plan_report,
    recording_digests,
    study_artefacts,
    timings_of,
    titles_of,
    write_metrics,
)
from vehest.studies.artefacts import PartsArtefacts, of_parts
from vehest.studies.kit.timings import timings_of_study
from vehest.studies.registry import study_module


@dataclass(frozen=True)
class AbsentPart:
    """A part that a study goes on without, since its raw files are not here.

    Args:
        name: in the pipeline file.
        title: for people.
    """

    name: str
    title: str


@dataclass(frozen=True)
class PartsJob:
    """A report to draw.

    Args:
        study: name of the study.
        title: its title.
        about: a paragraph on it.
        command: the command that makes it.
        module: name of the module that draws it, as `vehest.studies.registry` knows it.
        titles: part -> title, of all there are in the pipeline file.
        parts: part -> what was compared.
        absent: parts that the study goes on without.
    """

    study: str
    title: str
    about: str
    command: str
    module: str
    titles: Mapping[str, str]
    parts: Mapping[str, ReportJob]
    absent: Sequence[AbsentPart]


def plan_parts(job: PartsJob, output: Path) -> StagePlan:
    """What a report is made from."""
    plans = {name: plan_report(part, output) for name, part in job.parts.items()}
    config: dict[str, Any] = {key: getattr(job, key) for key in ("study", "title", "about", "command", "module")}
    config |= {"titles": dict(job.titles), "absent": [asdict(part) for part in job.absent]}
    return StagePlan(
        stage=STAGE,
        label=job.study,
        config={**config, "parts": {name: plan.config for name, plan in plans.items()}},
        inputs={f"{name}: {label}": digest for name, plan in plans.items() for label, digest in plan.inputs.items()},
        code=code_of_report(job.module, __name__),
        output=output,
    )


def write_parts(job: PartsJob, folder: Path) -> None:
    """Draw the study into ``folder``: report.md, report.html, metrics.csv, timings.csv, tables, figures, provenance."""
    from vehest.report.document import write_document

    artefacts = PartsArtefacts(
        study=job.study,
        title=job.title,
        about=job.about,
        command=job.command,
        titles=job.titles,
        parts={name: study_artefacts(part) for name, part in job.parts.items()},
        absent=[part.name for part in job.absent],
    )
    module = study_module(job.module)
    timings = {name: timings_of(part) for name, part in job.parts.items()}
    times = [(job.titles[name], timings[name], titles_of(part)) for name, part in artefacts.parts.items()]
    write_document(module.build_parts(artefacts), folder, on_page=timings_of_study(times))
    if not (folder / OVERVIEW).is_file():
        raise ConfigurationError(f"the study module '{job.module}' gives no table 'overview', which a study in parts shows in the terminal")
    write_metrics(artefacts.metrics, folder / METRICS)
    write_metrics(of_parts(timings), folder / TIMINGS)
    about: dict[str, Any] = {key: value for key, value in provenance(0.0).items() if key != "seconds"}
    about |= {"study": job.study, "command": job.command, "parts": list(job.parts), "absent": artefacts.absent}
    about["kinds"] = {name: kind for part in job.parts.values() for name, kind in part.evaluation.kinds.items()}
    about["recordings"] = {name: digest for part in job.parts.values() for name, digest in recording_digests(part).items()}
    (folder / PROVENANCE).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8", errors="backslashreplace")
