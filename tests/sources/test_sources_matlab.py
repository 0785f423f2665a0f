"""MAT-files as tables: the ways in which programs save signals, and one clear line for what is
none.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from refusals import refusal
from scipy.io import savemat

from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.sources.base import open_source
from vehest.sources.matlab import mat_contents, read_mat
from vehest.sources.readers import mat
from vehest.sources.tables import column_names, read_columns

N = 200
TIME = np.arange(N) / 50.0
SIGNALS = {"Speed": 20.0 + np.sin(TIME), "Gyro": 5.0 * np.cos(TIME), "AccY": 0.2 * np.sin(TIME)}
UNITS = {"Speed": "m/s", "Gyro": "deg/s", "AccY": "g"}
LOG = {"Time": TIME, **SIGNALS}
WRITTEN_BY_MATLAB = Path(scipy.io.__file__).parent / "matlab" / "tests" / "data"


def records(fields, rows):
    """An array of MATLAB's structures, one a row."""
    return np.array([tuple(row) for row in rows], dtype=[(name, object) for name in fields])


def signal(name, **fields):
    return {"value": SIGNALS[name], "unit": UNITS[name], **fields}


CONTROL_DESK = {
    "X": records(("Name", "Data"), [("", TIME)]),
    "Y": records(("Name", "Data", "Unit"), [(name, SIGNALS[name], UNITS[name]) for name in UNITS]),
}
LABELLED = {
    name: {"time": TIME, "signals": {"values": SIGNALS[name], "label": name}} for name in SIGNALS
}
MATRIX = np.stack([*SIGNALS.values()], axis=1)
NUMBERED = {f"({k})": samples for k, samples in enumerate(SIGNALS.values(), 1)}


@pytest.mark.parametrize(
    ("variables", "expected", "units"),
    [
        pytest.param(LOG, LOG, {}, id="variables"),
        pytest.param({"lap": LOG, "mass": 1500.0, "note": "dry"}, LOG, {}, id="structure"),
        pytest.param({"a": {"b": LOG}, "c": 1.0}, LOG, {}, id="nested structures"),
        pytest.param(
            {"a": LOG, "b": {"Yaw": TIME**2}},
            {**{f"a.{name}": samples for name, samples in LOG.items()}, "b.Yaw": TIME**2},
            {},
            id="two structures",
        ),
        pytest.param(
            {"lap": {name: signal(name, time=TIME) for name in SIGNALS}},
            {"Speed.time": TIME, **SIGNALS},
            UNITS,
            id="signals with times and units",
        ),
        pytest.param({"lap": CONTROL_DESK}, {"X": TIME, **SIGNALS}, UNITS, id="named elements"),
        pytest.param(LABELLED, {"Speed.time": TIME, **SIGNALS}, {}, id="labels"),
        pytest.param(
            {"out": {"time": TIME, "signals": {"values": MATRIX}}},
            {"out.time": TIME, **{f"out{number}": v for number, v in NUMBERED.items()}},
            {},
            id="columns of a matrix",
        ),
        pytest.param(
            {"log": MATRIX.T},
            {f"log{number}": samples for number, samples in NUMBERED.items()},
            {},
            id="rows of a matrix",
        ),
        pytest.param(
            {"S": records(LOG, zip(*LOG.values(), strict=True))}, LOG, {}, id="a structure a sample"
        ),
        pytest.param(
            {"n": np.arange(N, dtype=np.uint8), "on": TIME > 1.0},
            {"n": np.arange(N), "on": TIME > 1.0},
            {},
            id="whole numbers",
        ),
    ],
)
@pytest.mark.parametrize("oned_as", ["row", "column"])
def test_signals_are_columns_however_they_are_saved(tmp_path, variables, expected, units, oned_as):
    file = tmp_path / "lap.mat"
    savemat(file, variables, oned_as=oned_as, do_compression=oned_as == "row")
    columns, summary = mat.read(file, list(expected))
    assert all(np.array_equal(columns[name], samples) for name, samples in expected.items())
    assert summary["lengths"] == dict.fromkeys(columns, N)
    assert summary["units"] == units


def test_version_4_is_read(tmp_path):
    savemat(tmp_path / "lap.mat", LOG, format="4")
    assert np.array_equal(read_columns(tmp_path / "lap.mat", ["Speed"])["Speed"], LOG["Speed"])


