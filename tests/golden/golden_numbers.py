"""Numbers of every estimator family, source and stage on small recordings, and what is recorded of
them; `make golden` records anew.
"""

import contextlib
import csv
import hashlib
import io
import json
import platform
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path

import llvmlite.binding
import numpy as np
import yaml

from conftest import planar_drive
from every_estimator import drive_for, fitted
from fuzz.honest import run
from place import DATASET, Place, write_csv
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.run import calibrate, downsample, evaluate, evaluate_faults
from vehest.run.versions import FAULTS, VERSIONS
from vehest.sources.base import open_source, source_class
from vehest.trust.faults import is_fault

FILE = Path(__file__).with_name("digests.json")
DIGITS = 6
LEARNT = 1e-3
SIMULATED = 1e-6
FIXED = 1e-9  # tolerances elsewhere than on the machine that recorded, of an array's largest value
LIBRARIES = ("numpy", "scipy", "numba", "torch")
VEHICLE = Path(__file__).parents[2] / "conf" / "vehicle" / "bmw_320i_low.yaml"
MODEL = "static_map"
TRAINED = (f"estimator={MODEL}", "estimator.rate_hz=20", "split=mine", "tracking=none")
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Subject:
    """Something with versions whose numbers are recorded."""

    versions: Mapping[
        str, str
    ]  # what to raise when numbers move, for example ``Ksnn.version``, and its value
    tolerance: float  # of values elsewhere than on the machine that recorded
    numbers: Callable[
        [], Mapping[str, Arrays]
    ]  # makes them: ``weights`` and ``estimates`` of an estimator, else one part

    def record(self):
        """What digests.json holds of it."""
        parts = self.numbers()
        return {
            "versions": dict(self.versions),
            "digests": {part: digest_of(arrays) for part, arrays in parts.items()},
            "values": {
                part: {name: _values(array) for name, array in arrays.items()}
                for part, arrays in parts.items()
            },
        }


def subjects():
    """All of them, by name."""
    all_subjects = {
        name: _estimator(name)
        for name in estimator_names()
        if estimator_class(name).__module__.startswith("vehest.")
    }
    for name, make in SOURCES.items():
        tolerance = SIMULATED if name == "simulated" else FIXED
        source = source_class({"source": name})
        all_subjects[f"source {name}"] = Subject(
            {f"{source.__name__}.version": source.version}, tolerance, partial(in_folder, make)
        )
    for stage, numbers in STAGES.items():
        name = stage.__name__.removeprefix("vehest.run.")
        tolerance = FIXED
        version_name = f"{name} in vehest.run.versions"
        if stage is not downsample:
            version_name = f"{version_name}, unless numbers of {MODEL} moved too,"
            tolerance = LEARNT
        all_subjects[f"stage {name}"] = Subject(
            {version_name: VERSIONS.get(name, FAULTS)}, tolerance, partial(in_folder, numbers)
        )
    return all_subjects


def this_machine():
    """What digits depend on."""
    libraries = {name: metadata.version(name) for name in LIBRARIES}
    return {
        "cpu": str(llvmlite.binding.get_host_cpu_name()),
        "python": platform.python_version(),
        **libraries,
    }


def moved(name, recorded, now, tolerance):
    """What to do about numbers that are not those recorded.

    Empty where they are. Digests are compared where there is no tolerance.
    """
    if recorded["versions"] != now["versions"]:
        return f"a version of {name} was raised: record its numbers with `make golden`"
    if tolerance is None:
        parts = [
            part
            for part, digest in recorded["digests"].items()
            if now["digests"].get(part) != digest
        ]
    else:
        parts = [
            part
            for part in recorded["values"]
            if not _are_close(recorded["values"][part], now["values"].get(part, {}), tolerance)
        ]
    if not parts:
        return ""
    version, *training = now["versions"]
    version_to_raise = (
        version
        if not training or "weights" not in parts
        else f"{version}, or {training[0]} if all that it trains moved,"
    )
    return (
        f"{' and '.join(parts)} of {name} moved: "
        f"raise {version_to_raise} if that is meant, then run `make golden`"
    )


