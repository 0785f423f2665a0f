"""Running a trained model on a new recording that has no reference channels."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vehest.alignment.checks import Finding, checks_of_recording
from vehest.data.channels import REFERENCE_SUFFIX
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.estimate import QUANTITIES, Estimate
from vehest.data.files import sha256_of, written_aside
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import Recording
from vehest.data.store import write_estimate
from vehest.data.transforms import OF_REFERENCES
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import DESCRIPTION, WEIGHTS, load_model, read_description
from vehest.run.artefacts import MANIFEST, Artefact, read_artefact
from vehest.run.calibrate import trust_of
from vehest.run.config import compose_config, key_of
from vehest.run.config_files import is_file_name
from vehest.run.downsample import transforms_of
from vehest.run.printing import complain, note
from vehest.run.train import STAGE as TRAIN
from vehest.sources.base import read_single
from vehest.trust.contract import estimate_guarded
from vehest.trust.health import domain_verdict
from vehest.trust.record import Trust, is_other_vehicle
from vehest.trust.verdict import reason_in_words

SUFFIXES = (".parquet", ".csv")
CONTRADICTIONS = ("sign", "unit")
"""Checks that prove a channel wrong by others."""
PRETRAINED = "pretrained"
"""Name of the model that comes with vehest, for cars that nobody has trained on."""


def pretrained_folder() -> Path:
    """Where the model that comes with vehest lies."""
    return Path(__file__).resolve().parents[1] / PRETRAINED


def pretrained_note() -> str:
    """What people should know of an estimate by the model that comes with vehest.

    Raises:
        MissingError: it is not installed.
        DataError: its description is damaged.
    """
    return " ".join(read_description(pretrained_folder()).about.note.split())


def find_model(name: str, output: Path, say: Callable[[str], None]) -> Path:
    """A model's folder, by path or by the start of its name in the output root; ``pretrained`` is the one that comes with vehest.

    Of several that fit the newest is taken.

    Args:
        name: path or start of the name.
        output: the output root.
        say: told which one was taken and which others fit.

    Raises:
        MissingError: there is none.
    """
    given = Path(name)
    if given.is_dir():
        return given
    if name == PRETRAINED:
        return pretrained_folder()
    found = sorted(folder for folder in (output / "train").glob(f"{given.name}*") if folder.is_dir() and not folder.name.startswith("."))
    if not found:
        known = sorted(folder.name for folder in (output / "train").glob("[!.]*"))
        listed = f" (there are: {', '.join(known[:8])}{', …' if len(known) > 8 else ''})" if known else "; train one first"
        raise MissingError(f"there is no model '{name}', neither a folder nor in '{output / 'train'}'{listed}")
    if len(found) > 1:
        found.sort(key=lambda folder: folder.stat().st_mtime_ns, reverse=True)
        others = f"{', '.join(folder.name for folder in found[1:4])}{f' and {len(found) - 4} more' if len(found) > 4 else ''}"
        say(f"'{name}' is taken for {found[0].name}, the newest; it could also be {others}")
    return found[0]


def estimate_file(words: Sequence[str], out: Path, *, strict: bool = False) -> dict[str, Any]:
    """Run a model on a recording and write the estimate.

    Args:
        words: a model, which may be left out, a recording and overrides of conf/estimate.yaml.
        out: table to write.
        strict: whether what speaks against a channel is an error; else it is printed as a warning.

    Returns:
        Figures of the estimate and a verdict.

    Raises:
        ConfigurationError: words or the file to write make no sense.
        MissingError: there is no such model or recording.
        DataError: the recording cannot be used.
    """
    n_names = 2 if len(words) > 1 and is_file_name(words[1]) else 1
    name, file, overrides = (words[0] if n_names == 2 else PRETRAINED), Path(words[n_names - 1]), words[n_names:]
    if n_names == 1 and file.is_dir():
        raise ConfigurationError(f"'{file}' is a folder; a recording is a file, and comes after the model: vehest estimate MODEL lap.csv")
    if out.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(f"'{out}' must end in {' or '.join(SUFFIXES)}")
    config = compose_config("estimate", overrides)
    folder = find_model(name, Path(config["output"]), note)
    model = load_model(folder)
    own_preparation = any(key_of(override).split(".")[0] == "downsample" for override in overrides)
    downsample = config["downsample"] if own_preparation else preparation_of(folder)
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file")
    if out.exists() and file.exists() and out.samefile(file):
        raise ConfigurationError(f"'{out}' is the recording itself; name another file")
    trust = trust_of(folder, Path(config["output"]))
    with use_limits(limits_from_config(config["limits"])):
        drive = read_table(file, overrides)
        findings = findings_for(drive, model, config["dataset"].get("accept") or ())
        if strict and findings:
            raise DataError(f"'{file}': {finding_in_words(findings[0])}")
        result = estimate_recording(model, drive, downsample, trust)
    for finding in findings:
        complain(f"warning: {finding_in_words(finding)}")
    write_estimate_table(result, out)
    remark = {"note": pretrained_note()} if name == PRETRAINED else {}
    said = {"verdict": verdict_of(result, drive, trust), "findings": [finding_in_words(finding) for finding in findings]}
    return {"out": str(out), "model": str(folder) if not remark else PRETRAINED, **summary_of(result), **said, **remark}


def model_artefact(folder: Path) -> Artefact:
    """A model as an artefact: that of the stage ``train``, or one that came without, such as `pretrained_folder` or what `save` wrote.

    Raises:
        MissingError: there is no model.
        DataError: its files are damaged.
        ConfigurationError: it is what another stage made.
    """
    if (folder / MANIFEST).is_file():
        artefact = read_artefact(folder)
        if artefact.stage != TRAIN:
            raise ConfigurationError(f"'{folder}' holds no model but what the stage '{artefact.stage}' made")
        return artefact
    about = read_description(folder)
    outputs = {name: sha256_of(folder / name) for name in (DESCRIPTION, WEIGHTS)}
    label = PRETRAINED if folder == pretrained_folder() else folder.resolve().name
    key = hashlib.sha256(json.dumps(outputs, sort_keys=True).encode()).hexdigest()
    config = {"estimator": dict(about.settings), "train": [], "validation": []}
    return Artefact(folder, TRAIN, label, key, "complete", outputs, config, {}, skipped=True)


def read_table(path: Path, overrides: Sequence[str] = (), *, references: bool = False) -> Recording:
    """Read a recording from its file, a table unless the data set says otherwise, as conf/estimate.yaml and overrides describe it.

    Args:
        path: the file.
        overrides: of conf/estimate.yaml.
        references: whether reference channels that the data set declares are read.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be used as it is.
        ConfigurationError: the file is of another format than the data set's.
    """
    config = compose_config("estimate", overrides)
    with use_limits(limits_from_config(config["limits"])):
        return _read_table(path, config["dataset"], references)


def _without_references(dataset: dict[str, Any]) -> dict[str, Any]:
    """A data set's options for a new drive, which needs no reference channels, whatever is declared; not validated yet."""
    channels, transforms = dataset.get("channels"), dataset.get("transforms")
    if isinstance(channels, dict):
        channels = {name: entry for name, entry in channels.items() if not str(name).endswith(REFERENCE_SUFFIX)}
    if isinstance(transforms, list | tuple):
        transforms = [entry for entry in transforms if not (isinstance(entry, dict) and str(entry.get("name")) in OF_REFERENCES)]
    changed = {"channels": channels or None, "transforms": transforms or None, "reference_point": None, "pose": None}
    return {key: value for key, value in dataset.items() if key not in changed} | {key: new for key, new in changed.items() if new}


