"""Studies: what a file in pipelines/, or the overrides of a sweep, ask for, as jobs.

pipelines/*.yaml -> Study -> parts -> jobs, each a configuration; `study_run` runs them, `sweep` makes a study of a command's overrides.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.folds import FoldsFile
from vehest.data.limits import use_limits
from vehest.data.schema import validated
from vehest.data.splits import check_name
from vehest.data.text_files import read_yaml
from vehest.run.config import GIVEN, Config, check_jobs, compose_config, count, expand, has_key, key_of, limits_of, option_hint, value_of
from vehest.run.config_files import GROUPS, find_pipeline, pipeline_names
from vehest.studies.registry import study_module, study_names

FORMS = "it needs study, report and one of: split and sweeps; parts, each with split and sweeps; datasets"
SAME_IN_A_PART = ("split", "evaluation", "downsample")

Sweeps = Annotated[tuple[Annotated[tuple[str, ...], "a list of overrides"], ...], "a list of lists of overrides"]
Faults = Annotated[tuple[dict[str, int | float | str | None], ...], "a list of faults"]
Names = Annotated[tuple[str, ...], "a list of names"]
Value = bool | int | float | str


@dataclass(frozen=True)
class PartFile:
    """A part as a pipeline's file names it; a part on top of another pipeline's leaves what is None to that one."""

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
    """One comparison of a study: sweeps of trainings on one split.

    Args:
        name: short, ``""`` where it is the only one.
        title: for people.
        split: name in conf/split.
        sweeps: overrides of each sweep, several values allowed.
        optional: whether the study goes on without it where its raw files are missing.
        overrides: of all its jobs, before those of the sweeps.
    """

    name: str
    title: str
    split: str
    sweeps: tuple[tuple[str, ...], ...]
    optional: bool = False
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    Args:
        config: as composed for ``train`` or ``eval``.
        label: its settings as a sweep names them; empty for the estimator's name and variant.
        batch: the same without its fault, for trainings that are evaluated under several.
        values: keys that a sweep varies -> its own values.
        refusal: why it cannot be trained; empty if it can.
    """

    config: Config
    label: str = ""
    batch: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)
    refusal: str = ""


Jobs = Mapping[str, Sequence[Job]]
"""Part of a study -> its jobs; the one part of a study without parts is called ``""``."""


@dataclass(frozen=True)
class Study:
    """What is compared, and who draws the report.

    Args:
        study: its name.
        title: for people.
        about: a paragraph on what is compared and why.
        report: module that draws it, by its name in `vehest.studies.registry`; empty for a sweep.
        parts: what is compared; none where it shows recordings alone.
        evaluation: overrides of conf/eval.yaml's ``evaluation``.
        publish: whether its outcome also goes to results/<study>.
        file: where it was read from; none for a sweep.
        datasets: conf/dataset whose recordings it shows, where it compares no estimators.
        optional_datasets: further ones, left out where their raw files are missing.
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
    return Study(
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
    """A key of a pipeline's ``evaluation`` as an override; the faults of an evaluation are a key of their own."""
    if key == "faults":
        if not isinstance(value or (), tuple):
            raise ConfigurationError(f"'{file}': evaluation.faults must be a list of faults, not {value!r}")
        return f"faults=[{','.join(_fault_as_override(fault) for fault in value or ())}]"
    if isinstance(value, tuple):
        raise ConfigurationError(f"'{file}': evaluation.{key} takes one value; a list of faults is called faults")
    return f"evaluation.{key}={_as_override(value)}"


def _fault_as_override(fault: Mapping[str, int | float | str | None]) -> str:
    """A mapping in Hydra's grammar, its text in quotes: nan would be a number."""
    values = {name: f"'{value}'" if isinstance(value, str) else _as_override(value) for name, value in fault.items()}
    return "{" + ",".join(f"{name}:{value}" for name, value in values.items()) + "}"


def _as_override(value: int | float | bool | str | None) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _form_of(described: PipelineFile, file: Path) -> str:
    """Which of the three forms a pipeline has, by the key that tells: ``split``, ``parts`` or ``datasets``."""
    named = {
        "split": described.split is not None or described.sweeps is not None,
        "parts": described.parts is not None,
        "datasets": described.datasets is not None or described.optional_datasets is not None,
    }
    forms = [form for form, present in named.items() if present]
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


def jobs_of(study: Study, overrides: Sequence[str]) -> Jobs:
    """Every job of a study; further overrides apply to the sweeps, or data sets, that have their key.

    Raises:
        ConfigurationError: an override that suits none of them, or jobs of a part that differ in split, evaluation or downsampling.
    """
    used = {override for override in overrides if study.datasets and key_of(override).split(".")[0] == "tracking"}
    what, fixed = ("data set", "dataset") if study.datasets else ("sweep", "split")
    if any(key_of(override) == fixed for override in overrides):
        belongs = "data sets belong" if study.datasets else "split belongs"
        raise ConfigurationError(
            f"the {belongs} to the study; copy '{study.file.name}' to pipelines/ under another name and change that there"
        )
    if study.datasets:
        jobs: Jobs = {"": [_ingest_job(name, overrides, used) for name in (*study.datasets, *study.optional_datasets)]}
    else:
        composed: dict[tuple[str, ...], Config] = {}
        sweeps = [sweep for part in study.parts for sweep in part.sweeps]
        with use_limits(limits_of([*(override for sweep in sweeps for override in sweep), *overrides])):
            check_jobs(sum(count(sweep) for sweep in sweeps), f"the sweeps of '{study.file.name}' stand")
            jobs = {part.name: _part_jobs(part, study.evaluation, overrides, used, composed) for part in study.parts}
    for override in overrides:
        if override not in used:
            key = key_of(override)
            hint = option_hint(key) or f": none has an option '{key}'"
            raise ConfigurationError(f"'{override}' suits no {what} of '{study.file.name}'{hint}")
    return jobs


def _part_jobs(
    part: Part, evaluation: Sequence[str], overrides: Sequence[str], used: set[str], composed: dict[tuple[str, ...], Config]
) -> list[Job]:
    """The jobs of a part; overrides that suit any of them join ``used``, composed configurations join ``composed``."""

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
    jobs = [Job(config) for config in configs.values()]
    for other in jobs:
        for key in SAME_IN_A_PART:
            if other.config[key] != jobs[0].config[key]:
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
