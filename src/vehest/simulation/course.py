"""Courses: closed roads made of straights and corners whose curvature is piecewise linear in arc length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from vehest.data.errors import ConfigurationError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Straight:
    """A straight; its length [m] is nominal, see build_course."""

    length: float


@dataclass(frozen=True)
class Corner:
    """A corner: clothoid, circular arc, clothoid.

    Args:
        radius: of the arc [m].
        angle: change of heading, positive to the left [rad].
        transition: length of each clothoid [m].
    """

    radius: float
    angle: float
    transition: float

    @property
    def curvature(self) -> float:
        """Of the arc, positive to the left [1/m]."""
        return math.copysign(1.0 / self.radius, self.angle)

    @property
    def arc(self) -> float:
        """Length of the circular part [m]; each clothoid turns by half its length times the arc's curvature."""
        return abs(self.angle) * self.radius - self.transition


Segment = Straight | Corner


@dataclass(frozen=True, eq=False)
class Course:
    """A closed centre line, sampled from arc length 0 to the full length; first and last sample are the same place.

    Args:
        name: what recordings call it.
        arc_length: (N,) [m], uniform.
        x, y: (N,) [m].
        heading: (N,), not wrapped [rad].
        curvature: (N,), positive to the left [1/m].
    """

    name: str
    arc_length: FloatArray
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    curvature: FloatArray

    @property
    def length(self) -> float:
        """Once around [m]."""
        return float(self.arc_length[-1])

    @property
    def gap(self) -> float:
        """Distance between the end and the start [m]."""
        return math.hypot(self.x[-1] - self.x[0], self.y[-1] - self.y[0])

    @property
    def turning(self) -> float:
        """Change of heading once around, positive to the left [rad]."""
        return float(self.heading[-1] - self.heading[0])


def build_course(name: str, segments: Sequence[Segment], spacing: float = 1.0) -> Course:
    """A closed course from its segments, starting at the origin along the x axis.

    The corners are kept as they are and must turn by a full circle in total; the course is closed by the smallest
    change, in the sum of squares, of the lengths of its straights. Sample spacing [m] is at most ``spacing``.

    Raises:
        ConfigurationError: the corners do not add up to a circle, a corner is too short for its clothoids, or a
            straight would have to become negative.
    """
    for segment in segments:
        if isinstance(segment, Corner) and segment.arc < 0:
            raise ConfigurationError(f"course '{name}': {segment} is too short for its transitions")
    turning = sum(segment.angle for segment in segments if isinstance(segment, Corner))
    if abs(abs(turning) - 2.0 * math.pi) > 1e-9:
        raise ConfigurationError(f"course '{name}': its corners turn by {math.degrees(turning):.6g}°, not by ±360°")
    return _trace(name, _close(name, segments), spacing)


def course_by_name(name: str) -> Course:
    """One of the courses of the proving ground.

    Raises:
        ConfigurationError: there is no such course.
    """
    if name not in LAYOUTS:
        raise ConfigurationError(f"there is no course '{name}'; there are {', '.join(sorted(LAYOUTS))}")
    return _build_by_name(name)


@cache
def _build_by_name(name: str) -> Course:
    return build_course(name, LAYOUTS[name])


def _close(name: str, segments: Sequence[Segment]) -> list[Segment]:
    """The segments with the straights' lengths changed so that the end meets the start."""
    traced = _trace(name, segments, spacing=1.0)
    headings = _headings_of_straights(segments)
    directions = np.stack([np.cos(headings), np.sin(headings)])
    change = -np.linalg.pinv(directions) @ np.array([traced.x[-1], traced.y[-1]])
    changes = iter(change.tolist())
    closed: list[Segment] = []
    for segment in segments:
        if isinstance(segment, Straight):
            segment = Straight(segment.length + next(changes))
            if segment.length < 0:
                raise ConfigurationError(f"course '{name}': it closes only with a straight of {segment.length:.3g} m")
        closed.append(segment)
    return closed


