"""A pipeline: sweeps of trainings, the evaluations they feed, and the study that draws tables and figures from them.

Or several such comparisons, each on a split of its own, as parts of one study. Or data sets alone, and the study that draws tables
and figures from their recordings.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import pandas as pd

from vehest.data.errors import ConfigurationError, DataError, JobsFailedError, MissingError
from vehest.data.folds import FoldsFile
from vehest.data.limits import use_limits
from vehest.data.schema import validated
from vehest.data.splits import check_name
from vehest.data.text_files import read_yaml
from vehest.run.artefacts import Artefact, find
from vehest.run.comparison import Compared, compare, failed_in, prepare
from vehest.run.config import GIVEN, Config, check_jobs, compose_config, count, expand, has_key, key_of, limits_of, option_hint, value_of
from vehest.run.config_files import GROUPS, find_pipeline, pipeline_names
from vehest.run.fitting import Fitted
from vehest.run.ingest import STAGE as INGEST
from vehest.run.ingest import plan_ingest
from vehest.run.publishing import Publication, publish_study
from vehest.run.report import (
    AbsentPart,
    PartJob,
    ReportJob,
    ShownDatasets,
    plan_report,
    prose_of,
    shown_in_terminal,
    verdict_in_terminal,
    write_report,
)
from vehest.run.study_keys import Keys, keys_of_study
from vehest.run.tracking import Tracker
from vehest.run.workshop import NotThereYet, Workshop
from vehest.studies.artefacts import AbsentDataset
from vehest.studies.registry import study_module, study_names

NO_TIME = "not done yet: no time was left, the same command goes on"
FORMS = "it needs study, report and one of: split and sweeps; parts, each with split and sweeps; datasets"

Sweeps = Annotated[tuple[Annotated[tuple[str, ...], "a list of overrides"], ...], "a list of lists of overrides"]
Faults = Annotated[tuple[dict[str, int | float | str | None], ...], "a list of faults"]
Names = Annotated[tuple[str, ...], "a list of names"]


@dataclass(frozen=True)
class PartFile:
    """A part as a pipeline's file names it; what is None is not said, which a part on top of another's may leave to that one."""

    split: str | None = None
    sweeps: Sweeps | None = None
    title: str | None = None
    optional: bool = False
    overrides: Annotated[tuple[str, ...], "a list of overrides"] = ()


@dataclass(frozen=True)
class PipelineFile:
    """A pipeline's file; what is None is not said. docs/cli.md says what the keys mean."""

    study: str | None = None
    report: str | None = None
    title: str | None = None
    about: str | None = None
    publish: bool = False
    evaluation: dict[str, int | float | bool | str | Faults | None] | None = None
    split: str | None = None
    sweeps: Sweeps | None = None
    parts: Annotated[dict[str, PartFile | None], "a mapping from names to what each has"] | None = None
    datasets: Names | None = None
    optional_datasets: Names | None = None
    based_on: str | None = None


Configs = Mapping[str, Sequence[Config]]
"""Part of a pipeline -> configuration of its jobs; the one part of a pipeline without parts is called ``""``."""


@dataclass(frozen=True)
class Part:
    """One comparison of a study.

    Args:
        name: short, ``""`` where it is the only one.
        title: for people.
        split: conf/split it works on.
        sweeps: overrides of each sweep, several values allowed.
        optional: whether the study goes on without it where its raw files are not here.
        overrides: of all its jobs, before those of the sweeps.
    """

    name: str
    title: str
    split: str
    sweeps: tuple[tuple[str, ...], ...]
    optional: bool = False
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Pipeline:
    """A study as pipelines/*.yaml describes it.

    Args:
        study: its name.
        title: for people.
        about: a paragraph on what is compared and why.
        report: name of the module that draws it, as `vehest.studies.registry` knows it that draws it.
        parts: what is compared; none where it compares no estimators.
        evaluation: overrides of conf/eval.yaml's ``evaluation``.
        publish: whether its outcome also goes to results/<study>.
        file: where it was read from.
        datasets: conf/dataset whose recordings it shows, where it compares no estimators.
        optional_datasets: further ones, that it goes on without where their raw files are not here.
    """

    study: str
    title: str
    about: str
    report: str
    parts: tuple[Part, ...]
    evaluation: tuple[str, ...]
    publish: bool
    file: Path
    datasets: tuple[str, ...] = ()
    optional_datasets: tuple[str, ...] = ()

    @property
    def in_parts(self) -> bool:
        """Whether the file names parts, be it a single one."""
        return bool(self.parts) and self.parts[0].name != ""


