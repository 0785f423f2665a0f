"""Reads what a study compares, from a file or from a command's overrides, and composes its jobs.

pipelines/*.yaml -> `read_study` -> Study -> `jobs_of` -> part -> jobs, each a configuration; a sweep's overrides -> `sweep_of` -> both
"""

from __future__ import annotations

import difflib
import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.folds import FoldsFile
from vehest.data.limits import use_limits
from vehest.data.schema import settings_from_config, validated
from vehest.data.splits import check_name
from vehest.data.text_files import read_yaml
from vehest.run.config import (
    GIVEN,
    Config,
    check_jobs,
    compose_config,
    count,
    expand,
    has_key,
    key_of,
    limits_of,
    option_hint,
    parse,
    value_of,
)
from vehest.run.config_files import GROUPS, find_pipeline, pipeline_names
from vehest.run.evaluate_faults import faults_of
from vehest.run.failures import Failure, failure_of
from vehest.run.train import TrainJob, new_estimator
from vehest.studies.registry import study_module, study_names
from vehest.studies.sweep import is_of_fault, short_names, shown_value

FORMS = "it needs study, report and one of: split and sweeps; parts, each with split and sweeps; datasets, each once"
SAME_IN_A_PART = ("split", "evaluation", "downsample")
ONE_VALUE = ("split", "evaluation", "faults", "root", "output", "tracking", "limits")

Sweeps = Annotated[tuple[Annotated[tuple[str, ...], "a list of overrides"], ...], "a list of lists of overrides"]
Faults = Annotated[tuple[dict[str, int | float | str | None], ...], "a list of faults"]
Names = Annotated[tuple[str, ...], "a list of names"]
Value = bool | int | float | str


@dataclass(frozen=True)
class PartFile:
    """A part as a pipeline's file names it; docs/cli.md says what the keys mean."""

    split: str | None = None
    sweeps: Sweeps | None = None
    title: str | None = None
    optional: bool = False
    overrides: Annotated[tuple[str, ...], "a list of overrides"] = ()


@dataclass(frozen=True)
class PipelineFile:
    """A pipeline's file; docs/cli.md says what the keys mean."""

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


@dataclass(frozen=True)
class Part:
    """One comparison of a study: sweeps of trainings on one split; its name is empty where it is the only one."""

    name: str
    title: str
    split: str
    sweeps: Sweeps
    optional: bool = False
    overrides: tuple[str, ...] = ()


@dataclass(eq=False)
class Job:
    """One training and its evaluation.

    Args:
        config: as composed for ``train`` or ``eval``; rates may be lowered to those of recordings.
        label: its settings as a sweep names them; empty for the estimator's name and variant.
        batch: the same without its fault, for trainings that are evaluated under several.
        values: keys that a sweep varies -> its own values.
        combination: of these values, counted from 0.
        failure: why it cannot be done, or failed; none so far.
        training: none where it cannot be trained, or is not planned yet.
    """

    config: Config
    label: str = ""
    batch: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)
    combination: int = 0
    failure: Failure | None = None
    training: TrainJob | None = None


Jobs = Mapping[str, Sequence[Job]]
"""Part of a study -> its jobs; the one part of a study without parts is called ``""``."""


@dataclass(frozen=True)
class Study:
    """What is compared, and who draws the report.

    Args:
        study: its name.
        report: module that draws it, by its name in `vehest.studies.registry`.
        parts: what is compared; none where it shows recordings alone.
        evaluation: overrides of conf/eval.yaml's ``evaluation``.
        publish: whether its outcome also goes to results/<study>.
        file: where it was read from.
        datasets: conf/dataset whose recordings it shows, where it compares no estimators.
        optional_datasets: further ones, left out where their raw files are missing.
        command: of a sweep, without where data come from and results go.
    """

    study: str
    title: str
    about: str
    report: str
    parts: tuple[Part, ...]
    evaluation: tuple[str, ...] = ()
    publish: bool = False
    file: Path = Path()
    datasets: Names = ()
    optional_datasets: Names = ()
    command: str = ""

    @property
    def shows_failed(self) -> bool:
        """Whether its report can leave out failed jobs: it is not in parts, or its module says so."""
        in_parts = bool(self.parts) and self.parts[0].name != ""
        return not in_parts or bool(getattr(study_module(self.report), "SHOWS_FAILED", False))