def _headings_of_straights(segments: Sequence[Segment]) -> FloatArray:
    headings, heading = [], 0.0
    for segment in segments:
        if isinstance(segment, Corner):
            heading += segment.angle
        else:
            headings.append(heading)
    return np.array(headings)


def _trace(name: str, segments: Sequence[Segment], spacing: float) -> Course:
    nodes, curvatures = _curvature_nodes(segments)
    n_cells = math.ceil(nodes[-1] / spacing)
    arc_length = np.linspace(0.0, nodes[-1], n_cells + 1)
    heading_at = _HeadingProfile(nodes, curvatures)
    x, y = _integrate_position(np.union1d(arc_length, nodes), heading_at, arc_length)
    return Course(name, arc_length, x, y, heading_at(arc_length), np.interp(arc_length, nodes, curvatures))


def _curvature_nodes(segments: Sequence[Segment]) -> tuple[FloatArray, FloatArray]:
    """Arc lengths (M,) and curvatures (M,) between which the curvature is linear."""
    nodes, curvatures = [0.0], [0.0]
    for segment in segments:
        if isinstance(segment, Straight):
            pieces = [(segment.length, 0.0)]
        else:
            at_arc = segment.curvature
            pieces = [(segment.transition, at_arc), (segment.arc, at_arc), (segment.transition, 0.0)]
        for length, curvature in pieces:
            nodes.append(nodes[-1] + length)
            curvatures.append(curvature)
    return np.array(nodes), np.array(curvatures)


class _HeadingProfile:
    """Heading [rad] as a function of arc length: the exact integral of a piecewise linear curvature."""

    def __init__(self, nodes: FloatArray, curvatures: FloatArray) -> None:
        self._nodes, self._curvatures = nodes, curvatures
        areas = 0.5 * np.diff(nodes) * (curvatures[1:] + curvatures[:-1])
        self._headings = np.concatenate([[0.0], np.cumsum(areas)])

    def __call__(self, arc_length: FloatArray) -> FloatArray:
        before = np.clip(np.searchsorted(self._nodes, arc_length, side="right") - 1, 0, len(self._nodes) - 2)
        curvature = np.interp(arc_length, self._nodes, self._curvatures)
        mean = 0.5 * (self._curvatures[before] + curvature)
        return self._headings[before] + mean * (arc_length - self._nodes[before])


def _integrate_position(cells: FloatArray, heading_at: _HeadingProfile, arc_length: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position at ``arc_length`` by four-point Gauss-Legendre quadrature in each of the cells."""
    points, weights = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(cells)
    headings = heading_at((cells[:-1] + half)[:, None] + half[:, None] * points)
    keep = np.searchsorted(cells, arc_length)
    x = np.concatenate([[0.0], np.cumsum(half * (np.cos(headings) @ weights))])
    y = np.concatenate([[0.0], np.cumsum(half * (np.sin(headings) @ weights))])
    return x[keep], y[keep]


def _left(radius: float, degrees: float, transition: float) -> Corner:
    return Corner(radius, math.radians(degrees), transition)


def _right(radius: float, degrees: float, transition: float) -> Corner:
    return Corner(radius, -math.radians(degrees), transition)


LAYOUTS: dict[str, tuple[Segment, ...]] = {
    "handling": (
        Straight(443.0),
        _left(60.0, 110.0, 30.0),
        Straight(56.0),
        _right(45.0, 80.0, 25.0),
        Straight(77.0),
        _left(32.0, 150.0, 20.0),
        Straight(137.0),
        _right(110.0, 60.0, 40.0),
        Straight(23.0),
        _left(80.0, 100.0, 35.0),
        Straight(77.0),
        _right(26.0, 120.0, 18.0),
        Straight(69.0),
        _left(38.0, 130.0, 22.0),
        Straight(50.0),
        _left(150.0, 60.0, 50.0),
        Straight(54.0),
        _right(70.0, 50.0, 30.0),
        Straight(54.0),
        _left(50.0, 120.0, 25.0),
        Straight(83.0),
    ),
}
"""Segments of the courses by name; all values are assumed, chosen for a wide range of radii in both directions."""
