"""The driver: a racing line, a speed profile at a fraction of the grip, and path following with preview.

Steering follows the optimal-preview idea of Sharp, Casanova and Symonds 2000 in its simplest form: curvature
feed-forward, the lateral error expected at one preview point, and damping of the yaw rate. The speed profile is the
usual quasi-steady pass forwards and backwards through the friction circle (e.g. Heilmeier et al. 2020).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehest.data.errors import ConfigurationError
from vehest.simulation.course import Course

FloatArray = NDArray[np.float64]

GRIP = 9.3
"""Lateral acceleration that counts as all of the grip [m/s²]: what the lowered BMW 320i corners at in steady state."""

WAVELENGTHS = (310.0, 470.0, 1130.0)
"""Of the variations along a drive [m]; assumed, and none divides a lap."""


@dataclass(frozen=True)
class Driver:
    """How a driver drives; all values are assumed, chosen so that the shipped cars follow the shipped courses.

    Args:
        preview_time: how far ahead the driver looks for lateral errors [s].
        feedforward_time: how far ahead the driver takes the road's curvature, to make up for the car's lag [s].
        steering_lag: time constant from the wanted to the actual steering angle [s].
        steering_rate: largest steering velocity of the road wheels [rad/s].
        understeer: understeer gradient that the driver reckons with [rad s²/m].
        yaw_damping: steering angle per error of the yaw rate [s].
        speed_gain: wanted acceleration per speed error [1/s].
        braking_share: share of the grip that is used for braking straight ahead.
        driving_share: share of the grip that is used for accelerating straight ahead; only one axle drives.
        drive_power: engine power per mass that is used [W/kg].
        top_speed: [m/s].
    """

    preview_time: float = 0.7
    feedforward_time: float = 0.15
    steering_lag: float = 0.1
    steering_rate: float = 0.4
    understeer: float = 3.5e-4
    yaw_damping: float = 0.12
    speed_gain: float = 1.5
    braking_share: float = 0.75
    driving_share: float = 0.4
    drive_power: float = 75.0
    top_speed: float = 45.0


@dataclass(frozen=True)
class DrivingStyle:
    """What differs from drive to drive and, slowly, along one drive.

    Both variations are sums of sines of the distance driven, whose wavelengths do not divide a lap.

    Args:
        grip_fraction: mean share of the grip that the speed profile uses, 0 … 1.
        grip_ripple: amplitude of its variation.
        line_offset: amplitude of the lateral offset of the line [m].
        wavelengths: of the sines [m].
        grip_phases: phase of each sine of the grip [rad].
        line_phases: phase of each sine of the line [rad].

    Raises:
        ConfigurationError: the grip used is not between 0 and 1 all along.
    """

    grip_fraction: float
    grip_ripple: float = 0.05
    line_offset: float = 0.5
    wavelengths: tuple[float, ...] = WAVELENGTHS
    grip_phases: tuple[float, ...] = (0.0, 0.0, 0.0)
    line_phases: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        low, high = self.grip_fraction - abs(self.grip_ripple), self.grip_fraction + abs(self.grip_ripple)
        if not (low > 0.0 and high <= 1.0):
            raise ConfigurationError(f"grip fraction {self.grip_fraction} ± {self.grip_ripple} must stay above 0 and at most 1")


@dataclass(frozen=True, eq=False)
class Plan:
    """What the driver means to do, over the distance along the course's centre line; all arrays have shape (N,).

    Args:
        distance: [m], uniform from 0, over as many laps as the drive may take.
        x, y: the line [m].
        heading: of the line, not wrapped [rad].
        curvature: of the line, positive to the left [1/m].
        speed: [m/s].
        acceleration: along the line [m/s²].
    """

    distance: FloatArray
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    curvature: FloatArray
    speed: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True)
class Observation:
    """What the driver sees and feels of the car: place [m], direction of travel [rad], speed [m/s] and so on."""

    x: float
    y: float
    travel_direction: float
    speed: float
    yaw_rate: float
    steer: float


@dataclass(frozen=True)
class Command:
    """Steering velocity [rad/s], longitudinal acceleration [m/s²], and the car's place on the plan.

    Args:
        steering_velocity: of the road wheels.
        acceleration: wanted.
        progress: distance along the plan [m].
        lateral_error: the car's place left of the line [m].
    """

    steering_velocity: float
    acceleration: float
    progress: float
    lateral_error: float


def draw_style(seed: int, grip_range: tuple[float, float] = (0.65, 0.9)) -> DrivingStyle:
    """The style that belongs to a seed: grip fraction uniform in ``grip_range`` (assumed), phases around the circle."""
    generator = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(0,)))
    grip_fraction = float(generator.uniform(*grip_range))
    phases = generator.uniform(0.0, 2.0 * math.pi, (2, len(WAVELENGTHS))).tolist()
    return DrivingStyle(grip_fraction, grip_phases=tuple(phases[0]), line_phases=tuple(phases[1]))


def plan_drive(course: Course, driver: Driver, style: DrivingStyle, distance: float) -> Plan:
    """Line and speed profile for at least ``distance`` metres from the start of the course."""
    n_laps = math.ceil(distance / course.length) + 1
    unrolled = _unroll(course, n_laps)
    offset, offset_slope, offset_bend = _sines(unrolled.arc_length, style.wavelengths, style.line_phases, style.line_offset)
    stretch = 1.0 - unrolled.curvature * offset  # length of the line per length of the centre line
    curvature = unrolled.curvature / stretch + offset_bend
    ripple, _, _ = _sines(unrolled.arc_length, style.wavelengths, style.grip_phases, style.grip_ripple)
    lateral_limit = GRIP * (style.grip_fraction + ripple)
    speed = speed_profile(curvature, lateral_limit, unrolled.arc_length[1], driver)
    return Plan(
        distance=unrolled.arc_length,
        x=unrolled.x - offset * np.sin(unrolled.heading),
        y=unrolled.y + offset * np.cos(unrolled.heading),
        heading=unrolled.heading + np.arctan2(offset_slope, stretch),
        curvature=curvature,
        speed=speed,
        acceleration=speed * np.gradient(speed, unrolled.arc_length),
    )


def speed_profile(curvature: FloatArray, lateral_limit: FloatArray, spacing: float, driver: Driver) -> FloatArray:
    """Highest speeds [m/s] within friction circle, engine power and top speed; (N,).

    Args:
        curvature: (N,) [1/m].
        lateral_limit: (N,), largest lateral acceleration [m/s²]; braking gets ``driver.braking_share`` of it.
        spacing: distance between samples [m].
        driver: whose power, braking and top speed are used.
    """
    cornering = np.sqrt(lateral_limit / np.maximum(np.abs(curvature), 1e-9))
    speed = np.minimum(cornering, driver.top_speed).tolist()
    bend, limit = np.abs(curvature).tolist(), lateral_limit.tolist()

    def spare(i: int) -> float:
        """Longitudinal share of the friction circle at sample i."""
        return math.sqrt(max(1.0 - (speed[i] ** 2 * bend[i] / limit[i]) ** 2, 0.0))

    for i in range(len(speed) - 2, -1, -1):
        braking = driver.braking_share * limit[i + 1] * spare(i + 1)
        speed[i] = min(speed[i], math.sqrt(speed[i + 1] ** 2 + 2.0 * braking * spacing))
    for i in range(len(speed) - 1):
        driving = min(driver.drive_power / speed[i], driver.driving_share * limit[i] * spare(i))
        speed[i + 1] = min(speed[i + 1], math.sqrt(speed[i] ** 2 + 2.0 * driving * spacing))
    return np.array(speed)


def command(plan: Plan, driver: Driver, wheelbase: float, progress: float, seen: Observation) -> Command:
    """What the driver does now, given the place on the plan a moment ago."""
    progress, lateral_error, heading_error = _locate(plan, progress, seen)
    speed = seen.speed
    road_ahead = _at(plan, plan.curvature, progress + speed * driver.feedforward_time)
    preview = speed * driver.preview_time
    error_ahead = lateral_error + preview * math.sin(heading_error)
    wanted_curvature = road_ahead - 2.0 * error_ahead / preview**2
    steer = wanted_curvature * (wheelbase + driver.understeer * speed**2)
    steer -= driver.yaw_damping * (seen.yaw_rate - speed * wanted_curvature)
    steering_velocity = (steer - seen.steer) / driver.steering_lag
    limited = max(-driver.steering_rate, min(driver.steering_rate, steering_velocity))

    target = _at(plan, plan.speed, progress)
    feedforward = _at(plan, plan.acceleration, progress + speed * driver.feedforward_time)
    acceleration = feedforward + driver.speed_gain * (target - speed)
    spare = math.sqrt(max(1.0 - (seen.yaw_rate * speed / GRIP) ** 2, 0.0))
    lowest, highest = -driver.braking_share * GRIP * spare, driver.driving_share * GRIP * spare
    limited_acceleration = max(lowest, min(highest, driver.drive_power / speed, acceleration))
    return Command(limited, limited_acceleration, progress, lateral_error)


def _locate(plan: Plan, progress: float, seen: Observation) -> tuple[float, float, float]:
    """Progress [m], lateral error [m] and heading error [rad], by two Newton steps from the last progress."""
    for _ in range(2):
        heading = _at(plan, plan.heading, progress)
        dx, dy = seen.x - _at(plan, plan.x, progress), seen.y - _at(plan, plan.y, progress)
        progress += dx * math.cos(heading) + dy * math.sin(heading)
    lateral_error = dy * math.cos(heading) - dx * math.sin(heading)
    return progress, lateral_error, math.remainder(seen.travel_direction - heading, 2.0 * math.pi)


def _at(plan: Plan, values: FloatArray, distance: float) -> float:
    """Linear interpolation on the plan's uniform grid, held at its ends."""
    position = distance / plan.distance[1]
    before = min(max(int(position), 0), len(values) - 2)
    share = min(max(position - before, 0.0), 1.0)
    return float(values[before] + share * (values[before + 1] - values[before]))


def _unroll(course: Course, n_laps: int) -> Course:
    """The course laid end to end ``n_laps`` times, with heading going on."""

    def repeat(values: FloatArray, per_lap: float = 0.0) -> FloatArray:
        laps = [values[:-1] + lap * per_lap for lap in range(n_laps)]
        return np.concatenate([*laps, values[-1:] + (n_laps - 1) * per_lap])

    return Course(
        name=course.name,
        arc_length=repeat(course.arc_length, course.length),
        x=repeat(course.x),
        y=repeat(course.y),
        heading=repeat(course.heading, course.turning),
        curvature=repeat(course.curvature),
    )


def _sines(
    distance: FloatArray, wavelengths: tuple[float, ...], phases: tuple[float, ...], amplitude: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of sines of the given amplitude with its first and second derivative, each (N,)."""
    wave_numbers = 2.0 * math.pi / np.array(wavelengths)
    angles = distance[:, None] * wave_numbers + np.array(phases)
    value = amplitude * np.mean(np.sin(angles), axis=1)
    slope = amplitude * np.mean(wave_numbers * np.cos(angles), axis=1)
    bend = -amplitude * np.mean(wave_numbers**2 * np.sin(angles), axis=1)
    return value, slope, bend
