"""Reads what a study compares, from a file or from a command's overrides, and composes its jobs.

pipelines/*.yaml -> `read_study` -> Study -> `jobs_of` -> part -> jobs, each a configuration; a
sweep's overrides -> `sweep_of` -> both
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

from vehest.configuration.composition import (
    OVERRIDDEN_RATES_KEY,
    Config,
    check_jobs,
    close_key,
    compose_config,
    count,
    expand,
    has_key,
    key_of,
    limits_of,
    option_hint,
    parsed,
    value_of,
)
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.folds import FoldsFile
from vehest.data.limits import use_limits
from vehest.data.schema import settings_from_config, validated
from vehest.data.splits import check_name
from vehest.data.text_files import read_yaml
from vehest.estimators.registry import new_estimator
from vehest.evaluation.metrics import UNITS
from vehest.run.evaluate_faults import faults_of
from vehest.run.failures import Failure, failure_of
from vehest.run.named_files import require_pipeline
from vehest.run.train import TrainJob
from vehest.studies.registry import study_module, study_names
from vehest.studies.sweep import Value, override_text, short_names

# text on what a pipeline's file must have, for messages
FORMS = (
    "it needs study, report and one of: split and sweeps; parts, each with split and sweeps; "
    "datasets, each once"
)
# groups of the configuration that all jobs of a part must share
SHARED_KEYS = ("split", "evaluation", "downsample")
# groups of the configuration that cannot be swept
SINGLE_VALUED = ("split", "evaluation", "faults", "root", "output", "tracking", "limits")

# sweeps, each a list of overrides
Sweeps = Annotated[
    tuple[Annotated[tuple[str, ...], "a list of overrides"], ...], "a list of lists of overrides"
]
# settings of faults that are evaluated
Faults = Annotated[tuple[dict[str, int | float | str | None], ...], "a list of faults"]
Names = Annotated[tuple[str, ...], "a list of names"]  # list of names


@dataclass(frozen=True)
class Search:
    """Candidates of which the one with the lowest metric on the validation range is chosen."""

    candidates: Sweeps = ()  # sweeps over the candidates
    metric: str = "rmse_sideslip"  # metric that chooses


@dataclass(frozen=True)
class Part:
    """One comparison of a study: sweeps of trainings on one split.

    Docs/cli.md says what the keys mean.
    """

    split: str = ""  # name of the split
    sweeps: Sweeps = ()  # sweeps of trainings
    title: str = ""  # title in the report
    optional: bool = False  # whether the part is left out where raw files are missing
    # overrides of all jobs of the part
    overrides: Annotated[tuple[str, ...], "a list of overrides"] = ()
    search: Search | None = None  # search over candidates; of a trial, only its own options


@dataclass(frozen=True)
class PipelineFile:
    """A pipeline's file; docs/cli.md says what the keys mean."""

    study: str = ""  # name of the study
    report: str = ""  # name of the study module that draws it
    title: str = ""  # title of the report
    about: str = ""  # paragraph of the report on what is compared
    publish: bool = False  # whether its report is published in results/
    # overrides of ``evaluation`` for all jobs
    evaluation: dict[str, int | float | bool | str | Faults | None] = field(default_factory=dict)
    split: str = ""  # name of the split, of a study without parts
    sweeps: Sweeps = ()  # sweeps of trainings, of a study without parts
    # name -> part
    parts: Annotated[dict[str, Part], "a mapping from names to what each has"] = field(
        default_factory=dict
    )
    datasets: Names = ()  # data sets of a study of recordings alone
    optional_datasets: Names = ()  # data sets that are left out where raw files are missing
    # name of the pipeline on top of which this file is read; None: none
    based_on: str | None = None


@dataclass(frozen=True)
class Study(PipelineFile):
    """A pipeline or a sweep as it is run.

    The only part of a study that is not in parts is called ``""``, and has no title.
    """

    file: Path = Path()  # path of its pipeline file
    command: str = ""  # command that makes it, without locations of data and results
    words: tuple[str, ...] = ()  # words of the command that runs it here
    # part of the file with a search -> its trials, each a part here
    searches: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def trials(self) -> frozenset[str]:
        """Parts that are trials of a search."""
        return frozenset(trial for trials in self.searches.values() for trial in trials)

    @property
    def shows_failed(self) -> bool:
        """Whether its report can leave out failed jobs: it is not in parts, or its module says
        so.
        """
        return (
            not self.parts
            or "" in self.parts
            or bool(getattr(study_module(self.report), "SHOWS_FAILED", False))
        )


