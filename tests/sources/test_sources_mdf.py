"""MDF files of asammdf's own writer: groups of several rasters on one clock, and one clear line for what cannot be used."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.recording import Recording
from vehest.sources.base import open_source
from vehest.sources.unit_spellings import plain_unit

asammdf = pytest.importorskip("asammdf", reason="the measurements of these tests are written by asammdf")

FAST = np.arange(0, 2001) / 100.0  # 0 s to 20 s
SLOW = 0.513 + np.arange(0, 950) / 50.0  # to 19.493 s
JITTER = np.sort(0.2 + np.arange(0, 1960) / 100.0 + np.random.default_rng(0).uniform(-0.005, 0.005, 1960))  # intervals of 0 to 20 ms


def speed(t: FloatArray) -> FloatArray:
    return 25.0 + 4.0 * np.sin(0.5 * t)  # m/s


def yaw_rate(t: FloatArray) -> FloatArray:
    return 0.3 * np.sin(1.1 * t)  # rad/s


def lateral(t: FloatArray) -> FloatArray:
    return 6.0 * np.sin(1.1 * t + 0.2)  # m/s²


def signal(name: str, t: FloatArray, samples: Any, unit: str = "", **more: Any) -> Any:
    return asammdf.Signal(np.asarray(samples), t, name=name, unit=unit, **more)


GROUPS: list[tuple[str, list[Any]]] = [
    ("Powertrain", [signal("VehSpd", FAST, 3.6 * speed(FAST), "km/h"), signal("LongAcc", FAST, np.cos(0.5 * FAST), "m/s^2")]),
    ("Gateway", [signal("YawRate", SLOW, np.degrees(yaw_rate(SLOW)), "°/s"), signal("VehSpd", SLOW, 3.7 * speed(SLOW), "kph")]),
    ("Imu", [signal("LatAcc", JITTER, -lateral(JITTER) / 9.80665, "g")]),
]
CHANNELS: dict[str, Any] = {
    "vx": {"column": "VehSpd", "group": "Powertrain", "unit": "km/h"},
    "yaw_rate": {"column": "YawRate", "unit": "deg/s"},
    "ay": {"column": "LatAcc", "unit": "g", "sign": -1, "max_gap": 0.05},
    "ax": {"column": "LongAcc", "unit": "m/s²"},
}
THIRDS = np.arange(2001) % 3
ONE = {"vx": {"column": "v", "unit": "m/s"}}


def write(file: Path, groups: list[tuple[str, list[Any]]] = GROUPS, version: str = "4.10", **options: Any) -> Path:
    with asammdf.MDF(version=version) as measurement:
        for name, signals in groups:
            measurement.append(signals, acq_name=name, comment=name, common_timebase=True)
        saved = Path(measurement.save(file, overwrite=True, **options))
    return saved.rename(file)  # the writer chooses the suffix


def one(file: Path, t: FloatArray, samples: Any, unit: str = "m/s", **more: Any) -> Path:
    return write(file, [("Only", [signal("v", t, samples, unit, **more)])])


def source(folder: Path, **options: Any) -> Any:
    return open_source({"name": "mine", "source": "mdf", "path": str(folder), "rate_hz": 100, "channels": CHANNELS, **options})


def read(file: Path, **options: Any) -> Recording:
    recording = source(file.parent, files=file.name, **options).read(file.stem)
    assert isinstance(recording, Recording)
    return recording


def refusal(file: Path, kind: type[VehestError] = DataError, **options: Any) -> str:
    with pytest.raises(kind) as error:
        read(file, **options)
    assert type(error.value) is kind
    message = str(error.value)
    assert "\n" not in message
    assert file.name in message
    return message


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("mdf") / "drive.mf4")


@pytest.fixture(autouse=True)
def tidy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Whatever a test reads, nothing is left in the current folder or among temporary files."""
    here, temporary = tmp_path / "here", tmp_path / "temporary"
    here.mkdir()
    temporary.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    yield
    assert list(temporary.iterdir()) == []
    assert {file.name for file in here.iterdir()} <= {"conf", "outputs"}