@dataclass(frozen=True)
class PipelineOutcome:
    """What a pipeline made.

    Args:
        report: artefact of the report stage.
        leaderboard: its table, one row an estimator and test set; empty where there is an overview.
        published: folder in results/, if it was published.
        overview: table of a study in parts, or of recordings alone.
        publication: what is published of it where nothing stands against it.
        left_out: name of what failed, or is not there -> why.
        unfinished: jobs for which no time was left, by name.
        verdict: what the study says in words, a line each.
        failed: what the command ends with then.
    """

    report: Artefact
    leaderboard: pd.DataFrame
    published: Path | None
    overview: pd.DataFrame | None = None
    publication: Publication | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    failed: JobsFailedError | None = None
    unfinished: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()


def read_pipeline(name: str) -> Pipeline:
    """Read a pipeline by path or name.

    Raises:
        MissingError: there is none of that name.
        ConfigurationError: the file is not a pipeline.
    """
    file, content = _content_of(name)
    described = validated(PipelineFile, content, f"'{file}'", error=ConfigurationError)
    form = _form_of(described, file)
    assert described.study is not None
    assert described.report is not None
    datasets, optional = described.datasets or (), described.optional_datasets or ()
    if form == "datasets" and (not datasets or len({*datasets, *optional}) != len(datasets) + len(optional)):
        raise ConfigurationError(f"'{file}': datasets must name some, and none of them twice")
    parts: Mapping[str, PartFile | None] = described.parts or {}
    if form == "parts" and not parts:
        raise ConfigurationError(f"'{file}': parts must be names, each with its split and sweeps")
    if form == "split":
        parts = {"": PartFile(described.split, described.sweeps)}
    check_name(described.study, f"'{file}': study")
    folded = _check_module(described.report, form, file)
    made = tuple(_part(own, part, file) for own, part in parts.items())
    return Pipeline(
        study=described.study,
        title=" ".join((described.title or described.study).split()),
        about=" ".join((described.about or "").split()),
        report=described.report,
        parts=_folds_of(made[0], file) if folded else made,
        evaluation=tuple(_evaluation_override(key, value, file) for key, value in (described.evaluation or {}).items()),
        publish=described.publish,
        file=file,
        datasets=datasets,
        optional_datasets=optional,
    )


def _content_of(name: str, *, as_base: bool = False) -> tuple[Path, dict[str, Any]]:
    """A pipeline's file and its keys, on top of those of the one it is based on."""
    file = find_pipeline(name)
    if file is None:
        close = difflib.get_close_matches(Path(name).stem, pipeline_names(), n=1)
        hint = f"; did you mean pipelines/{close[0]}.yaml?" if close else ""
        raise MissingError(f"there is no pipeline '{name}'{hint} (there are: {', '.join(pipeline_names())})")
    try:
        content = read_yaml(file)
    except DataError as error:
        raise ConfigurationError(str(error)) from None
    if not isinstance(content, dict):
        raise ConfigurationError(f"'{file}' is not a pipeline: it holds no keys")
    own = validated(PipelineFile, content, f"'{file}'", error=ConfigurationError)
    if own.based_on is None:
        return file, content
    if as_base:
        raise ConfigurationError(f"'{file}' is based on another pipeline itself; base on '{own.based_on}'")
    _, base = _content_of(own.based_on, as_base=True)
    changes, parts = content.get("parts") or {}, base.get("parts") or {}
    if set(changes) - set(parts):
        raise ConfigurationError(f"'{file}': '{own.based_on}' has no part '{min(set(changes) - set(parts))}'")
    merged = {**base, **{key: value for key, value in content.items() if key != "based_on"}}
    kept = {key: {**(part or {}), **(changes.get(key) or {})} for key, part in parts.items() if changes.get(key, part) is not None}
    return file, merged | ({"parts": kept} if parts else {})


