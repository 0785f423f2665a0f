"""Manoeuvres on a circle: steady-state circle (skidpad) and braking in the turn."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal

from vehest.simulation.driving.car import Car
from vehest.simulation.driving.driver import Command, Driver, Observation, Plan
from vehest.simulation.driving.manoeuvre import (
    FASTEST_SHARE,
    SETTLING_TIME,
    SIDES,
    Controller,
    Draws,
    LineDriver,
    Manoeuvre,
    OpenArea,
    Range,
    Side,
    as_range,
    draw_driver,
    plan_along,
)
from vehest.simulation.road.lines import circle
from vehest.simulation.road.surface import Surface

# parameter -> lowest and highest value, of manoeuvres on a circle
CIRCLE_LIMITS = {"radius": (15.0, 500.0), "severity": (0.1, 1.3)}


@dataclass(frozen=True)
class SteadyCircle(Manoeuvre):
    """Steady-state circle: constant radius, slowly increasing speed (ISO 4138, constant-radius
    test).
    """

    name: ClassVar[str] = "skidpad"
    radius: Range = (35.0, 60.0)  # radius of the circle [m]; the standard requires at least 30 m
    severity: Range = (0.7, 0.95)  # share of the grip at which the drive ends
    # rate at which the lateral acceleration grows [m/s³]; the standard's slow increase
    ay_rate: float = 0.25
    start_ay: float = 2.0  # lateral acceleration at which the circle is entered [m/s²]
    hold_time: float = 2.0  # time at the final speed [s]
    side: Side = "either"  # ``left``, ``right`` or ``either``
    half_width: float = 4.0  # distance from the circle beyond which the car has left it [m]

    limits: ClassVar = CIRCLE_LIMITS | {
        "ay_rate": (0.02, 3.0),
        "start_ay": (0.2, 8.0),
        "hold_time": (0.0, 120.0),
    }

    @property
    def longest(self) -> float:
        """Time in which two times 9.81 m/s² are reached [s]."""
        return 30.0 + self.hold_time + 2.0 * 9.81 / self.ay_rate

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the radius, the side and the habits of this seed.

        Parameters
        ----------
        car : Car
            Its grip times the severity is the final lateral acceleration, limited by the top speed.
        surface : Surface
            The lowest friction of an open area with this seed scales the grip.
        seed : int
            Of the drive.

        Returns
        -------
        Controller
            Straight run-in, a clothoid, then the circle; the speed follows a lateral acceleration
            that grows at ``ay_rate``.
        """
        draw = Draws(seed)
        radius = draw(self.radius)
        severity = draw(self.severity)
        side = draw.side(self.side)
        driver = draw_driver(seed)
        final_ay = min(
            severity * car.grip * OpenArea(surface, seed).lowest,
            (FASTEST_SHARE * car.top_speed) ** 2 / radius,
        )
        first_ay = min(self.start_ay, 0.5 * final_ay)
        speed = math.sqrt(first_ay * radius)
        run_in = (SETTLING_TIME + 1.0) * speed
        transition = 1.5 * speed
        entered = (run_in + transition) / speed - SETTLING_TIME
        growing = (final_ay - first_ay) / self.ay_rate

        def speed_at(time: float) -> tuple[float, float]:
            share = min(max((time - entered) / growing, 0.0), 1.0)
            now = math.sqrt((first_ay + share * (final_ay - first_ay)) * radius)
            return now, 0.5 * self.ay_rate * radius / now if 0.0 < share < 1.0 else 0.0

        around = math.sqrt(final_ay * radius) * (growing + self.hold_time + 5.0)
        line = circle(radius, side, run_in, around, transition)
        plan = plan_along(line, speed, surface, seed)
        drawn = {
            "radius": radius,
            "severity": severity,
            "side": SIDES[side],
            "driver": asdict(driver),
        }
        return LineDriver(
            plan, car, driver, drawn, end_time=entered + growing + self.hold_time, speed_at=speed_at
        )