def test_three_rasters_come_to_one_clock_as_their_formulas_say(drive: Path) -> None:
    recording = read(drive, vehicle="kart", citation="me")
    assert (recording.rate_hz, recording.start_time, recording.vehicle) == (100.0, 0.52, "kart")  # ticks count from the measurement's start
    assert len(recording) == round((19.49 - 0.52) * 100) + 1
    t = recording.time
    # ticks are this group's own samples
    np.testing.assert_allclose(recording["vx"], speed(t), rtol=0, atol=1e-12)
    np.testing.assert_allclose(recording["ax"], np.cos(0.5 * t), rtol=0, atol=1e-12)
    # linear interpolation over h is off by at most h²/8 · max |f''|
    np.testing.assert_allclose(recording["yaw_rate"], yaw_rate(t), rtol=0, atol=0.02**2 / 8 * 0.3 * 1.1**2)
    widest = np.diff(JITTER).max()
    np.testing.assert_allclose(recording["ay"], lateral(t), rtol=0, atol=widest**2 / 8 * 6.0 * 1.1**2)


def test_it_is_what_asammdf_itself_interpolates(drive: Path) -> None:
    recording = read(drive)
    with asammdf.MDF(drive) as measurement:
        frame = measurement.to_dataframe(
            channels=[("YawRate", None, None), ("LatAcc", None, None)], raster=recording.time, time_from_zero=False
        )
        held = measurement.get("YawRate").interp(recording.time, float_interpolation_mode=0)
    np.testing.assert_allclose(recording["yaw_rate"], np.radians(frame["YawRate"]), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(recording["ay"], -9.80665 * frame["LatAcc"], rtol=1e-12, atol=1e-12)
    channels = {**CHANNELS, "yaw_rate": {**CHANNELS["yaw_rate"], "interpolation": "hold"}}
    np.testing.assert_allclose(read(drive, channels=channels)["yaw_rate"], np.radians(held.samples), rtol=1e-12)


def test_the_clock_of_a_channel_can_be_taken_as_it_is(drive: Path) -> None:
    recording = read(drive, rate_hz=None, raster="yaw_rate", accept=["aliasing"])
    assert (recording.rate_hz, recording.start_time, len(recording)) == (50.0, SLOW[0], len(SLOW))
    np.testing.assert_array_equal(recording["yaw_rate"], np.radians(1.0) * np.degrees(yaw_rate(SLOW)))
    np.testing.assert_allclose(recording["vx"], speed(SLOW), rtol=0, atol=0.01**2 / 8 * 1.0)
    assert "group 2 'Imu', whose clock is taken, does not come evenly: " in refusal(drive, rate_hz=None, raster="ay")


def test_a_signal_faster_than_the_raster_is_not_folded_into_it(drive: Path) -> None:
    message = refusal(drive, rate_hz=50)
    assert "signal 'VehSpd' of group 0 'Powertrain', for channel 'vx', comes at 100 Hz, faster than the raster of 50 Hz" in message
    assert read(drive, rate_hz=50, accept=["aliasing"]).rate_hz == 50.0


def test_a_name_in_several_groups_needs_its_group(drive: Path) -> None:
    without = {**CHANNELS, "vx": {"column": "VehSpd", "unit": "km/h"}}
    message = refusal(drive, channels=without)
    assert "signal 'VehSpd' stands 2 times, in group 0 'Powertrain', 1 'Gateway'; say which" in message
    by_number = read(drive, channels={**CHANNELS, "vx": {"column": "VehSpd", "unit": "km/h", "group": 1}})
    np.testing.assert_allclose(by_number["vx"], read(drive)["vx"] * 3.7 / 3.6, rtol=1e-4)
    for group in ("Getaway", 7, 2):
        message = refusal(drive, channels={**CHANNELS, "vx": {"column": "VehSpd", "unit": "km/h", "group": group}})
        assert f"signal 'VehSpd' is not in group '{group}', but in 0 'Powertrain', 1 'Gateway'" in message


def test_an_absent_signal_is_answered_with_near_ones(drive: Path, tmp_path: Path) -> None:
    assert "has no signal 'Vehspeed' (near it: VehSpd)" in refusal(drive, channels={"vx": {"column": "Vehspeed", "unit": "km/h"}})
    assert "(it has 4 signals)" in refusal(drive, channels={"vx": {"column": "zzzz", "unit": "km/h"}})
    assert "has no signal 'time'" in refusal(drive, channels={"vx": {"column": "time", "unit": "km/h"}})  # a master is no signal
    frames = write(tmp_path / "bus.mf4", [("CAN", [signal("CAN_DataFrame.ID", FAST, FAST)])])
    assert "undecoded frames of a bus" in refusal(frames, channels=ONE)


@pytest.mark.parametrize(
    ("raw", "conversion", "physical"),
    [
        (np.arange(2001, dtype="u2"), {"a": 0.01, "b": -3.0}, 0.01 * np.arange(2001) - 3.0),
        (THIRDS.astype("i2"), {"raw_0": 0, "phys_0": 5.0, "raw_1": 2, "phys_1": 9.0, "interpolation": True}, 5.0 + 2.0 * THIRDS),
        (
            np.arange(2001, dtype="f4"),
            {"P1": 1.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 1.0, "P6": 4.0},
            (np.arange(2001.0) ** 2 + 2 * np.arange(2001) + 1) / (np.arange(2001) + 4),
        ),
        (np.arange(2001) % 2 == 1, None, np.arange(2001) % 2),
    ],
    ids=["linear", "table", "rational", "bits"],
)
def test_physical_values_are_read(tmp_path: Path, raw: Any, conversion: Any, physical: FloatArray) -> None:
    recording = read(one(tmp_path / "a.mf4", FAST, raw, conversion=conversion), channels=ONE)
    np.testing.assert_allclose(recording["vx"], physical, rtol=1e-12)


def test_text_is_refused(tmp_path: Path) -> None:
    gear = {"val_0": 0, "text_0": b"N", "val_1": 1, "text_1": b"D", "default": b"?"}
    table = one(tmp_path / "a.mf4", FAST, np.arange(2001) % 2, conversion=gear)
    plain = one(tmp_path / "b.mf4", FAST, np.array([b"on"] * 2001), encoding="utf-8")
    for file in (table, plain):
        assert "signal 'v' of group 0 'Only' holds text; numbers are needed" in refusal(file, channels=ONE)
    rows = one(tmp_path / "c.mf4", FAST, np.zeros(2001, dtype=[("v", "(3,)<f8")]))
    assert "holds an array or structure" in refusal(rows, channels=ONE)


@pytest.mark.parametrize("version", ["2.14", "3.30", "4.20"])
def test_other_versions_of_the_format_are_read(tmp_path: Path, drive: Path, version: str) -> None:
    recording = read(write(tmp_path / "a.mf4", version=version))
    for name, samples in read(drive).channels.items():
        np.testing.assert_allclose(recording[name], samples, rtol=1e-9, atol=1e-9)


def test_a_unit_that_the_file_contradicts_is_refused(tmp_path: Path) -> None:
    file = one(tmp_path / "a.mf4", FAST, FAST, "km/h")
    message = refusal(file, channels=ONE)
    assert "signal 'v' of group 0 'Only', for channel 'vx', is in 'km/h' by the file and in 'm/s' by conf/dataset" in message
    assert "set file_units: ignore" in message
    np.testing.assert_allclose(read(file, channels=ONE, file_units="ignore")["vx"], FAST)
    np.testing.assert_allclose(read(file, channels={"vx": {**ONE["vx"], "factor": 0.5}})["vx"], 0.5 * FAST)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("Â°/s", "deg/s"),
        ("1/min", "rpm"),
        ("m/s^2", "m/s²"),
        ("KN", None),  # kilonewton or knots
        ("Grad", None),  # degrees in German, gon elsewhere
        ("MPa", "MPa"),
        ("mPa", "another unit"),
    ],
)
def test_spellings_are_known_where_they_mean_one_thing(text: str, plain: str | None) -> None:
    assert plain_unit(text) == plain


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: np.concatenate([t[:50], t[49:]]), "time repeats 1 times, first at sample 50 (0.49 s)"),
        (lambda t: np.concatenate([t[:50], t[40:]]), "time goes backwards 1 times, first at sample 50 (0.4 s)"),
        (lambda t: np.where(np.arange(len(t)) == 5, np.nan, t), "time stamp of sample 5 is nan s"),
        (lambda t: t[:1], "fewer than two time stamps"),
    ],
)
def test_disordered_time_stamps_are_refused_with_their_group(tmp_path: Path, change: Any, said: str) -> None:
    stamps = change(FAST)
    message = refusal(one(tmp_path / "a.mf4", stamps, np.ones(len(stamps))), channels=ONE)
    assert f"signal 'v' of group 0 'Only': {said}" in message


