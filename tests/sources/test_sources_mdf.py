"""MDF files of asammdf's own writer: groups of several rasters on one clock, and one clear line for
what cannot be used.
"""

import tempfile

import numpy as np
import pytest
from mdf_log import ONE, read_mdf, write_mdf
from refusals import refusal

from vehest.data.errors import ConfigurationError
from vehest.data.recording import MISSING
from vehest.sources.base import open_source
from vehest.sources.unit_spellings import plain_unit

asammdf = pytest.importorskip(
    "asammdf", reason="the measurements of these tests are written by asammdf"
)

FAST = np.arange(0, 2001) / 100.0  # 0 s to 20 s
SLOW = 0.513 + np.arange(0, 950) / 50.0  # to 19.493 s
JITTER = np.sort(
    0.2 + np.arange(0, 1960) / 100.0 + np.random.default_rng(0).uniform(-0.005, 0.005, 1960)
)  # intervals of 0 to 20 ms


def speed(t):
    return 25.0 + 4.0 * np.sin(0.5 * t)  # m/s


def yaw_rate(t):
    return 0.3 * np.sin(1.1 * t)  # rad/s


def lateral(t):
    return 6.0 * np.sin(1.1 * t + 0.2)  # m/s²


def signal(name, t, samples, unit="", **more):
    return asammdf.Signal(np.asarray(samples), t, name=name, unit=unit, **more)


GROUPS = {
    "Powertrain": [
        signal("VehSpd", FAST, 3.6 * speed(FAST), "km/h"),
        signal("LongAcc", FAST, np.cos(0.5 * FAST), "m/s^2"),
    ],
    "Gateway": [
        signal("YawRate", SLOW, np.degrees(yaw_rate(SLOW)), "°/s"),
        signal("VehSpd", SLOW, 3.7 * speed(SLOW), "kph"),
    ],
    "Imu": [signal("LatAcc", JITTER, -lateral(JITTER) / 9.80665, "g")],
}
CHANNELS = {
    "vx": {"column": "VehSpd", "group": "Powertrain", "unit": "km/h"},
    "yaw_rate": {"column": "YawRate", "unit": "deg/s"},
    "ay": {"column": "LatAcc", "unit": "g", "sign": -1, "max_gap": 0.05},
    "ax": {"column": "LongAcc", "unit": "m/s²"},
}
THIRDS = np.arange(2001) % 3


def one(file, t, samples, unit="m/s", **more):
    return write_mdf(file, {"Only": [signal("v", t, samples, unit, **more)]})


def refused(file, **options):
    message = refusal(lambda: read_mdf(file, **options))
    assert file.name in message
    return message


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return write_mdf(tmp_path_factory.mktemp("mdf") / "drive.mf4", GROUPS)


@pytest.fixture(autouse=True)
def tidy(tmp_path, monkeypatch):
    """Whatever a test reads, nothing is left in the current folder or among temporary files."""
    working_folder = tmp_path / "here"
    temporary = tmp_path / "temporary"
    working_folder.mkdir()
    temporary.mkdir()
    monkeypatch.chdir(working_folder)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    yield
    assert list(temporary.iterdir()) == []
    assert {file.name for file in working_folder.iterdir()} <= {"conf", "outputs"}


def test_three_rasters_come_to_one_clock_as_their_formulas_say(drive):
    recording = read_mdf(drive, channels=CHANNELS, vehicle="kart", citation="me")
    assert (recording.rate_hz, recording.start_time, recording.vehicle) == (
        100.0,
        0.52,
        "kart",
    )  # ticks count from the measurement's start
    assert len(recording) == round((19.49 - 0.52) * 100) + 1
    t = recording.time
    # ticks are this group's own samples
    np.testing.assert_allclose(recording["vx"], speed(t), rtol=0, atol=1e-12)
    np.testing.assert_allclose(recording["ax"], np.cos(0.5 * t), rtol=0, atol=1e-12)
    # linear interpolation over h is off by at most h²/8 · max |f''|
    np.testing.assert_allclose(
        recording["yaw_rate"], yaw_rate(t), rtol=0, atol=0.02**2 / 8 * 0.3 * 1.1**2
    )
    widest = np.diff(JITTER).max()
    np.testing.assert_allclose(
        recording["ay"], lateral(t), rtol=0, atol=widest**2 / 8 * 6.0 * 1.1**2
    )


