"""The driver: a racing line, a speed profile at a fraction of the grip, and path following with
preview.

Steering follows the optimal-preview idea of Sharp, Casanova and Symonds 2000 in its simplest form:
the steering of the steady turn ahead, the lateral error expected at one preview point, damping of
the yaw rate, and countersteering once the rear slides. The speed profile is the usual quasi-steady
pass forwards and backwards through the friction circle (e.g. Heilmeier et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.car import Car
from vehest.simulation.random_streams import STYLE, random_stream
from vehest.simulation.road.course import Course
from vehest.simulation.road.lines import Line

DRIVER_RATE_HZ = 100.0  # rate of a driver's decisions [Hz]

LOWEST_CORRECTION = 0.5  # Hz, lowest frequency at which a driver corrects; assumed
HIGHEST_CORRECTION = 2.0  # Hz, highest one; assumed

# wavelengths of the variations along a drive [m]; assumed, none divides a lap
WAVELENGTHS = (
    310.0,
    470.0,
    1130.0,
)


@dataclass(frozen=True)
class Driver:
    """Parameters of a person's driving; all values are assumed, chosen so that the shipped cars
    follow the shipped courses.
    """

    preview_time: float = 0.7  # time ahead at which the driver looks for lateral errors [s]
    steering_lag: float = 0.1  # time constant from the wanted to the actual steering angle [s]
    # additional delay of the car's answer per speed [s²/m]; the driver takes the road's curvature
    # as far ahead as this delay and the steering lag
    response: float = 3.5e-3
    yaw_damping: float = 0.16  # steering angle over error of the yaw rate [s]
    countersteer: float = 0.7  # steering angle over the sideslip angle beyond that of the turn
    # sideslip angle beyond that of the turn from which on the driver countersteers and lifts [rad]
    slide: float = 0.035
    speed_gain: float = 1.5  # wanted acceleration over speed error [1/s]
    braking_share: float = 0.75  # share of the grip that is used for braking straight ahead
    # share of the grip up to which the driver asks for more lateral acceleration when off the line
    saturation: float = 1.1


@dataclass(frozen=True)
class DrivingStyle:
    """Differences from drive to drive and, slowly, along one drive.

    Both variations are sums of sines of the distance driven, whose wavelengths do not divide a lap.

    Raises
    ------
    ConfigurationError
        The grip used is not between 0 and 1 all along.
    """

    grip_fraction: float  # mean share of the grip that the speed profile uses, 0 … 1
    grip_ripple: float  # amplitude by which the share of the grip varies
    line_offset: float  # amplitude of the lateral offset of the line [m]
    wavelengths: tuple[float, ...]  # wavelengths of the sines [m]
    grip_phases: tuple[float, ...]  # phase of each sine of the grip [rad]
    line_phases: tuple[float, ...]  # phase of each sine of the line [rad]

    def __post_init__(self) -> None:
        low = self.grip_fraction - abs(self.grip_ripple)
        high = self.grip_fraction + abs(self.grip_ripple)
        if not (low > 0.0 and high <= 1.0 + 1e-9):
            raise ConfigurationError(
                f"grip fraction {self.grip_fraction} ± {self.grip_ripple} must stay above 0 and at "
                "most 1"
            )


@dataclass(frozen=True, eq=False)
class Plan(Line):
    """Planned line and speed over the distance along the way, uniform from 0; all arrays have shape
    (N,).
    """

    speed: FloatArray  # speed [m/s]
    friction: FloatArray  # scale of the tyres' friction
    bank: FloatArray  # bank of the road, positive with the left side higher [rad]
    grade: FloatArray  # grade of the road, positive downhill [rad]

    @cached_property
    def acceleration(self) -> FloatArray:
        """Acceleration along the line [m/s²], shape (N,)."""
        return self.speed * np.gradient(self.speed, self.distance)

    @property
    def length(self) -> float:
        """Distance from the start to the end [m]."""
        return float(self.distance[-1])


class Observation(NamedTuple):
    """The car as the driver perceives it: place [m], heading [rad], velocity [m/s], yaw rate
    [rad/s], steering angle [rad].
    """

    x: float  # position [m]
    y: float  # position [m]
    yaw: float  # heading [rad]
    vx: float  # forward velocity [m/s]
    vy: float  # lateral velocity, positive to the left [m/s]
    yaw_rate: float  # yaw rate, positive to the left [rad/s]
    steer: float  # road-wheel angle, positive to the left [rad]

    @property
    def speed(self) -> float:
        """Speed of the car over the ground [m/s]."""
        return math.hypot(self.vx, self.vy)

    @property
    def sideslip(self) -> float:
        """Sideslip angle, atan2(vy, vx), zero below 1 m/s [rad]."""
        return math.atan2(self.vy, self.vx) if self.speed > 1.0 else 0.0


@dataclass(frozen=True)
class Command:
    """The driver's command, and the road at the car."""

    steering_velocity: float  # steering velocity of the road wheels [rad/s]
    acceleration: float  # requested longitudinal acceleration [m/s²]
    progress: float = 0.0  # distance along the way [m]
    # distance of the car from its line, positive left of it [m]; NaN where there is no line
    lateral_error: float = math.nan
    friction: float = 1.0  # scale of the tyres' friction at the car
    bank: float = 0.0  # bank of the road, positive with its left side higher [rad]
    grade: float = 0.0  # grade of the road, positive downhill [rad]
    heading: float = 0.0  # heading of the road, along which bank and grade are measured [rad]
    finished: bool = False  # whether the manoeuvre is over