def _read_table(path: Path, dataset: dict[str, Any], references: bool) -> Recording:
    if not references:
        dataset = _without_references(dataset)
    recording = read_single(dataset, path)
    accepted = set(dataset.get("accept") or [])
    for finding in checks_of_recording(recording):
        if finding.level == "error" and finding.check not in accepted:
            raise DataError(f"'{path}': channel '{finding.channel}': {finding.message} (or dataset.accept=[{finding.check}])")
    return recording


def estimate_recording(model: Estimator, recording: Recording, downsample: dict[str, Any], trust: Trust | None = None) -> Estimate:
    """Bring a recording to the model's rate and run the model on it, under the contract that holds online (`vehest.trust.contract`).

    Args:
        model: fitted.
        recording: with the channels that the model reads, at any rate from the model's upwards.
        downsample: method and transforms, as in `preparation_of`.
        trust: learnt with the model; without it there is neither band nor health of channels.

    Raises:
        DataError: a channel is missing, or the recording is sampled too slowly.
    """
    needed = prepared_recording(model, recording, downsample)
    estimate = estimate_guarded(model, needed.channels, needed, trust, elsewhere=is_other_vehicle(trust, recording))
    return require_estimate(model, recording, estimate)


def prepared_recording(model: Estimator, recording: Recording, downsample: dict[str, Any]) -> Recording:
    """The channels that a model reads, at its rate; see `estimate_recording`.

    Raises:
        DataError: a channel is missing, or the recording is sampled too slowly.
    """
    rate = model.settings.rate_hz
    needed = recording.select(model.channels) if all(name in recording for name in model.channels) else recording
    for name in model.channels:
        if name not in needed:
            raise DataError(
                f"recording '{recording.id}' has no channel '{name}', which '{model.name}' needs (it reads {', '.join(model.channels)})"
            )
    if recording.rate_hz < rate * (1 - 1e-9):
        raise DataError(
            f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, below the {rate:g} Hz that '{model.name}' works at"
        )
    for transform in transforms_of({"rate_hz": rate, **downsample}):
        needed = transform(needed)
    return needed