def _evaluation_override(key: str, value: Any, file: Path) -> str:
    """What a pipeline says of its evaluation as an override; the faults of an evaluation are a key of their own."""
    if key == "faults":
        if not isinstance(value or (), tuple):
            raise ConfigurationError(f"'{file}': evaluation.faults must be a list of faults, not {value!r}")
        return f"faults=[{','.join(_fault_as_override(fault) for fault in value or ())}]"
    if isinstance(value, tuple):
        raise ConfigurationError(f"'{file}': evaluation.{key} takes one value; a list of faults is called faults")
    return f"evaluation.{key}={_as_override(value)}"


def _fault_as_override(fault: Mapping[str, int | float | str | None]) -> str:
    """A mapping in Hydra's grammar, its text in quotes: nan would be a number."""
    said = {name: f"'{value}'" if isinstance(value, str) else _as_override(value) for name, value in fault.items()}
    return "{" + ",".join(f"{name}:{value}" for name, value in said.items()) + "}"


def _as_override(value: int | float | bool | str | None) -> str:
    """A value as an override of Hydra's grammar says it."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _form_of(described: PipelineFile, file: Path) -> str:
    """Which of the three forms a pipeline has, by the key that tells: ``split``, ``parts`` or ``datasets``."""
    says = {
        "split": described.split is not None or described.sweeps is not None,
        "parts": described.parts is not None,
        "datasets": described.datasets is not None or described.optional_datasets is not None,
    }
    forms = [form for form, said in says.items() if said]
    whole = described.study is not None and described.report is not None and len(forms) == 1
    whole = whole and (forms != ["split"] or (described.split is not None and described.sweeps is not None))
    if not whole or (forms == ["datasets"] and (described.datasets is None or described.evaluation is not None)):
        raise ConfigurationError(f"'{file}' is not a pipeline: {FORMS}")
    return forms[0]


def _part(name: str, part: PartFile | None, file: Path) -> Part:
    where = f"'{file}': part '{name}'" if name else f"'{file}'"
    if part is None or part.split is None or part.sweeps is None:
        raise ConfigurationError(f"{where} needs split and sweeps, and may have title, optional and overrides")
    if name:
        check_name(name, f"'{file}': part")
    if not part.sweeps or not all(part.sweeps):
        raise ConfigurationError(f"{where}: sweeps must be a list of lists of overrides")
    title = " ".join((part.title or name).split())
    return Part(name=name, title=title, split=part.split, sweeps=part.sweeps, optional=part.optional, overrides=part.overrides)


def _folds_of(part: Part, file: Path) -> tuple[Part, ...]:
    """A comparison on a split that is cross-validated as parts, a fold each."""
    folds = compose_config("train", [f"split={part.split}"])["split"].get("folds")
    number = folds.get("number", FoldsFile.number) if isinstance(folds, dict) else None
    if not isinstance(number, int) or number < 1:
        raise ConfigurationError(f"'{file}': its report takes folds; split '{part.split}' says no folds: {{number: 5, of: laps}}")
    check_jobs(number, f"the folds of '{file.name}' stand")
    return tuple(
        replace(part, name=f"fold_{fold + 1}", title=f"fold {fold + 1} of {number}", overrides=(f"++split.fold={fold}",))
        for fold in range(number)
    )


def _check_module(name: str, form: str, file: Path) -> bool:
    """Whether a module draws a study of this form; True where it needs a split's folds as parts."""
    if name not in study_names():
        raise ConfigurationError(f"'{file}': there is no study module '{name}'; there are: {', '.join(study_names())}")
    takes = getattr(study_module(name), "TAKES", None)
    if takes == "folds" and form == "split":
        return True
    if takes != form:
        draws = {"split": "split and sweeps", "folds": "split and sweeps, where the split has folds"}.get(
            str(takes), takes or "something else"
        )
        raise ConfigurationError(f"'{file}': the study module '{name}' draws its report from {draws}")
    return False