def draw_style(
    seed: int, grip_range: tuple[float, float], ripple: float, line_offset: float
) -> DrivingStyle:
    """The style that belongs to a seed.

    Parameters
    ----------
    seed : int
        Of the drive.
    grip_range : tuple
        Lowest and highest mean share of the grip; the style's is drawn uniformly between them.
    ripple : float
        Amplitude of the share's variation along the drive.
    line_offset : float
        Amplitude of the line's lateral offset [m].

    Returns
    -------
    DrivingStyle
        From a random stream of its own (spawn key 0); the phases are drawn after the share.

    Raises
    ------
    ConfigurationError
        Share and ripple together leave the range from 0 to 1, as `DrivingStyle` checks.
    """
    generator = random_stream(seed, STYLE)
    grip_fraction = float(generator.uniform(*grip_range))
    phases = generator.uniform(0.0, 2.0 * math.pi, (2, len(WAVELENGTHS))).tolist()
    return DrivingStyle(
        grip_fraction, ripple, line_offset, WAVELENGTHS, tuple(phases[0]), tuple(phases[1])
    )


def plan_laps(
    course: Course,
    car: Car,
    driver: Driver,
    style: DrivingStyle,
    n_laps: int,
    *,
    friction: FloatArray,
    highest_speed: FloatArray | float,
) -> Plan:
    """Line and speed profile over laps, within the car's limits.

    Parameters
    ----------
    course : Course
        Centre line of a closed course at N samples, of which the last repeats the first.
    car : Car
        Limits of the car.
    driver : Driver
        Share of the grip for braking.
    style : DrivingStyle
        Share of the grip and lateral offset of the line, both varying along the drive.
    n_laps : int
        Number of laps, 1 or more.
    friction : array, shape (N,)
        Scale of the tyres' friction on the course's samples.
    highest_speed : array or float
        Limit set by the driver [m/s], for each of the n_laps·(N - 1) + 1 samples or all.

    Returns
    -------
    Plan
        Of n_laps·(N - 1) + 1 samples.
    """
    distance = _repeat(course.arc_length, n_laps, course.length)
    heading = _repeat(course.heading, n_laps, course.turning)
    bend, bank, grade = (
        _repeat(values, n_laps) for values in (course.curvature, course.bank, course.grade)
    )
    scale = _repeat(friction, n_laps)
    offset, offset_slope, offset_bend = _sines(
        distance, style.wavelengths, style.line_phases, style.line_offset
    )
    stretch = 1.0 - bend * offset  # length of the line per length of the centre line
    curvature = bend / stretch + offset_bend
    ripple, _, _ = _sines(distance, style.wavelengths, style.grip_phases, style.grip_ripple)
    used_grip = car.grip * scale * (style.grip_fraction + ripple)
    return Plan(
        distance=distance,
        x=_repeat(course.x, n_laps) - offset * np.sin(heading),
        y=_repeat(course.y, n_laps) + offset * np.cos(heading),
        heading=heading + np.arctan2(offset_slope, stretch),
        curvature=curvature,
        speed=speed_profile(
            curvature, used_grip, float(distance[1]), car, driver, highest_speed, bank, grade
        ),
        friction=scale,
        bank=bank,
        grade=grade,
    )


