"""The Revs database as re-laid text: a file a channel, a number a line."""

import numpy as np
import pytest
from refusals import refusal

from real_drives import real_drive
from vehest.alignment.checks import checks_of_recording
from vehest.data.errors import DataError, MissingError
from vehest.sources.base import open_source
from vehest.sources.revs import RevsSource

N = 300


def configuration(root, **changes):
    channels = {
        "vx": {"column": "vx", "unit": "m/s"},
        "ay": {"column": "ayCG", "unit": "g", "sign": -1},
    }
    base = {
        "name": "mine",
        "source": "revs",
        "layout": "text",
        "path": str(root),
        "recordings": ["lap"],
        "vehicle": "car",
        "citation": "me",
    }
    return base | {"time": {"column": "t", "unit": "s"}, "channels": channels} | changes


@pytest.fixture
def folder(tmp_path):
    """A recording of three seconds."""
    lap = tmp_path / "lap"
    lap.mkdir()
    np.savetxt(lap / "t.txt", 149.99 + np.arange(N) / 100.0, fmt="%.2f")
    np.savetxt(lap / "vx.txt", np.linspace(10, 20, N))
    np.savetxt(lap / "ayCG.txt", np.linspace(-1, 1, N))
    return tmp_path


def refused(folder, kind=DataError, **changes):
    return refusal(lambda: RevsSource(configuration(folder, **changes)).read("lap"), kind)


def test_a_folder_of_text_files_is_a_recording(folder):
    source = open_source(configuration(folder))
    assert source.ids() == ["lap"]
    recording = source.read("lap")
    assert (recording.id, recording.vehicle, recording.kind, recording.rate_hz) == (
        "lap",
        "car",
        "real",
        100.0,
    )
    assert recording.start_time == 149.99
    np.testing.assert_array_equal(
        recording["vx"], [float(line) for line in (folder / "lap" / "vx.txt").read_text().split()]
    )
    np.testing.assert_allclose(recording["ay"], -9.80665 * np.linspace(-1, 1, N))
    assert dict(recording.provenance) == {"dataset": "mine", "source": "revs", "layout": "text"}


def test_missing_empty_and_incomplete_channel_files_are_named(folder):
    file = folder / "lap" / "vx.txt"
    np.savetxt(file, np.zeros(N - 3))
    assert f"holds {N - 3} samples, the time file {N}" in refused(folder)
    for text, kind, message in (
        (
            "1\n" * 41 + "spam\n",
            DataError,
            "vx.txt': column 'number' holds the text 'spam' in data row 42",
        ),
        ("", MissingError, "vx.txt' is empty"),
        ("\n\n", DataError, "vx.txt' has no rows"),
    ):
        file.write_text(text)
        assert message in refused(folder, kind)
    file.unlink()
    assert "vx.txt" in refused(folder, MissingError)


def test_the_ferrari_has_one_lost_sample_of_steer_and_the_bias_of_ay_of_the_paper(data_root):
    ferrari = real_drive(data_root)
    [finding] = [finding for finding in checks_of_recording(ferrari) if finding.level != "note"]
    assert (finding.check, finding.channel) == ("spike", "steer")
    assert "1 spike of" in finding.message
    assert "at t = 671.67 s" in finding.message
    derived = (ferrari["vy_ref"][2:] - ferrari["vy_ref"][:-2]) * 50.0
    residual = derived - (ferrari["ay"] - ferrari["yaw_rate"] * ferrari["vx"])[1:-1]
    assert residual.mean() == pytest.approx(
        -0.028, abs=5e-4
    )  # -0.03 in Table I of Da Lio et al. 2023
