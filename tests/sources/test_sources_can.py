"""Logs of python-can's own writers: a drive comes back as it was, and one clear line for what
cannot be used.
"""

import re
import struct
import zlib
from datetime import UTC, datetime

import numpy as np
import pytest
from refusals import refusal

from conftest import planar_drive
from vehest.data.errors import VehestError
from vehest.data.limits import Limits, use_limits
from vehest.data.recording import MISSING
from vehest.run.inspect_data import check
from vehest.run.own_car.inspect import inspect
from vehest.sources.base import open_source
from vehest.sources.surveys import survey

cantools = pytest.importorskip("cantools", reason="cantools is not installed")
can = pytest.importorskip("can", reason="python-can is not installed: pip install 'vehest[bus]'")

from can_drive import ORIGIN, SIGNALS, write_log  # noqa: E402

FOUR = {name: SIGNALS[name] for name in ("vx", "yaw_rate", "ax", "ay")}
STEPS = {"vx": 0.01 / 3.6, "yaw_rate": np.radians(0.005), "ax": 0.001, "ay": 0.001}


def read(folder, **options):
    told = {
        "files": "drive.*",
        "dbc": str(folder / "car.dbc"),
        "rate_hz": 100,
        "channels": FOUR,
        **options,
    }
    return open_source({"name": "mine", "source": "can", "path": str(folder), **told}).read("drive")


def drive(seconds=10.0):
    return planar_drive(seconds, 100.0, seed=3)


SPEED = {"vx": {"column": "Speed", "unit": "m/s"}}


def log(folder, dbc, frames):
    """Frames of message 291: their times, buses and bytes."""
    (folder / "car.dbc").write_text(dbc)
    with can.Logger(folder / "drive.asc") as writer:
        for stamp, bus, data in frames:
            is_fd = len(data) > 8
            writer(can.Message(stamp, 291, False, data=data, channel=bus, is_fd=is_fd))


def one(signal, length=8):
    return f'VERSION ""\n\nBO_ 291 Speed: {length} Car\n SG_ Speed : {signal}\n'


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_a_drive_comes_back_within_the_resolution_of_its_signals(tmp_path, suffix):
    sent = drive()
    write_log(sent, tmp_path, suffix)
    recording = read(tmp_path)
    k = np.rint((recording.time - recording.start_time) * 100.0).astype(int)
    assert len(recording) >= len(sent) - 2
    assert recording.rate_hz == 100.0
    for (
        name,
        step,
    ) in STEPS.items():  # frames of the second message come 0.4 ms late: the slope times that
        slack = 0.0005 * np.abs(np.gradient(sent[name], 0.01)).max()
        np.testing.assert_allclose(recording[name], sent[name][k], atol=0.5 * step + slack + 1e-9)


def test_raw_values_that_mean_nothing_are_gaps_of_a_gappy_channel_and_one_bus_of_several_is_taken(
    tmp_path,
):
    log(
        tmp_path,
        one('0|16@1+ (0.01,0) [0|0] "m/s" Car'),
        [(k / 100, 0, struct.pack("<H6x", 65535 if 20 <= k < 30 else k)) for k in range(100)],
    )
    recording = read(tmp_path, channels={"vx": {**SPEED["vx"], "invalid": [65535]}}, gappy=["vx"])
    assert np.flatnonzero(np.isnan(recording["vx"])).tolist() == list(range(20, 30))
    log(
        tmp_path,
        one('0|8@1+ (1,0) [0|0] "m/s" Car'),
        [(k / 200, k % 2, bytes([10 + k % 2] * 8)) for k in range(200)],
    )
    message = "comes on the buses 1, 2; say which by bus: 1"
    assert message in refusal(lambda: read(tmp_path, channels=SPEED, rate_hz=400))
    assert set(read(tmp_path, channels=SPEED, bus=2)["vx"]) == {11.0}
    assert "never occurs on bus 3" in refusal(lambda: read(tmp_path, channels=SPEED, bus=3))