def read_study(name: str) -> Study:
    """Read a pipeline by path or name.

    Raises:
        MissingError: there is none of that name.
        ConfigurationError: the file is not a pipeline.
    """
    file, content = _content_of(name)
    read = validated(PipelineFile, content, f"'{file}'", error=ConfigurationError)
    datasets, optional = read.datasets or (), read.optional_datasets or ()
    given = {"split": read.split or read.sweeps is not None, "parts": read.parts, "datasets": datasets or optional}
    forms = [form for form, keys in given.items() if keys]
    shown = [*datasets, *optional]
    odd = len(set(shown)) < len(shown) or (optional and not datasets) or (shown and read.evaluation)
    if not read.study or not read.report or len(forms) != 1 or odd:
        raise ConfigurationError(f"'{file}' is not a pipeline: {FORMS}")
    check_name(read.study, f"'{file}': study")
    folded = _check_module(read.report, forms[0], file)
    parts = {"": PartFile(read.split, read.sweeps)} if forms == ["split"] else read.parts or {}
    made = tuple(_part(own, part, file) for own, part in parts.items())
    return Study(
        study=read.study,
        title=" ".join((read.title or read.study).split()),
        about=" ".join((read.about or "").split()),
        report=read.report,
        parts=_folds_of(made[0], file) if folded else made,
        evaluation=tuple(_evaluation_override(key, value, file) for key, value in (read.evaluation or {}).items()),
        publish=read.publish,
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
    own = validated(PipelineFile, content, f"'{file}'", error=ConfigurationError)
    if own.based_on is None:
        return file, content
    if as_base:
        raise ConfigurationError(f"'{file}' is based on another pipeline itself; base on '{own.based_on}'")
    _, base = _content_of(own.based_on, as_base=True)
    changes, parts = content.pop("parts", None) or {}, base.get("parts") or {}
    if set(changes) - set(parts):
        raise ConfigurationError(f"'{file}': '{own.based_on}' has no part '{min(set(changes) - set(parts))}'")
    kept = {key: {**(part or {}), **(changes.get(key) or {})} for key, part in parts.items() if changes.get(key, part) is not None}
    return file, {**base, **content, "based_on": None, "parts": kept}


def _evaluation_override(key: str, value: Any, file: Path) -> str:
    """A key of a pipeline's ``evaluation`` as an override; the faults of an evaluation are a key of their own."""
    if (key == "faults") != isinstance(value, tuple):
        raise ConfigurationError(f"'{file}': evaluation.{key} = {value!r}: faults are a list of faults, and nothing else is a list")
    return f"{'' if key == 'faults' else 'evaluation.'}{key}={_as_override(value)}"


def _as_override(value: Any) -> str:
    """A plain value in Hydra's grammar; text in quotes, since nan would be a number."""
    if isinstance(value, tuple):
        return f"[{','.join(map(_as_override, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_as_override(own)}" for key, own in value.items()) + "}"
    if isinstance(value, str):
        return f"'{value}'"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _part(name: str, part: PartFile | None, file: Path) -> Part:
    if part is None or part.split is None or not part.sweeps or not all(part.sweeps):
        where = f"part '{name}'" if name else "it"
        raise ConfigurationError(f"'{file}': {where} needs split and sweeps; sweeps must be a list of lists of overrides")
    if name:
        check_name(name, f"'{file}': part")
    return Part(name, " ".join((part.title or name).split()), part.split, part.sweeps, part.optional, part.overrides)


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
    takes = str(getattr(study_module(name), "TAKES", "something else"))
    if (takes, form) == ("folds", "split"):
        return True
    if takes != form:
        draws = {"split": "split and sweeps", "folds": "split and sweeps, where the split has folds"}.get(takes, takes)
        raise ConfigurationError(f"'{file}': the study module '{name}' draws its report from {draws}")
    return False


