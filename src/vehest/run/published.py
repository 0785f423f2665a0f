"""Which published results are those of today's versions, configuration and raw files; neither models nor an output root are needed.

study -> `keys_of_study` -> provenance.json of results/STUDY -> `check_published` -> up to date, stale with its causes, or not known

A stage's own key holds digests of earlier artefacts. Those follow from versions, configuration and raw files, so the keys of a study are
the same as long as these are.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from vehest.data.errors import ConfigurationError, MissingError, VehestError
from vehest.data.split_files import dataset_names
from vehest.run.calibrate import code_of_calibration
from vehest.run.comparison import resampling_fact, training_facts
from vehest.run.config import Config
from vehest.run.config_files import find_pipeline, pipeline_names
from vehest.run.console import Messages
from vehest.run.downsample import code_of_downsampling
from vehest.run.evaluate import code_of_evaluation
from vehest.run.evaluate_faults import code_under_faults
from vehest.run.faults import all_of, faults_of
from vehest.run.ingest import PROSE, code_of_ingest, plan_ingest
from vehest.run.publishing import PROVENANCE, RESULTS, Published, published_in
from vehest.run.report import code_of_report
from vehest.run.runner import Runner
from vehest.run.signals import StopSignals
from vehest.run.study import Jobs, Study, content_overrides, jobs_of, read_study
from vehest.run.train import code_of_training
from vehest.sources.base import kind_of

Keys = dict[str, dict[str, str]]
"""What is made, for example ``scheme_1: train ksnn`` -> ``code``, ``configuration`` and, of an ingest, ``data`` -> version or hash."""

CODE, CONFIGURATION, DATA = "code", "configuration", "data"
CAUSES = (CODE, CONFIGURATION, DATA)
MOST_NAMED = 6

State = Literal["up to date", "stale", "not known"]


def keys_of_study(
    study: Study,
    jobs: Jobs,
    absent: Collection[str],
    dataset_config: Callable[[str, Config], Config],
    inputs_of: Callable[[Config], Mapping[str, str] | None],
) -> Keys:
    """What determines the results of a study.

    Args:
        study: with its parts or data sets.
        jobs: of the study.
        absent: parts or data sets that it goes on without.
        dataset_config: name of a data set and a job's configuration -> configuration of its ingest.
        inputs_of: configuration of an ingest -> name of a raw file, or of a library -> digest, or version; none where the raw files are
            missing, so that they are not compared.
    """
    keys: Keys = {}
    about: dict[str, Any] = {name: getattr(study, name) for name in ("study", "title", "about", "report")} | {"file": study.file.name}
    if study.datasets:
        configs = [job.config for job in jobs[""]]
        shown = [config for config in configs if config["dataset"]["name"] not in absent]
        keys |= {_ingest_name(config): _of_ingest(config, inputs_of(config)) for config in shown}
        about |= {"datasets": [_titled(config) for config in configs]}
        return keys | {"report": _of_report(study, about)}
    for part in study.parts:
        if part.name in absent:
            continue
        own = [job.config for job in jobs[part.name]]
        ingests = [dataset_config(name, own[0]) for name in dataset_names(own[0]["split"])]
        keys |= {_ingest_name(config): _of_ingest(config, inputs_of(config)) for config in ingests if _ingest_name(config) not in keys}
        keys |= {f"{part.name}: {name}" if part.name else name: entry for name, entry in _of_jobs(own)}
        about[f"part {part.name}"] = [part.title, *training_facts(own), resampling_fact(own), *(_titled(config) for config in ingests)]
    return keys | {"report": _of_report(study, about)}


def _of_jobs(configs: Sequence[Config]) -> Iterator[tuple[str, dict[str, str]]]:
    """Keys of a comparison, one an estimator and stage."""
    first = configs[0]
    faults = all_of(map(faults_of, configs))
    rates = sorted({float(config["estimator"]["rate_hz"]) for config in configs} | {float(first["evaluation"]["rate_hz"])})
    yield "split", {CONFIGURATION: _hash(first["split"])}
    yield "downsample", {CODE: code_of_downsampling(), CONFIGURATION: _hash([first["downsample"], rates])}
    for name in dict.fromkeys(str(config["estimator"]["name"]) for config in configs):
        jobs = [config for config in configs if config["estimator"]["name"] == name]
        trained = [[job["estimator"], {**job["training"], "checkpoint_seconds": None}, job["seed"]] for job in jobs]
        yield f"train {name}", {CODE: code_of_training(name), CONFIGURATION: _hash(trained)}
        if first["split"].get("validation"):
            yield f"calibrate {name}", {CODE: code_of_calibration(name), CONFIGURATION: _hash(None)}
        if not faults:
            yield f"evaluate {name}", {CODE: code_of_evaluation(name), CONFIGURATION: _hash(first["evaluation"])}
            continue
        conditions = [first["evaluation"], *map(asdict, faults)]
        yield f"evaluate {name}", {CODE: code_under_faults(code_of_evaluation(name)), CONFIGURATION: _hash(conditions)}


def _of_ingest(config: Config, inputs: Mapping[str, str] | None) -> dict[str, str]:
    dataset = config["dataset"]
    content = {key: value for key, value in dataset.items() if key not in PROSE}
    entry = {CODE: code_of_ingest(dataset), CONFIGURATION: _hash(content)}
    return entry if inputs is None else entry | {DATA: _hash(dict(inputs))}


def _of_report(study: Study, about: Mapping[str, Any]) -> dict[str, str]:
    return {CODE: code_of_report(study.report), CONFIGURATION: _hash(about)}


def _ingest_name(config: Config) -> str:
    return f"ingest {config['dataset']['name']}"


def _titled(config: Config) -> list[str]:
    dataset = config["dataset"]
    return [str(dataset["name"]), str(dataset.get("title", "")), kind_of(dataset)]


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Change:
    """Something that is not as it was when results were published.

    Args:
        what: is made of it, for example ``train ksnn``.
        cause: ``code``, ``configuration`` or ``data``.
    """

    what: str
    cause: str


@dataclass(frozen=True)
class Verdict:
    """What is known of a published study.

    Args:
        study: its name.
        state: of its results.
        changes: why they are stale.
        note: what could not be compared, or why nothing is known; may be empty.
    """

    study: str
    state: State
    changes: tuple[Change, ...] = ()
    note: str = ""

    def in_words(self) -> str:
        """One line."""
        words = []
        for cause in CAUSES:
            named = [change.what for change in self.changes if change.cause == cause]
            if named:
                more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
                words.append(f"{cause} ({', '.join(named[:MOST_NAMED])}{more})")
        why = [*([", ".join(words)] if words else []), *([self.note] if self.note else [])]
        return ": ".join([self.study, self.state, *(["; ".join(why)] if why else [])])


def check_published(names: Sequence[str], overrides: Sequence[str] = ()) -> list[Verdict]:
    """Compare what is recorded of published studies with what it would be today.

    Args:
        names: of studies, or pipelines by name or path; all that are published in ./results if there are none.
        overrides: ``root=FOLDER``, where raw files lie elsewhere than ``VEHEST_DATA`` says.

    Raises:
        ConfigurationError: an override that would change what comes out.
        MissingError: a name is neither a pipeline's nor that of a published study; or nothing is published.
    """
    if content_overrides(overrides):
        raise ConfigurationError(f"'{content_overrides(overrides)[0]}' changes what comes out, and what is published was made without it")
    pipelines: dict[str, Study | None] = {}
    for name in names:
        if find_pipeline(name) is None and (RESULTS / name / PROVENANCE).is_file():
            pipelines[name] = _pipeline_of(name)
        else:
            pipeline = read_study(name)
            pipelines[pipeline.study] = pipeline
    if not names:
        studies = sorted(file.parent.name for file in RESULTS.glob(f"*/{PROVENANCE}"))
        pipelines = {study: _pipeline_of(study) for study in studies}
    if not pipelines:
        raise MissingError(f"no study is published in '{RESULTS}'; run one whose pipeline says publish: true")
    return [_verdict(study, pipeline, overrides) for study, pipeline in pipelines.items()]


def _pipeline_of(study: str) -> Study | None:
    """The pipeline whose outcome goes to results/STUDY; the one of the same name first."""
    for name in sorted(pipeline_names(), key=lambda name: name != study):
        try:
            pipeline = read_study(name)
        except VehestError:
            continue
        if pipeline.study == study and pipeline.publish:
            return pipeline
    return None


def _verdict(study: str, pipeline: Study | None, overrides: Sequence[str]) -> Verdict:
    published = published_in(RESULTS / study)
    if published is None:
        return Verdict(study, "not known", note=f"there is nothing in '{RESULTS / study}' that vehest published")
    if not published.keys:
        return Verdict(study, "not known", note="published before keys were recorded; run it again")
    if pipeline is None:
        return Verdict(study, "not known", note=f"there is no pipeline that publishes '{study}'")
    try:
        return _compared(pipeline, jobs_of(pipeline, overrides), published)
    except ConfigurationError as error:
        return Verdict(study, "stale", (Change("pipeline", CONFIGURATION),), f"today it cannot be run ({error})")


def _compared(study: Study, jobs: Jobs, published: Published) -> Verdict:
    first = next(iter(jobs.values()))[0].config
    runner = Runner(Path(str(first["output"])), Messages(silent=True), StopSignals())
    missing: list[str] = []

    def inputs_of(config: Config) -> Mapping[str, str] | None:
        try:
            return plan_ingest(config).inputs
        except MissingError:
            missing.append(str(config["dataset"]["name"]))
            return None

    today = keys_of_study(study, jobs, published.absent, runner.dataset_config, inputs_of)
    changes = [*_changes(published.keys, today), *_found_since(study, jobs, published, runner)]
    note = f"raw files not here, not compared: {', '.join(missing)}" if missing else ""
    return Verdict(study.study, "stale" if changes else "up to date", tuple(changes), note)


def _changes(then: Mapping[str, Mapping[str, str]], today: Keys) -> list[Change]:
    changes = [Change(what, cause) for what in then if what in today for cause in CAUSES if _differs(then[what], today[what], cause)]
    changes += [Change(f"{what} added", CONFIGURATION) for what in today if what not in then]
    return changes + [Change(f"{what} removed", CONFIGURATION) for what in then if what not in today]


def _differs(then: Mapping[str, str], today: Mapping[str, str], cause: str) -> bool:
    if cause == DATA and DATA not in today:  # the raw files are not here
        return False
    return then.get(cause) != today.get(cause)


def _found_since(study: Study, jobs: Jobs, published: Published, runner: Runner) -> list[Change]:
    """Parts and data sets that a study had to go on without and could show today."""
    if study.datasets:
        wanted = {str(job.config["dataset"]["name"]): job.config for job in jobs[""]}
    else:
        wanted = {part.name: jobs[part.name][0].config for part in study.parts}
    found = []
    for name in sorted(set(wanted) & set(published.absent)):
        try:
            if study.datasets:
                plan_ingest(wanted[name])
            else:
                runner.look_for_files(wanted[name])
        except MissingError:
            continue
        found.append(Change(f"{name}, which was not here", DATA))
    return found