def speed_profile(
    curvature: FloatArray,
    used_grip: FloatArray,
    spacing: float,
    car: Car,
    driver: Driver,
    highest_speed: FloatArray | float = math.inf,
    bank: FloatArray | float = 0.0,
    grade: FloatArray | float = 0.0,
) -> FloatArray:
    """Highest speeds [m/s] within friction circle, engine power, the car's top speed and the
    driver's ``highest_speed`` [m/s]; (N,).

    Parameters
    ----------
    curvature : FloatArray
        (N,) [1/m], at samples ``spacing`` [m] apart.
    used_grip : FloatArray
        (N,), grip that is used at most [m/s²]; braking gets ``driver.braking_share`` of it, driving
        ``car.driving_share``.
    spacing : float
        Between samples along the line [m].
    car : Car
        Power per mass [W/kg], drag [1/m], top speed [m/s].
    driver : Driver
        Share of the grip for braking.
    highest_speed : FloatArray | float, default inf
        (N,) or one for all [m/s].
    bank, grade : FloatArray | float, default 0.0
        Angles of the road [rad]: bank is positive with the left side higher, grade is positive
        downhill.

    Returns
    -------
    FloatArray
        (N,) [m/s]. The first pass, backwards, limits braking, the second, forwards, acceleration;
        in both, lateral and longitudinal acceleration share one circle. Banking raises the lateral
        limit in a corner to its lower side; at least a tenth of the grip is left where it is
        adverse.
    """
    lateral = np.maximum(used_grip - np.sign(curvature) * GRAVITY * np.sin(bank), 0.1 * used_grip)
    cornering = np.sqrt(lateral / np.maximum(np.abs(curvature), 1e-9))
    speed = np.minimum(cornering, np.minimum(highest_speed, car.top_speed)).tolist()
    bend = np.abs(curvature).tolist()
    limit = lateral.tolist()
    max_grip = used_grip.tolist()
    downhill = (GRAVITY * np.sin(grade) + np.zeros_like(used_grip)).tolist()

    def spare(i: int) -> float:
        """Longitudinal share of the friction circle at sample i."""
        return math.sqrt(max(1.0 - (speed[i] ** 2 * bend[i] / limit[i]) ** 2, 0.0))

    for i in range(len(speed) - 2, -1, -1):
        braking = (
            driver.braking_share * max_grip[i + 1] * spare(i + 1)
            - downhill[i + 1]
            + car.drag * speed[i + 1] ** 2
        )
        speed[i] = min(speed[i], math.sqrt(speed[i + 1] ** 2 + 2.0 * max(braking, 0.0) * spacing))
    for i in range(len(speed) - 1):
        driving = (
            min(car.power_per_mass / speed[i], car.driving_share * max_grip[i] * spare(i))
            + downhill[i]
            - car.drag * speed[i] ** 2
        )
        speed[i + 1] = min(
            speed[i + 1], math.sqrt(max(speed[i] ** 2 + 2.0 * driving * spacing, 0.01))
        )
    return np.array(speed)


class Hands:
    """Steering corrections between 0.5 and 2 Hz beside following a line, as drivers make them at
    the limit.

    Parameters
    ----------
    size : float
        Root mean square of the lateral acceleration that is asked for, in a corner at the limit
        [m/s²]; a third of it on a straight.
    generator : np.random.Generator
        Draws 24 frequencies, evenly spread over the logarithm, and their phases.
    """

    def __init__(self, size: float, generator: np.random.Generator) -> None:
        frequencies = LOWEST_CORRECTION * (
            HIGHEST_CORRECTION / LOWEST_CORRECTION
        ) ** generator.uniform(size=24)
        phases = generator.uniform(0.0, 2.0 * math.pi, 24)
        self.size = size
        self._waves = np.stack([2.0 * math.pi * frequencies, phases], axis=1).tolist()

    def at(self, time: float, load: float) -> float:
        """Lateral acceleration that the corrections ask for at a time [m/s²].

        Parameters
        ----------
        time : float
            [s].
        load : float
            Lateral acceleration over grip; from 1 on the corrections have their full size.

        Returns
        -------
        float
            Positive to the left [m/s²]; a sum of 24 sines of equal amplitude.
        """
        unit = math.sqrt(2.0 / len(self._waves)) * sum(
            math.sin(rate * time + phase) for rate, phase in self._waves
        )
        return self.size * unit * (1.0 + 2.0 * min(load, 1.0)) / 3.0


