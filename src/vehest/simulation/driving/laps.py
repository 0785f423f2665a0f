"""Laps of a course: at a share of the grip, at given speeds, and in a given time."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.car import Car
from vehest.simulation.driving.driver import (
    Command,
    Driver,
    Hands,
    Observation,
    Plan,
    draw_style,
    plan_laps,
)
from vehest.simulation.driving.manoeuvre import (
    SETTLING_TIME,
    Controller,
    Draws,
    LineDriver,
    Manoeuvre,
    Range,
    as_range,
    draw_driver,
    require,
)
from vehest.simulation.random_streams import TRAFFIC, random_stream
from vehest.simulation.road.course import Course, course_by_name
from vehest.simulation.road.surface import Surface

TRAFFIC_LENGTH = (50.0, 400.0)  # shortest and longest segment behind a slower car [m]; assumed


@dataclass(frozen=True)
class Laps(Manoeuvre):
    """Laps of a course at a share of the grip that varies along the way."""

    name: ClassVar[str] = "laps"
    course: str = "handling"  # name of the course
    duration: float | None = None  # length of the recording [s], where ``laps`` is not given
    laps: int | None = None  # number of whole laps to record
    severity: Range = (0.65, 0.9)  # mean share of the grip
    ripple: float = 0.05  # amplitude by which the share of the grip varies along the way
    line_offset: float = 0.5  # amplitude by which the line varies about the road's middle [m]
    # speed that the driver does not exceed [m/s]; by default the car's
    top_speed: float | None = None
    flat: bool = False  # whether the course's bank and grade are left out
    half_width: float = 5.0  # half width of the road, beyond which the car has left it [m]
    corrections: Range = 0.0  # size of the corrections of the driver's hands, see `Hands` [m/s²]
    traffic: float = 0.0  # mean number of segments per lap behind a slower car
    # lowest and highest speed of the slower cars, drawn for each [m/s]
    traffic_speed: tuple[float, float] = (8.0, 30.0)

    limits: ClassVar = {
        **{"severity": (0.05, 1.0), "ripple": (0.0, 0.5), "corrections": (0.0, 5.0)},
        **{"traffic": (0.0, 20.0), "traffic_speed": (3.0, 100.0), "duration": (0.01, 36_000.0)},
        **{"laps": (1.0, 1000.0), "top_speed": (3.0, 100.0)},
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        course_by_name(self.course)
        if (self.duration is None) == (self.laps is None):
            raise ConfigurationError(
                "manoeuvre 'laps' needs either a duration [s] or a number of laps"
            )

    @property
    def longest(self) -> float:
        """The duration, or a time that is long enough for the laps [s]."""
        return self.duration if self.duration is not None else 1000.0 * (self.laps or 1)

    def description(self) -> dict[str, Any]:
        """Name and parameters, those of corrections and traffic only where there are any."""
        words = super().description()
        if self.corrections == 0.0:
            del words["corrections"]
        if self.traffic == 0.0:
            del words["traffic"], words["traffic_speed"]
        return words

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the style and the habits of this seed.

        Parameters
        ----------
        car : Car
            The car as its driver knows it.
        surface : Surface
            Scales the course's own friction.
        seed : int
            Of style, habits, traffic, corrections and patches.

        Returns
        -------
        Controller
            A LapDriver. With ``laps``, its plan has two laps more than are recorded: one before, on
            which the car starts, and one after, so that the preview does not reach the plan's end.
        """
        course = _course(self.course, self.flat)
        driver = draw_driver(seed)
        low, high = as_range(self.severity)
        room = 1.0 - self.ripple
        style = draw_style(seed, (min(low, room), min(high, room)), self.ripple, self.line_offset)
        friction = course.friction * surface.along(course.arc_length, seed, course.length)
        highest = self.top_speed if self.top_speed is not None else math.inf
        draw = Draws(seed)
        hands = Hands(draw(self.corrections), draw.generator) if self.corrections != 0.0 else None

        def plan(n_laps: int) -> Plan:
            speeds = (
                self._traffic_speeds(course, n_laps, highest, seed) if self.traffic else highest
            )
            return plan_laps(
                course, car, driver, style, n_laps, friction=friction, highest_speed=speeds
            )

        laps = (
            self.laps
            if self.laps is not None
            else math.ceil((self.duration or 0.0) / _lap_time(plan(2), course.length)) + 1
        )
        end = (1 + self.laps) * course.length if self.laps is not None else math.inf
        drawn: dict[str, Any] = {"style": asdict(style), "driver": asdict(driver)}
        end_time = self.duration if self.duration is not None else math.inf
        if hands is not None:
            drawn["corrections"] = hands.size
        return LapDriver(
            plan(laps + 2), car, driver, drawn, course.length, end, end_time=end_time, hands=hands
        )

    def _traffic_speeds(self, course: Course, n_laps: int, highest: float, seed: int) -> FloatArray:
        """Highest speeds along the way [m/s]: those of slower cars ahead, on segments that are
        drawn lap by lap.
        """
        cells = len(course.arc_length) - 1
        spacing = float(course.arc_length[1])
        speeds = np.full(n_laps * cells + 1, highest)
        for lap in range(n_laps):
            generator = random_stream(seed, TRAFFIC, lap)
            for _ in range(int(generator.poisson(self.traffic))):
                begin = lap * cells + int(generator.uniform(0.0, cells))
                length = int(generator.uniform(*TRAFFIC_LENGTH) / spacing)
                stretch = speeds[begin : begin + length]
                stretch[:] = np.minimum(stretch, generator.uniform(*self.traffic_speed))
        return speeds