def digest_of(arrays, digits=DIGITS):
    """Digest of numbers, each rounded to so many digits of its array's largest."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        numbers = np.asarray(array, np.float64)
        largest = np.max(np.abs(numbers[np.isfinite(numbers)]), initial=0.0)
        if largest > 0:
            numbers = np.round(numbers / 10.0 ** np.ceil(np.log10(largest)), digits) + 0.0
        digest.update(f"{name} {numbers.shape} ".encode() + numbers.tobytes())
    return digest.hexdigest()[:16]


def _values(array):
    """Largest value, and the first, middle and last; none where it is not finite."""
    flat = np.asarray(array, np.float64).ravel()
    if not flat.size:
        return []
    picked = [
        np.max(np.abs(flat[np.isfinite(flat)]), initial=0.0),
        flat[0],
        flat[flat.size // 2],
        flat[-1],
    ]
    return [float(f"{value:.12g}") if np.isfinite(value) else None for value in picked]


def _are_close(recorded, now, tolerance):
    """Whether recorded and present numbers agree within a tolerance."""
    if set(recorded) != set(now):
        return False
    for name, values in recorded.items():
        then = np.array(values, float)
        today = np.array(now[name], float)
        if then.shape != today.shape or not np.allclose(
            then, today, rtol=0, atol=tolerance * then[0] if then.size else 0, equal_nan=True
        ):
            return False
    return True


def _estimator(name):
    """Weights and estimates of a family."""
    cls = estimator_class(name)
    versions = {f"{cls.__name__}.version": cls.version}
    if hasattr(cls.training_type, "version"):
        versions[f"{cls.training_type.__name__}.version"] = cls.training_type.version

    def numbers():
        estimator = fitted(name)
        estimate = estimator.estimate([drive_for(estimator)])[0]
        return {"weights": dict(estimator.weights()), "estimates": dict(estimate.channels)}

    return Subject(versions, LEARNT if len(versions) > 1 else FIXED, numbers)


def in_folder(make):
    """What a function makes of an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        return {"numbers": make(Path(folder))}


def _channels(recording):
    """Times and channels of a recording."""
    return {"time": recording.time, **{name: recording[name] for name in recording.channels}}


def _tabular(folder):
    """Channels of a CSV table."""
    write_csv(folder / "lap.csv", 1, 5.0)
    return _channels(open_source(DATASET | {"path": str(folder)}).read("lap"))


def _text_log(folder):
    """Channels of a table with a row of units."""
    write_csv(folder / "lap.csv", 1, 5.0)
    lines = (folder / "lap.csv").read_text().splitlines()
    (folder / "lap.csv").write_text("\n".join([lines[0], "s,km/h,deg/s,,,", *lines[1:]]) + "\n")
    return _channels(
        open_source(
            DATASET | {"path": str(folder), "source": "text_log", "rows_below_names": 1}
        ).read("lap")
    )


def _vbo(folder):
    """Channels of a VBO file."""
    from vbo_log import dataset, write_log

    write_log(folder / "lap.vbo")
    return _channels(open_source(dataset(folder)).read("lap"))


def _can(folder):
    """Channels of a log of a CAN bus."""
    from can_drive import SIGNALS, write_log

    write_log(planar_drive(5.0, 100.0, seed=3), folder, ".asc")
    channels = {name: SIGNALS[name] for name in ("vx", "yaw_rate", "ax", "ay")}
    can_options = {
        "files": "drive.*",
        "dbc": str(folder / "car.dbc"),
        "rate_hz": 100,
        "channels": channels,
    }
    return _channels(
        open_source({"name": "mine", "source": "can", "path": str(folder), **can_options}).read(
            "drive"
        )
    )


def _rosbag(folder):
    """Channels of a ROS bag."""
    from test_sources_rosbag import configuration, drive, write_bag

    write_bag(folder, drive(2.0))
    return _channels(open_source(configuration(folder)).read("lap"))