def require_estimate(model: Estimator, recording: Recording, estimate: Estimate) -> Estimate:
    """The estimate, if there is any.

    Raises:
        DataError: there is none, since the recording is too short.
    """
    if np.isnan(estimate["vy"]).all():
        raise DataError(f"recording '{recording.id}' lasts {recording.duration:.3g} s, too short for '{model.name}' to estimate anything")
    return estimate


def write_estimate_table(estimate: Estimate, path: Path) -> None:
    """Write an estimate as Parquet or CSV, by the file's ending.

    Raises:
        ConfigurationError: another ending.
        MissingError: it cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(f"'{path}' must end in {' or '.join(SUFFIXES)}")
    if path.suffix.lower() == ".parquet":
        write_estimate(estimate, path)
        return
    columns: dict[str, Any] = {"time": estimate.time, **estimate.channels}
    if "health" in columns:
        columns["health"] = columns["health"].astype(int)
        columns["health_reason"] = [reason_in_words(code) for code in columns["health_reason"]]
    frame = pd.DataFrame(columns)
    with written_aside(path) as aside:
        frame.to_csv(aside, index=False, lineterminator="\n")


def preparation_of(model_folder: Path) -> dict[str, Any]:
    """How a model's recordings were brought to its rate when it was trained; a new one must be prepared the same way."""
    return read_description(model_folder).about.downsample.as_plain()


def summary_of(estimate: Estimate) -> dict[str, Any]:
    """What an estimate holds, for people and scripts."""
    known = estimate["vy"][~pd.isna(estimate["vy"])]
    degrees = [math.degrees(value) for value in (estimate["sideslip"][~pd.isna(estimate["sideslip"])])] or [math.nan]
    said: dict[str, Any] = {
        "recording": estimate.recording_id,
        "estimator": estimate.estimator,
        "rate_hz": estimate.rate_hz,
        "samples": len(estimate),
        "estimated": len(known),
        "quantities": {name: QUANTITIES[name] for name in estimate.channels},
        "sideslip_deg": {"min": round(min(degrees), 3), "max": round(max(degrees), 3)},
    }
    if "band_sideslip" in estimate.channels:
        half = np.degrees(estimate["band_sideslip"][~np.isnan(estimate["band_sideslip"])])
        said["band_sideslip_deg"] = (
            {"median": round(float(np.median(half)), 3), "largest": round(float(half.max()), 3)} if len(half) else {}
        )
    return said


def findings_for(recording: Recording, model: Estimator, accepted: Sequence[str] = ()) -> list[Finding]:
    """What the checks find in the channels that a model reads, the gravest first.

    Args:
        recording: at its native rate.
        model: whose channels count.
        accepted: names of checks that are not to stop anything.

    Raises:
        DataError: channels that the model reads contradict each other in sign or unit, which no estimate survives.
    """
    read = [name for name in model.channels if name in recording]
    findings = [finding for finding in checks_of_recording(recording.select(read)) if finding.level != "note"] if read else []
    for finding in findings:
        if finding.check in CONTRADICTIONS and finding.check not in accepted:
            raise DataError(
                f"recording '{recording.id}': channels contradict each other: {finding.message} (or dataset.accept=[{finding.check}])"
            )
    return findings


def finding_in_words(finding: Finding) -> str:
    """What a check found, after the channel's name where it is about one."""
    return f"{finding.channel}: {finding.message}" if finding.channel else finding.message


def verdict_of(estimate: Estimate, recording: Recording, trust: Trust | None) -> str:
    """How far an estimate can be trusted, in a line."""
    if trust is None or trust.health is None:
        return "this model has no calibration: no band, and health from gaps and speeds alone"
    status, reasons = estimate["health"], estimate["health_reason"]
    outside = domain_verdict(trust.health, {name: recording[name] for name in trust.health.channels})
    bad = status[~np.isnan(estimate["vy"])] > 0
    found, counts = np.unique(reasons[(status > 0) & (reasons > 0) & ~np.isnan(estimate["vy"])], return_counts=True)
    worst = [reason_in_words(float(found[at])) for at in np.argsort(-counts)[:2]]
    said = f"valid in {100.0 * (1.0 - float(bad.mean())):.3g} % of the drive" + (f"; else: {', '.join(worst)}" if worst else "")
    return f"{outside}; {said}" if outside else said
