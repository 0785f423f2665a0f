"""ROS 2 bags written by the test, of a drive in closed form: what comes back, and one clear line
for what cannot be used.
"""

import contextlib
import importlib
import runpy
import shutil
import sqlite3
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import yaml
from refusals import refusal

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.limits import Limits, use_limits
from vehest.sources.base import open_source
from vehest.sources.limited import read_limited
from vehest.sources.rosbag.topics import read_bag
from vehest.sources.surveys import survey

pytest.importorskip("rosbags", reason="the extra ros is not installed")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).parents[2]
CONFIGURATION = ROOT / "conf" / "dataset" / "f1tenth_bag.yaml"
START_NS = 1_700_000_000_123_456_789
SECONDS = 3.0
VX = 2.0
VY = -0.5
YAW_RATE = 1.5  # m/s, m/s, rad/s: a circle driven with a sideslip of -14°
ACCELERATION = 3.0
PULSATION = 2.0 * np.pi  # ax = 3 m/s² · sin(2π·1 Hz·t), ay likewise with the cosine
WINDOW = 9
LAYOUTS = {
    "car_msgs/msg/MotorStamped": "std_msgs/Header header\nMotor motor\n",
    "car_msgs/msg/Motor": "float64 rpm\nfloat64[2] currents\nstring name\n",
}
TOPICS = {
    "imu": {"topic": "/imu", "type": "sensor_msgs/msg/Imu", "clock": "uniform", "rate_hz": 400},
    "motor": {"topic": "/motor", "type": "car_msgs/msg/MotorStamped"},
    "servo": {
        "topic": "/servo",
        "type": "std_msgs/msg/Float64",
        "stamps": "received",
        "max_gap": 0.2,
    },
    "body": {
        "topic": "/body",
        "type": "geometry_msgs/msg/PoseStamped",
        "clock": "uniform",
        "rate_hz": 100,
    },
}
CHANNELS = {
    "ax": {"topic": "imu", "field": "linear_acceleration.x", "unit": "m/s²", "sign": -1},
    "ay": {"topic": "imu", "field": "linear_acceleration.y", "unit": "m/s²"},
    "yaw_rate": {"topic": "imu", "field": "angular_velocity.z", "unit": "deg/s"},
    "vx": {"topic": "motor", "field": "motor.rpm", "factor": 1e-3, "unit": "m/s"},
    "motor_current": {"topic": "motor", "field": "motor.currents.1", "unit": "A"},
    "steer": {
        "topic": "servo",
        "field": "data",
        "offset": 0.5,
        "sign": -1,
        "factor": 60.0,
        "unit": "deg",
    },
}
Topic = namedtuple(
    "Topic", "type times fields"
)  # messages of one topic: their times [s after START_NS] and fields


def drive(seconds=SECONDS):
    """A circle in closed form; every topic has a rate and a phase of its own."""
    imu = np.arange(0.0007, seconds, 1 / 400)
    motor = np.arange(0.0, seconds, 1 / 100)
    servo = np.arange(0.003, seconds, 0.05)
    body = np.arange(0.0042, seconds, 1 / 100)
    heading = 0.3 + YAW_RATE * body
    east = (np.sin(heading) * VX + np.cos(heading) * VY) / YAW_RATE
    north = (-np.cos(heading) * VX + np.sin(heading) * VY) / YAW_RATE
    sensed = {
        "linear_acceleration.x": -ACCELERATION * np.sin(PULSATION * imu),
        "linear_acceleration.y": ACCELERATION * np.cos(PULSATION * imu),
        "angular_velocity.z": np.full(len(imu), np.degrees(YAW_RATE)),
    }
    pose = {
        "pose.position.x": 7.0 + east,
        "pose.position.y": north - 3.0,
        "pose.position.z": np.full(len(body), 0.1),
        "pose.orientation.z": np.sin(heading / 2),
        "pose.orientation.w": np.cos(heading / 2),
    }
    return {
        "/imu": Topic("sensor_msgs/msg/Imu", imu, sensed),
        "/motor": Topic(
            "car_msgs/msg/MotorStamped",
            motor,
            {"motor.rpm": 1000.0 * (1.0 + motor), "motor.currents.1": 5.0 - motor},
        ),
        "/servo": Topic("std_msgs/msg/Float64", servo, {"data": 0.5 - 0.1 * servo}),
        "/body": Topic("geometry_msgs/msg/PoseStamped", body, pose),
    }


