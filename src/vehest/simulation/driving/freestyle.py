"""Freestyle driving of a small car: drifts, doughnuts, wheel spin and hard braking, in random
order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.driver import Observation
from vehest.simulation.driving.manoeuvre import Draws, Manoeuvre, OpenArea, Range, as_range
from vehest.simulation.plant.planar import Inputs
from vehest.simulation.plant.planar_car import PlanarCar
from vehest.simulation.road.surface import Surface

COMMAND_RATE_HZ = 100.0  # rate at which the driver's hands reach the car
MIN_SPEED = 0.9  # speed below which the driver always gives gas [m/s]
SPEED_MARGIN = 1.0  # speed over the wanted one at which the driver brakes [m/s]
# sideslip angle below which the driver brakes, and has caught a slide [rad]
MAX_CALM_SIDESLIP = 0.12
COUNTERSTEER = 1.5  # road-wheel angle over sideslip angle while a slide is caught


@dataclass(frozen=True)
class Freestyle(Manoeuvre):
    """A remotely controlled car on an open area, thrown from turn to turn; all habits are assumed.

    The driver holds the steering at a stop, half way or straight for a while, then goes on to the
    next; gives gas in bursts as long as the car is slower than wanted, coasts, brakes where it is
    much faster, and countersteers where it slides more than allowed.
    """

    name: ClassVar[str] = "freestyle"
    duration: Range = (20.0, 40.0)  # length of the recording [s]
    speed: tuple[float, float] = (1.4, 4.0)  # lowest and highest target speed [m/s]
    # lowest and highest motor current of a burst of gas [A]
    current: tuple[float, float] = (10.0, 45.0)
    # lowest and highest sideslip angle beyond which the driver lifts and countersteers, drawn anew
    # for each slide [rad]
    sideslip: tuple[float, float] = (
        0.15,
        0.35,
    )
    brakes: float = 0.02  # share of the decisions that are a full braking
    kicks: float = 0.03  # share of the decisions that are a burst with the largest current
    straights: float = 0.15  # share of the steering decisions that are straight ahead

    limits: ClassVar = {
        **{
            "duration": (1.0, 3600.0),
            "speed": (0.5, 20.0),
            "current": (0.0, 1000.0),
            "sideslip": (0.05, math.pi),
        },
        **dict.fromkeys(("brakes", "kicks", "straights"), (0.0, 1.0)),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.brakes + self.kicks > 1.0:
            raise ConfigurationError(
                f"manoeuvre 'freestyle': brakes and kicks are shares of one, not {self.brakes} and "
                f"{self.kicks}"
            )

    @property
    def longest(self) -> float:
        """Longest length that a recording may be drawn to have [s]."""
        return as_range(self.duration)[1]

    def controller(  # type: ignore[override]
        self, car: PlanarCar, surface: Surface, seed: int
    ) -> FreestyleDriver:
        """The driver of this seed.

        Parameters
        ----------
        car : PlanarCar
            Of the planar plant, whose limits of steering and current the driver keeps.
        surface : Surface
            Friction of the open area.
        seed : int
            Of the drive; it draws the duration and every later decision.
        """
        return FreestyleDriver(self, car, OpenArea(surface, seed), Draws(seed))


class FreestyleDriver:
    """Drives one car for the time of one recording."""

    def __init__(self, style: Freestyle, car: PlanarCar, area: OpenArea, draw: Draws) -> None:
        self._style = style
        self._car = car
        self._area = area
        self._draw = draw
        self._generator = draw.generator
        self.duration = draw(style.duration)
        self.drawn = {"duration": self.duration}
        self._progress = self._speed_until = self._steer_until = self._gas_until = 0.0
        self._target_speed = self._steer = self._gas = 0.0
        self._side = 1.0
        self._max_sideslip = draw(style.sideslip)
        self._saves = False

    def inputs(self, time: float, observation: Observation) -> Inputs:
        """The driver's inputs at a time [s]; called COMMAND_RATE_HZ times a second.

        Parameters
        ----------
        time : float
            [s], ascending from call to call.
        observation : Observation
            Motion of the car; below MIN_SPEED the sideslip counts as zero.

        Returns
        -------
        Inputs
            Wanted road-wheel angle [rad, positive to the left], motor current [A, negative brakes]
            and the scale of friction at the distance driven so far. While a slide beyond the
            allowed sideslip lasts, the driver countersteers and gives no gas.
        """
        self._progress += observation.speed / COMMAND_RATE_HZ
        sideslip = (
            math.atan2(observation.vy, observation.vx) if observation.speed > MIN_SPEED else 0.0
        )
        if not self._saves and abs(sideslip) > self._max_sideslip:
            self._saves, self._max_sideslip = True, self._draw(self._style.sideslip)
        elif self._saves and abs(sideslip) < MAX_CALM_SIDESLIP:
            self._saves = False
        steer = self._next_steer(time)
        gas = self._next_gas(time, observation)
        if self._saves:
            steer = COUNTERSTEER * sideslip
            gas = 0.0
        elif gas < 0.0 and abs(sideslip) > MAX_CALM_SIDESLIP:
            gas = 0.0
        return Inputs(steer, gas, self._area.friction_at(self._progress))

    def _next_steer(self, time: float) -> float:
        """Next wanted road-wheel angle [rad]: at a stop mostly, to one side and then to the
        other.
        """
        if time >= self._steer_until:
            generator = self._generator
            kind = self._generator.uniform()
            self._side = -self._side if generator.uniform() < 0.6 else self._side
            self._steer = self._side * self._car.largest_steer
            self._steer_until = time + float(generator.gamma(1.5, 1.0))
            if kind < self._style.straights:
                self._steer *= float(generator.uniform(-0.1, 0.1))
            elif kind < 2.0 * self._style.straights:
                self._steer *= float(generator.uniform(0.2, 0.9))
            else:
                self._steer_until += float(generator.gamma(1.5, 1.0))
        return self._steer

    def _next_gas(self, time: float, observation: Observation) -> float:
        """Next wanted motor current [A]: bursts up to the wanted speed, none above it, braking
        where it is much too fast, and at random.
        """
        generator = self._generator
        style = self._style
        largest = self._car.largest_current
        if time >= self._speed_until:
            self._target_speed = float(generator.uniform(*as_range(style.speed)))
            self._speed_until = time + float(generator.uniform(1.0, 4.0))
        if observation.vx < MIN_SPEED and self._gas <= 0.0:
            self._gas_until = time
        if time >= self._gas_until:
            kind = generator.uniform()
            current = float(generator.uniform(*style.current))
            self._gas_until = time + float(generator.uniform(0.15, 0.6))
            if observation.vx < MIN_SPEED:
                self._gas = max(current, 0.4 * largest)
            elif kind < style.brakes or observation.vx > self._target_speed + SPEED_MARGIN:
                self._gas = -float(generator.uniform(0.3, 0.7)) * largest
            elif kind > 1.0 - style.kicks:
                self._gas = float(generator.uniform(0.8, 1.0)) * largest
            else:
                self._gas = current if observation.vx < self._target_speed else 0.0
        return self._gas
