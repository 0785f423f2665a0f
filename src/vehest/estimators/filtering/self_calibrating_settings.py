"""Settings of the self-calibrating filter: the car, priors and noise of its bank, candidates."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import fields
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.declared import UNSET, setting
from vehest.estimators.base import rate
from vehest.estimators.recursive import Recursive

TYPICAL_WHEELBASE = 2.7  # m, of the car for which the defaults of the settings are
# distance of the centre of gravity from the rear axle over the wheelbase, where it is not given
TYPICAL_REAR = 0.48
WHEELBASE_POWERS = {
    "axle_lag": 0.5,
    "residual_time": 0.5,
    "slow_time": 0.5,
    "band_time": 0.5,
    "reached_time": 0.5,
    "memory": 0.5,
    "decision_time": 0.5,
    "minimum_speed": 0.5,
    "noise_speed": 0.5,
    "axle_constant": 0.5,
    "axle_white": 0.5,
    "residual_floor": 0.5,
    "noise_vy": 0.25,
    "noise_vx": 0.25,
    "noise_delay": 0.75,
    "compliance": -0.5,
}
"""Setting -> power of the wheelbase over the typical one by which it is scaled.

Times and speeds scale with the root; tyres of small cars slip more.
"""
REFERENCE_POINTS = ("cg", "rear_axle", "imu")  # points of the car at which v may be estimated


class SelfCalibratingSettings(Recursive):
    """Settings of `vehest.estimators.self_calibrating.SelfCalibrating`, and what follows from them.

    Symbols in their texts are those of its equations.
    """

    rate_hz: float = rate(20.0)
    wheelbase: float = setting(TYPICAL_WHEELBASE, "wheelbase", unit="m", least=0.05, most=20.0)
    cg_to_rear_axle: float = setting(
        UNSET,
        "distance of the centre of gravity from the rear axle; null: 0.48 wheelbases",
        unit="m",
    )
    imu_to_rear_axle: float = setting(
        UNSET,
        "distance of the inertial unit from the rear axle, negative behind it; null: identified",
        unit="m",
    )
    reference_point: str = setting(
        "",
        "point of v: cg, rear_axle or imu; empty: cg where cg_to_rear_axle is given, else imu",
    )
    smoothed: bool = setting(False, "whether each estimate is made of the whole drive, offline")
    measured_ax: bool = setting(
        True, "whether ax is measured; else the longitudinal equation is unused"
    )
    grips: tuple[float, ...] = setting(
        (4.5, 6.0, 7.5, 9.0, 10.5, 12.0, 14.0, 17.0, 25.0), "grip limits a_max of the bank [m/s²]"
    )
    grip: float = setting(14.0, "median of the prior of a_max", unit="m/s²", positive=True)
    grip_deviation: float = setting(
        0.55, "standard deviation of the logarithm of a_max's prior", positive=True
    )
    grip_excess: float = setting(
        2.0,
        "deviation over a second of accelerations beyond a grip limit",
        unit="m/s²",
        positive=True,
    )
    exponent: float = setting(0.25, "p of the axle's curve", above=0.0, most=1.0)
    largest_share: float = setting(
        0.98, "of the grip limit at which the curve is cut off", above=0.0, below=1.0
    )
    compliance: float = setting(
        0.0045, "prior of C of a car of 2.7 m", unit="rad s²/m", positive=True
    )
    compliance_deviation: float = setting(
        0.5, "standard deviation of C's prior over C", positive=True
    )
    leakage: float = setting(0.03, "prior of κ", least=-0.5, most=0.5)
    leakage_deviation: float = setting(0.05, "standard deviation of κ's prior", positive=True)
    imu_deviation: float = setting(
        0.02, "deviation of a given imu_to_rear_axle over the wheelbase", positive=True
    )
    place: float = setting(
        0.35,
        "prior of b over the wheelbase where imu_to_rear_axle is not given",
        least=-1.0,
        most=2.0,
    )
    place_deviation: float = setting(
        0.5, "standard deviation of b's prior over the wheelbase", positive=True
    )
    point_deviation: float = setting(
        0.05, "deviation of the reference point's place over the wheelbase, in bands", least=0.0
    )
    offset_ay: float = setting(0.65, "deviation of β_y", unit="m/s²", positive=True)
    offset_ay_time: float = setting(20.0, "time constant of β_y", unit="s", positive=True)
    offset_ax: float = setting(0.2, "deviation of β_x", unit="m/s²", positive=True)
    offset_ax_time: float = setting(10.0, "time constant of β_x", unit="s", positive=True)
    noise_vy: float = setting(0.05, "process noise of v over a second", unit="m/s", positive=True)
    noise_delay: float = setting(
        0.02, "process noise of v for each m/s³ by which u ω changes", unit="√s³", least=0.0
    )
    noise_vx: float = setting(0.1, "process noise of u over a second", unit="m/s", positive=True)
    noise_speed: float = setting(0.15, "deviation of the measured speed", unit="m/s", positive=True)
    axle_lag: float = setting(
        0.3, "low-pass of v, ω and ay in the axle's equation", unit="s", positive=True
    )
    axle_error_time: float = setting(2.0, "time constant of e", unit="s", positive=True)
    axle_constant: float = setting(
        0.007, "size s of the axle's error: constant", unit="m/s", positive=True
    )
    axle_per_speed: float = setting(
        0.0009, "size s of the axle's error: factor of the speed", least=0.0
    )
    axle_per_slip: float = setting(
        0.03, "size s of the axle's error: factor of speed · prior of C · |φ|", least=0.0
    )
    axle_per_bend: float = setting(
        4.0,
        "size s of the axle's error: factor of speed · prior of C · (φ' - 1)",
        unit="m/s²",
        least=0.0,
    )
    axle_per_slope: float = setting(
        0.05,
        "size s of the axle's error: factor of speed · prior of C · φ'",
        unit="m/s²",
        least=0.0,
    )
    axle_white: float = setting(0.03, "white error of the axle", unit="m/s", positive=True)
    axle_white_share: float = setting(
        0.3, "white part of the axle's error: variance over s²", least=0.0
    )
    gate: float = setting(3.0, "deviations at which an innovation is cut off", positive=True)
    memory: float = setting(
        150.0,
        "time after which the drive counts e times less in all weights",
        unit="s",
        positive=True,
    )
    minimum_speed: float = setting(
        3.0, "speed below which v = b ω and parameters stay", unit="m/s", positive=True
    )
    variance_share: float = setting(
        0.15, "share of the filters' and candidates' variance that is reported", positive=True
    )
    error_share: float = setting(
        0.085, "share of the mean square of the axle's error s e that is reported, too", least=0.0
    )
    band_time: float = setting(
        1.0, "time over which that mean square is taken", unit="s", positive=True
    )
    unreached_share: float = setting(
        0.25,
        "deviation of v over |b ω| + |v - b ω| at an ay that the drive has not reached before",
        least=0.0,
    )
    reached_time: float = setting(
        15.0,
        "time constant with which the reached ay follows a larger one",
        unit="s",
        positive=True,
    )
    angle_floor: float = setting(
        0.0022, "least deviation of the sideslip angle", unit="rad", least=0.0
    )
    residual_time: float = setting(
        1.0, "high-pass of v in the candidates' residuals", unit="s", positive=True
    )
    slow_time: float = setting(20.0, "high-pass of the residuals", unit="s", positive=True)
    residual_floor: float = setting(
        0.03, "residual below which candidates are alike", unit="m/s", positive=True
    )
    largest_leakage: float = setting(
        0.05, "of κ that residuals of the candidates are freed of", least=0.0
    )
    lateral_power: float = setting(5.0, "power by which the residual of v' counts", least=0.0)
    longitudinal_power: float = setting(7.0, "power by which the residual of u' counts", least=0.0)
    network_odds: float = setting(
        1.0, "weight of the network over the bank's at the start", positive=True
    )
    decision_time: float = setting(
        5.0, "driving after which residuals count half", unit="s", positive=True
    )
    steady_odds: float = setting(
        0.4, "weight of steady cornering over the bank's at the start", positive=True
    )
    steady_power: float = setting(
        3.0, "power of the typical wheelbase over the car's by which it grows", least=0.0
    )
    network_wheelbase: float = setting(
        1.5,
        "shortest wheelbase of cars for which the network counts and the place of the unit is "
        "identified",
        unit="m",
        least=0.0,
    )

    def check(self) -> None:
        """Check the car's geometry and the grip limits.

        Raises
        ------
        ConfigurationError
            The centre of gravity or the inertial unit is too far from the wheelbase, the reference
            point is unknown, or a grip limit is not positive.
        """
        if self.cg_to_rear_axle is not None and not 0.0 < self.cg_to_rear_axle < self.wheelbase:
            raise ConfigurationError(
                "estimator.cg_to_rear_axle must lie between 0 and the wheelbase "
                f"({self.wheelbase} m), not at {self.cg_to_rear_axle}"
            )
        imu = self.imu_to_rear_axle
        if imu is not None and not -self.wheelbase <= imu <= 2.0 * self.wheelbase:
            raise ConfigurationError(
                "estimator.imu_to_rear_axle must lie between one wheelbase behind the rear axle "
                f"and two ahead of it ({-self.wheelbase} to {2.0 * self.wheelbase} m), not at {imu}"
            )
        if self.reference_point not in ("", *REFERENCE_POINTS):
            raise ConfigurationError(
                f"estimator.reference_point must be {', '.join(REFERENCE_POINTS)} or empty, not "
                f"'{self.reference_point}'"
            )
        if not self.grips or not all(limit > 0.0 for limit in self.grips):
            raise ConfigurationError(
                f"estimator.grips must be positive accelerations, not {list(self.grips)}"
            )

    @property
    def point(self) -> str:
        """The point of the car that v belongs to: cg, rear_axle or imu."""
        return self.reference_point or ("imu" if self.cg_to_rear_axle is None else "cg")

    @property
    def rear(self) -> float:
        """Distance of the centre of gravity from the rear axle [m], as set or typical."""
        if self.cg_to_rear_axle is None:
            return TYPICAL_REAR * self.wheelbase
        return float(self.cg_to_rear_axle)

    @property
    def imu_prior(self) -> tuple[float, float]:
        """Mean and standard deviation of the inertial unit's distance from the rear axle [m]."""
        if self.imu_to_rear_axle is not None:
            return float(self.imu_to_rear_axle), self.imu_deviation * self.wheelbase
        if self.wheelbase < self.network_wheelbase:  # their sensors do not resolve the place
            return self.rear, self.imu_deviation * self.wheelbase
        mean = self.place * self.wheelbase if self.cg_to_rear_axle is None else self.rear
        return mean, self.place_deviation * self.wheelbase


# names of the settings that are numbers
NUMERIC = tuple(
    field.name
    for field in fields(SelfCalibratingSettings.settings_type)
    if isinstance(field.default, int | float)
)
DERIVED = ("dt", "point", "is_moved", "network_rear", "yaw_rate_max", "without_ax")  # see `Numbers`
# Importable by its name, without which the cache of compiled code does not recognise the type.
Numbers: Any = namedtuple("Numbers", NUMERIC + DERIVED)  # type: ignore[misc]
"""Numbers that the compiled recursion reads: settings, scaled to the car, and derived ones.

Derived: sampling interval ``dt`` [s]; ``point``, distance of the reference point from the rear axle
[m], used where ``is_moved``; ``network_rear``, the same of the centre of gravity for which the
network estimates [m]; ``yaw_rate_max`` of the network [rad/s]; ``without_ax``, 1 where ax is not
measured.
"""