def write_bag(folder, topics, storage="sqlite3", layouts=LAYOUTS, name="lap"):
    """A bag's folder."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    for typename, text in layouts.items():
        types.register(get_types_from_msg(text, typename))
    path = folder / name
    folder.mkdir(parents=True, exist_ok=True)
    messages = []
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        for topic, topic_data in topics.items():
            connection = writer.add_connection(topic, topic_data.type, typestore=types)
            for k, stamp in enumerate(topic_data.times.tolist()):
                values = {path: samples[k] for path, samples in topic_data.fields.items()}
                message = _message(types, topic_data.type, {"header.stamp": stamp} | values)
                messages.append(
                    (
                        START_NS + round(stamp * 1e9),
                        connection,
                        bytes(types.serialize_cdr(message, topic_data.type)),
                    )
                )
        for stamp_ns, connection, raw in sorted(messages, key=lambda entry: entry[0]):
            writer.write(connection, stamp_ns, raw)
    return path


def _message(types, name, values, prefix=""):
    """A message with these values, zero or empty where there are none."""
    if name == "builtin_interfaces/msg/Time":
        nanoseconds = START_NS + round(values.get(prefix.rstrip("."), 0.0) * 1e9)
        return types.types[name](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    arguments = {}
    for member, (kind, detail) in types.fielddefs[name][1]:
        path = f"{prefix}{member}"
        if kind.name == "NAME":
            arguments[member] = _message(types, detail, values, f"{path}.")
        elif kind.name == "ARRAY":
            arguments[member] = np.array([values.get(f"{path}.{k}", 0.0) for k in range(detail[1])])
        else:
            kinds = {"string": str, "float64": float, "float32": float}
            arguments[member] = kinds.get(detail[0], int)(
                values.get(path, kinds.get(detail[0], int)())
            )
    return types.types[name](**arguments)


def configuration(folder, **changes):
    base = {
        "name": "mine",
        "source": "rosbag",
        "path": str(folder),
        "files": "lap*",
        "vehicle": "car",
        "rate_hz": 100,
        "messages": LAYOUTS,
    }
    return (
        base
        | {
            "topics": TOPICS,
            "channels": CHANNELS,
            "pose": {"topic": "body", "window": WINDOW, "order": 2},
        }
        | changes
    )


def read(folder, **changes):
    (recording,) = open_source(configuration(folder, **changes)).recordings()
    return recording


def topic_options(name, **options):
    return TOPICS | {name: TOPICS[name] | options}


def refused(folder, kind=DataError, **changes):
    before = sorted(folder.rglob("*"))
    message = refusal(lambda: read(folder, **changes), kind)
    assert sorted(folder.rglob("*")) == before
    return message


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A folder with the circle's bag, which tests leave as it is."""
    return write_bag(tmp_path_factory.mktemp("bags"), drive()).parent


@pytest.fixture
def folder(bags, tmp_path):
    """The same, to be changed."""
    return Path(shutil.copytree(bags, tmp_path / "bags"))