def test_what_is_declared_wrongly_or_beyond_the_limits_is_said_in_a_line(tmp_path):
    write_log(drive(), tmp_path)
    for options, message in (
        (
            {"channels": {"vx": {"column": "Speed.VehSpeed", "unit": "km/h"}}},
            "no signal 'Speed.VehSpeed'; did you mean 'Speed.VehSpd'?",
        ),
        (
            {"channels": {"vx": {"column": "Counter", "unit": "m/s"}}},
            "stands in several messages; write one of IMU.Counter, Speed.Counter",
        ),
        (
            {"channels": {"steer": {"column": "SteerAng", "unit": "deg"}}},
            "'SteerAng' for channel 'steer' never occurs",
        ),
        (
            {"channels": {"vx": {"column": "VehSpd", "unit": "m/s"}}},
            "'km/h' by the file and in 'm/s' by conf/dataset",
        ),
        ({"rate_hz": 50}, "faster than the raster"),
    ):
        assert message in refusal(lambda options=options: read(tmp_path, **options))
    with use_limits(Limits(samples=100)):
        assert "holds 101 frames or more" in refusal(lambda: read(tmp_path))


@pytest.mark.parametrize(
    ("dbc", "message"),
    [
        (
            one('0|16@1+ (1,0) [0|0] "" Car', length=4_000_000_000),
            "impossible length: BO_ 291 Speed: 4000000000",
        ),
        (one('60|8@1+ (1,0) [0|0] "" Car'), "cannot be decoded"),
        (one('0|16@1+ (1e999,0) [0|0] "" Car'), "has the scale inf"),
        (one("soon"), "cannot be read as a DBC"),
    ],
)
def test_a_dbc_that_makes_no_sense_is_one_line(tmp_path, dbc, message):
    log(tmp_path, dbc, [(k / 100, 0, bytes(8)) for k in range(50)])
    assert message in refusal(lambda: read(tmp_path, channels=SPEED))


def blf_with(content, method=0):
    """A BLF file with one container of whatever is given."""
    head = b"LOGG" + struct.pack("<L", 144) + bytes(136)
    body = content if method == 0 else zlib.compress(content)
    return (
        head
        + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 32 + len(body), 10)
        + struct.pack("<H6xL4x", method, len(content))
        + body
    )


@pytest.mark.parametrize(
    ("suffix", "change", "message"),
    [
        (".blf", lambda content: content[:-20], "is truncated"),
        (
            ".blf",
            lambda _: blf_with(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 2**32 - 1, 1) + bytes(100)),
            "holds no frame",
        ),
        (".blf", lambda _: blf_with(bytes(100 * 2**20), 2), "Could not find next object"),
        (
            ".asc",
            lambda content: content[: content.rindex(b"Rx") + 12] + b"\n",
            "a frame of message .* holds",
        ),
        (
            ".asc",
            lambda content: content.replace(b" 120 ", b" IMU "),
            "names of messages such as 'IMU'",
        ),
        (".asc", lambda content: content.replace(b" 04 ", b" zz ", 1), "is damaged .*zz"),
    ],
)
def test_a_damaged_log_is_one_line(tmp_path, suffix, change, message):
    written = write_log(drive(3.0), tmp_path, suffix)
    written.log.write_bytes(change(written.log.read_bytes()))
    assert re.search(message, refusal(lambda: read(tmp_path)))


def since_last_event(text):
    """An .asc whose stamps count from the event before."""
    stamp = re.compile(r" *(\d+\.\d+) ")
    lines = text.replace("timestamps absolute", "timestamps relative").splitlines()
    before = 0.0
    for k, line in enumerate(lines):
        if match := stamp.match(line):
            lines[k] = f" {float(match[1]) - before:.6f} {line[match.end() :]}"
            before = float(match[1])
    return "\n".join(lines)