def test_the_clock_of_a_channel_can_be_taken_as_it_is(drive):
    recording = read_mdf(
        drive, channels=CHANNELS, rate_hz=None, raster="yaw_rate", accept=["aliasing"]
    )
    assert (recording.rate_hz, recording.start_time, len(recording)) == (50.0, SLOW[0], len(SLOW))
    np.testing.assert_array_equal(
        recording["yaw_rate"], np.radians(1.0) * np.degrees(yaw_rate(SLOW))
    )
    np.testing.assert_allclose(recording["vx"], speed(SLOW), rtol=0, atol=0.01**2 / 8 * 1.0)
    assert "group 2 'Imu', whose clock is taken, does not come evenly: " in refused(
        drive, channels=CHANNELS, rate_hz=None, raster="ay"
    )


def test_a_name_in_several_groups_needs_its_group_and_an_absent_signal_is_answered_with_near_ones(
    drive, tmp_path
):
    def of(column, **more):
        return {**CHANNELS, "vx": {"column": column, "unit": "km/h", **more}}

    for channels, message in (
        (
            of("VehSpd"),
            "signal 'VehSpd' stands 2 times, in group 0 'Powertrain', 1 'Gateway'; say which",
        ),
        (
            of("VehSpd", group=2),
            "signal 'VehSpd' is not in group '2', but in 0 'Powertrain', 1 'Gateway'",
        ),
        (of("Vehspeed"), "has no signal 'Vehspeed'; did you mean 'VehSpd'?"),
        (of("time"), "has no signal 'time'"),  # a master is no signal
    ):
        assert message in refused(drive, channels=channels)
    by_number = read_mdf(drive, channels=of("VehSpd", group=1))
    np.testing.assert_allclose(
        by_number["vx"], read_mdf(drive, channels=CHANNELS)["vx"] * 3.7 / 3.6, rtol=1e-4
    )
    frames = write_mdf(tmp_path / "bus.mf4", {"CAN": [signal("CAN_DataFrame.ID", FAST, FAST)]})
    assert "undecoded frames of a bus" in refused(frames)


@pytest.mark.parametrize(
    ("raw", "conversion", "physical"),
    [
        (np.arange(2001, dtype="u2"), {"a": 0.01, "b": -3.0}, 0.01 * np.arange(2001) - 3.0),
        (
            THIRDS.astype("i2"),
            {"raw_0": 0, "phys_0": 5.0, "raw_1": 2, "phys_1": 9.0, "interpolation": True},
            5.0 + 2.0 * THIRDS,
        ),
        (
            np.arange(2001, dtype="f4"),
            {"P1": 1.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 1.0, "P6": 4.0},
            (np.arange(2001.0) ** 2 + 2 * np.arange(2001) + 1) / (np.arange(2001) + 4),
        ),
    ],
    ids=["linear", "table", "rational"],
)
def test_physical_values_are_read(tmp_path, raw, conversion, physical):
    recording = read_mdf(one(tmp_path / "a.mf4", FAST, raw, conversion=conversion))
    np.testing.assert_allclose(recording["vx"], physical, rtol=1e-12)


def test_values_that_a_conversion_names_not_available_are_missing_samples(tmp_path):
    from asammdf.blocks.conversion_utils import from_dict

    raw = np.arange(2001, dtype="u2")
    raw[100:103] = 65535
    names = {"val_0": 65535, "text_0": b"SNA", "val_1": 0, "text_1": b"Error", "default": b""}
    named = from_dict({**names, "default_addr": from_dict({"a": 0.01, "b": 0.0})})
    file = one(tmp_path / "a.mf4", FAST, raw, conversion=named)
    bridged = {"vx": {**ONE["vx"], "max_gap": 0.05}}
    expected = 0.01 * np.arange(1, 2001)
    np.testing.assert_allclose(read_mdf(file, channels=bridged)["vx"], expected, rtol=1e-12)
    assert [len(part) for part in parts_of(file)] == [99, 1898]
    gear = from_dict({**names, "text_1": b"D", "default_addr": from_dict({"a": 0.01, "b": 0.0})})
    assert "holds text" in refused(one(tmp_path / "a.mf4", FAST, raw, conversion=gear))