def _mdf(folder):
    """Channels of a measurement."""
    from mdf_log import write_mdf

    from fuzz.families.mdf import DECLARED, signals

    write_mdf(folder / "lap.mf4", {"Only": signals()})
    return _channels(open_source(DECLARED | {"path": str(folder)}).read("lap"))


def _revs(folder):
    """Channels of a folder of the Revs database."""
    from test_sources_revs import configuration

    time = np.arange(300) / 100.0
    (folder / "lap").mkdir()
    for name, values in {"t": time, "vx": 20.0 + np.sin(time), "ayCG": 0.3 * np.cos(time)}.items():
        np.savetxt(folder / "lap" / f"{name}.txt", values, fmt="%.6f")
    return _channels(open_source(configuration(folder)).read("lap"))


def simulated(folder, seconds=3.0, **car):
    """Channels of a simulated drive."""
    drive = {
        "id": "a",
        "seed": 1,
        "manoeuvre": {"name": "laps", "course": "handling", "duration": seconds},
    }
    vehicle = yaml.safe_load(VEHICLE.read_text(encoding="utf-8")) | car
    dataset = {
        "name": "sim",
        "source": "simulated",
        "vehicle": vehicle,
        "rate_hz": 50,
        "drives": [drive],
    }
    return _channels(open_source(dataset).read("a"))


SOURCES = {"can": _can, "mdf": _mdf, "revs": _revs, "rosbag": _rosbag, "simulated": simulated}
SOURCES |= {"tabular": _tabular, "text_log": _text_log, "vbo": _vbo}


def _downsampled(folder):
    """Channels of a recording after the stage ``downsample``."""
    recording = planar_drive(10.0, 100.0, seed=1, noise=0.02)
    for transform in downsample.transforms_of(
        {"rate_hz": 20.0, "method": "polyphase", "transforms": []}
    ):
        recording = transform(recording)
    return _channels(recording)


def _artefact_file(pattern):
    """The one file of the study that matches a pattern."""
    (file,) = (Path(_study().name) / "outputs").glob(pattern)
    return file


def _metrics(chosen):
    """Metrics of the rows of chosen conditions."""
    with _artefact_file("evaluate/*/metrics.csv").open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if chosen(row["condition"])]
    metrics = {}
    for row in rows:
        metrics.setdefault(row["metric"], []).extend(
            float(row[column] or "nan") for column in ("value", "low", "high")
        )
    return {metric: np.array(values) for metric, values in metrics.items()}


@cache
def _study():
    """A folder with a small study: one model, calibrated, evaluated without faults and
    under one.
    """
    study_folder = tempfile.TemporaryDirectory()
    folder = Path(study_folder.name)
    Place(folder, None)
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        for words in (("train", *TRAINED), ("eval", *TRAINED, "fault=noise")):
            run(*words)
    return study_folder


def _leaves(path, content):
    """Numbers in plain values, by the keys that lead to them; texts are left out."""
    if isinstance(content, Mapping):
        for name, value in content.items():
            yield from _leaves(f"{path}.{name}".lstrip("."), value)
    elif isinstance(content, int | float | list) and np.issubdtype(
        np.array(content).dtype, np.number
    ):
        yield path, np.array(content)


STAGES = {
    downsample: _downsampled,
    calibrate: lambda _: dict(
        _leaves(
            "", yaml.safe_load(_artefact_file("calibrate/*/trust.yaml").read_text(encoding="utf-8"))
        )
    ),
    evaluate: lambda _: _metrics(lambda condition: not is_fault(condition)),
    evaluate_faults: lambda _: _metrics(is_fault),
}


def main():
    """Record the numbers of this machine."""
    former = json.loads(FILE.read_text(encoding="utf-8"))["subjects"] if FILE.is_file() else {}
    records = {}
    for name, subject in subjects().items():
        records[name] = subject.record()
        print(f"{name}: {'as before' if records[name] == former.get(name) else 'recorded'}")
    lines = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(record)}" for name, record in records.items()
    )
    FILE.write_text(
        f'{{"machine": {json.dumps(this_machine())},\n"subjects": {{\n{lines}\n}}}}\n',
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