def with_requests(text):
    """An .asc in which each frame was requested to be sent, a little before."""
    return re.sub(r"(?m)^(.*) Rx (.*)$", r"\1 TxRq \2\n\1 Rx \2", text)


def on_screen(text):
    """What candump writes on the screen, of its log."""

    def line(match):
        time, bus, identifier, data = match.groups()
        pairs = re.sub("(..)", r"\1 ", data).strip()
        return f" ({time})  {bus}  {identifier}   [{len(data) // 2}]  {pairs}"

    return re.sub(r"\(([\d.]+)\) (\S+) (\w+)#(\w+).*", line, text)


def with_dates(text):
    """What `candump -tA` writes on the screen."""

    def date(match):
        moment = datetime.fromtimestamp(float(match[1]), UTC)
        return f"({moment:%Y-%m-%d %H:%M:%S.%f})"

    return re.sub(r"\(([\d.]+)\)", date, on_screen(text))


def from_zero(text):
    """What `candump -tz` writes on the screen."""
    return re.sub(r"\(([\d.]+)\)", lambda m: f"({float(m[1]) - ORIGIN:010.6f})", on_screen(text))


def since_last_frame(text):
    """What `candump -td` writes on the screen."""
    stamps = [float(stamp) for stamp in re.findall(r"\(([\d.]+)\)", text)]
    steps = iter(np.diff(stamps, prepend=stamps[0]))
    return re.sub(r"\(([\d.]+)\)", lambda _: f"({next(steps):010.6f})", on_screen(text))


@pytest.mark.parametrize(
    ("suffix", "written_by_another"),
    [
        (".log", from_zero),
        (".log", since_last_frame),
        (".asc", since_last_event),
        (".asc", with_requests),
        (".log", on_screen),
        (".log", with_dates),
    ],
)
def test_logs_of_other_writers_hold_the_same_drive(tmp_path, suffix, written_by_another):
    written = write_log(drive(3.0), tmp_path, suffix)
    expected = read(tmp_path)
    text = written.log.read_text()
    written.log.write_text(written_by_another(text))
    assert written.log.read_text() != text
    for name, samples in read(tmp_path).channels.items():
        np.testing.assert_allclose(samples, expected[name], atol=1e-6)


LAYOUTS = """VERSION ""

BO_ 291 Layouts: 24 Car
 SG_ Which M : 0|4@1+ (1,0) [0|0] "" Car
 SG_ Little : 13|11@1- (0.25,-3) [0|0] "m/s" Car
 SG_ Big : 27|13@0- (-0.5,7) [0|0] "m/s" Car
 SG_ Wide : 46|30@0+ (1,0) [0|0] "" Car
 SG_ Selected m3 : 72|16@1- (0.01,0) [0|0] "" Car
 SG_ Single : 96|32@1- (1,0) [0|0] "" Car
 SG_ Double : 135|64@0- (1,0) [0|0] "" Car

SIG_VALTYPE_ 291 Single : 1 ;
SIG_VALTYPE_ 291 Double : 2 ;
"""


