"""Compares published results with today's versions, configuration and raw files, without models or
an output root.

study -> `keys_of_study` -> provenance.json of results/STUDY -> `check_published` -> up to date,
stale with its causes, or not known

A stage's own key holds digests of earlier artefacts. Those follow from versions, configuration and
raw files, which the keys of a study therefore hold instead. What of the configuration matters, each
stage says for both (`training_options`, `evaluation_options`); titles and descriptions are in no
key of a study.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.artefacts.keys import CONFIGURATION, Keys, changed_keys, changed_options, hash_of
from vehest.configuration.composition import Config
from vehest.configuration.files import find_pipeline, pipeline_names
from vehest.data.errors import (
    ConfigurationError,
    MissingError,
    VehestError,
    abbreviated,
    number_of,
)
from vehest.data.schema import validated
from vehest.data.split_files import dataset_names
from vehest.data.text_files import read_yaml
from vehest.data.transforms import Preparation
from vehest.run.console import Messages
from vehest.run.evaluate import evaluation_options
from vehest.run.evaluate_faults import faults_of, union_of_faults
from vehest.run.ingest import PROSE, plan_ingest
from vehest.run.publishing import PROVENANCE, RESULTS, Published, published_in
from vehest.run.runner import Stages
from vehest.run.signals import StopSignals
from vehest.run.study import Jobs, Study, content_overrides, jobs_of, read_study
from vehest.run.table_records import changes_of_tables
from vehest.run.train import estimator_rate, training_options
from vehest.run.versions import code_of, is_of_other_stages

CODE = "code"  # cause of a change: versions of code
DATA = "data"  # cause of a change: raw files
CAUSES = (CODE, CONFIGURATION, DATA)  # possible causes of a change of a published study
MAX_NAMED = 6  # largest number of changes of a cause that are named; further ones are counted
STALE_LIST = "stale.yaml"
"""File in results/: studies that may still be stale, each with the reason and what will end it."""


def keys_of_study(
    study: Study,
    jobs: Jobs,
    absent: Collection[str],
    stages: Stages,
    inputs: Mapping[str, Mapping[str, str]],
) -> Keys:
    """Keys of everything that determines the results of a study.

    Parameters
    ----------
    study : Study
        The pipeline.
    jobs : mapping
        Part -> its jobs, before rates are lowered.
    absent : collection of str
        Parts or data sets that the study goes on without.
    stages : Stages
        Composes configurations of data sets.
    inputs : mapping
        Data set -> digests of its raw files; those that are not here have no DATA.

    Returns
    -------
    Keys
        ``ingest DATASET``, ``[PART: ]STAGE [ESTIMATOR]`` and ``report``, each -> CODE,
        CONFIGURATION and DATA as far as they apply.
    """
    ingests = _ingests(study, jobs, absent, stages)
    keys: Keys = {}
    for name, config in ingests.items():
        content = {key: value for key, value in config["dataset"].items() if key not in PROSE}
        keys[f"ingest {name}"] = {
            CODE: code_of("ingest", config["dataset"]["source"]),
            CONFIGURATION: _hash(content),
        }
        if name in inputs:
            keys[f"ingest {name}"][DATA] = _hash(dict(inputs[name]))
    for part in (name for name in study.parts if name not in absent):
        configs = [job.config for job in jobs[part]]
        keys |= {
            f"{part}: {name}" if part else name: entry for name, entry in _of_jobs(configs, stages)
        }
    return keys | {"report": {CODE: code_of("report", study.report)}}


def _ingests(
    study: Study, jobs: Jobs, absent: Collection[str], stages: Stages
) -> dict[str, Config]:
    """Data set -> configuration of its ingest, of all parts that are not absent."""
    configs = {name: config for name, config in _firsts(study, jobs).items() if name not in absent}
    if study.datasets:
        return configs
    return {
        name: stages.dataset_config(name, config)
        for config in configs.values()
        for name in dataset_names(config["split"])
    }


def _firsts(study: Study, jobs: Jobs) -> dict[str, Config]:
    """Part, or data set, -> configuration of its first job."""
    return {name: jobs[name][0].config for name in study.parts} or {
        str(job.config["dataset"]["name"]): job.config for job in jobs[""]
    }


def _of_jobs(configs: Sequence[Config], stages: Stages) -> Iterator[tuple[str, dict[str, str]]]:
    """Keys of a comparison: pairs of name and key, one for each estimator and stage."""
    first = configs[0]
    faults = union_of_faults(map(faults_of, configs))
    protocol = stages.protocol(first, dataset_names(first["split"]))
    rates = sorted({*map(estimator_rate, configs), protocol.rate_hz})
    preparation = changed_options(
        validated(Preparation, first["downsample"], "", error=ConfigurationError)
    )
    yield "split", {CONFIGURATION: _hash(first["split"])}
    yield (
        "downsample",
        {CODE: code_of("downsample"), CONFIGURATION: _hash([preparation, rates])},
    )
    for name in dict.fromkeys(str(config["estimator"]["name"]) for config in configs):
        trained = sorted(
            hash_of(training_options(config))
            for config in configs
            if config["estimator"]["name"] == name
        )
        yield f"train {name}", {CODE: code_of("train", name), CONFIGURATION: _hash(trained)}
        if first["split"].get("validation"):
            yield (
                f"calibrate {name}",
                {CODE: code_of("calibrate", name), CONFIGURATION: _hash(None)},
            )
        yield (
            f"evaluate {name}",
            {
                CODE: code_of("evaluate", name, faults=bool(faults)),
                CONFIGURATION: _hash(evaluation_options(protocol, faults)),
            },
        )


def _hash(content: Any) -> str:
    """First sixteen hexadecimal digits of the hash of plain values."""
    return hash_of(content)[:16]


def describe_verdict(verdict: Mapping[str, Any]) -> str:
    """One line on the state of a published study: up to date, stale with its causes, or not
    known.
    """
    words = []
    for cause in CAUSES:
        named = [change["what"] for change in verdict["changes"] if change["cause"] == cause]
        if named:
            words.append(f"{cause} ({abbreviated(named, MAX_NAMED)})")
    may_be = verdict.get("may_be_stale")
    listed = f"may be until {may_be}" if may_be else ""
    failure = verdict["failure"] if may_be else ""
    parts = (", ".join(words), verdict["note"], listed, failure)
    why = "; ".join(dict.fromkeys(part for part in parts if part))
    return ": ".join(part for part in (verdict["study"], verdict["state"], why) if part)


def check_published(
    names: Sequence[str], overrides: Sequence[str], messages: Messages
) -> list[dict[str, Any]]:
    """Compare the recorded keys of published studies with those of today's code, configuration and
    raw files; ``messages`` name a study that takes long.

    Returns a ``study`` each with its ``state``, up to date, stale or not known, ``changes``, each
    with ``what`` (``train ksnn``) and one of `CAUSES`, and a ``note`` on what was not compared, or
    why the state is not known.

    Parameters
    ----------
    names : sequence of str
        Pipelines or published studies; none for all that are published.
    overrides : sequence of str
        Of where raw files come from and results go alone.
    messages : Messages
        Prints the study that takes long.

    Raises
    ------
    ConfigurationError
        An override that would change results.
    MissingError
        A name of no pipeline or published study.
    """
    if content_overrides(overrides):
        raise ConfigurationError(
            f"'{content_overrides(overrides)[0]}' changes the results, which are published without "
            "overrides"
        )
    published = sorted(file.parent.name for file in RESULTS.glob(f"*/{PROVENANCE}"))
    if not (names or published):
        raise MissingError(
            f"no study is published in '{RESULTS}'; run one whose pipeline says publish: true"
        )
    pipelines: dict[str, Study | None] = {}
    for name in names or published:
        if not names or (find_pipeline(name) is None and name in published):
            pipelines[name] = _pipeline_of(name)
        else:
            pipeline = read_study(name)
            pipelines[pipeline.study] = pipeline
    verdicts = []
    for study, declared_pipeline in pipelines.items():
        with messages.running("check", study):
            verdicts.append(_verdict(study, declared_pipeline, overrides))
    return verdicts


def check_listed(overrides: Sequence[str], messages: Messages) -> list[dict[str, Any]]:
    """Compare all published studies as `check_published`, and those that are not up to date with
    the list of those that may be stale.

    Returns the same, each with ``failure``, empty for a study as it should be. A listed study with
    keys of other stages than today's is stale without a look at its configuration, which takes a
    minute for all.

    Parameters
    ----------
    overrides : sequence of str
        As of `check_published`.
    messages : Messages
        As of `check_published`.
    """
    reasons = _stale_list()
    verdicts = []
    settled = set()
    for study in sorted(reasons):
        published = published_in(RESULTS / study)
        if published is None:
            note = f"nothing is published, which does not end its entry in '{RESULTS / STALE_LIST}'"
            verdicts.append(_outcome(study, "not known", note=note) | {"failure": note})
        elif changes := [
            (name, CODE)
            for name, entry in published.keys.items()
            if is_of_other_stages(entry.get(CODE, ""))
        ]:
            verdicts.append(_outcome(study, "stale", changes))
        else:
            continue
        settled.add(study)
    names = {file.parent.name for file in RESULTS.glob(f"*/{PROVENANCE}")} - settled
    for verdict in (
        check_published(sorted(names), overrides, messages) if names or not settled else ()
    ):
        is_incomplete = verdict["n_not_trained"] > 0
        is_current = verdict["state"] == "up to date"
        is_listed = verdict["study"] in reasons
        if is_incomplete and not is_listed:
            verdict["failure"] = f"it is incomplete, and not in '{RESULTS / STALE_LIST}'"
        elif is_current and is_listed and not is_incomplete:  # else the list says what completes it
            verdict["failure"] = f"it is up to date; remove it from '{RESULTS / STALE_LIST}'"
        elif not is_current and not is_listed:
            verdict["failure"] = f"it is not in '{RESULTS / STALE_LIST}'"
        verdicts.append(verdict)
    for verdict in verdicts:
        verdict.setdefault("failure", "")
        verdict["may_be_stale"] = reasons.get(verdict["study"], "")
    return sorted(verdicts, key=lambda verdict: str(verdict["study"]))


def _stale_list() -> dict[str, str]:
    """Content of `STALE_LIST`: study -> why it may still be stale.

    Raises `ConfigurationError` for anything but text by study.
    """
    file = RESULTS / STALE_LIST
    content = read_yaml(file) if file.is_file() else {}
    if not isinstance(content, dict) or not all(
        isinstance(study, str) and isinstance(reason, str) and reason
        for study, reason in content.items()
    ):
        raise ConfigurationError(f"'{file}' must give a reason for each study")
    return content


def _pipeline_of(study: str) -> Study | None:
    """The pipeline that is published in results/STUDY, that of the same name first; None where
    there is none.
    """
    for name in sorted(pipeline_names(), key=lambda name: name != study):
        try:
            pipeline = read_study(name)
        except VehestError:
            if name == study:
                raise
            continue  # a broken file of another study
        if pipeline.study == study and pipeline.publish:
            return pipeline
    return None


def _verdict(study: str, pipeline: Study | None, overrides: Sequence[str]) -> dict[str, Any]:
    """Compare one published study: its tables where a command outside pipelines made them, else its
    pipeline. Returns state, changes and note.
    """
    published = published_in(RESULTS / study)
    state = "not known"
    changes = [("pipeline", CONFIGURATION)]
    note = ""
    if published is None:
        changes = []
        note = f"there is nothing in '{RESULTS / study}' that vehest published"
    elif published.tables:
        changes, note = changes_of_tables(
            published.tables, published.keys, RESULTS / study, overrides
        )
        complete = not any(record.without_keys for record in published.tables.values())
        state = "stale" if changes else "up to date" if complete else "not known"
    elif not published.keys:
        changes = []
        note = "published before keys were recorded; run it again"
    elif pipeline is None:
        changes = []
        note = f"there is no pipeline that publishes '{study}'"
    else:
        try:
            changes, note = _changes(pipeline, jobs_of(pipeline, overrides), published)
        except ConfigurationError as error:
            note = f"today it cannot be run ({error})"
        state = "stale" if changes else "up to date"
    n_not_trained = 0 if published is None else published.n_not_trained
    if n_not_trained:
        missing = f"published without {number_of(n_not_trained, 'training')}"
        note = "; ".join(filter(None, (missing, note)))
    return _outcome(study, state, changes, note, n_not_trained)


def _outcome(
    study: str,
    state: str,
    changes: Sequence[tuple[str, str]] = (),
    note: str = "",
    n_not_trained: int = 0,
) -> dict[str, Any]:
    """The result of a comparison as plain values."""
    return {
        "study": study,
        "state": state,
        "changes": [{"what": name, "cause": cause} for name, cause in changes],
        "note": note,
        "n_not_trained": n_not_trained,
    }


def _changes(study: Study, jobs: Jobs, published: Published) -> tuple[list[tuple[str, str]], str]:
    """Pairs of what differs from when results were published and the cause, and a note on what was
    not compared.
    """
    stages = Stages(
        Path(str(next(iter(jobs.values()))[0].config["output"])),
        Messages(quiet=True),
        StopSignals(),
    )
    ingests = _ingests(study, jobs, published.absent, stages)
    inputs = {}
    for name, config in ingests.items():
        with suppress(MissingError):
            inputs[name] = plan_ingest(config).inputs
    missing = [name for name in ingests if name not in inputs]
    today = keys_of_study(study, jobs, published.absent, stages, inputs)
    changes = changed_keys(published.keys, today)
    parts = _firsts(study, jobs)
    for name in sorted(parts.keys() & set(published.absent)):  # that the study had to go on without
        with suppress(MissingError):
            stages.look_for_files(parts[name]) if study.parts else plan_ingest(parts[name])
            changes.append((f"{name}, which was not here", DATA))
    return changes, f"data not checked, raw files not here: {', '.join(missing)}" if missing else ""
