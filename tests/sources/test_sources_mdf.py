"""MDF files of asammdf's own writer: groups of several rasters on one clock, and one clear line for what cannot be used."""

from __future__ import annotations

import gc
import struct
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.recording import Recording
from vehest.data.store import read_recording
from vehest.sources.base import open_source
from vehest.sources.unit_spellings import plain_unit

asammdf = pytest.importorskip("asammdf", reason="the measurements of these tests are written by asammdf")

SECONDS = 20.0
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


# --- one clock ---------------------------------------------------------------------------------------------------------------------


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


def test_a_held_value_stands_until_the_next_one(tmp_path: Path) -> None:
    file = one(tmp_path / "a.mf4", np.array([0.0, 0.1, 0.2, 0.1 + 0.2]), [1.0, 2.0, 3.0, 4.0])
    held = read(file, channels={"vx": {**ONE["vx"], "interpolation": "hold"}}, rate_hz=20)
    np.testing.assert_array_equal(held["vx"], [1, 1, 2, 2, 3, 3, 4])  # though 0.1 + 0.2 is a little more than 0.3
    np.testing.assert_allclose(read(file, channels=ONE, rate_hz=20)["vx"], [1, 1.5, 2, 2.5, 3, 3.5, 4], rtol=1e-12)


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


def test_provenance_says_version_start_and_rasters(drive: Path) -> None:
    about = dict(read(drive).provenance)
    assert (about["source"], about["file"], about["version"]) == ("mdf", "drive.mf4", "4.10")
    assert about["measured"].startswith("20")
    assert about["groups"]["1 'Gateway'"] == 50.0


def test_files_without_a_common_stretch_are_refused(tmp_path: Path) -> None:
    late = FAST + 30.0
    file = write(tmp_path / "a.mf4", [("A", [signal("v", FAST, FAST)]), ("B", [signal("w", late, late)])])
    channels = {**ONE, "ay": {"column": "w", "unit": "m/s²"}}
    assert "channel 'ay' (group 1 'B') begins at 30 s, channel 'vx' (group 0 'A') ends at 20 s" in refusal(file, channels=channels)


# --- signals and groups ------------------------------------------------------------------------------------------------------------


def test_a_name_in_several_groups_needs_its_group(drive: Path) -> None:
    without = {**CHANNELS, "vx": {"column": "VehSpd", "unit": "km/h"}}
    message = refusal(drive, channels=without)
    assert "signal 'VehSpd' stands in several groups: 0 'Powertrain', 1 'Gateway'; say which" in message
    by_number = read(drive, channels={**CHANNELS, "vx": {"column": "VehSpd", "unit": "km/h", "group": 1}})
    np.testing.assert_allclose(by_number["vx"], read(drive)["vx"] * 3.7 / 3.6, rtol=1e-4)
    for group in ("Getaway", 7, 2):
        message = refusal(drive, channels={**CHANNELS, "vx": {"column": "VehSpd", "unit": "km/h", "group": group}})
        assert f"signal 'VehSpd' is not in group '{group}', but in 0 'Powertrain', 1 'Gateway'" in message


def test_a_name_that_stands_twice_in_one_group_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "a.mf4", [("A", [signal("v", FAST, FAST), signal("v", FAST, 2 * FAST)])])
    assert "signal 'v' stands 2 times in group 0 'A'" in refusal(file, channels=ONE)


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
        (np.arange(2001, dtype="u1"), None, np.arange(2001) % 256),
        (np.arange(2001) % 2 == 1, None, np.arange(2001) % 2),
    ],
    ids=["linear", "table", "rational", "bytes", "bits"],
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