@dataclass(eq=False)
class Job:
    """One training and its evaluation."""

    # configuration as composed for ``train`` or ``eval``; rates may be lowered to those of
    # recordings
    config: Config
    label: str = ""  # settings as a sweep names them; empty for the estimator's name and variant
    # keys that a sweep varies -> the job's values
    values: Mapping[str, Value] = field(default_factory=dict)
    combination: int = 0  # index of the combination of these values in the sweep
    failure: Failure | None = None  # reason why it cannot be done, or failed
    training: TrainJob | None = None  # the planned training; None before it is planned


Jobs = Mapping[
    str, Sequence[Job]
]  # part of a study -> its jobs; the one part of a study without parts is called ``""``


def failure_messages(jobs: Iterable[Job]) -> str:
    """Text of why jobs failed, each reason once; empty where none failed."""
    return "; ".join(dict.fromkeys(job.failure.message for job in jobs if job.failure is not None))


def read_study(name: str, overrides: Sequence[str] = ()) -> Study:
    """Read a pipeline by path or name.

    Parameters
    ----------
    name : str
        Path of a file, or name of one in ./pipelines or of those that come with vehest.
    overrides : sequence of str
        Of the command; they enter ``command`` and ``words`` of the study.

    Returns
    -------
    Study
        Folds of a cross-validated split, and candidates of searches, are parts of it.

    Raises
    ------
    MissingError
        There is no such pipeline.
    ConfigurationError
        The file is no pipeline, or does not fit the module that draws its report.
    """
    file, content = _content_of(name, overrides)
    read = validated(PipelineFile, content, f"'{file}'", error=ConfigurationError)
    datasets = [*read.datasets, *read.optional_datasets]
    forms = {"split": read.split or read.sweeps, "parts": read.parts, "datasets": datasets}
    stated_forms = [form for form, keys in forms.items() if keys]
    odd = len(set(datasets)) < len(datasets) or (
        datasets and (read.evaluation or not read.datasets)
    )
    if not read.study or not read.report or len(stated_forms) != 1 or odd:
        raise ConfigurationError(f"'{file}' is not a pipeline: {FORMS}")
    for key in (read.study, *read.parts):
        check_name(key, f"'{file}'")
    parts = read.parts or ({} if datasets else {"": Part(read.split, read.sweeps)})
    for key, part in parts.items():
        if not part.split or not part.sweeps or not all(part.sweeps):
            subject = f"part '{key}'" if key else "it"
            raise ConfigurationError(
                f"'{file}': {subject} needs split and sweeps; sweeps must be a list of lists of "
                "overrides"
            )
    if read.report not in study_names():
        raise ConfigurationError(
            f"'{file}': there is no study module '{read.report}'; there are: "
            f"{', '.join(study_names())}"
        )
    takes = getattr(study_module(read.report), "TAKES", "")
    if stated_forms != ["split" if takes == "folds" else takes]:
        draws = {
            "split": "split and sweeps",
            "folds": "split and sweeps, where the split has folds",
        }.get(takes, takes)
        raise ConfigurationError(
            f"'{file}': the study module '{read.report}' draws its report from {draws}"
        )
    parts = _folds_of(parts[""], file) if takes == "folds" else parts
    searches: dict[str, tuple[str, ...]] = {}
    for key in [key for key, part in parts.items() if part.search is not None]:
        trials = _trials_of(key, parts[key], file)
        searches[key] = tuple(trials)
        twins = sorted(trials.keys() & parts.keys())
        if twins:
            raise ConfigurationError(
                f"'{file}': part '{twins[0]}' has the name of a trial of '{key}'"
            )
        parts = dict(
            item
            for name, part in parts.items()
            for item in (trials.items() if name == key else [(name, part)])
        )
    evaluation = [
        f"{'' if key == 'faults' else 'evaluation.'}{key}={_as_override(value)}"
        for key, value in read.evaluation.items()
    ]
    changed = {
        "title": " ".join((read.title or read.study).split()),
        "about": " ".join(read.about.split()),
        "parts": {
            key: replace(
                part,
                title=" ".join((part.title or key).split()),
                overrides=(*part.overrides, *evaluation),
            )
            for key, part in parts.items()
        },
    }
    command = " ".join([f"vehest run pipelines/{file.name}", *content_overrides(overrides)])
    return Study(
        **{**vars(read), **changed},
        file=file,
        command=command,
        words=(name, *overrides),
        searches=searches,
    )