def pipeline_configs(pipeline: Pipeline, overrides: Sequence[str]) -> Configs:
    """The configuration of every job; further overrides apply to the sweeps, or data sets, that have their key.

    Raises:
        ConfigurationError: an override that suits none of them.
    """
    if pipeline.datasets:
        return {"": _survey_configs(pipeline, overrides)}
    if any(key_of(override) == "split" for override in overrides):
        raise ConfigurationError(
            f"the split belongs to the study; copy '{pipeline.file.name}' to pipelines/ under another name and change it there"
        )
    used: set[str] = set()
    composed: dict[tuple[str, ...], Config] = {}
    sweeps = [sweep for part in pipeline.parts for sweep in part.sweeps]
    with use_limits(limits_of([*(override for sweep in sweeps for override in sweep), *overrides])):
        check_jobs(sum(count(sweep) for sweep in sweeps), f"the sweeps of '{pipeline.file.name}' stand")
        configs = {part.name: _part_configs(part, pipeline.evaluation, overrides, used, composed) for part in pipeline.parts}
    for override in overrides:
        if override not in used:
            key = key_of(override)
            hint = option_hint(key) or f": none has an option '{key}'"
            raise ConfigurationError(f"'{override}' suits no sweep of '{pipeline.file.name}'{hint}")
    return configs


def _part_configs(
    part: Part, evaluation: Sequence[str], overrides: Sequence[str], used: set[str], composed: dict[tuple[str, ...], Config]
) -> list[Config]:
    """The configuration of every job of a part; the overrides that suit any of them join ``used``, what was composed joins ``composed``."""

    def config_of(job: tuple[str, ...]) -> Config:
        """Composed without its split, which other jobs share, as other parts share the rest."""
        own = tuple(override for override in job if key_of(override).split(".")[0] == "split")
        rest = tuple(override for override in job if override not in own)
        for overrides_of in (own, rest):
            if overrides_of not in composed:
                composed[overrides_of] = compose_config("eval", overrides_of)
        return {**composed[rest], "split": composed[own]["split"]}

    configs: dict[str, Config] = {}
    for sweep in part.sweeps:
        for job in expand([f"split={part.split}", *part.overrides, *evaluation, *sweep]):
            seeds = [override for override in job if key_of(override) == "seed"]
            shared = tuple(override for override in job if override not in seeds)
            base = config_of((*shared, *(override for override in overrides if key_of(override) == "fault")))  # which has further keys
            suiting = [override for override in overrides if key_of(override) in GROUPS or has_key(base, key_of(override))]
            used.update(suiting)
            config = dict(config_of((*shared, *suiting)))
            own_seed = any(key_of(override) == "seed" for override in suiting)
            if seeds and not own_seed:
                config["seed"] = value_of(seeds[-1])
            configs.setdefault(json.dumps({key: value for key, value in config.items() if key != GIVEN}, sort_keys=True), config)
    return list(configs.values())


def _survey_configs(pipeline: Pipeline, overrides: Sequence[str]) -> list[Config]:
    """The configuration of every ingest. Nothing is tracked, and so what is said about tracking suits."""
    if any(key_of(override) == "dataset" for override in overrides):
        raise ConfigurationError(
            f"the data sets belong to the study; copy '{pipeline.file.name}' to pipelines/ under another name and change them there"
        )
    used = {override for override in overrides if key_of(override).split(".")[0] == "tracking"}
    configs = []
    for name in (*pipeline.datasets, *pipeline.optional_datasets):
        base = compose_config("ingest", [f"dataset={name}"])
        suiting = [override for override in overrides if has_key(base, key_of(override))]
        used.update(suiting)
        configs.append(compose_config("ingest", [f"dataset={name}", *suiting]))
    for override in overrides:
        if override not in used:
            raise ConfigurationError(f"'{override}' suits no data set of '{pipeline.file.name}': none has an option '{key_of(override)}'")
    return configs


def content_overrides(overrides: Sequence[str]) -> list[str]:
    """Those overrides that change what comes out: not where data come from, where results go, or tracking."""
    return [override for override in overrides if key_of(override).split(".")[0] not in {"root", "output", "tracking"}]