@pytest.mark.parametrize("version", ["2.14", "3.30", "4.00", "4.20"])
def test_other_versions_of_the_format_are_read(tmp_path: Path, drive: Path, version: str) -> None:
    recording = read(write(tmp_path / "a.mf4", version=version))
    for name, samples in read(drive).channels.items():
        np.testing.assert_allclose(recording[name], samples, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("compression", [1, 2])
def test_compressed_blocks_are_read(tmp_path: Path, drive: Path, compression: int) -> None:
    recording = read(write(tmp_path / "a.mf4", compression=compression))
    np.testing.assert_array_equal(recording["ay"], read(drive)["ay"])


def test_a_measurement_that_was_not_closed_is_read_and_stays_as_it_is(tmp_path: Path, drive: Path) -> None:
    content = bytearray(drive.read_bytes())
    content[:8] = b"UnFinMF "
    struct.pack_into("<H", content, 60, 1)  # "cycle counters need an update"
    (tmp_path / "open.mf4").write_bytes(content)
    np.testing.assert_array_equal(read(tmp_path / "open.mf4")["ay"], read(drive)["ay"])
    assert (tmp_path / "open.mf4").read_bytes() == content


# --- units -------------------------------------------------------------------------------------------------------------------------


def test_a_unit_that_the_file_contradicts_is_refused(tmp_path: Path) -> None:
    file = one(tmp_path / "a.mf4", FAST, FAST, "km/h")
    message = refusal(file, channels=ONE)
    assert "signal 'v' of group 0 'Only', for channel 'vx', is in 'km/h' by the file and in 'm/s' by conf/dataset" in message
    assert "set file_units: ignore" in message
    np.testing.assert_allclose(read(file, channels=ONE, file_units="ignore")["vx"], FAST)
    np.testing.assert_allclose(read(file, channels={"vx": {**ONE["vx"], "factor": 0.5}})["vx"], 0.5 * FAST)


@pytest.mark.parametrize("written", ["", "-", "1", "m/s", "M/s", "mps", "m / s", "[m/s]", "m·s^-1", "furlong"])
def test_the_same_unit_otherwise_spelt_and_unknown_ones_pass(tmp_path: Path, written: str) -> None:
    assert len(read(one(tmp_path / "a.mf4", FAST, FAST, written), channels=ONE)) == 2001


@pytest.mark.parametrize("written", ["kph", "mph", "kts", "deg", "m/s²", "%", "V", "km"])
def test_another_unit_or_quantity_is_refused(tmp_path: Path, written: str) -> None:
    assert f"is in '{written}' by the file" in refusal(one(tmp_path / "a.mf4", FAST, FAST, written), channels=ONE)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("°/s", "deg/s"),
        ("Â°/s", "deg/s"),
        ("1/min", "rpm"),
        ("m/s^2", "m/s²"),
        ("m s-2", "m/s²"),
        ("N·m", "Nm"),
        ("N", "N"),
        ("kN", "kN"),
        ("KN", None),  # kilonewton or knots
        ("Grad", None),  # degrees in German, gon elsewhere
        ("MPa", "MPa"),
        ("mPa", "another unit"),
        ("G", "g"),
    ],
)
def test_spellings_are_known_where_they_mean_one_thing(text: str, plain: str | None) -> None:
    assert plain_unit(text) == plain


# --- times and gaps ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: np.concatenate([t[:50], t[49:]]), "time repeats 1 times, first at sample 50 (0.49 s)"),
        (lambda t: np.concatenate([t[:50], t[40:]]), "time goes backwards 1 times, first at sample 50 (0.4 s)"),
        (lambda t: np.where(np.arange(len(t)) == 5, np.nan, t), "time stamp of sample 5 is not a number"),
        (lambda t: t[:1], "fewer than two time stamps"),
        (lambda t: t[:0], "fewer than two time stamps"),
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
    assert "group 0 'Only', for channel 'vx', is not measured for 0.31 s after 4.99 s, 1 such gaps in all (longer than 0.03 s)" in message
    assert "not measured for" in refusal(file, channels={"vx": {**ONE["vx"], "max_gap": 0.3}})
    bridged = read(file, channels={"vx": {**ONE["vx"], "max_gap": 0.31}})
    np.testing.assert_allclose(bridged["vx"], 3.0 * bridged.time, rtol=0, atol=1e-12)


def test_a_gap_where_other_signals_are_not_measured_does_not_matter(tmp_path: Path) -> None:
    kept, later = np.delete(FAST, np.s_[100:300]), FAST[500:]
    file = write(tmp_path / "a.mf4", [("A", [signal("v", kept, kept)]), ("B", [signal("w", later, later)])])
    recording = read(file, channels={**ONE, "ay": {"column": "w", "unit": "m/s²"}})
    assert (recording.start_time, len(recording)) == (5.0, 1501)


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


def test_a_recording_begins_and_ends_with_valid_samples(tmp_path: Path) -> None:
    stamps = FAST.copy()
    stamps[[30, 1989]] = np.nextafter(FAST[[30, 1989]], [9.0, 0.0])  # stamps carry the dust of their arithmetic
    recording = read(with_invalid(tmp_path / "a.mf4", np.s_[:30], np.s_[1990:], stamps=stamps), channels=ONE)
    assert (recording.start_time, len(recording)) == (0.3, 1960)
    np.testing.assert_allclose(recording["vx"], 10.0 + recording.time, rtol=1e-12)
    assert "holds no valid sample" in refusal(with_invalid(tmp_path / "b.mf4", np.s_[:]), channels=ONE)


def test_values_that_are_no_numbers_are_missing_too(tmp_path: Path) -> None:
    file = one(tmp_path / "a.mf4", FAST, np.where(FAST == 3.0, np.nan, FAST))
    assert "holds 1 samples between 3 s and 3 s" in refusal(file, channels=ONE)
    infinite = one(tmp_path / "b.mf4", FAST, np.where(FAST == 3.0, np.inf, FAST))
    assert "holds 1 samples between 3 s and 3 s" in refusal(infinite, channels=ONE)
    assert "holds 1 infinite values" in refusal(infinite, channels=ONE, gappy=["vx"])


