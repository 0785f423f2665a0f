"""A ROS 2 node around a model: an inertial unit and a speed in, estimates out.

    python sideslip_node.py --ros-args -p model:=outputs/train/MODEL -p imu_rate_hz:=100.0

Subscribes to ``imu`` (sensor_msgs/msg/Imu, of which yaw rate and accelerations are read, x ahead and y to the left) and ``speed``
(geometry_msgs/msg/TwistStamped, of which linear.x is read), publishes ``sideslip`` (vehest_msgs/msg/SideslipEstimate, beside this file).
Only `main` depends on ROS; `Samples` and `fields_of` take whatever has the fields of the messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import vehest

OLDEST_SPEED = 0.1
"""Seconds after which a speed counts as not measured."""


class Samples:
    """Forms a sample of each message of the inertial unit, whose clock counts."""

    def __init__(self) -> None:
        self._speed = math.nan
        self._when = -math.inf

    def speed(self, message: Any) -> None:
        """Take a geometry_msgs/msg/TwistStamped."""
        self._speed = message.twist.linear.x
        self._when = seconds(message.header.stamp)

    def imu(self, message: Any) -> tuple[float, dict[str, float]]:
        """The time [s] and the sample of a sensor_msgs/msg/Imu."""
        time = seconds(message.header.stamp)
        fresh = abs(time - self._when) <= OLDEST_SPEED
        return time, {
            "vx": self._speed if fresh else math.nan,
            "yaw_rate": message.angular_velocity.z,
            "ax": message.linear_acceleration.x,
            "ay": message.linear_acceleration.y,
        }


def fields_of(said: Mapping[str, float]) -> dict[str, Any]:
    """Fields of a SideslipEstimate, but the header, from what a stepper of vehest says."""
    return {
        "lateral_velocity": said["vy"],
        "sideslip_angle": said["sideslip"],
        "yaw_rate": said.get("yaw_rate", math.nan),
        "lateral_velocity_band": said.get("band_vy", math.nan),
        "sideslip_angle_band": said.get("band_sideslip", math.nan),
        "health": int(said["health"]),
        "reason": vehest.reason_in_words(said["health_reason"]),
    }


def ahead_of(stepper: Any) -> float:
    """How long after its sample an estimate applies [s]; negative where the filter from the bus's rate takes longer."""
    return float(stepper.horizon_steps / stepper.estimator.settings.rate_hz - stepper.delay)


def seconds(stamp: Any) -> float:
    """A builtin_interfaces/msg/Time in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def main() -> None:
    """Run the node."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.time import Time
    from sensor_msgs.msg import Imu
    from vehest_msgs.msg import SideslipEstimate

    rclpy.init()
    node = Node("vehest")
    model = vehest.load_model(node.declare_parameter("model", "pretrained").value)
    rate_hz = node.declare_parameter("imu_rate_hz", 100.0).value
    stepper = vehest.online(model, rate_hz).stepper
    samples = Samples()
    publisher = node.create_publisher(SideslipEstimate, "sideslip", 10)
    last = stepper.last

    def on_imu(message: Imu) -> None:
        nonlocal last
        time, sample = samples.imu(message)
        said = stepper.step(sample, time)  # samples that are missing in between are bridged
        if said is last:  # the model's rate is below that of the inertial unit
            return
        last = said
        estimate = SideslipEstimate()
        estimate.header.frame_id = message.header.frame_id
        estimate.header.stamp = Time(nanoseconds=round(1e9 * (time + ahead_of(stepper)))).to_msg()
        for name, value in fields_of(said).items():
            setattr(estimate, name, value)
        publisher.publish(estimate)

    node.create_subscription(TwistStamped, "speed", samples.speed, qos_profile_sensor_data)
    node.create_subscription(Imu, "imu", on_imu, qos_profile_sensor_data)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