def test_a_circle_comes_back_from_its_poses(bags):
    """In body axes the velocity is constant: what is left is the filter's gain, 0.9996 here, and
    the stamps' nanoseconds.
    """
    recording = read(bags)
    k = np.arange(
        1, WINDOW // 2 + 1
    )  # the slope of a Savitzky-Golay derivative of second order is Σ k·x_k / Σ k²
    gain = float((k * np.sin(YAW_RATE * k / 100.0)).sum() / (k**2).sum() * 100.0 / YAW_RATE)
    assert gain == pytest.approx(
        1 - YAW_RATE**2 * 1.18e-3 / 6, abs=1e-6
    )  # second term: Σk⁴/Σk² = 11.8 samples² at 100 Hz
    for name, expected in (
        ("vx", gain * VX),
        ("vy", gain * VY),
        ("yaw_rate", YAW_RATE),
        ("sideslip", np.arctan2(VY, VX)),
    ):
        np.testing.assert_allclose(
            recording[f"{name}_ref"][WINDOW:-WINDOW], expected, rtol=0, atol=1e-6
        )  # where no end is touched


def test_sensors_come_back_in_si_units_with_signs_zeros_and_factors(bags):
    """Straight lines are exact.

    A line between samples 2.5 ms apart misses a sine by up to A·(ω·dt)²/8 = 1e-4 m/s².
    """
    recording = read(bags)
    time = recording.time
    missed = 1.01 * ACCELERATION * (PULSATION / 400) ** 2 / 8
    for name, expected, atol in (
        ("ax", ACCELERATION * np.sin(PULSATION * time), missed),
        ("ay", ACCELERATION * np.cos(PULSATION * time), missed),
        ("yaw_rate", np.full(len(time), YAW_RATE), 2e-12),
        ("vx", 1.0 + time, 1e-8),
        ("motor_current", 5.0 - time, 1e-8),
        ("steer", np.radians(6.0 * time), 1e-8),
    ):
        np.testing.assert_allclose(recording[name], expected, rtol=0, atol=atol, err_msg=name)


@pytest.mark.parametrize(
    ("storage", "form"),
    [("sqlite3", "zip"), ("sqlite3", "file"), ("mcap", "folder"), ("mcap", "file")],
)
def test_storage_and_packing_make_no_difference(bags, tmp_path, storage, form):
    expected = read(bags)
    bag = write_bag(tmp_path / "made", drive(), storage)
    (data,) = [file for file in bag.iterdir() if file.suffix in (".db3", ".mcap")]
    there = tmp_path / "there"
    there.mkdir()
    if form == "zip":
        shutil.make_archive(str(there / "lap"), "zip", bag.parent, bag.name)
    else:
        shutil.move(bag if form == "folder" else data, there)
    recording = read(there)
    assert (recording.id, recording.start_time, len(recording)) == (
        "lap",
        expected.start_time,
        len(expected),
    )
    for name, samples in expected.channels.items():
        np.testing.assert_array_equal(recording[name], samples)


@pytest.mark.parametrize(
    ("stamps_of", "clocks"),
    [
        (lambda topic, times: times, {"header"}),
        (lambda topic, times: times - 1e6, {"header"}),
        (lambda topic, times: times - 1e6 * (topic == "/imu"), {"header", "received"}),
        (lambda topic, times: 0.0 * times, {"received"}),
    ],
    ids=["of the bag", "of a simulation", "since the start of a sensor", "none"],
)
def test_a_survey_takes_stamps_of_headers_where_they_are_the_bags_clock(
    tmp_path, stamps_of, clocks
):
    topics = {
        name: topic._replace(fields=topic.fields | {"header.stamp": stamps_of(name, topic.times)})
        for name, topic in drive().items()
        if name in {"/imu", "/body"}
    }
    log = survey(write_bag(tmp_path, topics))
    assert {column.place["stamps"] for column in log.columns} == clocks
    first = {column.place["topic"]: column.stamps[0] for column in log.columns}
    assert first["/body"] - first["/imu"] == pytest.approx(0.0035, abs=1e-6)
    imu = {column.place["stamps"] for column in log.columns if column.place["topic"] == "/imu"}
    assert any("headers of topic '/imu'" in text for text in log.skipped) == (imu == {"received"})