def test_a_slow_gappy_signal_stands_at_its_nearest_ticks_and_nowhere_else(tmp_path: Path) -> None:
    slow = 0.003 + np.arange(1, 15)  # a GNSS at 1 Hz, 3 ms late, from 1 s to 14 s
    file = write(tmp_path / "a.mf4", [("A", [signal("v", FAST, FAST)]), ("G", [signal("w", slow, slow)])])
    recording = read(file, channels={**ONE, "vx_ref": {"column": "w", "unit": "m/s"}}, gappy=["vx_ref"])
    assert len(recording) == 2001  # it does not shorten the recording
    measured = np.flatnonzero(~np.isnan(recording["vx_ref"]))
    np.testing.assert_array_equal(measured, 100 * np.arange(1, 15))
    np.testing.assert_array_equal(recording["vx_ref"][measured], slow)


# --- files that cannot be read -----------------------------------------------------------------------------------------------------


def test_files_of_another_format_are_refused(tmp_path: Path) -> None:
    for name, content in {"text.mf4": b"time,vx\n1,2\n" * 50, "zip.mf4": b"PK\x03\x04" * 50, "short.mf4": b"MDF"}.items():
        (tmp_path / name).write_bytes(content)
        assert "is not an MDF file" in refusal(tmp_path / name, channels=ONE)
    (tmp_path / "empty.mf4").touch()
    assert "empty.mf4' is empty" in refusal(tmp_path / "empty.mf4", MissingError, channels=ONE)