@dataclass(frozen=True)
class BrakingInTurn(Manoeuvre):
    """Braking on a circle with the steering held (ISO 7975, open loop)."""

    name: ClassVar[str] = "braking_in_turn"
    radius: Range = (60.0, 100.0)  # radius of the circle [m]; 100 m in the standard
    # share of the grip that the turn takes; the standard's 5 m/s² are about half of a dry road's
    severity: Range = (
        0.4,
        0.7,
    )
    deceleration: Range = (2.0, 5.0)  # deceleration of the braking [m/s²]
    turn_time: Range = (3.0, 5.0)  # time on the circle before the brakes [s]
    # ``held`` or, for a driver who keeps to the circle, ``path``
    steering: Literal["held", "path"] = "held"
    until_speed: float = 0.0  # speed at which the recording ends [m/s]; 0 is the stand
    side: Side = "either"  # ``left``, ``right`` or ``either``
    # distance from the circle beyond which the car has left it [m]; counts for ``path`` only once
    # it brakes
    half_width: float = 4.0

    limits: ClassVar = CIRCLE_LIMITS | {
        "deceleration": (0.5, 10.0),
        "turn_time": (1.0, 60.0),
        "until_speed": (0.0, 60.0),
    }

    @property
    def longest(self) -> float:
        """An upper bound of the time that it takes [s]."""
        return 60.0 + as_range(self.turn_time)[1]

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the radius, the speed, the brakes and the habits of this seed.

        Parameters
        ----------
        car : Car
            Its grip times the severity decides the speed, up to FASTEST_SHARE of the top speed.
        surface : Surface
            The mean friction of an open area with this seed scales the grip.
        seed : int
            Of the drive.
        """
        draw = Draws(seed)
        radius = draw(self.radius)
        severity = draw(self.severity)
        side = draw.side(self.side)
        deceleration = draw(self.deceleration)
        turn_time = draw(self.turn_time)
        driver = draw_driver(seed)
        speed = min(
            math.sqrt(severity * car.grip * OpenArea(surface, seed).mean * radius),
            FASTEST_SHARE * car.top_speed,
        )
        run_in = (SETTLING_TIME + 1.0) * speed
        transition = 1.5 * speed
        brakes_at = (run_in + transition) / speed - SETTLING_TIME + turn_time
        line = circle(radius, side, run_in, speed * (turn_time + 30.0), transition)
        plan = plan_along(line, speed, surface, seed)
        drawn = {
            "radius": radius,
            "severity": severity,
            "speed": speed,
            "deceleration": deceleration,
            "brakes_at": brakes_at,
            "side": SIDES[side],
            "driver": asdict(driver),
        }
        return TurnBraker(self, plan, car, driver, drawn)


class TurnBraker(LineDriver):
    """Follows a circle, then brakes until the manoeuvre's speed is reached or the car stands."""

    def __init__(
        self, manoeuvre: BrakingInTurn, plan: Plan, car: Car, driver: Driver, drawn: dict[str, Any]
    ) -> None:
        super().__init__(plan, car, driver, drawn)
        self._brakes_at = drawn["brakes_at"]
        self._deceleration = drawn["deceleration"]
        self._holds_steering = manoeuvre.steering == "held"
        self._until_speed = manoeuvre.until_speed

    def command(self, time: float, observation: Observation) -> Command:
        """Follow the circle, then brake, with the steering held or not.

        The deceleration builds up linearly within BRAKE_BUILD_UP. With the steering held there is
        no line to be off: the lateral error is NaN from then on.
        """
        decision = super().command(time, observation)
        if time < self._brakes_at:
            return decision
        braking = -self._deceleration * min((time - self._brakes_at) / BRAKE_BUILD_UP, 1.0)
        decision = replace(
            decision, acceleration=braking, finished=observation.speed < self._until_speed
        )
        if self._holds_steering:
            decision = replace(decision, steering_velocity=0.0, lateral_error=math.nan)
        return decision


BRAKE_BUILD_UP = 0.2  # time in which brakes come on [s]; assumed
