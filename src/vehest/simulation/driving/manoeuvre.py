"""Base of the manoeuvres: limits of parameters, values drawn by a seed, and controllers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.car import Car
from vehest.simulation.driving.driver import Command, Driver, Follower, Observation, Plan
from vehest.simulation.random_streams import MANOEUVRE, random_stream
from vehest.simulation.road.lines import Line
from vehest.simulation.road.surface import Surface

# a number, or the lowest and highest value from which every drive draws one
Range = float | tuple[float, float]
Side = Literal["left", "right", "either"]  # side to which a manoeuvre goes first; ``either``: drawn

# parameter -> lowest and highest value, of all manoeuvres
COMMON_LIMITS = {"half_width": (0.5, 50.0), "line_offset": (0.0, 3.0)}
SETTLING_TIME = 2.0  # time that is driven before the first sample [s]
OPEN_AREA_LAP = 2000.0  # distance after which an open area's patches of friction repeat [m]


class Controller(Protocol):
    """Drives one car through one manoeuvre."""

    @property
    def start(self) -> tuple[float, float, float, float]:
        """Place x, y [m], heading [rad] and speed [m/s] at which the car starts."""
        ...

    @property
    def drawn(self) -> dict[str, Any]:
        """Values that the seed drew, as JSON can hold them."""
        ...

    def command(self, time: float, observation: Observation) -> Command:
        """The driver's command at a time [s]; called DRIVER_RATE_HZ times a second."""
        ...


@dataclass(frozen=True)
class Manoeuvre(ABC):
    """Base of all manoeuvres; raises `ConfigurationError`: a parameter is outside its limits."""

    name: ClassVar[str]  # name in a configuration
    # parameter -> lowest and highest value, beside `COMMON_LIMITS`
    limits: ClassVar[Mapping[str, tuple[float, float]]] = {}

    def __post_init__(self) -> None:
        require(self, **COMMON_LIMITS, **self.limits)

    @property
    @abstractmethod
    def longest(self) -> float:
        """Time after which the recording ends in any case, unless the car is coming to its stand
        [s].
        """

    @abstractmethod
    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """The controller of this car on this surface, as the seed draws it; raises
        `ConfigurationError` where the car cannot do this.

        Parameters
        ----------
        car : Car
            Size, grip and limits of the car.
        surface : Surface
            Friction; patches are drawn by the seed unless the surface has its own.
        seed : int
            Of the drive: the same seed gives the same controller.

        Returns
        -------
        Controller
            Made anew for every drive; it keeps state.

        Raises
        ------
        ConfigurationError
            The car cannot do the manoeuvre.
        """

    def description(self) -> dict[str, Any]:
        """Name and parameters."""
        return {"name": self.name, **asdict(self)}


FASTEST_SHARE = 0.9  # largest share of the top speed at which a manoeuvre on an open area is driven


class LineDriver(Follower):
    """Follows a line to the distance ``end`` [m], by default the plan's end, or until ``end_time``
    [s]; ``following``: see `Follower`.
    """

    def __init__(
        self,
        plan: Plan,
        car: Car,
        driver: Driver,
        drawn: dict[str, Any],
        *,
        end: float | None = None,
        end_time: float = math.inf,
        **following: Any,
    ) -> None:
        super().__init__(plan, car, driver, **following)
        self.drawn = drawn
        self._end = plan.length - 1.0 if end is None else end
        self._end_time = end_time

    def command(self, time: float, observation: Observation) -> Command:
        """Command as planned, until the end."""
        decision = super().command(time, observation)
        is_over = decision.progress >= self._end or time >= self._end_time
        return replace(decision, finished=is_over)


class OpenArea:
    """Friction along the way on an open area, with patches drawn by the seed of the drive."""

    def __init__(self, surface: Surface, seed: int) -> None:
        self._friction = surface.along(np.arange(0.0, OPEN_AREA_LAP), seed, OPEN_AREA_LAP).tolist()
        self.mean, self.lowest = float(np.mean(self._friction)), min(self._friction)

    def friction_at(self, distance: float) -> float:
        """Scale of the tyres' friction after a distance [m]."""
        return float(self._friction[int(distance) % len(self._friction)])


SIDES = {1.0: "left", -1.0: "right"}  # names of the values of Draws.side


def require(manoeuvre: Any, **limits: tuple[float, float]) -> None:
    """Raise `ConfigurationError` for parameters outside their limits, both ends of a range
    included; None is within.

    Parameters
    ----------
    manoeuvre : Any
        With a ``name``; limits of parameters that it does not have are ignored.
    **limits : tuple of float
        Parameter -> lowest and highest allowed value, both inclusive.

    Raises
    ------
    ConfigurationError
        Names the manoeuvre, the parameter, its value and the limits; also where a range's ends are
        in the wrong order.
    """
    for key, (lowest, highest) in limits.items():
        value = getattr(manoeuvre, key, None)
        low, high = as_range(lowest if value is None else value)
        if not (lowest <= low <= high <= highest):
            raise ConfigurationError(
                f"manoeuvre '{manoeuvre.name}': {key} must lie between {lowest:g} and {highest:g}, "
                f"not {value}"
            )


def as_range(value: Range) -> tuple[float, float]:
    """Lowest and highest value of a range.

    Returns
    -------
    tuple of float
        A plain number twice.
    """
    low, high = value if isinstance(value, tuple) else (value, value)
    return float(low), float(high)


class Draws:
    """Values that the seed of a drive draws for its manoeuvre, in a fixed order."""

    def __init__(self, seed: int) -> None:
        self.generator = random_stream(seed, MANOEUVRE, 0)

    def __call__(self, value: Range) -> float:
        """A value of the range, uniformly; also a plain number takes one draw, so that later ones
        stay as they are.
        """
        return float(self.generator.uniform(*as_range(value)))

    def side(self, side: Side) -> float:
        """The side as a sign: 1 for the left, -1 for the right.

        Also a fixed side takes one draw, so that later draws stay as they are.
        """
        drawn = 1.0 if self.generator.uniform() < 0.5 else -1.0
        return {"left": 1.0, "right": -1.0}.get(side, drawn)


def draw_driver(seed: int) -> Driver:
    """Habits of the driver; their spread is assumed.

    Parameters
    ----------
    seed : int
        Of the drive; the habits have a random stream of their own.

    Returns
    -------
    Driver
        Preview, response, lag, damping and countersteer within 10 to 20 % of the defaults,
        uniformly.
    """
    generator = random_stream(seed, MANOEUVRE, 1)
    usual = Driver()
    spread = {
        "preview_time": 0.1,
        "response": 0.1,
        "steering_lag": 0.15,
        "yaw_damping": 0.15,
        "countersteer": 0.2,
    }
    habits = {
        name: getattr(usual, name) * float(generator.uniform(1.0 - by, 1.0 + by))
        for name, by in spread.items()
    }
    return replace(usual, **habits)


def plan_along(line: Line, speed: float, surface: Surface, seed: int) -> Plan:
    """A plan along a line on a level open area, at a constant speed.

    Parameters
    ----------
    line : Line
        Where to drive.
    speed : float
        Constant [m/s].
    surface : Surface
        Friction over the distance along the line, repeated after OPEN_AREA_LAP.
    seed : int
        Draws the surface's patches.
    """
    level = np.zeros_like(line.distance)
    friction = surface.along(line.distance, seed, OPEN_AREA_LAP)
    return Plan(**vars(line), speed=level + speed, friction=friction, bank=level, grade=level)