def jobs_of(study: Study, overrides: Sequence[str]) -> Jobs:
    """Every job of a pipeline; further overrides apply to the sweeps, or data sets, that have their key.

    Raises:
        ConfigurationError: an override that suits none of them, or jobs of a part that differ in split, evaluation or downsampling.
    """
    what, fixed = ("data set", "dataset") if study.datasets else ("sweep", "split")
    if any(key_of(override) == fixed for override in overrides):
        belongs = "data sets belong" if study.datasets else "split belongs"
        raise ConfigurationError(
            f"the {belongs} to the study; copy '{study.file.name}' to pipelines/ under another name and change that there"
        )
    used = {override for override in overrides if study.datasets and key_of(override).split(".")[0] == "tracking"}
    if study.datasets:
        jobs: Jobs = {"": [_ingest_job(name, overrides, used) for name in (*study.datasets, *study.optional_datasets)]}
    else:
        compose = cache(partial(compose_config, "eval"))
        sweeps = [sweep for part in study.parts for sweep in part.sweeps]
        with use_limits(limits_of([*(override for sweep in sweeps for override in sweep), *overrides])):
            check_jobs(sum(count(sweep) for sweep in sweeps), f"the sweeps of '{study.file.name}' stand")
            jobs = {part.name: _part_jobs(part, study.evaluation, overrides, used, compose) for part in study.parts}
    for override in overrides:
        if override not in used:
            hint = option_hint(key_of(override)) or f": none has an option '{key_of(override)}'"
            raise ConfigurationError(f"'{override}' suits no {what} of '{study.file.name}'{hint}")
    return jobs


def _part_jobs(
    part: Part, evaluation: Sequence[str], overrides: Sequence[str], used: set[str], compose: Callable[[tuple[str, ...]], Config]
) -> list[Job]:
    """The jobs of a part; overrides that suit any of them join ``used``."""

    def config_of(job: Sequence[str]) -> Config:
        """Composed without its split, which other jobs share, as other parts share the rest."""
        own = tuple(override for override in job if key_of(override).split(".")[0] == "split")
        return {**compose(tuple(override for override in job if override not in own)), "split": compose(own)["split"]}

    configs: dict[str, Config] = {}
    for sweep in part.sweeps:
        for job in expand([f"split={part.split}", *part.overrides, *evaluation, *sweep]):
            seeds = [override for override in job if key_of(override) == "seed"]
            shared = [override for override in job if override not in seeds]
            base = config_of([*shared, *(override for override in overrides if key_of(override) == "fault")])  # which has further keys
            suiting = [override for override in overrides if key_of(override) in GROUPS or has_key(base, key_of(override))]
            used.update(suiting)
            config = config_of([*shared, *suiting])
            if seeds and not any(key_of(override) == "seed" for override in suiting):
                config["seed"] = value_of(seeds[-1])
            configs.setdefault(json.dumps({key: value for key, value in config.items() if key != GIVEN}, sort_keys=True), config)
    jobs = [Job(config) for config in configs.values()]
    for key in SAME_IN_A_PART:
        if any(job.config[key] != jobs[0].config[key] for job in jobs):
            raise ConfigurationError(f"the sweeps of a study must agree in '{key}'; put what differs into a pipeline of its own")
    return jobs


def _ingest_job(name: str, overrides: Sequence[str], used: set[str]) -> Job:
    base = compose_config("ingest", [f"dataset={name}"])
    suiting = [override for override in overrides if has_key(base, key_of(override))]
    used.update(suiting)
    return Job(compose_config("ingest", [f"dataset={name}", *suiting]))