class Follower:
    """Drives a car along a plan.

    Parameters
    ----------
    plan : Plan
        Line, speed and road over the distance along the way.
    car : Car
        The car as its driver knows it.
    driver : Driver
        Habits: preview, lags and gains.
    progress : float, default 0.0
        Where on the plan the car starts [m].
    speed_at : Callable[[float], tuple[float, float]] | None, default None
        Wanted speed [m/s] and acceleration [m/s²] at a time [s]; by default the plan's, by place.
    hands : Hands | None, default None
        Corrections beside the line; by default none.
    """

    def __init__(
        self,
        plan: Plan,
        car: Car,
        driver: Driver,
        progress: float = 0.0,
        speed_at: Callable[[float], tuple[float, float]] | None = None,
        hands: Hands | None = None,
    ) -> None:
        self._hands = hands
        self.plan = plan
        self.car = car
        self.driver = driver
        self.progress = progress
        self._speed_at = speed_at
        self._per_metre = 1.0 / float(plan.distance[1])
        self._last_cell = len(plan.distance) - 2
        along_plan = {**vars(plan), "acceleration": plan.acceleration}
        self._values: dict[str, list[float]] = {
            name: values.tolist() for name, values in along_plan.items()
        }

    @property
    def start(self) -> tuple[float, float, float, float]:
        """Place x, y [m], heading [rad] and speed [m/s] at which the car starts.

        Returns
        -------
        tuple of float
            x, y, heading and speed on the plan at ``progress``; with ``speed_at`` the speed of long
            before the first sample.
        """
        cell = self._cell(self.progress)
        x, y, heading, speed = (self._at(name, cell) for name in ("x", "y", "heading", "speed"))
        return x, y, heading, self._speed_at(-math.inf)[0] if self._speed_at else speed

    def command(self, time: float, observation: Observation) -> Command:
        """The command at a time [s] for an observation of the car.

        Steering: the steady turn of the curvature ahead, plus a correction of the lateral error
        expected one preview away, minus damping of the yaw rate, plus countersteer beyond the
        sideslip of the turn. Acceleration: that of the plan, feedback of the speed error, and
        resistance; limited by power and by what the friction circle has to spare.

        Parameters
        ----------
        time : float
            Since the first sample [s].
        observation : Observation
            Place, velocity and steering angle now.

        Returns
        -------
        Command
            With the road at the car (friction, bank, grade, heading) and the lateral error.
        """
        car = self.car
        driver = self.driver
        speed = observation.speed
        sideslip = observation.sideslip
        lateral_error, heading_error, cell = self._locate(observation, sideslip)
        ahead = self._cell(self.progress + speed * (driver.steering_lag + driver.response * speed))
        friction = max(self._at("friction", ahead), 0.05)
        bank = self._at("bank", cell)
        grade = self._at("grade", cell)
        grip = car.grip * friction

        preview = max(speed * driver.preview_time, 3.0)
        error_ahead = lateral_error + preview * math.sin(heading_error)
        planned_curvature = self._at("curvature", ahead)
        max_curvature = driver.saturation * grip / max(speed, 1.0) ** 2
        curvature = max(
            -max_curvature, min(max_curvature, planned_curvature - 2.0 * error_ahead / preview**2)
        )
        lateral = curvature * speed**2 + GRAVITY * math.sin(bank)
        # Back to the line with no more steering than at half of the grip: at the limit a car hardly
        # answers, and more makes it weave.
        steady_steer = car.steer_for(
            planned_curvature, planned_curvature * speed**2 + GRAVITY * math.sin(bank), friction
        )
        steer = steady_steer + self._per_curvature(speed, friction) * (
            curvature - planned_curvature
        )
        steer -= driver.yaw_damping * (observation.yaw_rate - speed * curvature)
        sliding = sideslip - car.sideslip_for(curvature, lateral, friction)
        excess_slide = max(abs(sliding) - driver.slide, 0.0)
        steer += driver.countersteer * math.copysign(excess_slide, sliding)
        if self._hands is not None:
            correction = self._hands.at(time, abs(lateral) / grip)
            steer += self._per_curvature(speed, friction) * correction / max(speed, 5.0) ** 2

        target, feedforward = (
            self._speed_at(time)
            if self._speed_at
            else (self._at("speed", cell), self._at("acceleration", ahead))
        )
        resistance = car.resistance(
            speed, observation.yaw_rate, observation.steer, sideslip
        ) - GRAVITY * math.sin(grade)
        acceleration = feedforward + driver.speed_gain * (target - speed) + resistance
        spare = math.sqrt(max(1.0 - (observation.yaw_rate * speed / grip) ** 2, 0.0))
        highest = min(car.driving_share * grip * spare, car.power_per_mass / max(speed, 1.0)) * max(
            1.0 - excess_slide / 0.1, 0.0
        )
        lowest = -max(driver.braking_share * grip * spare, 0.1 * grip)
        return Command(
            steering_velocity=steering_velocity(car, driver, steer, observation.steer),
            acceleration=max(lowest, min(highest, acceleration)),
            progress=self.progress,
            lateral_error=lateral_error,
            friction=self._at("friction", cell),
            bank=bank,
            grade=grade,
            heading=self._at("heading", cell),
        )

    def _per_curvature(self, speed: float, friction: float) -> float:
        """Steering angle over curvature of the path [rad m] at a speed [m/s], with understeer as at
        half of the grip.
        """
        car = self.car
        moderate = 0.5 * self.car.grip * friction
        return car.wheelbase + abs(car.steer_for(0.0, moderate, friction)) / moderate * speed**2

    def _locate(
        self, observation: Observation, sideslip: float
    ) -> tuple[float, float, tuple[int, float]]:
        """Lateral error [m], heading error [rad] and cell of the plan, by two Newton steps from the
        last progress.
        """
        for _ in range(2):
            cell = self._cell(self.progress)
            heading = self._at("heading", cell)
            dx = observation.x - self._at("x", cell)
            dy = observation.y - self._at("y", cell)
            along = math.cos(heading)
            across = math.sin(heading)
            self.progress = max(self.progress + dx * along + dy * across, 0.0)
        heading_error = math.remainder(observation.yaw + sideslip - heading, 2.0 * math.pi)
        return dy * along - dx * across, heading_error, self._cell(self.progress)

    def _cell(self, distance: float) -> tuple[int, float]:
        """Index of the sample before a distance [m], and the share of the way to the next one, held
        at the plan's ends.
        """
        position = distance * self._per_metre
        before = min(max(int(position), 0), self._last_cell)
        return before, min(max(position - before, 0.0), 1.0)

    def _at(self, name: str, cell: tuple[int, float]) -> float:
        """A quantity of the plan, interpolated between two samples at a share of the way."""
        before, share = cell
        low, high = self._values[name][before : before + 2]
        return low + share * (high - low)


