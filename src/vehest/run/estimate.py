"""Runs a trained model on a new recording that has no reference channels.

model, recording -> checks -> the model's rate -> estimate with bands and health -> table, figures and a verdict
"""

from __future__ import annotations

import csv
import hashlib
import json
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.checks import checks_of_recording, merged_findings, refuse_errors
from vehest.alignment.findings import Finding
from vehest.constants import GRAVITY, FloatArray
from vehest.data.channels import REFERENCE_SUFFIX
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.estimate import IN_DEGREES, QUANTITIES, Estimate, number_cell, time_cell
from vehest.data.files import sha256_of, written_aside
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import UNNAMED_VEHICLE, Recording, joined
from vehest.data.store import estimate_columns, with_degrees, write_estimate_parts
from vehest.data.transforms import OF_REFERENCES
from vehest.estimators.base import Estimator
from vehest.estimators.kernels.compiling import has_to_compile
from vehest.estimators.model_files import DESCRIPTION, WEIGHTS, load_model, read_description
from vehest.run.artefacts import MANIFEST, Artefact, read_artefact
from vehest.run.calibrate import trust_of
from vehest.run.car_record import adapted, read_car
from vehest.run.config import compose_config, key_of, value_of
from vehest.run.config_files import is_file_name
from vehest.run.downsample import resampled, resampled_parts
from vehest.run.estimate_log import LOGS, check_log_name, write_log
from vehest.run.estimate_summary import point_of_estimate
from vehest.run.printing import complain, counted, note
from vehest.run.train import STAGE as TRAIN
from vehest.sources.base import car_of, read_single, source_of_file
from vehest.trust.contract import GuardedRun
from vehest.trust.health import SLOW_KERNEL, domain_verdict, outside_domain, reason_in_words
from vehest.trust.record import Trust, describe_band, is_other_vehicle

SLOWEST_LOG_HZ = 5.0  # of a log that is brought to a faster model; a slower one misses the motion
SUFFIXES = (".parquet", ".csv")
SHARPEST_TURN = (
    0.8  # wheelbase over radius that a tenth of a drive may exceed; 0.42 on real cars that drift
)
LARGEST_FROUDE = 400.0  # vx² over gravity and wheelbase that a hundredth of a drive may exceed; 170 on real race cars
CONTRADICTIONS = ("sign", "unit")  # checks that compare channels with each other
PRETRAINED = "pretrained"
SELF_CALIBRATING = "self_calibrating"
"""Names of the models that come with vehest, for cars without a model of their own: a network, and the filter around it."""
WITH_VEHEST = {PRETRAINED: "pretrained", SELF_CALIBRATING: "pretrained_filter"}
SHIPPED_NOTES = {
    PRETRAINED: "trained on simulated cars, not on yours; the KS-NN is patented by its authors (PCT/IT2023/050058); "
    "errors and limits: docs/estimators/ksnn.md",
    SELF_CALIBRATING: "the network inside was trained on simulated cars, not on yours; the KS-NN is patented by its "
    "authors (PCT/IT2023/050058); errors and limits: docs/estimators/self_calibrating.md",
}
"""What users of these models should know, in one line; their model.yaml says more."""


def pretrained_folder(name: str = PRETRAINED) -> Path:
    """The folder of a model that comes with vehest."""
    return Path(__file__).resolve().parents[1] / WITH_VEHEST[name]


def find_model(name: str, output: Path, say: Callable[[str], None]) -> Path:
    """A model's folder, by path or by the start of its name in the output root; those of `WITH_VEHEST` come with vehest.

    Of several models the newest is taken, with a remark to ``say``; `MissingError` where there is none.
    """
    given = Path(name)
    if given.is_dir():
        return given
    models = [folder for folder in sorted(output.glob("train/[!.]*")) if folder.is_dir()]
    found = [folder for folder in models if folder.match(f"{given.name}*")]
    if name in WITH_VEHEST:
        if found:
            say(
                f"'{name}' is the model that comes with vehest; yours are {counted([folder.name for folder in found])}"
            )
        return pretrained_folder(name)
    if not found:
        known = (
            f"'{output / 'train'}', which contains {counted([folder.name for folder in models])}"
        )
        raise MissingError(
            f"there is no model '{name}', neither a folder nor in {known}; train one first"
        )
    newest = max(found, key=lambda folder: folder.stat().st_mtime_ns)
    if len(found) > 1:
        say(
            f"'{name}' is assumed to be {newest.name}, the newest of {counted([folder.name for folder in found])}"
        )
    return newest