def test_a_command_is_held_and_a_range_is_cut_out(folder):
    recording = read(
        folder, topics=topic_options("servo", interpolation="hold"), start=1.0, stop=2.0
    )
    assert (recording.start_time, len(recording)) == (
        1.01,
        95,
    )  # poses at 1.0042 s to servo at 1.953 s
    sent = 0.003 + 0.05 * np.floor((recording.time - 0.003) / 0.05 + 1e-6)
    np.testing.assert_allclose(recording["steer"], np.radians(6.0 * sent), rtol=0, atol=1e-8)


def test_a_moving_average_removes_what_would_alias(tmp_path):
    """Vibration at 100 Hz looks like a constant to a recording of 100 Hz.

    An average over its period removes it.
    """
    topics = drive()
    imu = topics["/imu"]
    imu.fields["linear_acceleration.y"] = np.cos(2 * np.pi * 100 * (imu.times - imu.times[0]))
    imu.fields["linear_acceleration.x"] = 2.0 * imu.times
    bags = write_bag(tmp_path, topics).parent
    plain = read(bags)
    averaged = read(bags, topics=topic_options("imu", average=0.01))
    assert abs(plain["ay"].mean()) > 0.4
    np.testing.assert_allclose(averaged["ay"], 0.0, atol=1e-9)
    np.testing.assert_allclose(
        averaged["ax"], -2.0 * averaged.time, rtol=0, atol=1e-8
    )  # a line stays the line: no delay


def test_nan_in_a_field_is_bridged_up_to_the_max_gap_of_its_topic(tmp_path):
    topics = drive()
    speed = topics["/motor"].fields["motor.rpm"]
    speed[50:53] = np.nan
    folder = write_bag(tmp_path, topics).parent
    step = float(np.median(np.diff(topics["/motor"].times)))
    recording = read(folder, topics=topic_options("motor", max_gap=4.1 * step))
    np.testing.assert_allclose(recording["vx"], 1.0 + recording.time, rtol=0, atol=1e-8)
    message = refused(folder, topics=topic_options("motor", max_gap=3.9 * step))
    assert "field 'motor.rpm' holds 3 samples" in message
    assert "no finite numbers" in message


@pytest.mark.parametrize(("storage", "share"), [("sqlite3", 0.999), ("mcap", 0.3), ("mcap", 0.999)])
def test_a_truncated_bag_is_refused(tmp_path, storage, share):
    bag = write_bag(tmp_path, drive(1.0), storage)
    (data,) = [file for file in bag.iterdir() if file.suffix in (".db3", ".mcap")]
    data.write_bytes(data.read_bytes()[: int(share * data.stat().st_size)])
    message = refused(tmp_path)
    assert "truncated" in message or "is damaged" in message


def test_absent_or_empty_topics_other_layouts_long_gaps_and_more_than_the_limits_are_refused(
    tmp_path, bags
):
    topics = drive()
    without_motor = {name: topic for name, topic in topics.items() if name != "/motor"}
    empty = topics | {"/servo": Topic(topics["/servo"].type, topics["/servo"].times[:0], {})}
    other_layouts = LAYOUTS | {
        "car_msgs/msg/Motor": "float64[2] currents\nfloat64 rpm\nstring name\n"
    }  # numbers would come from the wrong bytes
    for name, layout, message in (
        (
            "absent",
            (without_motor,),
            "holds no messages of topic '/motor' (of /body, /imu, /servo)",
        ),
        ("empty", (empty,), "holds no messages of topic '/servo'"),
        (
            "other",
            (topics, "mcap", other_layouts),
            "the bag's own layout of 'car_msgs/msg/Motor' is not the declared one",
        ),
    ):
        assert message in refused(write_bag(tmp_path / name, *layout).parent)
    gap = topic_options("motor", max_gap=0.009)
    full_content = topic_options("servo", type="std_msgs/msg/Int64")
    assert "topic '/servo' carries 'std_msgs/msg/Float64', not 'std_msgs/msg/Int64'" in refused(
        bags, topics=full_content
    )
    assert "topic '/motor': field 'motor.rpm' has a gap of 0.01 s" in refused(bags, topics=gap)
    with use_limits(Limits(samples=250)):
        assert "raise it: limits.samples=NUMBER" in refused(bags)


