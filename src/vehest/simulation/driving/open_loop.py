"""Manoeuvres steered by the clock on an open area: J-turn, spiral and random steer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.car import Car
from vehest.simulation.driving.driver import DRIVER_RATE_HZ, Command, Observation
from vehest.simulation.driving.manoeuvre import (
    FASTEST_SHARE,
    SETTLING_TIME,
    SIDES,
    Controller,
    Draws,
    Manoeuvre,
    OpenArea,
    Range,
    Side,
    as_range,
)
from vehest.simulation.road.surface import Surface


@dataclass(frozen=True)
class StepSteer(Manoeuvre):
    """J-turn: straight ahead, then the steering wheel is turned quickly and held (ISO 7401, step
    input).
    """

    name: ClassVar[str] = "j_turn"
    speed: Range = (15.0, 28.0)  # speed [m/s]; the driver holds it as far as grip and power allow
    # share of the grip that the steady turn takes; beyond 1 the steering angle grows with its
    # square
    severity: Range = (
        0.4,
        1.0,
    )
    # time in which the angle is reached, unless the steering is slower [s]
    steer_time: Range = (
        0.15,
        0.6,
    )
    turn_time: Range = (5.0, 8.0)  # time after the step [s]
    side: Side = "either"  # ``left``, ``right`` or ``either``

    limits: ClassVar = {
        "speed": (3.0, 70.0),
        "severity": (0.05, 2.0),
        "steer_time": (0.02, 10.0),
        "turn_time": (0.5, 600.0),
    }

    @property
    def longest(self) -> float:
        """Time of run-in, step and turn [s]."""
        return 5.0 + as_range(self.steer_time)[1] + as_range(self.turn_time)[1]

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the speed, the angle and the side of this seed.

        Returns
        -------
        Controller
            The step begins between 1 and 2 s after the first sample; its angle is that of a steady
            turn with ``severity`` of the grip, on mean friction.
        """
        area, drawn, turn_time = _drawn_turn(self, "steer_time", self.turn_time, car, surface, seed)
        begin = drawn["begin"]
        steer_time = drawn["steer_time"]

        def steer_at(time: float) -> float:
            return float(drawn["steer"] * min(max((time - begin) / steer_time, 0.0), 1.0))

        return OpenLoop(car, area, drawn["speed"], steer_at, begin + steer_time + turn_time, drawn)


@dataclass(frozen=True)
class Spiral(Manoeuvre):
    """Spiral: at constant speed the steering angle grows slowly, then, in a second turn, to the
    other side.
    """

    name: ClassVar[str] = "spiral"
    speed: Range = (14.0, 25.0)  # speed [m/s]; the driver holds it as far as grip and power allow
    # share of the grip that the tightest turn takes; beyond 1 the steering angle grows with its
    # square
    severity: Range = (
        0.7,
        1.0,
    )
    ramp_time: Range = (6.0, 12.0)  # time in which the angle is reached [s]
    hold_time: Range = (1.0, 2.0)  # time at the angle [s]
    turns: Literal[1, 2] = 2  # number of turns: 1, or 2 for a second turn to the other side
    side: Side = "either"  # side of the first turn: ``left``, ``right`` or ``either``

    limits: ClassVar = {
        "speed": (3.0, 70.0),
        "severity": (0.05, 2.0),
        "ramp_time": (0.5, 300.0),
        "hold_time": (0.0, 300.0),
    }

    @property
    def longest(self) -> float:
        """Time of run-in, ramps and holds, at most [s]."""
        return 10.0 + 2.0 * (1.5 * as_range(self.ramp_time)[1] + as_range(self.hold_time)[1])

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the speed, the angle and the side of this seed.

        Returns
        -------
        Controller
            The angle is piecewise linear in time: up within ``ramp_time``, held, and back to zero;
            then, for two turns, the same to the other side.
        """
        area, drawn, hold = _drawn_turn(self, "ramp_time", self.hold_time, car, surface, seed)
        begin = drawn["begin"]
        ramp = drawn["ramp_time"]
        angle = drawn["steer"]
        back = min(0.4 * ramp, 3.0)
        times = [begin, begin + ramp, begin + ramp + hold, begin + ramp + hold + back]
        angles = [0.0, angle, angle, 0.0]
        if self.turns == 2:
            again = times[-1]
            times = [*times, again + ramp, again + ramp + hold, again + ramp + hold + back]
            angles = [*angles, -angle, -angle, 0.0]

        def steer_at(time: float) -> float:
            return float(np.interp(time, times, angles))

        return OpenLoop(car, area, drawn["speed"], steer_at, times[-1] + 1.0, drawn)


@dataclass(frozen=True)
class RandomSteer(Manoeuvre):
    """Random steering within a band of frequencies at roughly constant speed (in the manner of ISO
    7401, random input).
    """

    name: ClassVar[str] = "random_steer"
    speed: Range = (14.0, 30.0)  # speed [m/s]; the driver holds it as far as grip and power allow
    # share of the grip that three standard deviations of the steering angle would take in a steady
    # turn
    severity: Range = (
        0.5,
        1.0,
    )
    band: tuple[float, float] = (0.1, 1.2)  # lowest and highest frequency [Hz]
    duration: float = 30.0  # length of the recording [s]

    limits: ClassVar = {"speed": (3.0, 70.0), "severity": (0.05, 2.0), "duration": (1.0, 3600.0)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.01 <= self.band[0] < self.band[1] <= 5.0:
            raise ConfigurationError(
                "manoeuvre 'random_steer': the band must lie between 0.01 and 5 Hz, not "
                f"{self.band}"
            )

    @property
    def longest(self) -> float:
        """The duration [s]."""
        return self.duration

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the speed and the noise of this seed.

        Returns
        -------
        Controller
            The angle is a sum of N_SINES sines of equal amplitude with one frequency drawn in each
            part of the band; it fades in over 1 s around the first sample.
        """
        draw = Draws(seed)
        speed = min(draw(self.speed), FASTEST_SHARE * car.top_speed)
        severity = draw(self.severity)
        area = OpenArea(surface, seed)
        deviation = _steer_at(car, severity, speed, area.mean) / 3.0
        edges = np.linspace(*self.band, N_SINES + 1)
        rates = (2.0 * math.pi * draw.generator.uniform(edges[:-1], edges[1:])).tolist()
        phases = draw.generator.uniform(0.0, 2.0 * math.pi, N_SINES).tolist()
        amplitude = deviation * math.sqrt(2.0 / N_SINES)

        def steer_at(time: float) -> float:
            fade = min(max((time + 0.5) / 1.0, 0.0), 1.0)
            waves = (
                math.sin(rate * time + phase) for rate, phase in zip(rates, phases, strict=True)
            )
            return fade * amplitude * sum(waves)

        drawn = {"speed": speed, "severity": severity, "steer_deviation": deviation}
        return OpenLoop(car, area, speed, steer_at, self.duration, drawn)