def open_model(
    name: str, output: Path, say: Callable[[str], None]
) -> tuple[Path, Estimator, Trust | None]:
    """A model's folder, found as `find_model` does, the model with the preparation of its training data, and its calibration."""
    folder = find_model(name, output, say)
    if (folder / MANIFEST).is_file():
        read_artefact(folder)  # raises `DataError` where a file was changed after it was made
    model = load_model(folder)
    model.preparation = preparation_of(folder)
    trust = trust_of(folder, output, say)
    if trust is not None:
        trust.check_fit(model)
    return folder, model, trust


def model_for_car(
    name: str,
    settings: Mapping[str, Any],
    overrides: Sequence[str],
    say: Callable[[str], None],
) -> tuple[Path, Estimator, Trust | None, bool]:
    """A model as `open_model` finds it, for the car of the data set that overrides of conf/estimate.yaml name, without a recording.

    Returns
    -------
    tuple
        Folder, model, calibration, and whether bands are for another car: by the answer ``same_vehicle``,
        by values of the car, and by its name where a data set is named.
    """
    config = compose_config("estimate", overrides)
    folder, model, trust = open_model(name, Path(config["output"]), say)
    dataset = config["dataset"]
    car = car_of(dataset)
    same_vehicle = same_vehicle_from_config(config)
    names_dataset = any(key_of(override) == "dataset" for override in overrides)
    is_other = False
    if names_dataset or same_vehicle is not None:
        vehicle = vehicle_of(dataset)
        is_other = is_other_vehicle(trust, vehicle, same_vehicle, car)
    elif trust is not None and trust.bands is not None:
        is_other = bool(trust.bands.difference_to(car))
    model, trust, remarks = adapted(model, trust, car, settings)
    for remark in remarks:
        say(remark)
    return folder, model, trust, is_other


def vehicle_of(dataset: Mapping[str, Any]) -> str:
    """The name of a data set's car; `UNNAMED_VEHICLE` where it has none."""
    vehicle = dataset.get("vehicle")
    return vehicle if isinstance(vehicle, str) and vehicle else UNNAMED_VEHICLE