def test_text_arrays_and_disordered_time_stamps_are_refused_with_their_group(tmp_path):
    gear = {"val_0": 0, "text_0": b"N", "val_1": 1, "text_1": b"D", "default": b"?"}
    stamps = np.concatenate([FAST[:50], FAST[49:]])
    text = "signal 'v' of group 0 'Only' holds text; numbers are needed"
    signal_text = "signal 'v' of group 0 'Only': "
    for t, samples, more, message in (
        (FAST, np.arange(2001) % 2, {"conversion": gear}, text),
        (FAST, np.array([b"on"] * 2001), {"encoding": "utf-8"}, text),
        (FAST, np.zeros(2001, dtype=[("v", "(3,)<f8")]), {}, "holds an array or structure"),
        (
            stamps,
            np.ones(2002),
            {},
            signal_text + "time repeats 1 time, first at sample 50 (0.49 s)",
        ),
    ):
        assert message in refused(one(tmp_path / "a.mf4", t, samples, **more))


@pytest.mark.parametrize("version", ["2.14", "3.30"])
def test_other_versions_of_the_format_are_read(tmp_path, drive, version):
    recording = read_mdf(write_mdf(tmp_path / "a.mf4", GROUPS, version), channels=CHANNELS)
    for name, samples in read_mdf(drive, channels=CHANNELS).channels.items():
        np.testing.assert_allclose(recording[name], samples, rtol=1e-9, atol=1e-9)


def test_a_unit_that_the_file_contradicts_is_refused(tmp_path):
    file = one(tmp_path / "a.mf4", FAST, FAST, "km/h")
    message = refused(file)
    assert (
        "signal 'v' of group 0 'Only', for channel 'vx', is in 'km/h' by the file and in 'm/s' "
        "by conf/dataset" in message
    )
    assert "set file_units: ignore" in message
    np.testing.assert_allclose(read_mdf(file, file_units="ignore")["vx"], FAST)
    np.testing.assert_allclose(
        read_mdf(file, channels={"vx": {**ONE["vx"], "factor": 0.5}})["vx"], 0.5 * FAST
    )


def test_spellings_are_known_where_they_mean_one_thing():
    spellings = {
        "Â°/s": "deg/s",
        "1/min": "rpm",
        "m/s^2": "m/s²",
        "[m/sec²]": "m/s²",
        "m/(s^2)": "m/s²",
        "km|h": "km/h",
        "MPa": "MPa",
        "mPa": "another unit",
        "Unit_KiloMeterPerHour": "km/h",
        "Unit_DegreOfArcPerSecon": "deg/s",
        "Unit_MeterPerSeconSquar": "m/s²",
    }
    unclear = dict.fromkeys(("KN", "Grad"))  # kilonewton or knots; degrees in German, gon elsewhere
    assert {text: plain_unit(text) for text in (spellings | unclear)} == spellings | unclear


def parts_of(file, **options):
    declared = {"name": "mine", "source": "mdf", "path": str(file.parent), "files": file.name}
    return list(open_source(declared | {"rate_hz": 100, "channels": ONE} | options).recordings())


def test_a_gap_beyond_the_channels_max_gap_ends_a_recording(tmp_path):
    remaining = np.delete(FAST, np.s_[500:530])
    file = one(tmp_path / "a.mf4", remaining, 3.0 * remaining)
    for max_gap in (None, 0.3):
        parts = parts_of(file, channels={"vx": {**ONE["vx"], "max_gap": max_gap}})
        assert [(part.id, len(part)) for part in parts] == [("a_run_0", 500), ("a_run_1", 1471)]
        for part in parts:
            np.testing.assert_allclose(part["vx"], 3.0 * part.time, rtol=0, atol=1e-12)
        assert (
            parts[0].provenance[MISSING]["vx"][0].startswith("a gap of 0.31 s after 4.99 s, ends")
        )
        assert MISSING not in parts[1].provenance
    bridged = read_mdf(file, channels={"vx": {**ONE["vx"], "max_gap": 0.31}})
    np.testing.assert_allclose(bridged["vx"], 3.0 * bridged.time, rtol=0, atol=1e-12)