def test_two_rates_are_told_apart_and_only_mixing_them_is_refused(tmp_path):
    file = tmp_path / "lap.mat"
    savemat(file, {**LOG, "fast": np.arange(10 * N)})
    assert mat_contents(file).n_rows == N
    assert len(read_mat(file, ["fast"])["fast"]) == 10 * N
    message = refusal(lambda: read_columns(file, ["Speed", "fast"]))
    assert "'Speed' has 200 samples, 'fast' 2000; resample" in message


def test_a_changed_file_is_read_anew(tmp_path):
    file = tmp_path / "lap.mat"
    savemat(file, {"a": TIME})
    assert column_names(file) == ["a"]
    savemat(file, {"longer": TIME, "b": TIME})
    assert column_names(file) == ["longer", "b"]


def test_a_data_set_of_matlab_files_is_read_like_one_of_tables(tmp_path):
    savemat(tmp_path / "lap.mat", {"lap": LOG})
    declared = {
        "name": "mine",
        "source": "tabular",
        "path": str(tmp_path),
        "files": "*.mat",
        "time": {"column": "Time", "unit": "s"},
        "channels": {
            "vx": {"column": "Speed", "unit": "m/s"},
            "ay": {"column": "AccY", "unit": "g", "sign": -1},
        },
    }
    recording = open_source(declared).read("lap")
    assert recording.rate_hz == 50.0
    assert np.allclose(recording["ay"], -9.80665 * SIGNALS["AccY"], rtol=1e-12)


def element(kind, data):
    """A data element of MAT 5."""
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def file_of_object(name, kind):
    """A file with an object of one of MATLAB's classes, which only MATLAB reads."""
    numbers = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 1, 2))
    numbers += element(1, b"") + element(6, struct.pack("<2I", 0, 1))
    texts = b"".join(element(1, text) for text in (name, b"MCOS", kind))
    content = element(6, struct.pack("<II", 17, 0)) + texts + element(14, numbers)
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    return header + element(14, content)


def test_objects_of_matlab_are_named_with_the_way_to_save_their_columns(tmp_path):
    (tmp_path / "lap.mat").write_bytes(file_of_object(b"T", b"timetable"))
    contents = mat_contents(tmp_path / "lap.mat")
    assert not contents.lengths
    assert "variable 'T' is a timetable; save its columns as vectors" in contents.skipped[0]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", "version 7.3, which is HDF5"),
        (b"\x89HDF\r\n\x1a\n" + bytes(600), "version 7.3, which is HDF5"),
        (b"# Created by Octave 8\n# name: a\n", "cannot be read as a MAT-file"),
        (b"MATLAB 5.0 MAT-file", "cannot be read as a MAT-file"),
        (b"", "cannot be read as a MAT-file"),
    ],
)
def test_other_files_of_that_name_are_refused_with_the_way_to_save_them(tmp_path, content, says):
    (tmp_path / "lap.mat").write_bytes(content)
    message = refusal(lambda: column_names(tmp_path / "lap.mat"))
    assert says in message
    assert "-v7" in message


@pytest.mark.parametrize("size", [140, 1000, 5000])
def test_truncated_files_are_refused(tmp_path, size):
    savemat(tmp_path / "whole.mat", LOG)
    (tmp_path / "lap.mat").write_bytes((tmp_path / "whole.mat").read_bytes()[:size])
    assert "damaged" in refusal(lambda: column_names(tmp_path / "lap.mat"))


def test_more_samples_than_the_limits_allow_are_refused(tmp_path):
    savemat(tmp_path / "lap.mat", {"a": np.zeros(5000)}, do_compression=True)
    with use_limits(Limits(samples=1000)):
        assert "5000 rows" in refusal(lambda: mat_contents(tmp_path / "lap.mat"))


@pytest.mark.parametrize(
    "file", sorted(WRITTEN_BY_MATLAB.glob("*.mat")), ids=lambda file: file.stem
)
def test_every_file_of_scipys_own_tests_is_read_or_refused_in_a_line(file):
    try:
        _, summary = mat.read(file, None)
    except DataError:
        assert file.stem in refusal(lambda: mat.read(file, None))
        return
    columns, _ = mat.read(file, [*summary["lengths"]])
    assert {name: len(column) for name, column in columns.items()} == summary["lengths"]
    assert all(column.dtype == np.float64 for column in columns.values())
    assert all(text.isprintable() for text in summary["skipped"])