ENDLESS = (
    "WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) SELECT id, 1 AS topic_id, "
    "id AS timestamp, 'x' AS data FROM c"
)


@pytest.mark.parametrize(
    ("statements", "message"),
    [
        (["DROP TABLE messages", f"CREATE VIEW messages AS {ENDLESS}"], "missing tables"),
        (["UPDATE messages SET timestamp = -1 WHERE id = 5"], "at no time there is"),
        (
            [
                "UPDATE message_definitions SET encoded_message_definition = 'float64 "
                '__import__("os")\''
            ],
            "is damaged",
        ),
    ],
)
def test_a_hostile_database_ends_in_one_line(folder, statements, message):
    with contextlib.closing(sqlite3.connect(folder / "lap" / "lap.db3")) as database, database:
        for statement in statements:
            database.execute(statement)
    assert message in refused(folder)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("nanoseconds_since_epoch: 17", "nanoseconds_since_epoch: 9917", "which is no time"),
        ("- lap.db3", "- lap.db3\n  - lap.db3", "holds 2400 messages, the bag says 1200"),
        (
            "- lap.db3",
            "- ../../../etc/passwd",
            "files are missing",
        ),  # it is looked for in the bag's own folder
    ],
)
def test_metadata_that_lie_are_refused(folder, before, after, message):
    metadata = folder / "lap" / "metadata.yaml"
    content = metadata.read_text()
    assert before in content
    metadata.write_text(content.replace(before, after))
    assert message in refused(folder)