def _trials_of(name: str, part: Part, file: Path) -> dict[str, Part]:
    """Trials of a part with a search, each as a part of its own: name -> part."""
    search = part.search
    assert search is not None
    subject = f"'{file}': the search '{name}'"
    if search.metric not in UNITS:
        raise ConfigurationError(f"{subject} chooses by '{search.metric}', which is no metric")
    candidates = [tuple(job) for sweep in search.candidates for job in expand(sweep)]
    if len(candidates) < 2:
        raise ConfigurationError(
            f"{subject} needs candidates, a list of lists of overrides with two combinations or "
            "more"
        )
    if len(part.sweeps) != 1 or count(part.sweeps[0]) != 1:
        raise ConfigurationError(
            f"{subject} needs sweeps with one list of overrides for one training"
        )
    stated = {key_of(override) for override in (*part.overrides, *part.sweeps[0])}
    for key in (key_of(override) for candidate in candidates for override in candidate):
        if key in stated:
            raise ConfigurationError(f"{subject} tries '{key}', which its sweeps state too")
    return {
        f"{name}_{number}": replace(
            part,
            title=f"{part.title or name}, {', '.join(candidate)}",
            overrides=(*part.overrides, *candidate),
            search=replace(search, candidates=(candidate,)),
        )
        for number, candidate in enumerate(candidates, start=1)
    }


def _content_of(
    name: str, overrides: Sequence[str] = (), *, as_base: bool = False
) -> tuple[Path, dict[str, Any]]:
    """Path of a pipeline's file, and its content on top of that of the pipeline it is based on.

    ``overrides`` are those of the command, for the text of an error.
    """
    file = require_pipeline(name, overrides)
    try:
        content = read_yaml(file)
    except DataError as error:
        raise ConfigurationError(str(error)) from None
    if not isinstance(content, dict):
        raise ConfigurationError(f"'{file}' is not a pipeline: {FORMS}")
    based_on = content.get("based_on")
    if not isinstance(based_on, str):
        return file, content
    if as_base:
        raise ConfigurationError(
            f"'{file}' is based on another pipeline itself; base on '{based_on}'"
        )
    _, base = _content_of(based_on, as_base=True)
    return file, {
        **base,
        **content,
        "based_on": None,
        "parts": _merged(base.get("parts"), content.get("parts", {})),
    }


def _merged(base: Any, changes: Any) -> Any:
    """Merge two mappings recursively; keys that ``changes`` sets to null are left out."""
    if not isinstance(base, dict) or not isinstance(changes, dict):
        return changes
    changed = {key: _merged(base.get(key), value) for key, value in changes.items()}
    return {
        key: value
        for key, value in {**base, **changed}.items()
        if key not in changed or value is not None
    }


def _as_override(value: Any) -> str:
    """Text of a plain value in Hydra's grammar; strings are quoted, since nan would be a number."""
    if isinstance(value, tuple):
        return f"[{','.join(map(_as_override, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_as_override(inner)}" for key, inner in value.items()) + "}"
    return f"'{value}'" if isinstance(value, str) else json.dumps(value)


