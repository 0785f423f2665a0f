"""Manoeuvres between cones: double lane change and slalom."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from vehest.simulation.driving.car import Car
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
    draw_driver,
    plan_along,
)
from vehest.simulation.road.lines import Gate, Line, line_through
from vehest.simulation.road.surface import Surface

# parameter -> lowest and highest value, of manoeuvres between cones
CONE_LIMITS = {"severity": (0.05, 1.3), "speed": (3.0, 70.0)}


@dataclass(frozen=True)
class DoubleLaneChange(Manoeuvre):
    """Change to the neighbouring lane and back between cones, at a constant speed.

    Lengths and widths of the gates are those of ISO 3888-1 and ISO 3888-2; the offset of part 1 is
    taken between the lanes' middles.
    """

    name: ClassVar[str] = "double_lane_change"
    # ``iso_3888_1`` (double lane change) or ``iso_3888_2`` (obstacle avoidance)
    layout: Literal["iso_3888_1", "iso_3888_2"] = "iso_3888_1"
    # share of the grip that the sharpest bend of the line takes; decides the speed
    severity: Range = (
        0.5,
        0.9,
    )
    speed: Range | None = None  # speed [m/s], instead of the severity
    side: Side = "either"  # side of the neighbouring lane: ``left``, ``right`` or ``either``
    half_width: float = 1.5  # distance from the line beyond which the car has left the road [m]

    limits: ClassVar = CONE_LIMITS

    @property
    def longest(self) -> float:
        """An upper bound of the time that it takes [s]."""
        return 60.0

    def gates(self, width: float) -> tuple[Gate, ...]:
        """Gates for a car of a width [m], along the x axis from the first gate on, with the other
        lane on the left.

        Parameters
        ----------
        width : float
            Over all, without mirrors [m]; widths of the lanes depend on it as in the standard.

        Returns
        -------
        tuple of Gate
            Entry, side and exit lane, of ISO 3888-1 or ISO 3888-2 as ``layout`` says.
        """
        first = 1.1 * width + 0.25
        last = 1.3 * width + 0.25
        if self.layout == "iso_3888_1":
            second = 1.2 * width + 0.25
            offset = 3.5
            lanes = (
                (0.0, 15.0, first, 0.0),
                (45.0, 70.0, second, offset),
                (95.0, 125.0, last, 0.0),
            )
        else:
            second = width + 1.0
            last = max(last, 3.0)
            offset = 0.5 * first + 1.0 + 0.5 * second  # one metre between the lanes
            lanes = (
                (0.0, 12.0, first, 0.0),
                (25.5, 36.5, second, offset),
                (49.0, 61.0, last, 0.5 * (last - first)),
            )
        return tuple(
            Gate(begin, end, middle - 0.5 * wide, middle + 0.5 * wide)
            for begin, end, wide, middle in lanes
        )

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the speed, the side and the habits of this seed."""
        return _between_cones(self, self.gates(car.width), car, surface, seed)


@dataclass(frozen=True)
class Slalom(Manoeuvre):
    """Drive around cones in a row, at a constant speed."""

    name: ClassVar[str] = "slalom"
    spacing: float = 18.0  # distance between the cones [m]; 18 m and 30 m are customary
    cones: int = 8  # number of cones
    # share of the grip that the sharpest bend of the line takes; decides the speed
    severity: Range = (
        0.5,
        0.9,
    )
    speed: Range | None = None  # speed [m/s], instead of the severity
    # side on which the first cone is passed: ``left``, ``right`` or ``either``
    side: Side = "either"
    half_width: float = 2.0  # distance from the line beyond which the car has left the road [m]

    limits: ClassVar = CONE_LIMITS | {"spacing": (8.0, 100.0), "cones": (1.0, 30.0)}

    @property
    def longest(self) -> float:
        """An upper bound of the time that it takes [s]."""
        return 30.0 + self.cones * self.spacing / 2.0

    def gates(self, width: float) -> tuple[Gate, ...]:
        """Cones along the x axis from the first one on, which is passed on its left.

        ``width`` [m] plays no part: a cone bounds the line on one side only, alternately left and
        right.
        """
        places = [cone * self.spacing for cone in range(self.cones)]
        sides = ((0.0, math.inf), (-math.inf, 0.0))
        return tuple(Gate(place, place, *sides[cone % 2]) for cone, place in enumerate(places))

    def controller(self, car: Car, surface: Surface, seed: int) -> Controller:
        """A driver with the speed, the side and the habits of this seed."""
        return _between_cones(self, self.gates(car.width), car, surface, seed)


def _between_cones(
    manoeuvre: DoubleLaneChange | Slalom,
    gates: tuple[Gate, ...],
    car: Car,
    surface: Surface,
    seed: int,
) -> Controller:
    """A driver along the smoothest line through gates, at the drawn speed, or at the speed at which
    the line's sharpest bend takes ``severity`` of the grip.
    """
    draw = Draws(seed)
    severity = draw(manoeuvre.severity)
    side = draw.side(manoeuvre.side)
    fixed_speed = draw(manoeuvre.speed) if manoeuvre.speed is not None else None
    average_driver = draw_driver(seed)  # who looks less far ahead and steers faster between cones
    driver = replace(
        average_driver,
        preview_time=0.57 * average_driver.preview_time,
        steering_lag=0.5 * average_driver.steering_lag,
    )
    shape = line_through(gates, car.width, 40.0, 60.0)
    grip = car.grip * OpenArea(surface, seed).mean
    speed = fixed_speed or min(
        math.sqrt(severity * grip / float(np.abs(shape.curvature).max())),
        FASTEST_SHARE * car.top_speed,
    )
    run_in = (SETTLING_TIME + 1.0) * speed
    line = _beginning_at(shape, run_in - 40.0) if run_in > 40.0 else shape
    if side < 0.0:
        line = Line(line.distance, line.x, -line.y, -line.heading, -line.curvature)
    plan = plan_along(line, speed, surface, seed)
    drawn = {
        "severity": severity if fixed_speed is None else None,
        "speed": speed,
        "side": SIDES[side],
        "driver": asdict(driver),
    }
    end = max(run_in, 40.0) + gates[-1].end - gates[0].begin + 40.0
    return LineDriver(plan, car, driver, drawn, end=end)


def _beginning_at(line: Line, earlier: float) -> Line:
    """The line with a straight of this length [m] before it."""
    step = line.distance[1]
    before = np.arange(math.ceil(earlier / step)) * step
    distance = np.concatenate([before, before[-1] + step + line.distance])
    x = np.concatenate([line.x[0] - before[::-1] - step, line.x])
    return Line(
        distance,
        x,
        *(np.pad(values, (len(before), 0)) for values in (line.y, line.heading, line.curvature)),
    )