def estimate_file(
    words: Sequence[str], out: Path, *, strict: bool = False, car: Path | None = None
) -> dict[str, Any]:
    """Run a model on a recording and write the estimate to ``out``; returns its figures and a verdict.

    Args:
        words: a model, which may be left out, a recording and overrides of conf/estimate.yaml; ``estimator.KEY=VALUE``: settings of the
            self-calibrating filter.
        out: table to write, or the log with further channels (`estimate_log`).
        strict: whether findings in the channels are an error; else they are printed as warnings.
        car: record of `vehest identify` to start from.

    Raises:
        VehestError: model, recording or table cannot be used.
    """
    n_names = 2 if len(words) > 1 and is_file_name(words[1]) else 1
    name = words[0] if n_names == 2 else SELF_CALIBRATING
    file = Path(words[n_names - 1])
    overrides = words[n_names:]
    if n_names == 1 and file.is_dir():
        raise ConfigurationError(
            f"'{file}' is a folder; a recording is a file, and comes after the model: vehest estimate MODEL lap.csv"
        )
    if out.suffix.lower() in LOGS:
        check_log_name(file, out)
    else:
        _check_table_name(out)
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file")
    if out.exists() and file.exists() and out.samefile(file):
        raise ConfigurationError(f"'{out}' is the recording itself; name another file")
    settings, overrides = split_settings(overrides)
    config = compose_config("estimate", overrides)
    folder, model, trust = open_model(name, Path(config["output"]), note)
    with use_limits(limits_from_config(config["limits"])):
        dataset = _without_references(config["dataset"])
        accepted = dataset.get("accept") or ()
        source = source_of_file(dataset, file)
        parts = (
            (part, refuse_errors(part, accepted, f"'{file}'")) for part in source.file_parts(file)
        )
        first, known = next(parts)
        remarks: list[str] = []
        if name == SELF_CALIBRATING and "ax" not in first and "measured_ax" not in settings:
            settings["measured_ax"] = False
            remarks.append("there is no channel ax: estimator.measured_ax=false")
        record = None if car is None else read_car(car)
        model, trust, of_car = adapted(model, trust, first.car, settings, record)
        remarks += of_car
        if is_training_recording(folder, first.id):
            remarks.append(
                f"'{name}' was trained on this recording: its errors here are no test of it"
            )
        if has_to_compile(model.slow_kernel) or (trust is not None and has_to_compile(SLOW_KERNEL)):
            note("compiling once, about 20 s")
        if any(key_of(override).split(".")[0] == "downsample" for override in overrides):
            model.preparation = config["downsample"]
        same_vehicle = same_vehicle_from_config(config)
        band = describe_band(trust, first.vehicle, same_vehicle, first.car)
        elsewhere = is_other_vehicle(trust, first.vehicle, same_vehicle, first.car)
        if SLOWEST_LOG_HZ <= first.rate_hz < (1.0 - 1e-9) * model.settings.rate_hz:
            remarks.append(
                f"the recording is sampled at {first.rate_hz:g} Hz and brought to the "
                f"{model.settings.rate_hz:g} Hz of '{name}'; nothing faster than it is in the estimate"
            )
        run = GuardedRun(model, trust, elsewhere=elsewhere)
        log = out.suffix.lower() in LOGS
        report = _Report(model, trust, accepted, f"'{file}'" if strict else None)
        drive = report.checked(chain([(first, known)], parts))
        if log or not run.takes_parts:
            first = joined(list(drive))
            drive = iter([first])
        needed = resampled_parts(
            (part.select(model.channels) for part in drive),
            model.settings.rate_hz,
            model.preparation,
            slowest_hz=SLOWEST_LOG_HZ,
        )
        estimates = report.counted(_estimates(run, needed))
        if log:
            (estimate,) = estimates
            write_log(estimate, first, file, out)
        else:
            del first  # a part that is done needs no memory
            write_estimate_table(estimates, out, band)
    for remark in remarks:
        note(remark)
    findings = [finding_in_words(finding) for finding in merged_findings(report.findings)]
    for finding in findings:
        complain(f"warning: {finding}")
    return {
        "out": str(out),
        "model": name if name in WITH_VEHEST else str(folder),
        **({"car": str(car)} if car is not None else {}),
        **report.summary(),
        "point": point_of_estimate(model, folder),
        **({"band": band} if band else {}),
        "verdict": report.verdict(),
        "findings": findings,
        **({"note": SHIPPED_NOTES[name]} if name in SHIPPED_NOTES else {}),
    }


def _estimates(run: GuardedRun, parts: Iterable[Recording]) -> Iterator[Estimate]:
    """The estimates of parts, each made by a thread, in compiled code, while the next part is read, checked and resampled."""
    with ThreadPoolExecutor(1) as thread:
        going: list[Future[Estimate]] = []
        for part in parts:
            going.append(thread.submit(copy_context().run, run, part.channels, part))
            if len(going) > 1:
                yield going.pop(0).result()
        yield going.pop().result()


def is_training_recording(model_folder: Path, recording_id: str) -> bool:
    """Whether a model was trained or validated on some part of a recording."""
    about = read_description(model_folder).about
    return any(
        span.startswith((f"{recording_id} [", f"{recording_id} ("))
        for span in (*about.trained_on, *about.validated_on)
    )