def _folds_of(part: Part, file: Path) -> dict[str, Part]:
    """Folds of a comparison on a split that is cross-validated, each as a part: name -> part."""
    folds = compose_config("train", [f"split={part.split}"])["split"].get("folds")
    number = folds.get("number", FoldsFile.number) if isinstance(folds, dict) else None
    if not isinstance(number, int) or number < 1:
        raise ConfigurationError(
            f"'{file}': its report takes folds; split '{part.split}' says no folds: {{number: 5, "
            f"of: laps}}"
        )
    check_jobs(number, f"the folds of '{file.name}' stand")
    return {
        f"fold_{fold}": replace(
            part, title=f"fold {fold} of {number}", overrides=(f"++split.fold={fold - 1}",)
        )
        for fold in range(1, number + 1)
    }


def jobs_of(study: Study, overrides: Sequence[str]) -> Jobs:
    """Every job of a pipeline.

    Parameters
    ----------
    study : Study
        The pipeline.
    overrides : sequence of str
        Each applies to the sweeps, or data sets, that have its key.

    Returns
    -------
    Jobs
        Part -> its jobs, each configuration once.

    Raises
    ------
    ConfigurationError
        An override matches nothing or belongs to the study; sweeps of a part disagree in what they
        share; there are more jobs than the limit.
    """
    unit, fixed = ("data set", "dataset") if study.datasets else ("sweep", "split")
    if fixed in map(key_of, overrides):
        raise ConfigurationError(
            f"'{fixed}' belongs to the study; copy '{study.file.name}' to pipelines/ under another "
            "name and change that there"
        )
    matching = {
        override
        for override in overrides
        if study.datasets and key_of(override).split(".")[0] == "tracking"
    }

    matched: list[Config] = []  # configurations that overrides were matched with

    def suiting(config: Config) -> list[str]:
        matched.append(config)
        suitable = [override for override in overrides if has_key(config, key_of(override))]
        matching.update(suitable)
        return suitable

    if study.datasets:
        dataset_overrides = [
            [f"dataset={name}"] for name in (*study.datasets, *study.optional_datasets)
        ]
        jobs: Jobs = {
            "": [
                Job(
                    compose_config(
                        "ingest",
                        [*dataset_override, *suiting(compose_config("ingest", dataset_override))],
                    )
                )
                for dataset_override in dataset_overrides
            ]
        }
    else:
        compose = cache(partial(compose_config, "eval"))
        sweeps = [sweep for part in study.parts.values() for sweep in part.sweeps]
        with use_limits(
            limits_of([*(override for sweep in sweeps for override in sweep), *overrides])
        ):
            check_jobs(
                sum(count(sweep) for sweep in sweeps), f"the sweeps of '{study.file.name}' stand"
            )
            jobs = {
                name: _part_jobs(part, overrides, suiting, compose)
                for name, part in study.parts.items()
            }
    for override in overrides:
        if override not in matching:
            key = key_of(override)
            meant = next(filter(None, (close_key(key, config) for config in matched)), "")
            hint = option_hint(key) or f": none has an option '{key}'"
            if meant:
                hint += f"; did you mean '{meant}'?"
            raise ConfigurationError(f"'{override}' matches no {unit} of '{study.file.name}'{hint}")
    return jobs


def _part_jobs(
    part: Part,
    overrides: Sequence[str],
    suiting: Callable[[Config], list[str]],
    compose: Callable[[tuple[str, ...]], Config],
) -> list[Job]:
    """Jobs of one part: all combinations of its sweeps, each once, with the overrides that they
    have keys for; raises `ConfigurationError` where they disagree in `SHARED_KEYS`.
    """

    def config_of(job: Sequence[str]) -> Config:
        """Composed without its split, which other jobs share, as other parts share the rest."""
        of_split = tuple(override for override in job if key_of(override).split(".")[0] == "split")
        return {
            **compose(tuple(override for override in job if override not in of_split)),
            "split": compose(of_split)["split"],
        }

    configs: dict[str, Config] = {}
    faults = [
        override for override in overrides if key_of(override) == "fault"
    ]  # which have further keys
    for sweep in part.sweeps:
        for job in expand([f"split={part.split}", *part.overrides, *sweep]):
            seeds = [override for override in job if key_of(override) == "seed"]
            shared = [override for override in job if override not in seeds]
            config = config_of([*shared, *suiting(config_of([*shared, *faults]))])
            if seeds and "seed" not in map(key_of, overrides):
                config["seed"] = value_of(seeds[-1])
            configs.setdefault(
                json.dumps({**config, OVERRIDDEN_RATES_KEY: None}, sort_keys=True), config
            )
    jobs = [Job(config) for config in configs.values()]
    for key in SHARED_KEYS:
        if any(job.config[key] != jobs[0].config[key] for job in jobs):
            raise ConfigurationError(
                f"the sweeps of a study must agree in '{key}'; put what differs into a pipeline of "
                "its own"
            )
    return jobs