def test_all_signals_of_a_log_are_decoded_as_cantools_does(tmp_path):
    generator = np.random.default_rng(0)
    frames = [(k / 100, 0, generator.bytes(24)) for k in range(400)]
    log(tmp_path, LAYOUTS, frames)
    (message,) = cantools.database.load_string(LAYOUTS, "dbc").messages
    expected = [
        {name: float(value) for name, value in message.decode(data).items()}
        for _, _, data in frames
        if data[0] % 16 == 3
    ]
    (file,) = tmp_path.glob("drive.*")
    columns = survey(file, tmp_path / "car.dbc").by_name
    others = {"Layouts.Little", "Layouts.Big", "Layouts.Wide", "Layouts.Single", "Layouts.Double"}
    assert set(columns) == {*others, "Layouts.Selected"}
    is_selected = np.array([data[0] % 16 == 3 for _, _, data in frames])
    np.testing.assert_allclose(
        columns["Layouts.Selected"].stamps - columns["Layouts.Little"].stamps[0],
        np.flatnonzero(is_selected) / 100.0,
        atol=1e-6,
    )
    for name, column in columns.items():
        values = column.values if name == "Layouts.Selected" else column.values[is_selected]
        sent = np.array([sample[name.removeprefix("Layouts.")] for sample in expected])
        usual = np.abs(sent) < 1e15
        np.testing.assert_allclose(values[usual], sent[usual], rtol=1e-6)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["car.dbc"], "describes a bus; name a log of it as well"),
        (["drive.asc"], "name the DBC file of the bus behind it, as in: vehest new"),
        (["drive.asc", "car.dbc", "other.dbc"], "a data set has one DBC"),
        (["lap.csv", "car.dbc"], "is no log of a CAN bus"),
        (["drive.asc", "other.dbc"], "has no frame of a message of"),
        (["drive.asc", "broken.dbc"], "cannot be read as a DBC"),
    ],
)
def test_what_new_cannot_do_with_a_dbc_is_one_line(tmp_path, names, message):
    write_log(drive(3.0), tmp_path)
    (tmp_path / "other.dbc").write_text(one('0|16@1+ (1,0) [0|0] "m/s" Car'))
    (tmp_path / "broken.dbc").write_text("no DBC")
    (tmp_path / "lap.csv").write_text("t,v\n0,1\n")
    files = [tmp_path / name for name in names]
    assert message in refusal(lambda: inspect("my_car", files), VehestError)


def ramp(missing):
    """Frames of 100 Hz whose first two bytes count up, but for a missing code from sample 20."""
    return [
        (k / 100, 0, struct.pack("<H6x", missing[k - 20] if 20 <= k < 20 + len(missing) else k))
        for k in range(200)
    ]


def choices(text):
    return one('0|16@1+ (0.01,0) [0|300] "m/s" Car') + f"\nVAL_ 291 Speed {text} ;\n"


def recordings(folder, **options):
    declared = {"name": "mine", "source": "can", "files": "drive.*", "path": str(folder)}
    declared |= {"dbc": str(folder / "car.dbc"), "rate_hz": 100, "channels": SPEED}
    return list(open_source(declared | options).recordings())


@pytest.mark.parametrize("name", ["SNA", "Speed_Invalid", "ERROR", "Init", "n.a."])
def test_values_that_the_dbc_names_not_available_are_missing_samples(tmp_path, name):
    log(tmp_path, choices(f'65535 "{name}"'), ramp([65535] * 5))
    recording = read(tmp_path, channels={"vx": {**SPEED["vx"], "max_gap": 0.1}})
    np.testing.assert_allclose(recording["vx"], np.arange(len(recording)) / 100.0, atol=1e-9)
    parts = recordings(tmp_path)
    expected = [(20, 0.19), (175, 1.99)]
    assert [(len(part), float(part["vx"].max())) for part in parts] == expected
    assert (
        parts[0]
        .provenance[MISSING]["vx"][0]
        .startswith(
            "a gap of 0.06 s after 0.19 s, 5 samples of which are marked as not measured, ends "
            "the recording"
        )
    )


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig"])
def test_names_of_values_match_in_the_encodings_of_dbc_files(tmp_path, encoding):
    log(tmp_path, "", ramp([65535] * 5))
    content = choices('65535 "Ungültig"').replace("m/s", "km/h").encode(encoding)
    (tmp_path / "car.dbc").write_bytes(content)
    speed = {**SPEED["vx"], "unit": "km/h", "max_gap": 0.1}
    recording = read(tmp_path, channels={"vx": speed})
    np.testing.assert_allclose(recording["vx"], np.arange(len(recording)) / 360.0, atol=1e-9)


