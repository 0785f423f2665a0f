"""What a study's results are determined by, from configuration, code and raw files alone: no artefact is needed to know it.

A stage's own key holds digests of what earlier stages made. Those follow, stage by stage, from code, configuration and raw files, and so
these say for a whole study what its keys would say one by one: as long as all are the same, so are the keys.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from vehest.data.split_files import dataset_names
from vehest.run.calibrate import code_of_calibration
from vehest.run.comparison import resampling_fact, training_facts
from vehest.run.config import Config
from vehest.run.downsample import code_of_downsampling
from vehest.run.evaluate import code_of_evaluation
from vehest.run.evaluate_faults import code_under_faults
from vehest.run.faults import all_of, faults_of
from vehest.run.ingest import PROSE, code_of_ingest
from vehest.run.report import code_of_report
from vehest.run.train import code_of_training
from vehest.sources.base import kind_of

if TYPE_CHECKING:
    from vehest.run.study import Study

Keys = dict[str, dict[str, str]]
"""What is made, for example ``scheme_1: train ksnn`` -> ``code``, ``configuration`` and, of an ingest, ``data`` -> hash."""

CODE, CONFIGURATION, DATA = "code", "configuration", "data"


def keys_of_study(
    pipeline: Study,
    configs: Mapping[str, Sequence[Config]],
    absent: Collection[str],
    dataset_config: Callable[[str, Config], Config],
    inputs_of: Callable[[Config], Mapping[str, str] | None],
) -> Keys:
    """What determines the results of a study.

    Args:
        pipeline: the study.
        configs: its jobs.
        absent: parts or data sets that it goes on without.
        dataset_config: name of a data set and a job's configuration -> configuration of its ingest.
        inputs_of: configuration of an ingest -> name of a raw file, or of a library -> digest, or version; none where the raw files are
            not here, so that nothing is said of them.
    """
    keys: Keys = {}
    about: dict[str, Any] = {name: getattr(pipeline, name) for name in ("study", "title", "about", "report")} | {"file": pipeline.file.name}
    if pipeline.datasets:
        shown = [config for config in configs[""] if config["dataset"]["name"] not in absent]
        keys |= {_ingest_name(config): _of_ingest(config, inputs_of(config)) for config in shown}
        about |= {"datasets": [_titled(config) for config in configs[""]]}
        return keys | {"report": _of_report(pipeline, about)}
    for part in pipeline.parts:
        if part.name in absent:
            continue
        own = configs[part.name]
        ingests = [dataset_config(name, own[0]) for name in dataset_names(own[0]["split"])]
        keys |= {_ingest_name(config): _of_ingest(config, inputs_of(config)) for config in ingests if _ingest_name(config) not in keys}
        keys |= {f"{part.name}: {name}" if part.name else name: entry for name, entry in _of_jobs(own)}
        about[f"part {part.name}"] = [part.title, *training_facts(own), resampling_fact(own), *(_titled(config) for config in ingests)]
    return keys | {"report": _of_report(pipeline, about)}


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
        told = [first["evaluation"], *map(asdict, faults)]
        yield f"evaluate {name}", {CODE: code_under_faults(code_of_evaluation(name)), CONFIGURATION: _hash(told)}


def _of_ingest(config: Config, inputs: Mapping[str, str] | None) -> dict[str, str]:
    dataset = config["dataset"]
    told = {key: value for key, value in dataset.items() if key not in PROSE}
    entry = {CODE: code_of_ingest(dataset), CONFIGURATION: _hash(told)}
    return entry if inputs is None else entry | {DATA: _hash(dict(inputs))}


def _of_report(pipeline: Study, about: Mapping[str, Any]) -> dict[str, str]:
    return {CODE: code_of_report(pipeline.report), CONFIGURATION: _hash(about)}


def _ingest_name(config: Config) -> str:
    return f"ingest {config['dataset']['name']}"


def _titled(config: Config) -> list[str]:
    dataset = config["dataset"]
    return [str(dataset["name"]), str(dataset.get("title", "")), kind_of(dataset)]


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]