def content_overrides(overrides: Sequence[str]) -> list[str]:
    """Those overrides that change results, without locations of data and results, and without
    tracking.
    """
    return [
        override
        for override in overrides
        if key_of(override).split(".")[0] not in {"root", "output", "tracking"}
    ]


def sweep_of(overrides: Sequence[str], name: str | None = None) -> tuple[Study, Jobs]:
    """A study with one sweep: all combinations of overrides over their seeds, in the order of the
    command.

    A combination that its estimator refuses stays in the list with the reason.

    Parameters
    ----------
    overrides : sequence of str
        With several values for the keys that are swept.
    name : str or None
        Of the study; by default estimators and split.

    Returns
    -------
    tuple
        The study, and its jobs under the part ``""``.

    Raises
    ------
    ConfigurationError
        A key is named twice or takes one value only, all combinations are refused, or there are
        more jobs than the limit.
    """
    with use_limits(limits_of(overrides)):
        check_jobs(count(overrides), "these overrides stand")
        keys = [key_of(override) for override in overrides]
        for key in keys:
            if keys.count(key) > 1:
                raise ConfigurationError(
                    f"'{key}' is named twice; give all its values at once: {key}=1,2"
                )
        swept = [
            str(override.key_or_group)
            for override in map(parsed, overrides)
            if override.is_sweep_override()
        ]
        for key in swept:
            if key.split(".")[0] in SINGLE_VALUED:
                raise ConfigurationError(
                    f"'{key}' takes one value in a sweep, whose combinations are compared with "
                    "each other; run one sweep a value"
                )
        unseeded = [override for override in overrides if key_of(override) != "seed"]
        combinations = [
            _combination(combination, swept, number)
            for number, combination in enumerate(expand(unseeded))
        ]
        seeds = [
            value_of(combination[0])
            for combination in expand(
                [override for override in overrides if override not in unseeded]
            )
            if combination
        ]
    usable = [job.config for job in combinations if job.failure is None]
    if not usable:
        raise ConfigurationError(failure_messages(combinations))
    split = str(usable[0]["split"]["name"])
    study = (
        name
        or "_".join(dict.fromkeys(str(config["estimator"]["name"]) for config in usable))
        + f"-{split}"
    )
    check_name(study, "--name")
    words = [*map(shlex.quote, content_overrides(overrides)), *(["--name", study] if name else [])]
    of_jobs = {repr(seed): seed for seed in seeds or [usable[0]["seed"]]}.values()
    jobs = [
        replace(job, config={**job.config, "seed": seed})
        for job in combinations
        for seed in of_jobs
    ]
    command = " ".join(["vehest sweep", *words])
    combination = Study(
        study,
        "sweep",
        study,
        parts={"": Part(split)},
        command=command,
        words=(*overrides, *(["--name", study] if name else [])),
    )
    return combination, {"": jobs}


def _combination(overrides: Sequence[str], swept: Sequence[str], number: int) -> Job:
    """The job of one combination of a sweep; one that is refused has a failure and no
    configuration.
    """
    values: dict[str, Value] = {}
    for override in overrides:
        if key_of(override) in swept:
            value = value_of(override)
            values[key_of(override)] = (
                value if isinstance(value, bool | int | float | str) else override.split("=", 1)[-1]
            )
    names = short_names(list(values))
    label = ", ".join(f"{names[key]}={override_text(value)}" for key, value in values.items())
    try:
        config = compose_config("eval", overrides)
        estimator = new_estimator(config["estimator"])
        settings_from_config(estimator.training_type, config["training"], "training")
        faults_of(config)
    except ConfigurationError as error:
        return Job({}, label or "this", values, number, failure_of(error))
    return Job(config, label or estimator.full_title, values, number)