def test_long_missing_samples_end_a_recording_where_the_data_set_has_a_max_gap(tmp_path):
    log(tmp_path, choices('65535 "SNA"'), ramp([65535] * 50))
    parts = recordings(tmp_path, max_gap=0.1)
    assert [(len(part), float(part["vx"].max())) for part in parts] == [(20, 0.19), (130, 1.99)]


@pytest.mark.parametrize(
    "names", ['0 "Init"', '30 "Errors occurred once"', '30 "valid"', '30 "N" 31 "Normal"']
)
def test_values_with_other_names_and_the_zero_of_a_standing_car_are_measurements(tmp_path, names):
    log(tmp_path, choices(names), ramp([]))
    recording = read(tmp_path, channels=SPEED)
    np.testing.assert_allclose(recording["vx"], np.arange(len(recording)) / 100.0, atol=1e-9)


J1939 = """VERSION ""

BO_ 2566834174 Wheels: 8 Car
 SG_ Speed : 0|16@1+ (0.00390625,0) [0|{maximum}] "km/h" Car
{protocol}"""
PROTOCOL = """BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
BA_ "VFrameFormat" BO_ 2566834174 3;
"""


@pytest.mark.parametrize(
    ("maximum", "protocol", "n_missing"),
    [("250.996", "", 3), ("0", PROTOCOL, 3), ("300", "", 0)],
    ids=["beyond the declared maximum", "by the protocol", "within the declared range"],
)
def test_reserved_codes_of_j1939_are_missing_samples(tmp_path, maximum, protocol, n_missing):
    (tmp_path / "car.dbc").write_text(J1939.format(maximum=maximum, protocol=protocol))
    raw = np.full(100, 0xFAFF)  # the highest value that is a measurement
    raw[[40, 50, 60]] = 0xFB00, 0xFE01, 0xFFFF
    with can.Logger(tmp_path / "drive.asc") as writer:
        for k, code in enumerate(raw.tolist()):
            data = struct.pack("<H6x", code)
            writer(can.Message(k / 100, 2566834174 & 0x1FFFFFFF, True, data=data, channel=0))
    channels = {"vx": {"column": "Speed", "unit": "km/h"}}
    speed = read(tmp_path, channels=channels, gappy=["vx"])["vx"]
    assert np.count_nonzero(np.isnan(speed)) == n_missing
    assert (3.6 * speed[~np.isnan(speed)] < 251.0).all() == (n_missing > 0)