def test_a_long_gap_must_be_declared(tmp_path: Path) -> None:
    kept = np.delete(FAST, np.s_[500:530])
    file = one(tmp_path / "a.mf4", kept, 3.0 * kept)
    message = refusal(file, channels=ONE)
    assert "group 0 'Only', for channel 'vx', has a gap of 0.31 s after 4.99 s, the longest of 1 above 0.03 s" in message
    assert "a gap of" in refusal(file, channels={"vx": {**ONE["vx"], "max_gap": 0.3}})
    bridged = read(file, channels={"vx": {**ONE["vx"], "max_gap": 0.31}})
    np.testing.assert_allclose(bridged["vx"], 3.0 * bridged.time, rtol=0, atol=1e-12)


def with_invalid(file: Path, *ranges: slice, stamps: FloatArray = FAST) -> Path:
    bits = np.zeros(len(FAST), dtype=bool)
    for one_range in ranges:
        bits[one_range] = True
    values = np.where(bits, 1e6, 10.0 + FAST)  # what stands at an invalid sample must never be seen
    return one(file, stamps, values, invalidation_bits=bits)


def test_invalid_samples_are_missing_values(tmp_path: Path) -> None:
    file = with_invalid(tmp_path / "a.mf4", np.s_[500:520])
    message = refusal(file, channels=ONE)
    assert "holds 20 samples between 5 s and 5.19 s that are marked invalid" in message
    recording = read(file, channels=ONE, gappy=["vx"])
    expected = np.where((np.arange(2001) >= 500) & (np.arange(2001) < 520), np.nan, 10.0 + FAST)
    np.testing.assert_allclose(recording["vx"], expected, rtol=1e-12)