def steering_velocity(car: Car, driver: Driver, target_steer: float, steer: float) -> float:
    """Steering velocity of the road wheels towards an angle, within the car's limits [rad/s].

    Parameters
    ----------
    car : Car
        Largest steering angle and velocity.
    driver : Driver
        Time constant of the steering.
    target_steer, steer : float
        Requested and present road-wheel angle [rad].

    Returns
    -------
    float
        Positive to the left.
    """
    target_steer = max(-car.largest_steer, min(car.largest_steer, target_steer))
    return max(
        -car.steering_rate, min(car.steering_rate, (target_steer - steer) / driver.steering_lag)
    )


def _repeat(values: FloatArray, n_laps: int, per_lap: float = 0.0) -> FloatArray:
    """Values along a lap, repeated ``n_laps`` times; each lap is ``per_lap`` higher than the one
    before.
    """
    laps = [values[:-1] + lap * per_lap for lap in range(n_laps)]
    return np.concatenate([*laps, values[-1:] + (n_laps - 1) * per_lap])


def _sines(
    distance: FloatArray,
    wavelengths: tuple[float, ...],
    phases: tuple[float, ...],
    amplitude: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of sines of the given amplitude over distance [m], with its first and second derivative,
    each (N,).
    """
    wave_numbers = 2.0 * math.pi / np.array(wavelengths)
    angles = distance[:, None] * wave_numbers + np.array(phases)
    value = amplitude * np.mean(np.sin(angles), axis=1)
    slope = amplitude * np.mean(wave_numbers * np.cos(angles), axis=1)
    bend = -amplitude * np.mean(wave_numbers**2 * np.sin(angles), axis=1)
    return value, slope, bend