def test_gaps_in_most_of_a_file_are_an_error_that_names_the_first(tmp_path):
    times = np.concatenate([start + np.arange(20) * 0.01 for start in range(20)])
    message = refused(one(tmp_path / "a.mf4", times, times))
    assert "has a gap of 0.81 s after " in message
    assert "the longest of 19 above 0.03 s; raise its max_gap" in message


def test_a_pause_of_one_group_ends_a_recording_of_all_where_max_gap_says_so(tmp_path):
    """The other group goes on, and a sample on either side of the pause still serves to
    interpolate.
    """
    slow = np.delete(SLOW, np.s_[(SLOW > 5.0) & (SLOW < 8.0)])
    groups = {
        "Fast": [signal("v", FAST, 3.0 * FAST, "m/s")],
        "Slow": [signal("r", slow, 0.01 * slow, "rad/s")],
    }
    file = write_mdf(tmp_path / "a.mf4", groups)
    options = {"channels": {**ONE, "yaw_rate": {"column": "r", "unit": "rad/s"}}, "max_gap": 1.0}
    first, second = (read_mdf(file, run=run, **options) for run in (0, 1))
    assert (first.time[-1], second.start_time) == (
        pytest.approx(5.0, abs=0.03),
        pytest.approx(8.0, abs=0.03),
    )
    assert (first.provenance["run"], second.provenance["run"]) == (0, 1)
    for recording in (first, second):
        np.testing.assert_allclose(recording["vx"], 3.0 * recording.time, rtol=0, atol=1e-9)
        np.testing.assert_allclose(recording["yaw_rate"], 0.01 * recording.time, rtol=0, atol=1e-9)
    assert len(parts_of(file, **options | {"max_gap": None})) == 2


def test_invalid_samples_are_missing_values(tmp_path):
    bits = (np.arange(2001) >= 500) & (np.arange(2001) < 520)
    values = np.where(bits, 1e6, 10.0 + FAST)  # what stands at an invalid sample must never be seen
    file = one(tmp_path / "a.mf4", FAST, values, invalidation_bits=bits)
    before, after = parts_of(file)
    assert (
        "a gap of 0.21 s after 4.99 s, 20 samples of which are marked as not measured"
        in (before.provenance[MISSING]["vx"][0])
    )
    np.testing.assert_allclose(np.r_[before["vx"], after["vx"]], 10.0 + FAST[~bits], rtol=1e-12)
    recording = read_mdf(file, gappy=["vx"])
    expected = np.where(bits, np.nan, 10.0 + FAST)
    np.testing.assert_allclose(recording["vx"], expected, rtol=1e-12)


def test_a_slow_gappy_signal_stands_at_its_nearest_ticks_and_nowhere_else(tmp_path):
    slow = 0.003 + np.arange(1, 15)  # a GNSS at 1 Hz, 3 ms late, from 1 s to 14 s
    file = write_mdf(
        tmp_path / "a.mf4", {"A": [signal("v", FAST, FAST)], "G": [signal("w", slow, slow)]}
    )
    recording = read_mdf(
        file, channels={**ONE, "vx_ref": {"column": "w", "unit": "m/s"}}, gappy=["vx_ref"]
    )
    assert len(recording) == 2001  # it does not shorten the recording
    measured = np.flatnonzero(~np.isnan(recording["vx_ref"]))
    np.testing.assert_array_equal(measured, 100 * np.arange(1, 15))
    np.testing.assert_array_equal(recording["vx_ref"][measured], slow)


def test_a_misspelt_data_set_is_refused_in_one_line(tmp_path):
    for changes, message_part in (
        ({"rate_hz": None}, "give either rate_hz, or as raster"),
        ({"rate_hz": None, "raster": "steer"}, "raster must name one of its channels"),
        ({"gappy": ["steer"]}, "gappy names 'steer'"),
    ):
        options = {"channels": CHANNELS, **changes}
        message = refusal(
            lambda options=options: read_mdf(tmp_path / "a.mf4", **options), ConfigurationError
        )
        assert all(words in message for words in (message_part, "data set 'mine'"))