def run_pipeline(
    pipeline: Pipeline, configs: Configs, overrides: Sequence[str], workshop: Workshop, *, only_report: bool = False
) -> PipelineOutcome:
    """Run every stage of a pipeline; what is there is skipped. What overrides changed is not published in results/.

    Args:
        pipeline: the study.
        configs: its jobs, from `pipeline_configs`.
        overrides: what changed them, apart from where data come from, where results go and tracking.
        workshop: where stages run.
        only_report: draw the report from what is there, train and evaluate nothing.

    Raises:
        JobsFailedError: some jobs of a study in parts, or all of another, failed; what was done is kept.
        DataError: recordings lack what some job of a study in parts, or all of another, needs; nothing was trained.
        MissingError: ``only_report`` and something is missing.
        NotThereYet: in a dry run.
        Stopped: a signal came.
    """
    parts: dict[str, PartJob] = {}
    absent: list[AbsentPart] = []
    failed: JobsFailedError | None = None
    datasets = ShownDatasets()
    if pipeline.datasets:
        datasets = _ingest_all(pipeline, configs[""], workshop, only_report=only_report)
    else:
        first = next(iter(configs.values()))[0]
        workshop.tracker = Tracker(first["tracking"], workshop.output, workshop.messages.warn, workshop.stop.requested)
        workshop.tags = {"vehest.study": pipeline.study}
        compared, absent = _run_parts(pipeline, configs, workshop, only_report=only_report)
        failed = failed_in(compared.values(), workshop)
        if failed is not None and not (_shows_failed(pipeline) and any(own.members for own in compared.values())):
            raise failed
        if not any(own.members for own in compared.values()):
            left = [name for own in compared.values() for name in own.unfinished]
            raise DataError(f"no estimator was done in this time; the same command goes on with: {', '.join(left)}")
        parts = {part.name: _part_job(part, compared[part.name]) for part in pipeline.parts if _has_members(compared, part)}
    job = ReportJob(
        study=pipeline.study,
        title=pipeline.title,
        about=pipeline.about,
        command=" ".join([f"vehest run pipelines/{pipeline.file.name}", *overrides]),
        module=pipeline.report,
        titles={part.name: part.title for part in pipeline.parts},
        parts=parts,
        absent=absent,
        datasets=datasets,
    )
    report = workshop.ensure(plan_report(job, workshop.output), lambda folder: _draw(job, folder))
    left_out = {part.name: f"part '{part.name}'" for part in absent} | {own.name: f"data set '{own.name}'" for own in datasets.absent}
    return _published(pipeline, configs, job, report, overrides, workshop, left_out, failed)


def _draw(job: ReportJob, folder: Path) -> None:
    """Write a report on one thread, as groups are run: what it computes has the same last digits whether trainings came before or not."""
    import torch

    from vehest.estimators.kernels.blas import one_blas_thread

    torch.set_num_threads(1)
    with one_blas_thread():
        write_report(job, folder)


def _run_parts(
    pipeline: Pipeline, configs: Configs, workshop: Workshop, *, only_report: bool
) -> tuple[dict[str, Compared], list[AbsentPart]]:
    """Every part, one after another, those left out whose raw files are not here though the study can go on without them.

    What the jobs of all parts lack is found before anything of any part is trained.
    """
    prepared: dict[str, Fitted] = {}
    compared: dict[str, Compared] = {}
    absent: list[AbsentPart] = []
    waits = False
    for part in pipeline.parts:
        try:
            workshop.look_for_files(configs[part.name][0])
        except MissingError as error:
            if not part.optional:
                raise
            workshop.messages.warn(f"{error}; the study goes on without part '{part.name}'")
            absent.append(AbsentPart(part.name, part.title))
    for part in pipeline.parts:
        if any(part.name == missing.name for missing in absent):
            continue
        try:
            prepared[part.name] = prepare(configs[part.name], workshop)
        except NotThereYet:
            waits = True
    lacking = [failure.message for own in prepared.values() for failure in own.failures.values()]
    if lacking and not _shows_failed(pipeline):
        raise DataError(f"a study in parts needs all of its jobs; {'; '.join(dict.fromkeys(lacking))}")
    for name, own in prepared.items():
        try:
            compared[name] = compare(own, workshop, f"vehest run {pipeline.file}", only_report=only_report)
        except NotThereYet:
            waits = True
    if waits:
        workshop.messages.line("plan", "report", pipeline.study)
        raise NotThereYet
    if not compared:
        raise MissingError(f"nothing that '{pipeline.file.name}' compares is here; set VEHEST_DATA, or give root=FOLDER")
    return compared, absent


