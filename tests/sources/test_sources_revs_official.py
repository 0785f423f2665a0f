"""The official CSV layout of the Revs database: known values in, SI units out.

Whatever is malformed is one line.
"""

import re

import numpy as np
import pytest
from refusals import refusal

from revs_files import COLUMNS, PREAMBLE, Drive, smooth_drive, write_csv, write_vehicle_parameters
from vehest.configuration.composition import compose_config
from vehest.sources.base import open_source

NAME = "20140222_01_01_03_250lm"
SECONDS = 4.0
BLANK = 37
ONE_ROUNDING = {
    "rtol": 4e-16,
    "atol": 1e-300,
}  # degrees and back: two multiplications by π/180 or its inverse


def source(root, *overrides, dataset="revs_targa_2014", **changes):
    """The source of a data set in conf/, of one recording below ``root``."""
    config = compose_config("ingest", [f"dataset={dataset}", f"root={root}", *overrides])["dataset"]
    return open_source({**config, "recordings": [NAME], **changes})


def read(root, *overrides, **changes):
    return source(root, *overrides, **changes).read(NAME)


def refused(root, **changes):
    return refusal(lambda: read(root, **changes))


@pytest.fixture
def root(tmp_path):
    (tmp_path / "revs").mkdir()
    return tmp_path


@pytest.fixture
def csv(root):
    return root / "revs" / f"{NAME}.csv"


def test_the_csv_files_angles_in_degrees_become_radians_and_its_held_values_stay(root, csv):
    drive, truth = smooth_drive(SECONDS, start_time=12.5)
    write_csv(csv, drive, blank_rows=BLANK)
    recording = read(root)
    assert (recording.id, recording.vehicle, recording.kind, recording.rate_hz) == (
        NAME,
        "ferrari_250lm",
        "real",
        1000.0,
    )
    assert recording.start_time == pytest.approx(12.5 + BLANK / 1000, abs=1e-12)
    assert len(recording) == 1000 * SECONDS - BLANK
    rows = BLANK + np.arange(len(recording))
    assert set(recording.channels) == set(truth) - {"steer"}
    for name in recording.channels:
        expected = (
            truth[name][rows] if name == "handwheel" else truth[name][rows // 10 * 10]
        )  # the INS delivers every 10 ms
        np.testing.assert_allclose(recording[name], expected, **ONE_ROUNDING, err_msg=name)


def test_gappy_channels_keep_their_blanks_and_hold_up_no_other(root, csv):
    drive, _ = smooth_drive(SECONDS)
    roll = np.array(drive.signals["rollAngle"])
    roll[200:230] = np.nan
    drive = Drive(SECONDS, {**drive.signals, "rollAngle": roll})
    write_csv(csv, drive, blank_rows={"rollAngle": 3500})
    recording = read(root, gappy=["roll"])
    assert len(recording) == 4000
    assert np.isnan(recording["roll"][:3500]).all()
    assert np.isfinite(recording["roll"][3500:]).all()
    write_csv(csv, drive, blank_rows=0)
    np.testing.assert_array_equal(
        np.flatnonzero(np.isnan(read(root, gappy=["roll"])["roll"])), np.arange(2000, 2300)
    )


def test_provenance_tells_session_parameters_and_file(root, csv):
    write_csv(csv, smooth_drive(1.0)[0])
    write_vehicle_parameters(root / "revs" / "250lm.csv")
    assert set(source(root).inputs()) == {f"{NAME}.csv", "250lm.csv"}
    provenance = read(root).provenance
    assert (provenance["file"], provenance["preamble"]) == (
        f"{NAME}.csv",
        [line for line in PREAMBLE if line],
    )
    assert provenance["vehicle_parameters"]["mass"] == {"value": 982.0, "unit": "kg"}
    assert provenance["vehicle_parameters"]["handwheelAngle"] == {
        "value": [-90.0, 0.0, 90.0],
        "unit": "°",
    }
    (root / "revs" / "250lm.csv").unlink()
    assert "vehicle_parameters" not in read(root).provenance


def with_cell(line, column, text):
    """Put ``text`` into a cell; lines count from 1."""

    def change(content):
        lines = content.splitlines(keepends=True)
        cells = lines[line - 1].rstrip(b"\r\n").split(b",")
        cells[list(COLUMNS).index(column)] = text.encode("latin-1")
        lines[line - 1] = b",".join(cells) + b"\r\n"
        return b"".join(lines)

    return change


MALFORMED = {
    "cut in a row": (
        lambda content: content[: content.rindex(b",", 0, len(content) - 200)],
        r"Row #\d+: Expected 55 columns, got \d+.* is it truncated",
    ),
    "text": (
        with_cell(500, "vyCG", "n/a?"),
        r"column 'vyCG' holds the text 'n/a\?' in data row 488",
    ),
    "blank after the head": (
        with_cell(500, "vyCG", ""),
        r"channel 'vy_ref' holds 1 NaN between 0.487 s and 0.487 s",
    ),
    "no units": (
        lambda content: b"".join((lines := content.splitlines(True))[:11] + lines[12:]),
        "line 12 should hold units of the 55 columns",
    ),
    "UTF-16": (
        lambda content: content.decode("latin-1").encode("utf-16"),
        "line 11 should name the columns and has no 'time'",
    ),
}


@pytest.fixture(scope="module")
def one_second(tmp_path_factory):
    """A file of 1,000 rows below 12 lines."""
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    write_csv(path, smooth_drive(1.0)[0])
    return path.read_bytes()


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_csv_is_one_line(root, csv, one_second, case):
    change, message_part = MALFORMED[case]
    csv.write_bytes(change(one_second))
    message = refused(root)
    assert (csv.name in message, bool(re.search(message_part, message))) == (True, True), message


def test_the_files_own_row_of_units_must_not_contradict_the_declared_ones(root, csv, one_second):
    csv.write_bytes(with_cell(12, "yawRate", "rad/s")(one_second))
    assert "column 'yawRate' is in 'rad/s' by the file and in 'deg/s' by conf/dataset" in refused(
        root
    )
    assert len(read(root, units_row="ignore")) == 1000 - BLANK


def test_a_malformed_table_of_vehicle_parameters_is_one_line(root, csv, one_second):
    csv.write_bytes(one_second)
    for content, message_part in (
        ("mass,,b\nkg,m,m\n1,2,3\n", "column 2 is called ''"),
        ("mass\nkg\n1\nabc\n", "parameter 'mass' holds 'abc' in line 4"),
        ("mass\nkg\n1\0\n", "is no table of vehicle parameters"),
    ):
        (root / "revs" / "250lm.csv").write_text(content)
        message = refused(root)
        assert all(words in message for words in ("250lm.csv", message_part))