def test_data_check_names_missing_samples_and_goes_on_with_the_segments(tmp_path, monkeypatch):
    log(tmp_path, choices('65535 "SNA"'), [*ramp([65535] * 5), (2.0, 0, b"\x00\xf0" + bytes(6))])
    text = f"""
name: mine
title: ""
vehicle: mine
licence: ""
citation: ""
source: can
path: {tmp_path}
files: drive.*
dbc: {tmp_path}/car.dbc
rate_hz: 100
channels: {{vx: {{column: Speed, unit: m/s}}}}
"""
    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    (tmp_path / "conf" / "dataset" / "mine.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    rows, _ = check("mine", [])
    missing = [(row["recording"], row["channel"]) for row in rows if row["check"] == "missing"]
    assert missing == [("drive_run_0", "vx")]
    impossible = [row["recording"] for row in rows if row["check"] == "impossible"]
    assert impossible == ["drive_run_1"]


@pytest.mark.parametrize("suffix", [".asc", ".log"])
@pytest.mark.parametrize("n_bytes", [2, 12, 30])
def test_a_last_line_that_is_cut_short_is_left_out_and_named(tmp_path, suffix, n_bytes):
    written = write_log(drive(3.0), tmp_path, suffix)
    expected = read(tmp_path)
    lines = [line for line in written.log.read_text().splitlines() if "#" in line or "Rx" in line]
    text = written.log.read_text()
    written.log.write_text(text[: text.index(lines[-1]) + len(lines[-1]) - n_bytes])
    recording = read(tmp_path)
    assert len(recording) >= len(expected) - 1
    (left_out,) = recording.provenance[MISSING][""]
    assert left_out.startswith("not read: last line '")


def pcan(text):
    """A candump log as a trace of PCAN's version 1.1."""
    rows = []
    for k, line in enumerate(text.splitlines(), start=1):
        stamp, _, frame = line.split()[:3]
        identifier, data = frame.split("#")
        pairs = re.sub("(..)", r"\1 ", data).strip()
        milliseconds = 1000.0 * (float(stamp.strip("()")) - 1.7e9)
        digits = 4 if len(identifier) == 3 else 8
        rows.append(
            f"{k:6})  {milliseconds:10.1f}  Rx     {identifier:0>{digits}}  {len(data) // 2}  "
            f"{pairs}"
        )
    return "\n".join([";$FILEVERSION=1.1", ";$STARTTIME=43008.925", ";---+--   ----", *rows, ""])


def test_a_trace_of_pcan_holds_the_same_drive(tmp_path):
    written = write_log(drive(3.0), tmp_path, ".log")
    expected = read(tmp_path)
    (tmp_path / "drive.trc").write_text(pcan(written.log.read_text()))
    recording = read(tmp_path, files="drive.trc", bus=1)
    assert abs(len(recording) - len(expected)) <= 1
    for name in FOUR:
        n = min(len(recording), len(expected)) - 1
        step = np.abs(np.diff(expected[name])).max()
        np.testing.assert_allclose(recording[name][:n], expected[name][:n], atol=1.1 * step)


MAGNITUDE = """VERSION ""

BO_ 291 ESP_02: 8 Car
 SG_ ESP_Gierrate : 0|14@1+ (0.01,0) [0|163] "deg/s" Car
 SG_ ESP_VZ_Gierrate : 14|1@1+ (1,0) [0|1] "" Car

BO_ 292 ESP_03: 8 Car
 SG_ ESP_VZ_Other : 14|1@1+ (1,0) [0|1] "" Car
"""


def test_a_signal_of_the_same_message_is_the_sign_of_a_magnitude(tmp_path):
    rate = np.arange(-100, 100)  # 0.01 deg/s
    frames = [
        (k / 100, 0, struct.pack("<H6x", abs(raw) | (raw < 0) << 14))
        for k, raw in enumerate(rate.tolist())
    ]
    log(tmp_path, MAGNITUDE, frames)
    declared = {"column": "ESP_Gierrate", "unit": "deg/s", "sign_column": "ESP_VZ_Gierrate"}
    recording = read(tmp_path, channels={"yaw_rate": declared})
    np.testing.assert_allclose(recording["yaw_rate"], np.radians(0.01 * rate), atol=1e-12)
    for column, message in (
        ("ESP_VZ_Other", "is in message 'ESP_03', 'ESP_Gierrate' in 'ESP_02'; only a sign in the"),
        ("ESP_VZ_Gierate", "did you mean 'ESP_VZ_Gierrate'"),
    ):
        channels = {"yaw_rate": {**declared, "sign_column": column}}
        assert message in refusal(lambda channels=channels: read(tmp_path, channels=channels))


def test_a_message_of_j1939_from_another_source_address_is_named_with_the_remedy(tmp_path):
    dbc = J1939.format(maximum="250.996", protocol="")
    channels = {"vx": {"column": "Speed", "unit": "km/h"}}
    with can.Logger(tmp_path / "drive.asc") as writer:
        for k in range(100):
            identifier = (2566834174 & 0x1FFFFF00) | 0x0B
            writer(can.Message(k / 100, identifier, True, data=struct.pack("<H6x", k), channel=0))
    (tmp_path / "car.dbc").write_text(dbc)
    message = refusal(lambda: read(tmp_path, channels=channels))
    number = re.search(r"write BO_ (\d+) in the DBC, instead of 2566834174", message)[1]
    (tmp_path / "car.dbc").write_text(dbc.replace("2566834174", number))
    assert len(read(tmp_path, channels=channels)) == 100
