"""A pipeline: sweeps of trainings, the evaluations they feed, and the study that draws tables and figures from them.

Or data sets alone, and the study that draws tables and figures from their recordings.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from vehest.data.errors import ConfigurationError, JobsFailedError, MissingError
from vehest.data.splits import check_name
from vehest.stages.artefacts import Artefact
from vehest.stages.config import Config, compose_config, expand, has_key, key_of
from vehest.stages.config_files import GROUPS, find_pipeline, pipeline_names
from vehest.stages.evaluate import protocol_from_config
from vehest.stages.group import Evaluation, Group, existing, is_finished
from vehest.stages.report import ReportJob, leaderboard_of, plan_report, publish, write_report
from vehest.stages.survey import SurveyJob, ingest_all, lost_by_publishing, overview_of, plan_survey, write_survey
from vehest.stages.tracking import Tracker
from vehest.stages.train import TrainJob, new_estimator, plan_train
from vehest.stages.workshop import NotThereYet, Workshop

COMPARISON = {"split", "sweeps", "evaluation"}
SURVEY = {"datasets", "optional_datasets"}
KEYS = {"study", "title", "about", "report", "publish", *COMPARISON, *SURVEY}


@dataclass(frozen=True)
class Pipeline:
    """A study as pipelines/*.yaml describes it.

    Args:
        study: its name.
        title: for people.
        about: a paragraph on what is compared and why.
        report: module of `vehest.studies` that draws it.
        split: conf/split it works on.
        sweeps: overrides of each sweep, several values allowed.
        evaluation: overrides of conf/eval.yaml's ``evaluation``.
        publish: whether its outcome also goes to results/<study>.
        file: where it was read from.
        datasets: conf/dataset whose recordings it shows, where it compares no estimators; split and sweeps are empty then.
        optional_datasets: further ones, that it goes on without where their raw files are not here.
    """

    study: str
    title: str
    about: str
    report: str
    split: str
    sweeps: tuple[tuple[str, ...], ...]
    evaluation: tuple[str, ...]
    publish: bool
    file: Path
    datasets: tuple[str, ...] = ()
    optional_datasets: tuple[str, ...] = ()


@dataclass(frozen=True)
class PipelineOutcome:
    """What a pipeline made.

    Args:
        report: artefact of the report stage.
        leaderboard: its table, one row an estimator and test set; empty where it compares none.
        published: folder in results/, if it was published.
        overview: table of a study of recordings alone.
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
    survey = bool(SURVEY & set(content))
    needed = {"study", "report", "datasets"} if survey else {"study", "report", "split", "sweeps"}
    if not needed <= set(content) or (survey and COMPARISON & set(content)):
        raise ConfigurationError(
            f"'{file}' is not a pipeline: it needs study, report, split and sweeps; or study, report and datasets, and no split or sweeps"
        )
    sweeps = content.get("sweeps", [])
    if not isinstance(sweeps, list) or not all(isinstance(sweep, list) and sweep for sweep in sweeps):
        raise ConfigurationError(f"'{file}': sweeps must be a list of lists of overrides")
    datasets, optional = (_names_in(content.get(key, []), f"'{file}': {key}") for key in ("datasets", "optional_datasets"))
    if survey and (not datasets or len({*datasets, *optional}) != len(datasets) + len(optional)):
        raise ConfigurationError(f"'{file}': datasets must name some, and none of them twice")
    if importlib.util.find_spec(f"vehest.studies.{content['report']}") is None:
        raise ConfigurationError(f"'{file}': there is no study module '{content['report']}' in vehest.studies")
    if not hasattr(importlib.import_module(f"vehest.studies.{content['report']}"), "documents" if survey else "build"):
        takes = "split and sweeps" if survey else "datasets"
        raise ConfigurationError(f"'{file}': the study module '{content['report']}' draws its report from {takes}")
    check_name(str(content["study"]), f"'{file}': study")
    return Pipeline(
        study=str(content["study"]),
        title=str(content.get("title", content["study"])),
        about=" ".join(str(content.get("about", "")).split()),
        report=str(content["report"]),
        split=str(content.get("split", "")),
        sweeps=tuple(tuple(str(override) for override in sweep) for sweep in sweeps),
        evaluation=tuple(f"evaluation.{key}={value}" for key, value in (content.get("evaluation") or {}).items()),
        publish=bool(content.get("publish", False)),
        file=file,
        datasets=datasets,
        optional_datasets=optional,
    )


def _names_in(content: Any, where: str) -> tuple[str, ...]:
    if not isinstance(content, list) or not all(isinstance(name, str) for name in content):
        raise ConfigurationError(f"{where} must be a list of names in conf/dataset")
    return tuple(content)


def pipeline_configs(pipeline: Pipeline, overrides: Sequence[str]) -> list[Config]:
    """The configuration of every job; further overrides apply to the sweeps, or data sets, that have their key.

    Raises:
        ConfigurationError: an override that suits none of them.
    """
    if pipeline.datasets:
        return _survey_configs(pipeline, overrides)
    composed: dict[tuple[str, ...], Config] = {}

    def config_of(job: tuple[str, ...]) -> Config:
        if job not in composed:
            composed[job] = compose_config("eval", job)
        return composed[job]

    if any(key_of(override) == "split" for override in overrides):
        raise ConfigurationError(
            f"the split belongs to the study; copy '{pipeline.file.name}' to pipelines/ under another name and change it there"
        )
    used: set[str] = set()
    configs: list[Config] = []
    for sweep in pipeline.sweeps:
        for job in expand([f"split={pipeline.split}", *pipeline.evaluation, *sweep]):
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
    for override in overrides:
        if override not in used:
            raise ConfigurationError(f"'{override}' suits no sweep of '{pipeline.file.name}': none has an option '{key_of(override)}'")
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
    pipeline: Pipeline, configs: Sequence[Config], overrides: Sequence[str], workshop: Workshop, *, only_report: bool = False
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
        return _run_survey(pipeline, configs, overrides, workshop, only_report=only_report)
    first = configs[0]
    workshop.tracker = Tracker(first["tracking"], workshop.output, workshop.messages.warn)
    workshop.tags = {"vehest.study": pipeline.study}
    try:
        groups = _groups(configs, workshop)
    except NotThereYet:
        for config in configs:
            estimator = new_estimator(config["estimator"])
            workshop.messages.line("plan", "train", f"{estimator.name}-{estimator.variant}-seed{config['seed']}", "then evaluate")
        workshop.messages.line("plan", "report", pipeline.study)
        raise
    if only_report:
        for group in groups:
            for member in existing(group):
                if not is_finished(group, member):
                    raise MissingError(
                        f"{member.job.plan.label} has not been trained and evaluated; run 'vehest run {pipeline.file}' first"
                    )
    members, failures = workshop.run_groups(groups)
    if failures:
        listed = "; ".join(f"{name}: {failure.message}" for name, failure in failures)
        for name, failure in failures:
            if failure.detail:
                workshop.messages.warn(f"{name}:\n{failure.detail}")
        raise JobsFailedError(f"{len(failures)} of {len(groups)} groups of jobs failed, the others are kept; {listed}")
    order = {job.plan.key: position for position, job in enumerate(job for group in groups for job in group.jobs)}
    members.sort(key=lambda member: order[member.job.plan.key])
    evaluation = groups[0].evaluation
    assert evaluation is not None
    titles = {name: str(workshop.dataset_config(name, first)["dataset"].get("title", name)) for name in evaluation.split.datasets}
    job = ReportJob(
        study=pipeline.study,
        title=pipeline.title,
        about=pipeline.about,
        command=_command(pipeline, overrides),
        module=pipeline.report,
        members=members,
        evaluation=evaluation,
        data_titles=titles,
        training=[*training_facts(configs), resampling_fact(configs)],
    )
    report = workshop.ensure(plan_report(job, workshop.output), lambda folder: write_report(job, folder))
    published = _publish(pipeline, report, overrides, workshop)
    return PipelineOutcome(report, leaderboard_of(job), published)


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
    published = None
    lost = lost_by_publishing(absent, _results_of(pipeline)) if pipeline.publish else []
    if lost:
        workshop.messages.warn(f"not published: '{_results_of(pipeline)}' shows data set '{lost[0]}', and this run could not read it")
    else:
        published = _publish(pipeline, report, overrides, workshop)
    return PipelineOutcome(report, pd.DataFrame(), published, overview_of(report))


def _command(pipeline: Pipeline, overrides: Sequence[str]) -> str:
    return " ".join([f"vehest run pipelines/{pipeline.file.name}", *overrides])


def _results_of(pipeline: Pipeline) -> Path:
    return Path("results") / pipeline.study


def _publish(pipeline: Pipeline, report: Artefact, overrides: Sequence[str], workshop: Workshop) -> Path | None:
    """Publish a study as it is written: not what overrides changed."""
    if not pipeline.publish or workshop.dry_run or overrides:
        return None
    published = _results_of(pipeline)
    if publish(report, published):
        workshop.messages.line("done", "publish", str(published))
    return published


def _groups(configs: Sequence[Config], workshop: Workshop) -> list[Group]:
    """Jobs that fit one batch, with the data they need, which is made on the way."""
    groups: dict[tuple[Any, ...], list[TrainJob]] = {}
    evaluations: dict[tuple[Any, ...], Evaluation] = {}
    labels: dict[str, str] = {}
    for config in configs:
        for key in ("split", "evaluation", "downsample"):
            if config[key] != configs[0][key]:
                raise ConfigurationError(f"the sweeps of a study must agree in '{key}'; put what differs into a pipeline of its own")
        split = workshop.split(config)
        if not any(split.tests.values()):
            raise ConfigurationError(f"split '{split.name}' has no test ranges; a study needs some")
        protocol = protocol_from_config(config["evaluation"])
        data = workshop.data_for(split, new_estimator(config["estimator"]).settings.rate_hz, config)
        references = workshop.data_for(split, protocol.rate_hz, plain_resampling(config))
        job = plan_train(config, split, data)
        if labels.setdefault(job.plan.label, job.plan.key) != job.plan.key:
            raise ConfigurationError(
                f"two jobs are both called {job.plan.label}: they differ in what its name does not say; sweep that in a pipeline of its own"
            )
        groups.setdefault(job.group, []).append(job)
        evaluations[job.group] = Evaluation(split, data, references, workshop.kinds_of(split, config), protocol, workshop.output)
    return [Group(jobs, evaluations[key], workshop.force) for key, jobs in groups.items()]


def resampling_fact(configs: Sequence[Config]) -> str:
    """How recordings came to the rates that estimators work at."""
    rates = sorted({float(config["estimator"]["rate_hz"]) for config in configs} | {float(configs[0]["evaluation"]["rate_hz"])})
    options = configs[0]["downsample"]
    how = {
        "polyphase": "anti-aliased by a zero-phase polyphase filter (offline: it looks ahead; the estimators themselves are causal)",
        "decimate": "by plain decimation",
    }[options["method"]]
    first = f", after {len(options['transforms'])} further transforms" if options["transforms"] else ""
    return f"Recordings at {' and '.join(f'{rate:g}' for rate in rates)} Hz are made from the native rate {how}{first}"


def plain_resampling(config: Config) -> Config:
    """The configuration for references: resampled like everything, but never filtered further."""
    return {**config, "downsample": {**config["downsample"], "transforms": []}}


def training_facts(configs: Sequence[Config]) -> list[str]:
    """What each training scheme was allowed, a line each."""
    facts = []
    for config in configs:
        training = config["training"]
        options = ", ".join(f"{key} {value}" for key, value in training.items() if key not in {"name", "checkpoint_seconds", "compiled"})
        names = sorted({c["estimator"]["name"] for c in configs if c["training"] == training})
        fact = f"{', '.join(names)}: {training['name']} ({options})" if options else f"{', '.join(names)}: nothing is trained"
        if fact not in facts:
            facts.append(fact)
    return facts
