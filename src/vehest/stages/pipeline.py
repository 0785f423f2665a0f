"""A pipeline: sweeps of trainings, the evaluations they feed, and the study that draws tables and figures from them.

Or several such comparisons, each on a split of its own, as parts of one study. Or data sets alone, and the study that draws tables
and figures from their recordings.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.splits import check_name
from vehest.stages.artefacts import Artefact
from vehest.stages.comparison import Compared, compare, raise_failures
from vehest.stages.config import Config, compose_config, expand, has_key, key_of
from vehest.stages.config_files import GROUPS, find_pipeline, pipeline_names
from vehest.stages.parts import AbsentPart, PartsJob, plan_parts, write_parts
from vehest.stages.report import ReportJob, leaderboard_of, overview_of, plan_report, publish, shown_in, write_report
from vehest.stages.survey import SurveyJob, ingest_all, plan_survey, write_survey
from vehest.stages.tracking import Tracker
from vehest.stages.workshop import NotThereYet, Workshop

COMPARISON = {"split", "sweeps"}
SURVEY = {"datasets", "optional_datasets"}
KEYS = {"study", "title", "about", "report", "publish", "evaluation", "parts", "based_on", *COMPARISON, *SURVEY}
PART_KEYS = {*COMPARISON, "title", "optional"}
FORMS = "it needs study, report and one of: split and sweeps; parts, each with split and sweeps; datasets"

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
    """

    name: str
    title: str
    split: str
    sweeps: tuple[tuple[str, ...], ...]
    optional: bool = False


@dataclass(frozen=True)
class Pipeline:
    """A study as pipelines/*.yaml describes it.

    Args:
        study: its name.
        title: for people.
        about: a paragraph on what is compared and why.
        report: module of `vehest.studies` that draws it.
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
    """

    report: Artefact
    leaderboard: pd.DataFrame
    published: Path | None
    overview: pd.DataFrame | None = None