def content_overrides(overrides: Sequence[str]) -> list[str]:
    """Those overrides that change what comes out: not where data come from, where results go, or tracking."""
    return [override for override in overrides if key_of(override).split(".")[0] not in {"root", "output", "tracking"}]


def sweep_of(overrides: Sequence[str], name: str | None = None) -> tuple[Study, Jobs]:
    """A study with one sweep: all combinations of overrides over their seeds, in the order of the command.

    A combination that its estimator refuses stays in the list with the reason. By default the study is named after estimators and split.

    Raises:
        ConfigurationError: a key is named twice, a key takes several values that cannot, the name is none for files, or no combination can
            be trained.
    """
    with use_limits(limits_of(overrides)):
        check_jobs(count(overrides), "these overrides stand")
        keys = [key_of(override) for override in overrides]
        for key in keys:
            if keys.count(key) > 1:
                raise ConfigurationError(f"'{key}' is named twice; give all its values at once: {key}=1,2")
        swept = [str(one.key_or_group) for one in parse(overrides) if one.is_sweep_override()]
        for key in swept:
            if key.split(".")[0] in ONE_VALUE:
                raise ConfigurationError(
                    f"'{key}' takes one value in a sweep, whose combinations are compared with each other; run one sweep a value"
                )
        others = [override for override in overrides if key_of(override) != "seed"]
        found = [_combination(own, swept, number) for number, own in enumerate(expand(others))]
        seeds = [value_of(own[0]) for own in expand([override for override in overrides if override not in others]) if own]
    refused: dict[str, list[str]] = {}
    for job in found:
        if job.failure is not None:
            refused.setdefault(job.failure.message, []).append(job.label)
    usable = [job.config for job in found if job.failure is None]
    if not usable:
        listed = "; ".join(f"{' and '.join(labels)}: {reason}" for reason, labels in refused.items())
        raise ConfigurationError(next(iter(refused)) if len(refused) == 1 else f"no combination can be trained; {listed}")
    split = str(usable[0]["split"]["name"])
    study = name or f"{'_'.join(dict.fromkeys(str(config['estimator']['name']) for config in usable))}-{split}"
    check_name(study, "--name")
    words = [*map(shlex.quote, content_overrides(overrides)), *(["--name", study] if name else [])]
    of_jobs = {repr(seed): seed for seed in seeds or [usable[0]["seed"]]}.values()
    jobs = [replace(job, config={**job.config, "seed": seed}) for job in found for seed in of_jobs]
    part = Part("", "", split, (tuple(overrides),))
    return Study(study, study, "", "sweep", (part,), command=" ".join(["vehest sweep", *words])), {"": jobs}


def _combination(overrides: Sequence[str], swept: Sequence[str], number: int) -> Job:
    """A combination of values; the seed is each job's own."""
    values = {key_of(override): _value(override) for override in overrides if key_of(override) in swept}
    label = _label(values)
    try:
        config = compose_config("eval", overrides)
        estimator = new_estimator(config["estimator"])
        settings_from_config(estimator.training_type, config["training"], "training")
        faults_of(config)
    except ConfigurationError as error:
        return Job({}, label or "this", "", values, number, failure_of(error))
    trained = _label({key: value for key, value in values.items() if not is_of_fault(key)})
    return Job(config, label or estimator.full_title, trained or estimator.full_title, values, number)


def _label(values: Mapping[str, Value]) -> str:
    """Settings for people, ``n_local=2, bias=true``."""
    names = short_names(list(values))
    return ", ".join(f"{names[key]}={shown_value(value)}" for key, value in values.items())


def _value(override: str) -> Value:
    """A plain value, or the text of any other."""
    value = value_of(override)
    return value if isinstance(value, bool | int | float | str) else override.split("=", 1)[-1]