def _shows_failed(pipeline: Pipeline) -> bool:
    """Whether a study's report can leave out what failed: one that is not in parts, or whose module says so."""
    return not pipeline.in_parts or bool(getattr(study_module(pipeline.report), "SHOWS_FAILED", False))


def _has_members(compared: Mapping[str, Compared], part: Part) -> bool:
    return part.name in compared and bool(compared[part.name].members)


def datasets_of(pipeline: Pipeline, configs: Configs, workshop: Workshop) -> dict[str, Config]:
    """The configuration of every data set that a pipeline draws on, by its name."""
    if pipeline.datasets:
        return {str(config["dataset"]["name"]): config["dataset"] for config in configs[""]}
    return {name: own for part in configs.values() for name, own in workshop.datasets_of(part[0]).items()}


def _part_job(part: Part, compared: Compared) -> PartJob:
    failed = {name: failure.message for name, failure in compared.failures} | dict.fromkeys(compared.unfinished, NO_TIME)
    return PartJob(part.title, compared.members, compared.evaluation, compared.data_titles, compared.facts, failed)


def _ingest_all(pipeline: Pipeline, configs: Sequence[Config], workshop: Workshop, *, only_report: bool) -> ShownDatasets:
    """Ingest the data sets of a study of recordings alone, those left out whose raw files are not here though it can go on without them.

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
            if dataset["name"] not in pipeline.optional_datasets:
                raise
            workshop.messages.warn(f"{error}; the study goes on without it")
            absent.append(AbsentDataset(dataset["name"], *(prose_of(dataset, key) for key in ("title", "licence", "citation"))))
            continue
        if only_report and find(plan) is None:
            raise MissingError(f"data set '{plan.label}' has not been ingested; run 'vehest run' first")
        try:
            ingested.append(workshop.ingest(config))
            here.append(config)
        except NotThereYet:
            waits = True
    if waits:
        workshop.messages.line("plan", "report", pipeline.study)
        raise NotThereYet
    return ShownDatasets(here, ingested, absent)


def _published(
    pipeline: Pipeline,
    configs: Configs,
    job: ReportJob,
    report: Artefact,
    overrides: Sequence[str],
    workshop: Workshop,
    absent: Mapping[str, str],
    failed: JobsFailedError | None,
) -> PipelineOutcome:
    """What a pipeline made, published as it is written: not what overrides changed, and not where anything failed.

    Args:
        pipeline: the study.
        configs: its jobs.
        job: its report.
        report: the same, drawn.
        overrides: what changed it.
        workshop: where stages ran.
        absent: name of what the study went on without -> what it is, for people.
        failed: what the command ends with, where anything failed.
    """
    table, overview = shown_in_terminal(job, report)
    publication = None
    unfinished = tuple(name for part in job.parts.values() for name, reason in part.failed.items() if reason == NO_TIME)
    if pipeline.publish and not overrides and failed is None and not unfinished:
        publication = Publication(pipeline.study, absent, _keys(pipeline, configs, absent, workshop))
    with workshop.messages.off_record():
        folder = None if workshop.dry_run else publish_study(publication, report, workshop.messages)
    left_out = {name: reason for part in job.parts.values() for name, reason in part.failed.items()}
    return PipelineOutcome(
        report,
        pd.DataFrame() if table is None else table,
        folder,
        overview,
        publication,
        left_out,
        failed,
        unfinished,
        tuple(verdict_in_terminal(job)),
    )


def _keys(pipeline: Pipeline, configs: Configs, absent: Mapping[str, str], workshop: Workshop) -> Keys:
    """What determined the results: raw files as they were ingested."""
    inputs = {artefact.label: artefact.inputs for artefact in workshop.artefacts.values() if artefact.stage == INGEST}
    return keys_of_study(pipeline, configs, absent, workshop.dataset_config, lambda config: inputs[str(config["dataset"]["name"])])