def test_a_slow_gappy_signal_stands_at_its_nearest_ticks_and_nowhere_else(tmp_path: Path) -> None:
    slow = 0.003 + np.arange(1, 15)  # a GNSS at 1 Hz, 3 ms late, from 1 s to 14 s
    file = write(tmp_path / "a.mf4", [("A", [signal("v", FAST, FAST)]), ("G", [signal("w", slow, slow)])])
    recording = read(file, channels={**ONE, "vx_ref": {"column": "w", "unit": "m/s"}}, gappy=["vx_ref"])
    assert len(recording) == 2001  # it does not shorten the recording
    measured = np.flatnonzero(~np.isnan(recording["vx_ref"]))
    np.testing.assert_array_equal(measured, 100 * np.arange(1, 15))
    np.testing.assert_array_equal(recording["vx_ref"][measured], slow)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"channels": None}, "dataset.channels must be a mapping from a channel to its column and unit, not None"),
        ({"channels": {"vx": {**ONE["vx"], "interpolation": "cubic"}}}, "interpolation 'cubic' is not one of: linear, hold"),
        ({"channels": {"vx": {**ONE["vx"], "max_gap": 0}}}, "max_gap: input should be greater than 0, not 0"),
        ({"rate_hz": None}, "give either rate_hz, or as raster"),
        ({"rate_hz": None, "raster": "steer"}, "raster must name one of its channels"),
        ({"gappy": ["steer"]}, "gappy names 'steer'"),
        ({"file_units": "no"}, "file_units 'no' is not one of: check, ignore"),
        ({"rates": 3}, "has no option 'rates'"),
    ],
)
def test_a_misspelt_data_set_is_refused_in_one_line(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        source(tmp_path, **changes)
    assert said in str(error.value)
    assert "data set 'mine'" in str(error.value)
    assert "\n" not in str(error.value)