def read_pipeline(name: str) -> Pipeline:
    """Read a pipeline by path or name.

    Raises:
        MissingError: there is none of that name.
        ConfigurationError: the file is not a pipeline.
    """
    file, content = _content_of(name)
    form = _form_of(content, file)
    datasets, optional = (_names_in(content.get(key, []), f"'{file}': {key}") for key in ("datasets", "optional_datasets"))
    if form == "datasets" and (not datasets or len({*datasets, *optional}) != len(datasets) + len(optional)):
        raise ConfigurationError(f"'{file}': datasets must name some, and none of them twice")
    parts = {"datasets": {}, "parts": content.get("parts"), "split": {"": {key: content.get(key) for key in COMPARISON}}}[form]
    if not isinstance(parts, dict) or (form == "parts" and not parts):
        raise ConfigurationError(f"'{file}': parts must be names, each with its split and sweeps")
    _check_module(str(content["report"]), form, file)
    check_name(str(content["study"]), f"'{file}': study")
    return Pipeline(
        study=str(content["study"]),
        title=str(content.get("title", content["study"])),
        about=" ".join(str(content.get("about", "")).split()),
        report=str(content["report"]),
        parts=tuple(_part(str(name), part, file) for name, part in parts.items()),
        evaluation=tuple(
            f"evaluation.{key}={'null' if value is None else value}" for key, value in (content.get("evaluation") or {}).items()
        ),
        publish=bool(content.get("publish", False)),
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
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"'{file}' cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict) or set(content) - KEYS:
        reason = f"unknown key '{min(set(content) - KEYS)}'" if isinstance(content, dict) else "it holds no keys"
        raise ConfigurationError(f"'{file}' is not a pipeline: {reason}")
    if "based_on" not in content:
        return file, content
    if as_base:
        raise ConfigurationError(f"'{file}' is based on another pipeline itself; base on '{content['based_on']}'")
    _, base = _content_of(str(content["based_on"]), as_base=True)
    own, parts = content.get("parts") or {}, base.get("parts") or {}
    if not isinstance(own, dict) or not isinstance(parts, dict) or not all(part is None or isinstance(part, dict) for part in own.values()):
        raise ConfigurationError(f"'{file}': parts must be names, each with what it changes, or null where it is left out")
    if set(own) - set(parts):
        raise ConfigurationError(f"'{file}': '{content['based_on']}' has no part '{min(set(own) - set(parts))}'")
    merged = {**base, **{key: value for key, value in content.items() if key != "based_on"}}
    kept = {key: {**part, **(own.get(key) or {})} for key, part in parts.items() if own.get(key, part) is not None}
    return file, merged | ({"parts": kept} if parts else {})


def _form_of(content: Mapping[str, Any], file: Path) -> str:
    """Which of the three forms a pipeline has, by the key that tells: ``split``, ``parts`` or ``datasets``."""
    forms = [form for form, own in (("split", COMPARISON), ("parts", {"parts"}), ("datasets", SURVEY)) if own & set(content)]
    whole = {"study", "report"} <= set(content) and len(forms) == 1
    whole = whole and (forms != ["split"] or set(content) >= COMPARISON) and (forms != ["datasets"] or "evaluation" not in content)
    if not whole or (forms == ["datasets"] and "datasets" not in content):
        raise ConfigurationError(f"'{file}' is not a pipeline: {FORMS}")
    return forms[0]


def _part(name: str, content: Any, file: Path) -> Part:
    where = f"'{file}': part '{name}'" if name else f"'{file}'"
    if not isinstance(content, dict) or set(content) - PART_KEYS or not set(content) >= COMPARISON:
        raise ConfigurationError(f"{where} needs split and sweeps, and may have title and optional")
    if name:
        check_name(name, f"'{file}': part")
    sweeps = content["sweeps"]
    if not isinstance(sweeps, list) or not sweeps or not all(isinstance(sweep, list) and sweep for sweep in sweeps):
        raise ConfigurationError(f"{where}: sweeps must be a list of lists of overrides")
    return Part(
        name=name,
        title=str(content.get("title", name)),
        split=str(content["split"]),
        sweeps=tuple(tuple(str(override) for override in sweep) for sweep in sweeps),
        optional=bool(content.get("optional", False)),
    )


def _check_module(name: str, form: str, file: Path) -> None:
    if importlib.util.find_spec(f"vehest.studies.{name}") is None:
        raise ConfigurationError(f"'{file}': there is no study module '{name}' in vehest.studies")
    module = importlib.import_module(f"vehest.studies.{name}")
    takes = {"build": "split and sweeps", "build_parts": "parts", "documents": "datasets"}
    wanted = {"split": "build", "parts": "build_parts", "datasets": "documents"}[form]
    if not hasattr(module, wanted):
        known = " or ".join(words for function, words in takes.items() if hasattr(module, function))
        raise ConfigurationError(f"'{file}': the study module '{name}' draws its report from {known or 'something else'}")


def _names_in(content: Any, where: str) -> tuple[str, ...]:
    if not isinstance(content, list) or not all(isinstance(name, str) for name in content):
        raise ConfigurationError(f"{where} must be a list of names in conf/dataset")
    return tuple(content)


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
    configs = {part.name: _part_configs(part, pipeline.evaluation, overrides, used) for part in pipeline.parts}
    for override in overrides:
        if override not in used:
            raise ConfigurationError(f"'{override}' suits no sweep of '{pipeline.file.name}': none has an option '{key_of(override)}'")
    return configs


def _part_configs(part: Part, evaluation: Sequence[str], overrides: Sequence[str], used: set[str]) -> list[Config]:
    """The configuration of every job of a part; the overrides that suit any of them join ``used``."""
    composed: dict[tuple[str, ...], Config] = {}

    def config_of(job: tuple[str, ...]) -> Config:
        if job not in composed:
            composed[job] = compose_config("eval", job)
        return composed[job]

    configs: list[Config] = []
    for sweep in part.sweeps:
        for job in expand([f"split={part.split}", *evaluation, *sweep]):
            seeds = [override for override in job if key_of(override) == "seed"]
            shared = tuple(override for override in job if override not in seeds)
            base = config_of(shared)
            suiting = [override for override in overrides if key_of(override) in GROUPS or has_key(base, key_of(override))]
            used.update(suiting)
            config = dict(config_of((*shared, *suiting)))
            own_seed = any(key_of(override) == "seed" for override in suiting)
            if seeds and not own_seed:
                config["seed"] = compose_seed(seeds[-1])
            if config not in configs:
                configs.append(config)
    return configs


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


def compose_seed(override: str) -> Any:
    """The value of ``seed=…``."""
    return yaml.safe_load(override.split("=", 1)[1])


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
        JobsFailedError: some jobs failed; the others are kept.
        MissingError: ``only_report`` and something is missing.
        NotThereYet: in a dry run.
        Stopped: a signal came.
    """
    if pipeline.datasets:
        return _run_survey(pipeline, configs[""], overrides, workshop, only_report=only_report)
    first = next(iter(configs.values()))[0]
    workshop.tracker = Tracker(first["tracking"], workshop.output, workshop.messages.warn)
    workshop.tags = {"vehest.study": pipeline.study}
    compared, absent = _run_parts(pipeline, configs, workshop, only_report=only_report)
    raise_failures(compared.values(), workshop)
    jobs = {name: _report_job(pipeline, own, overrides) for name, own in compared.items()}
    if not pipeline.in_parts:
        (job,) = jobs.values()
        report = workshop.ensure(plan_report(job, workshop.output), lambda folder: write_report(job, folder))
        return PipelineOutcome(report, leaderboard_of(job), _publish(pipeline, report, overrides, workshop))
    whole = PartsJob(
        study=pipeline.study,
        title=pipeline.title,
        about=pipeline.about,
        command=_command(pipeline, overrides),
        module=pipeline.report,
        titles={part.name: part.title for part in pipeline.parts},
        parts=jobs,
        absent=absent,
    )
    report = workshop.ensure(plan_parts(whole, workshop.output), lambda folder: write_parts(whole, folder))
    published = _publish(pipeline, report, overrides, workshop, absent={part.name: f"part '{part.name}'" for part in absent})
    return PipelineOutcome(report, pd.DataFrame(), published, overview_of(report))


def _run_parts(
    pipeline: Pipeline, configs: Configs, workshop: Workshop, *, only_report: bool
) -> tuple[dict[str, Compared], list[AbsentPart]]:
    """Every part, one after another, those left out whose raw files are not here though the study can go on without them."""
    compared: dict[str, Compared] = {}
    absent: list[AbsentPart] = []
    waits = False
    for part in pipeline.parts:
        if part.optional:
            try:
                workshop.look_for_files(configs[part.name][0])
            except MissingError as error:
                workshop.messages.warn(f"{error}; the study goes on without part '{part.name}'")
                absent.append(AbsentPart(part.name, part.title))
                continue
        try:
            compared[part.name] = compare(configs[part.name], workshop, f"vehest run {pipeline.file}", only_report=only_report)
        except NotThereYet:
            waits = True
    if waits:
        workshop.messages.line("plan", "report", pipeline.study)
        raise NotThereYet
    if not compared:
        raise MissingError(f"nothing that '{pipeline.file.name}' compares is here; set VEHEST_DATA, or give root=FOLDER")
    return compared, absent


def _report_job(pipeline: Pipeline, compared: Compared, overrides: Sequence[str]) -> ReportJob:
    return ReportJob(
        study=pipeline.study,
        title=pipeline.title,
        about=pipeline.about,
        command=_command(pipeline, overrides),
        module=pipeline.report,
        members=compared.members,
        evaluation=compared.evaluation,
        data_titles=compared.data_titles,
        training=compared.facts,
    )


def _run_survey(
    pipeline: Pipeline, configs: Sequence[Config], overrides: Sequence[str], workshop: Workshop, *, only_report: bool
) -> PipelineOutcome:
    try:
        here, ingested, absent = ingest_all(configs, pipeline.optional_datasets, workshop, only_report=only_report)
    except NotThereYet:
        workshop.messages.line("plan", "report", pipeline.study)
        raise
    job = SurveyJob(
        study=pipeline.study,
        title=pipeline.title,
        about=pipeline.about,
        command=_command(pipeline, overrides),
        module=pipeline.report,
        configs=here,
        ingested=ingested,
        absent=absent,
    )
    report = workshop.ensure(plan_survey(job, workshop.output), lambda folder: write_survey(job, folder))
    names = {dataset.name: f"data set '{dataset.name}'" for dataset in absent}
    return PipelineOutcome(report, pd.DataFrame(), _publish(pipeline, report, overrides, workshop, absent=names), overview_of(report))


def _command(pipeline: Pipeline, overrides: Sequence[str]) -> str:
    return " ".join([f"vehest run pipelines/{pipeline.file.name}", *overrides])


def _results_of(pipeline: Pipeline) -> Path:
    return Path("results") / pipeline.study


def _publish(
    pipeline: Pipeline, report: Artefact, overrides: Sequence[str], workshop: Workshop, absent: Mapping[str, str] | None = None
) -> Path | None:
    """Publish a study as it is written: not what overrides changed, nor without what the published one shows.

    Args:
        absent: name of what the study went on without -> what it is, for people.
    """
    if not pipeline.publish or workshop.dry_run or overrides:
        return None
    published = _results_of(pipeline)
    lost = [words for name, words in (absent or {}).items() if name in shown_in(published)]
    if lost:
        workshop.messages.warn(f"not published: '{published}' shows {lost[0]}, and this run could not read it")
        return None
    if publish(report, published):
        workshop.messages.line("done", "publish", str(published))
    return published