def split_settings(overrides: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Settings of an estimator among overrides, ``estimator.KEY=VALUE``, and the others; raises `ConfigurationError` on bad syntax."""
    own = [override for override in overrides if key_of(override).startswith("estimator.")]
    return {key_of(one).partition(".")[2]: value_of(one) for one in own}, [
        one for one in overrides if one not in own
    ]


def model_artefact(folder: Path) -> Artefact:
    """A model as an artefact of the stage ``train``, also where it has no manifest, such as `pretrained_folder` or a saved model."""
    if (folder / MANIFEST).is_file():
        artefact = read_artefact(folder)
        if artefact.stage != TRAIN:
            raise ConfigurationError(
                f"'{folder}' holds no model but an artefact of the stage '{artefact.stage}'"
            )
        return artefact
    about = read_description(folder)
    outputs = {name: sha256_of(folder / name) for name in (DESCRIPTION, WEIGHTS)}
    key = hashlib.sha256(json.dumps(outputs, sort_keys=True).encode()).hexdigest()
    config = {"estimator": dict(about.settings), "train": [], "validation": []}
    return Artefact(
        folder, TRAIN, folder.resolve().name, key, "complete", outputs, config, {}, skipped=True
    )


def preparation_of(model_folder: Path) -> dict[str, Any]:
    """Method and transforms of a model's training data; new recordings must be prepared the same way."""
    return read_description(model_folder).about.downsample.as_plain()


def read_table(path: Path, overrides: Sequence[str] = (), *, references: bool = False) -> Recording:
    """Read a recording from its file, a table unless the data set says otherwise, as conf/estimate.yaml and overrides describe it.

    Raises what `read_single` does, and `DataError` where a check finds an error that the data set does not accept.
    """
    config = compose_config("estimate", overrides)
    dataset = config["dataset"] if references else _without_references(config["dataset"])
    with use_limits(limits_from_config(config["limits"])):
        recording = read_single(dataset, path)
        refuse_errors(recording, dataset.get("accept") or (), f"'{path}'")
    return recording


def _without_references(dataset: dict[str, Any]) -> dict[str, Any]:
    """Options of a data set without its reference channels; not validated yet."""
    channels = dataset.get("channels")
    transforms = dataset.get("transforms")
    if isinstance(channels, dict):
        channels = {
            name: entry
            for name, entry in channels.items()
            if not str(name).endswith(REFERENCE_SUFFIX)
        }
    if isinstance(transforms, list | tuple):
        transforms = [
            entry
            for entry in transforms
            if not (isinstance(entry, dict) and str(entry.get("name")) in OF_REFERENCES)
        ]
    changed = {
        "channels": channels or None,
        "transforms": transforms or None,
        "reference_point": None,
        "pose": None,
    }
    return {key: value for key, value in dataset.items() if key not in changed} | {
        key: new for key, new in changed.items() if new
    }


def finding_in_words(finding: Finding) -> str:
    """A finding, with the channel that it is about."""
    return f"{finding.channel}: {finding.message}" if finding.channel else finding.message


def findings_of(
    recording: Recording,
    model: Estimator,
    accepted: Sequence[str],
    known: Sequence[Finding] | None = None,
) -> list[Finding]:
    """Findings in the channels that a model reads, given those of all channels, if they are known; raises `DataError` on contradictions."""
    read = [name for name in model.channels if name in recording]
    if known is not None and (
        set(read) == set(recording.channels) or all(finding.level == "note" for finding in known)
    ):
        findings = list(known)
    else:
        findings = checks_of_recording(recording.select(read)) if read else []
    findings = [finding for finding in findings if finding.level != "note"]
    for finding in findings:
        if finding.check in CONTRADICTIONS and finding.check not in accepted:
            what = f"channels contradict each other: {finding.message}"
            raise DataError(
                f"recording '{recording.id}': {what} (or dataset.accept=[{finding.check}])"
            )
    return findings + wheelbase_findings(recording, getattr(model.settings, "wheelbase", None))


def wheelbase_findings(recording: Recording, wheelbase: float | None) -> list[Finding]:
    """A finding where a drive above 1 m/s turns too sharply, or is too fast, for any car of a wheelbase [m]; None: not known."""
    if wheelbase is None or not {"vx", "yaw_rate"} <= set(recording.channels):
        return []
    speed = recording["vx"]
    yaw_rate = np.abs(recording["yaw_rate"])
    moving = (speed > 1.0) & np.isfinite(yaw_rate)
    if not moving.any():
        return []
    speed, turn = speed[moving], float(np.quantile(yaw_rate[moving] / speed[moving], 0.9))
    what = f"the drive does not fit a wheelbase of {wheelbase:g} m: a car of that size"
    remedy = "give estimator.wheelbase"
    if wheelbase * turn > SHARPEST_TURN:
        return [
            Finding(
                "warning",
                "wheelbase",
                "",
                f"{what} does not turn within {1.0 / turn:.2g} m, as in a tenth of it; {remedy}",
            )
        ]
    fast = float(np.quantile(speed, 0.99))
    if fast**2 > LARGEST_FROUDE * GRAVITY * wheelbase:
        return [
            Finding("warning", "wheelbase", "", f"{what} does not reach {fast:.0f} m/s; {remedy}")
        ]
    return []


def same_vehicle_from_config(config: Mapping[str, Any]) -> bool | None:
    """Whether the user says that a recording is of the car of the calibration; raises `ConfigurationError`."""
    answer = config.get("same_vehicle")
    if answer is not None and not isinstance(answer, bool):
        raise ConfigurationError(f"same_vehicle must be true, false or null, not {answer!r}")
    return answer


def estimate_recording(
    model: Estimator,
    recording: Recording,
    trust: Trust | None = None,
    same_vehicle: bool | None = None,
) -> Estimate:
    """Bring a recording to the model's rate and run the model on it, guarded as online (`vehest.trust.contract`); raises `DataError`."""
    needed = prepared_recording(model, recording)
    elsewhere = is_other_vehicle(trust, recording.vehicle, same_vehicle, recording.car)
    run = GuardedRun(model, trust, elsewhere=elsewhere)
    return require_estimate(model, recording, run(needed.channels, needed))


def prepared_recording(
    model: Estimator, recording: Recording, rate_hz: float | None = None
) -> Recording:
    """The channels that a model reads, at its rate or another one [Hz]; raises as `estimate_recording` does."""
    return resampled(
        recording.select(model.channels), rate_hz or model.settings.rate_hz, model.preparation
    )


def require_estimate(model: Estimator, recording: Recording, estimate: Estimate) -> Estimate:
    """The estimate; raises `DataError` where it is empty, since the recording is too short."""
    if np.isnan(estimate["vy"]).all():
        raise _too_short(model, recording.id, recording.duration)
    return estimate


def _too_short(model: Estimator, recording_id: str, seconds: float) -> DataError:
    return DataError(
        f"recording '{recording_id}' lasts {seconds:.3g} s, too short for '{model.name}' to estimate anything"
    )


def write_estimate_table(parts: Iterable[Estimate], path: Path, band: str = "") -> None:
    """Write an estimate, of parts that follow one another, as Parquet or CSV, by the file's ending.

    Units are those of `COLUMN_UNITS`. CSV has six significant digits, times to a microsecond.
    ``band`` says what calibrated the bands, in the metadata of Parquet.
    """
    _check_table_name(path)
    if path.suffix.lower() == ".parquet":
        write_estimate_parts(parts, path, band)
        return
    tables = map(_text_columns, estimate_columns(parts))
    first = next(tables)
    with written_aside(path) as aside, open(aside, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(first)
        for columns in chain([first], tables):
            writer.writerows(zip(*(columns[name] for name in first), strict=True))


def _text_columns(columns: Mapping[str, FloatArray]) -> dict[str, list[Any]]:
    """Cells of a table of text, with the reasons of health in words."""
    cells: dict[str, list[Any]] = {"time": [time_cell(time) for time in columns["time"].tolist()]}
    quantities = [name for name in columns if name in QUANTITIES]
    cells |= {name: [number_cell(value) for value in columns[name].tolist()] for name in quantities}
    if "health" in columns:
        cells["health"] = columns["health"].astype(int).tolist()
        cells["health_reason"] = [reason_in_words(code) for code in columns["health_reason"]]
    angles = with_degrees(columns)
    in_degrees = [name for name in IN_DEGREES if name in angles]
    return cells | {
        name: [number_cell(value) for value in angles[name].tolist()] for name in in_degrees
    }


def _check_table_name(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(
            f"'{path}' must end in {', '.join(SUFFIXES)} or, as a log with further channels, {' or '.join(LOGS)}"
        )


class _Report:
    """Findings, figures and verdict of a drive that is checked and estimated in parts.

    Args:
        model, trust: that estimate it.
        accepted: checks whose contradictions do not count.
        strict: name of the file if findings are an error.
    """

    def __init__(
        self, model: Estimator, trust: Trust | None, accepted: Sequence[str], strict: str | None
    ) -> None:
        self.model = model
        self.accepted = accepted
        self.strict = strict
        self.health = trust.health if trust is not None else None
        self.findings: list[list[Finding]] = []
        self.outside: Any = 0
        self.seconds = 0.0
        self.samples = self.estimated = self.invalid = 0
        self.extremes: list[float] = []
        self.half = array("f")  # widths of the band
        self.reasons: Counter[float] = Counter()

    def checked(self, parts: Iterable[tuple[Recording, list[Finding]]]) -> Iterator[Recording]:
        """The parts, once they are checked; raises `DataError` as `findings_of` does, and where it is strict."""
        for part, known in parts:
            found = findings_of(part, self.model, self.accepted, known)
            if self.strict and found:
                raise DataError(f"{self.strict}: {finding_in_words(found[0])}")
            self.findings.append(found)
            self.seconds += part.duration
            if self.health is not None:
                self.outside = self.outside + outside_domain(
                    self.health, {name: part[name] for name in self.health.channels}
                )
            yield part

    def counted(self, parts: Iterable[Estimate]) -> Iterator[Estimate]:
        """The parts of the estimate, once they count; raises `DataError` where all are empty."""
        for part in parts:
            self.last = part
            known = ~np.isnan(part["vy"])
            degrees = np.degrees(part["sideslip"])
            self.extremes += [float(np.fmin.reduce(degrees)), float(np.fmax.reduce(degrees))]
            self.samples, self.estimated = (
                self.samples + len(part),
                self.estimated + int(known.sum()),
            )
            if "band_sideslip" in part.channels:
                self.half.frombytes(
                    part["band_sideslip"][~np.isnan(part["band_sideslip"])]
                    .astype(np.float32)
                    .tobytes()
                )
            status = part["health"][known]
            reasons = part["health_reason"][known]
            self.invalid += int((status > 0).sum())
            found, counts = np.unique(reasons[(status > 0) & (reasons > 0)], return_counts=True)
            self.reasons.update(dict(zip(found.tolist(), counts.tolist(), strict=True)))
            yield part
        if not self.estimated:
            raise _too_short(self.model, self.last.recording_id, self.seconds)

    def summary(self) -> dict[str, Any]:
        """Figures of the estimate, for people and scripts."""
        last = self.last
        figures: dict[str, Any] = {
            "recording": last.recording_id,
            "estimator": last.estimator,
            "rate_hz": last.rate_hz,
            "samples": self.samples,
            "estimated": self.estimated,
            "seconds": self.seconds,
            "valid_percent": self.valid_percent,
            "invalid_reasons": self.invalid_reasons,
            "outside_training": self.outside_training,
            "has_calibration": self.health is not None,
            "quantities": {name: QUANTITIES[name] for name in last.channels},
            "sideslip_deg": {
                end: round(float(take.reduce(self.extremes)), 3)
                for end, take in (("min", np.fmin), ("max", np.fmax))
            },
        }
        if "band_sideslip" in last.channels:
            half = np.frombuffer(self.half, np.float32)
            np.degrees(half, out=half)
            middle = float(np.median(half, overwrite_input=True)) if len(half) else 0.0
            band = (
                {"median": round(middle, 3), "largest": round(float(half.max()), 3)}
                if len(half)
                else {}
            )
            figures["band_sideslip_deg"] = band
        return figures

    @property
    def valid_percent(self) -> float:
        """Share of the estimated samples whose health is valid [%]."""
        return 100.0 * (1.0 - self.invalid / self.estimated)

    @property
    def invalid_reasons(self) -> list[str]:
        """The two most frequent reasons for samples that are not valid."""
        counts = sorted(self.reasons.items(), key=lambda reason: -reason[1])
        return [reason_in_words(code) for code, _ in counts[:2]]

    @property
    def outside_training(self) -> str:
        """Share of the drive outside the range of the training, and its channels; empty if there is none."""
        return domain_verdict(self.health, self.outside) if self.health is not None else ""

    def verdict(self) -> str:
        """The share of valid samples and what makes others invalid, in a line."""
        if self.health is None:
            bands = "its bands are its own" if "band_vy" in self.last.channels else "no band"
            return f"this model has no calibration: {bands}, and health from gaps and speeds alone"
        reasons = self.invalid_reasons
        valid = f"valid in {self.valid_percent:.3g} % of the drive" + (
            f"; otherwise: {', '.join(reasons)}" if reasons else ""
        )
        return "; ".join(filter(None, (self.outside_training, valid)))