@pytest.mark.parametrize("kept", [8, 63, 64, 100, 1000, 0.25, 0.5, 0.75, 0.99, 0.9999])
def test_a_truncated_file_is_one_line_and_no_noise(
    tmp_path: Path, drive: Path, kept: float, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ignored: list[Any] = []  # exceptions that Python would print as it clears up
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    content = drive.read_bytes()
    (tmp_path / "cut.mf4").write_bytes(content[: int(kept if kept >= 8 else kept * len(content))])
    assert "is it truncated or damaged?" in refusal(tmp_path / "cut.mf4")
    gc.collect()
    assert (capfd.readouterr(), ignored) == (("", ""), [])


def test_fewer_samples_than_the_header_says_are_refused(tmp_path: Path) -> None:
    content = bytearray(one(tmp_path / "a.mf4", FAST, FAST).read_bytes())
    count = content.find(b"##CG") + 24 + 6 * 8 + 8
    assert struct.unpack_from("<Q", content, count) == (2001,)
    struct.pack_into("<Q", content, count, 5000)
    (tmp_path / "a.mf4").write_bytes(content)
    assert "holds 2001 samples, its header says 5000; the file is truncated or damaged" in refusal(tmp_path / "a.mf4", channels=ONE)


def damaged(file: Path, block: bytes, which: int, offset: int, layout: str, value: int) -> Path:
    """Overwrite a number in one of a file's blocks, counted from 0."""
    content = bytearray(one(file, FAST, FAST, invalidation_bits=FAST > 15.0).read_bytes())
    place = -1
    for _ in range(which + 1):
        place = content.find(block, place + 1)
    struct.pack_into(layout, content, place + offset, value)
    file.write_bytes(content)
    return file


@pytest.mark.parametrize(("which", "offset"), [(0, 92), (1, 92), (1, 104)], ids=["time stamps", "values", "invalidation bits"])
def test_what_stands_outside_of_its_record_is_refused_before_foreign_memory_is_read(tmp_path: Path, which: int, offset: int) -> None:
    assert len(read(damaged(tmp_path / "a.mf4", b"##CN", 0, 88, "<B", 2), channels=ONE)) == 1501  # a master, as it should be
    file = damaged(tmp_path / "a.mf4", b"##CN", which, offset, "<I", 65_000)
    assert "stands outside of its group's records; the file is damaged" in refusal(file, channels=ONE)


def test_times_that_no_drive_has_are_refused(tmp_path: Path) -> None:
    assert "which is no time of a drive" in refusal(one(tmp_path / "a.mf4", 1e12 * FAST, FAST), channels=ONE)
    far = 1e300 * (1.0 + FAST)
    file = write(tmp_path / "b.mf4", [("A", [signal("v", FAST, FAST)]), ("B", [signal("w", far, FAST)])])
    message = refusal(file, channels={**ONE, "ay": {"column": "w", "unit": "m/s²"}})
    assert "signal 'w' of group 1 'B': time stamp of sample 0 is 1e+300 s, which is no time of a drive; repair" in message


@pytest.mark.parametrize(("attribute", "value"), [("sync_type", 4), ("sync_type", 2), ("channel_type", 0)])
def test_a_group_without_times_is_refused(tmp_path: Path, attribute: str, value: int) -> None:
    with asammdf.MDF() as measurement:
        measurement.append([signal("v", FAST, FAST)])
        setattr(measurement.groups[0].channels[0], attribute, value)  # an index, an angle; or no master at all
        measurement.save(tmp_path / "a.mf4")
    assert "has no time stamps: its group has no master channel of time" in refusal(tmp_path / "a.mf4", channels=ONE)


def test_files_are_found_by_pattern_and_named_by_stem(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    with pytest.raises(MissingError, match=r"no file in '.*' matches '\*\.mf4'"):
        source(folder).ids()
    for name in ("b.mf4", "a.mf4", "c.dat"):
        one(folder / name, FAST, FAST)
    (folder / "notes.txt").write_text("hello")
    found = source(folder, channels=ONE)
    assert (found.ids(), sorted(found.inputs())) == (["a", "b"], ["a.mf4", "b.mf4"])
    assert [recording.id for recording in found.recordings()] == ["a", "b"]
    with pytest.raises(MissingError, match=r"no recording 'z' \(it has a, b\)"):
        found.read("z")
    (folder / "a.dat").write_bytes(b"x")
    with pytest.raises(DataError, match="two files are called 'a'"):
        source(folder, files="*.*", channels=ONE).ids()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"channels": None}, "dataset.channels must be a mapping from a channel to its column and unit, not None"),
        ({"channels": {}}, "channels must map a channel to its column"),
        ({"channels": {"vx": "v"}}, "must say column, unit"),
        ({"channels": {"vx": {**ONE["vx"], "interpolation": "cubic"}}}, "interpolation 'cubic' is not one of: linear, hold"),
        ({"channels": {"vx": {**ONE["vx"], "group": 1.5}}}, "group must be the number or name"),
        ({"channels": {"vx": {**ONE["vx"], "max_gap": 0}}}, "max_gap: input should be greater than 0, not 0"),
        ({"channels": {"vx": {**ONE["vx"], "unit": "deg"}}}, "'deg' cannot be converted to 'm/s'"),
        ({"rate_hz": None}, "give either rate_hz, or as raster"),
        ({"raster": "vx"}, "give either rate_hz, or as raster"),
        ({"rate_hz": -1}, "rate_hz: input should be greater than 0, not -1"),
        ({"rate_hz": None, "raster": "steer"}, "raster must name one of its channels"),
        ({"gappy": "vx"}, "dataset.gappy must be a list of channels, not 'vx'"),
        ({"gappy": ["steer"]}, "gappy names 'steer'"),
        ({"file_units": "no"}, "file_units 'no' is not one of: check, ignore"),
        ({"files": "/etc/*"}, "files must be a pattern inside path"),
        ({"rates": 3}, "has no option 'rates'"),
    ],
)
def test_a_misspelt_data_set_is_refused_in_one_line(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        source(tmp_path, **changes)
    assert said in str(error.value)
    assert "data set 'mine'" in str(error.value)
    assert "\n" not in str(error.value)


# --- from the command line ---------------------------------------------------------------------------------------------------------


def test_ingest_and_check_run_on_measurements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from vehest.cli import main

    def vehest(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vehest", *arguments])
        code = 0
        try:
            main()
        except SystemExit as leave:
            code = int(leave.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    (tmp_path / "raw").mkdir()
    drive = write(tmp_path / "raw" / "lap.mf4")
    monkeypatch.setenv("VEHEST_DATA", str(tmp_path / "raw"))
    monkeypatch.delenv("VEHEST_OUTPUT", raising=False)
    shipped = Path(__file__).parents[2] / "conf" / "dataset" / "mdf.yaml"
    dataset = {**yaml.safe_load(shipped.read_text(encoding="utf-8")), "name": "mine", "channels": CHANNELS}
    Path("conf/dataset").mkdir(parents=True)
    Path("conf/dataset/mine.yaml").write_text(yaml.safe_dump(dataset, allow_unicode=True), encoding="utf-8")

    code, _, err = vehest("ingest", "mine")
    assert code == 0, err
    (stored,) = Path("outputs/ingest").glob("mine-*/lap.parquet")
    np.testing.assert_array_equal(read_recording(stored)["ay"], read(drive)["ay"])
    code, out, err = vehest("data", "check", "mine")
    assert (code, out, err) == (0, "nothing found\n", "")

    drive.write_bytes(drive.read_bytes()[:-3000])
    code, out, err = vehest("ingest", "mine")
    assert (code, out, len(err.splitlines())) == (3, "", 1)
    code, out, err = vehest("data", "check", "mine")
    assert (code, err) == (3, "")
    assert out.startswith("error   lap: ")