def test_a_bag_that_ros_compressed_is_read_up_to_the_limits(folder):
    zstd = importlib.import_module(
        "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    )
    expected = read(folder)
    data = folder / "lap" / "lap.db3"
    metadata = folder / "lap" / "metadata.yaml"
    about = yaml.safe_load(metadata.read_text())
    options = {
        "compression_format": "zstd",
        "compression_mode": "file",
        "relative_file_paths": ["lap.db3.zstd"],
    }
    about["rosbag2_bagfile_information"] |= options
    metadata.write_text(yaml.safe_dump(about))
    content = data.read_bytes()
    data.with_name("lap.db3.zstd").write_bytes(
        zstd.compress(content[:5000]) + zstd.compress(content[5000:])
    )
    data.unlink()
    np.testing.assert_array_equal(read(folder)["ax"], expected["ax"])
    assert "raise unpacked_limit" in refused(folder, unpacked_limit=1e-5)
    zeros = zstd.compress(bytes(80 * 2**20))
    data.with_name("lap.db3.zstd").write_bytes(zstd.compress(content) + zeros)
    assert "would unpack to more than the limit of 0.0671 GB; unpack it by hand" in refused(folder)


def test_the_packed_size_of_a_bag_counts_towards_memory(folder, monkeypatch):
    sizes = []

    def limited(reader, bag, *, packed, **request):
        sizes.append((bag.name, packed))
        return read_limited(reader, bag, packed=packed, **request)

    monkeypatch.setattr("vehest.sources.rosbag.topics.read_limited", limited)
    archive = Path(shutil.make_archive(str(folder / "packed"), "zip", folder, "lap"))
    servo = ["/servo", "std_msgs/msg/Float64", ["data"]]
    bag = read_bag(archive, "read_topics", topics=[servo], layouts=LAYOUTS)
    assert len(bag.arrays["/servo.data"]) == len(drive()["/servo"].times)
    assert sizes == [("lap", archive)]


def test_a_misspelt_declaration_is_refused(bags):
    vx = CHANNELS["vx"]
    topics = topic_options
    for changes, message in (
        ({"topics": topics("imu", rate_hz=None)}, "a uniform clock needs"),
        ({"topics": topics("motor", average=0.01)}, "a moving average needs"),
        ({"topics": topics("body", average=0.02)}, "orientations cannot be averaged"),
        ({"channels": {"vx_ref": vx}}, "'vx_ref' comes both from channels and from pose"),
        # what only the message types can tell
        (
            {"channels": {"vx": vx | {"field": "motor.speed"}}},
            "has no field 'motor.speed': 'speed' is none of: rpm, currents",
        ),
        ({"channels": {"vx": vx | {"field": "motor.name"}}}, "is not a number"),
        ({"topics": topics("servo", stamps="header")}, "have no header; set stamps: received"),
    ):
        assert message in refused(bags, ConfigurationError, **changes)


def identify(car, root):
    """Every figure that tools/identify.py prints of a car, by name."""
    parts = runpy.run_path(str(ROOT / "tools" / "identify.py"))[car](root / car)
    return {name: value for _, part in parts for name, value in part.items()}


@pytest.mark.slow
def test_declared_constants_of_tables_are_those_that_the_data_show(data_root):
    declared = {
        car: yaml.safe_load((CONFIGURATION.parent / f"{car}.yaml").read_text())
        for car in ("av21", "dart", "roboracer")
    }
    identified = {car: identify(car, data_root) for car in declared}
    assert declared["av21"]["transforms"][0]["wheel_radius"] == pytest.approx(
        identified["av21"]["wheel radius [m]"], abs=5e-5
    )
    assert declared["dart"]["pose"]["yaw_offset"] == pytest.approx(
        identified["dart"]["body_yaw"], abs=5e-5
    )
    assert declared["dart"]["held"]["delay"] == pytest.approx(
        1e-3 * identified["dart"]["vel encoder late [ms]"]
    )
    assert 1 / declared["roboracer"]["channels"]["vx"]["factor"] == pytest.approx(
        identified["roboracer"]["rpm for 1 m/s"], rel=1e-3
    )


@pytest.mark.slow
def test_declared_constants_are_those_that_the_data_show(data_root):
    """Within two of the standard deviations that the script prints.

    What the publishers' files fix exactly, to a millionth.
    """
    identified = identify("f1tenth", data_root)
    declared = yaml.safe_load(
        CONFIGURATION.read_text(encoding="utf-8").replace("${root}", str(data_root))
    )
    channels = declared["channels"]
    pose = declared["pose"]
    assert abs(pose["yaw"] - identified["body_yaw"]) < 2 * identified["body_yaw_sd"]
    rpm = 1 / channels["vx"]["factor"]
    assert abs(rpm - identified["erpm_per_mps"]) < 2 * identified["erpm_per_mps_sd"]
    assert channels["motor_speed"]["factor"] == pytest.approx(channels["vx"]["factor"] / 0.05)
    assert channels["steer"]["offset"] == pytest.approx(identified["servo_neutral"], abs=1e-6)
    assert channels["steer"]["factor"] == pytest.approx(identified["servo_gain"], rel=1e-6)
    assert channels["steer"]["sign"] == -np.sign(identified["servo_agreement"])
    for name, measured in (
        ("ax", "ax by forward"),
        ("ay", "ay by lateral"),
        ("yaw_rate", "gyro by turning"),
    ):
        assert channels[name].get("sign", 1) * identified[measured] == pytest.approx(
            1.0, abs=0.1
        )  # sign and unit
    assert identified["acc_z"] == pytest.approx(9.81, abs=0.05)  # z is up, in m/s²
    for name, topic in (
        ("imu", "/imu"),
        ("vesc", "/vesc/core"),
        ("body", "/optitrack/rigid_body_0"),
    ):
        assert declared["topics"][name]["rate_hz"] == pytest.approx(
            identified[f"rate {topic}"], rel=1e-4
        )
    assert (
        identified["pose_roughness_even"] < 0.2 * identified["pose_roughness_header"]
    )  # why the clock is declared even