N_SINES = 24  # number of sines of which random steering is made, evenly spread over the band


class OpenLoop:
    """Steers by time on an open area, and holds the speed, until ``end_time``.

    Parameters
    ----------
    car : Car
        Limits of steering rate, grip and power.
    area : OpenArea
        Friction over the distance driven.
    speed : float
        Held as far as grip and power allow [m/s].
    steer_at : callable
        Time [s] -> road-wheel angle [rad], positive to the left.
    end_time : float
        [s].
    drawn : dict
        Values that the seed drew.
    """

    def __init__(
        self,
        car: Car,
        area: OpenArea,
        speed: float,
        steer_at: Callable[[float], float],
        end_time: float,
        drawn: dict[str, Any],
    ) -> None:
        self.drawn = drawn
        self.start = (0.0, 0.0, 0.0, speed)
        self._car = car
        self._area = area
        self._speed = speed
        self._steer_at = steer_at
        self._end_time = end_time
        self._progress = 0.0
        self._before = -SETTLING_TIME

    def command(self, time: float, observation: Observation) -> Command:
        """Steering velocity towards the angle of this time, and throttle or brakes by the speed as
        the grip allows.
        """
        car = self._car
        speed = observation.speed
        self._progress += speed * (time - self._before)
        self._before = time
        friction = self._area.friction_at(self._progress)
        rate = (self._steer_at(time + 1.0 / DRIVER_RATE_HZ) - observation.steer) * DRIVER_RATE_HZ
        grip = car.grip * friction
        spare = math.sqrt(max(1.0 - (observation.yaw_rate * speed / grip) ** 2, 0.0))
        target_acceleration = 1.5 * (self._speed - speed) + car.resistance(
            speed, observation.yaw_rate, observation.steer, observation.sideslip
        )
        highest = min(car.driving_share * grip * spare, car.power_per_mass / max(speed, 1.0))
        return Command(
            steering_velocity=max(-car.steering_rate, min(car.steering_rate, rate)),
            acceleration=max(-0.2 * grip, min(highest, target_acceleration)),
            progress=self._progress,
            friction=friction,
            finished=time >= self._end_time,
        )


def _drawn_turn(
    manoeuvre: StepSteer | Spiral,
    steering_time: str,
    time_after: Range,
    car: Car,
    surface: Surface,
    seed: int,
) -> tuple[OpenArea, dict[str, Any], float]:
    """The area, the values that the seed draws for a turn by the clock, and a time after it [s].

    ``steering_time`` is the name of the time in which the angle is reached.
    """
    draw = Draws(seed)
    speed = min(draw(manoeuvre.speed), FASTEST_SHARE * car.top_speed)
    severity = draw(manoeuvre.severity)
    steering = draw(getattr(manoeuvre, steering_time))
    after = draw(time_after)
    side = draw.side(manoeuvre.side)
    begin = draw((1.0, 2.0))
    area = OpenArea(surface, seed)
    drawn = {
        "speed": speed,
        "severity": severity,
        "steer": side * _steer_at(car, severity, speed, area.mean),
        "begin": begin,
        steering_time: steering,
        "side": SIDES[side],
    }
    return area, drawn, after


def _steer_at(car: Car, severity: float, speed: float, friction: float) -> float:
    """Road-wheel angle [rad] of a steady turn at a speed [m/s] that takes a share of the grip,
    ``severity``.
    """
    lateral = min(severity, 1.0) * car.grip * friction
    return min(
        car.steer_for(lateral / speed**2, lateral, friction) * max(severity, 1.0) ** 2,
        car.largest_steer,
    )