@dataclass(frozen=True)
class SpeedLaps(Manoeuvre):
    """A lap at each of several speeds, then a stop, as the truck of Di Biase et al. 2020 drove
    them.
    """

    name: ClassVar[str] = "speed_laps"
    course: str = "vairano_like"  # name of the course
    # speeds of the laps, in order [m/s]; 30, 40 and 45 km/h in the paper
    speeds: tuple[float, ...] = (
        30.0 / 3.6,
        40.0 / 3.6,
        45.0 / 3.6,
    )
    stop_time: float = 5.0  # time from the last lap's speed to the stand [s]; 5 s in the paper
    severity: Range = 0.7  # largest share of the grip that corners take
    change_rate: float = 0.4  # acceleration with which the speed changes from lap to lap [m/s²]
    line_offset: float = 0.3  # amplitude by which the line varies about the road's middle [m]
    flat: bool = False  # whether the course's bank and grade are left out
    half_width: float = 5.0  # half width of the road, beyond which the car has left it [m]

    limits: ClassVar = {
        "severity": (0.05, 0.95),
        "stop_time": (1.0, 60.0),
        "change_rate": (0.05, 3.0),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        course_by_name(self.course)
        if not self.speeds or not all(2.0 <= speed <= 60.0 for speed in self.speeds):
            raise ConfigurationError(
                "manoeuvre 'speed_laps': speeds must lie between 2 and 60 m/s, not "
                f"{list(self.speeds)}"
            )

    @property
    def longest(self) -> float:
        """Twice the time that the laps take at their speeds, and the stop [s]."""
        length = course_by_name(self.course).length
        return 2.0 * sum(length / speed for speed in self.speeds) + self.stop_time

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the line and the habits of this seed.

        Friction and corners may keep a lap below its speed. After the last lap the car brakes
        evenly to its stand within ``stop_time``.
        """
        course = _course(self.course, self.flat)
        driver = draw_driver(seed)
        severity = Draws(seed)(self.severity)
        style = draw_style(seed, (severity, severity), 0.0, self.line_offset)
        friction = course.friction * surface.along(course.arc_length, seed, course.length)
        n_laps = len(self.speeds) + 2
        cells = len(course.arc_length) - 1
        lap_of = np.clip(np.arange(n_laps * cells + 1) // cells - 1, 0, len(self.speeds) - 1)
        lap_speeds = np.array(self.speeds)[lap_of]
        plan = plan_laps(
            course,
            car,
            driver,
            style,
            n_laps,
            friction=friction,
            highest_speed=_eased(lap_speeds, course, self.change_rate),
        )
        end = (1 + len(self.speeds)) * course.length
        drawn = {"severity": severity, "style": asdict(style), "driver": asdict(driver)}
        return LapDriver(plan, car, driver, drawn, course.length, end, stop_time=self.stop_time)


@dataclass(frozen=True)
class FastLap(Manoeuvre):
    """One lap of a given mean and top speed, as the truck of Di Biase et al. 2020 drove it."""

    name: ClassVar[str] = "fast_lap"
    course: str = "vairano_like"  # name of the course
    # length of the course over the time of the lap [m/s]; 76 km/h in the paper
    mean_speed: float = 76.0 / 3.6
    # speed that the driver does not exceed [m/s]; 115 km/h in the paper
    top_speed: float = 115.0 / 3.6
    line_offset: float = 0.3  # amplitude by which the line varies about the road's middle [m]
    flat: bool = False  # whether the course's bank and grade are left out
    half_width: float = 5.0  # half width of the road, beyond which the car has left it [m]

    limits: ClassVar = {"mean_speed": (2.0, 60.0)}

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, top_speed=(self.mean_speed, 100.0))
        course_by_name(self.course)

    @property
    def longest(self) -> float:
        """Twice the time that the lap should take [s]."""
        return 2.0 * course_by_name(self.course).length / self.mean_speed

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver who uses as much of the grip as the mean speed takes; raises
        `ConfigurationError` where the car is too slow for it.

        The share of the grip is found by bisection, in twelve steps between 0.02 and
        FASTEST_SEVERITY, on the planned lap time.
        """
        course = _course(self.course, self.flat)
        driver = draw_driver(seed)
        friction = course.friction * surface.along(course.arc_length, seed, course.length)

        def plan(severity: float) -> Plan:
            style = draw_style(seed, (severity, severity), 0.0, self.line_offset)
            return plan_laps(
                course, car, driver, style, 3, friction=friction, highest_speed=self.top_speed
            )

        def mean(severity: float) -> float:
            return course.length / _lap_time(plan(severity), course.length)

        low = 0.02
        high = FASTEST_SEVERITY
        if mean(high) < self.mean_speed:
            raise ConfigurationError(
                f"manoeuvre 'fast_lap': vehicle '{car.name}' laps '{course.name}' at "
                f"{mean(high):.1f} m/s at most, not at {self.mean_speed:.1f} m/s: choose another "
                "car, or a lower mean_speed"
            )
        for _ in range(12):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if mean(middle) < self.mean_speed else (low, middle)
        return LapDriver(
            plan(high),
            car,
            driver,
            {"severity": high, "driver": asdict(driver)},
            course.length,
            2.0 * course.length,
        )


FASTEST_SEVERITY = 0.95  # largest share of the grip that a fast lap may take


class LapDriver(LineDriver):
    """Follows a plan of laps of length ``lap`` [m] from just before the second one; the first
    sample is taken on the start line.

    At the distance ``end`` [m] the drive is over or, with a ``stop_time`` [s], the car begins to
    stop, to stand after it; it is over at ``end_time`` [s] wherever the car is. The plan has one
    lap more than is recorded.

    Parameters
    ----------
    plan, car, driver
        As of `Follower`.
    drawn : dict
        Values that the seed drew, for the provenance.
    lap : float
        Length of a lap [m].
    end : float
        Distance along the plan [m].
    stop_time : float or None
        From the end to the stand [s]; None: the drive ends there.
    end_time : float
        [s].
    hands : Hands or None
        Corrections of the driver.
    """

    def __init__(
        self,
        plan: Plan,
        car: Car,
        driver: Driver,
        drawn: dict[str, Any],
        lap: float,
        end: float,
        *,
        stop_time: float | None = None,
        end_time: float = math.inf,
        hands: Hands | None = None,
    ) -> None:
        times = np.concatenate(
            [[0.0], np.cumsum(plan.distance[1] / (0.5 * (plan.speed[1:] + plan.speed[:-1])))]
        )
        begin = float(
            np.interp(np.interp(lap, plan.distance, times) - SETTLING_TIME, times, plan.distance)
        )
        super().__init__(
            plan, car, driver, drawn, end=end, end_time=end_time - 1e-9, progress=begin, hands=hands
        )
        self._stop_time = stop_time
        self._stop: tuple[float, float] | None = None  # when it began, and at which speed

    def command(self, time: float, observation: Observation) -> Command:
        """Command as planned; even braking once the end is reached."""
        decision = super().command(time, observation)
        if self._stop_time is None or decision.progress < self._end:
            return decision
        if self._stop is None:
            self._stop = (time, observation.speed)
        begin, speed = self._stop
        rate = speed / self._stop_time
        planned_speed = speed - rate * (time - begin)
        acceleration = -rate + 3.0 * min(planned_speed - observation.speed, 0.0)
        return replace(decision, finished=False, acceleration=acceleration)


def _course(name: str, flat: bool) -> Course:
    """A course by name; with ``flat``, without its bank and grade."""
    course = course_by_name(name)
    level = np.zeros_like(course.arc_length)
    return replace(course, bank=level, grade=level) if flat else course


def _lap_time(plan: Plan, length: float) -> float:
    """Time of the plan's second lap [s]; ``length`` of a lap [m]."""
    lap = (plan.distance >= length) & (plan.distance < 2.0 * length)
    return float(np.sum(plan.distance[1] / plan.speed[lap]))


def _eased(speed: FloatArray, course: Course, rate: float) -> FloatArray:
    """Speeds along the way [m/s] without steps: from each step on they change by a constant
    acceleration ``rate`` [m/s²].
    """
    spacing = float(course.arc_length[1])
    eased = speed.copy()
    for at in np.flatnonzero(np.diff(speed)).tolist():
        before = speed[at]
        after = speed[at + 1]
        cells = max(round(abs(after**2 - before**2) / (2.0 * rate) / spacing), 1)
        eased[at + 1 : at + 1 + cells] = np.sqrt(np.linspace(before**2, after**2, cells + 1)[1:])[
            : len(eased) - at - 1
        ]
    return eased
