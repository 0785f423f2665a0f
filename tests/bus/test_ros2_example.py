"""The ROS 2 node of the documentation, without ROS: messages of a bag go through it and come back
as they were.
"""

import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import vehest
from conftest import planar_drive

pytest.importorskip("rosbags", reason="the extra ros is not installed")

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "ros2"
KIND = "vehest_msgs/msg/SideslipEstimate"
START = 1_700_000_000  # s


@pytest.fixture(scope="module")
def node():
    return SimpleNamespace(
        **runpy.run_path(str(EXAMPLE / "sideslip_node.py"), run_name="sideslip_node")
    )


@pytest.fixture(scope="module")
def types():
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg((EXAMPLE / "msg" / "SideslipEstimate.msg").read_text(), KIND))
    return store


def ros_message(types, kind, **fields):
    return types.types[kind](**fields)


def header(types, time):
    nanoseconds = START * 10**9 + round(1e9 * time)
    stamp = ros_message(
        types, "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
    )
    return ros_message(types, "std_msgs/msg/Header", stamp=stamp, frame_id="base_link")


def vector(types, x=0.0, y=0.0, z=0.0):
    return ros_message(types, "geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def imu(types, time, yaw_rate, ax, ay):
    nothing = np.zeros(9)
    return ros_message(
        types,
        "sensor_msgs/msg/Imu",
        header=header(types, time),
        orientation=ros_message(types, "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=nothing,
        angular_velocity=vector(types, z=yaw_rate),
        angular_velocity_covariance=nothing,
        linear_acceleration=vector(types, ax, ay, 9.81),
        linear_acceleration_covariance=nothing,
    )


def speed(types, time, vx):
    twist = ros_message(
        types, "geometry_msgs/msg/Twist", linear=vector(types, vx), angular=vector(types)
    )
    return ros_message(
        types, "geometry_msgs/msg/TwistStamped", header=header(types, time), twist=twist
    )


def through(types, message):
    """As it arrives on the other side of a wire."""
    return types.deserialize_cdr(
        types.serialize_cdr(message, message.__msgtype__), message.__msgtype__
    )


def test_a_drive_goes_through_the_node_and_its_estimates_through_a_bag(tmp_path, node, types):
    drive = planar_drive(6.0, 100.0)
    stepper, bare = (
        vehest.online(vehest.load_model("pretrained"), 100.0).stepper for _ in range(2)
    )
    samples = node.Samples()
    sent = []
    expected = []
    last = stepper.last
    for k in range(len(drive)):
        samples.speed(through(types, speed(types, k / 100, drive["vx"][k])))
        time, sample = samples.imu(
            through(
                types, imu(types, k / 100, *(drive[name][k] for name in ("yaw_rate", "ax", "ay")))
            )
        )
        step = stepper.step(sample, time)
        plain = bare.step({name: drive[name][k] for name in ("vx", "yaw_rate", "ax", "ay")})
        if step is not last:
            last = step
            expected.append(plain["vy"])
            sent.append(
                ros_message(
                    types,
                    KIND,
                    header=header(types, time - START + node.ahead_of(stepper)),
                    **node.fields_of(step),
                )
            )
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topic = bag.add_connection("/sideslip", KIND, typestore=types)
        for k, message in enumerate(sent):
            bag.write(topic, START * 10**9 + k, types.serialize_cdr(message, KIND))
    with Reader(tmp_path / "bag") as bag:
        received = [types.deserialize_cdr(raw, KIND) for _, _, raw in bag.messages()]
    assert len(received) == len(expected) == 120
    np.testing.assert_array_equal([message.lateral_velocity for message in received], expected)
    assert [message.reason for message in received] == [message.reason for message in sent]
    assert {message.health for message in received[100:]} <= {
        types.types[KIND].VALID,
        types.types[KIND].DEGRADED,
        types.types[KIND].INVALID,
    }
    last_time = node.seconds(received[-1].header.stamp) - START
    assert last_time == pytest.approx(5.95 + 1 / 20 - stepper.delay, abs=1e-6)


def test_an_outdated_speed_counts_as_not_measured_and_absent_fields_are_nan(node, types):
    samples = node.Samples()
    assert math.isnan(samples.imu(imu(types, 0.0, 0.1, 0.0, 1.0))[1]["vx"])
    samples.speed(speed(types, 0.0, 20.0))
    assert samples.imu(imu(types, 0.05, 0.1, 0.0, 1.0))[1]["vx"] == 20.0
    assert math.isnan(samples.imu(imu(types, 0.2, 0.1, 0.0, 1.0))[1]["vx"])
    fields = node.fields_of({"vy": 0.5, "sideslip": 0.02, "health": 2.0, "health_reason": 300000.0})
    assert fields["reason"] == "there is no estimate"
    assert math.isnan(fields["yaw_rate"])
    assert math.isnan(fields["sideslip_angle_band"])
