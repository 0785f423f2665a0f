"""Courses: closed roads made of straights and corners, with bank, grade and friction along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.simulation.road.segments import Compound, Corner, Segment, Straight
from vehest.simulation.road.tracks import LAYOUTS, Layout

SPACING = 1.0  # largest distance between the samples of a course [m]


@dataclass(frozen=True, eq=False)
class Course:
    """A closed centre line, sampled from arc length 0 to the full length; first and last sample are
    the same place.
    """

    name: str  # name of the course in recordings
    arc_length: FloatArray  # distance along the line, (N,) [m], uniform
    x: FloatArray  # position, (N,) [m]
    y: FloatArray  # position, (N,) [m]
    heading: FloatArray  # heading, (N,), not wrapped [rad]
    curvature: FloatArray  # curvature, (N,), positive to the left [1/m]
    bank: FloatArray  # bank of the road, (N,), positive with the left side higher [rad]
    grade: FloatArray  # grade of the road, (N,), positive downhill [rad]
    friction: FloatArray  # (N,), scale of the tyres' friction on the dry road

    @property
    def length(self) -> float:
        """Length of a lap [m]."""
        return float(self.arc_length[-1])

    @property
    def turning(self) -> float:
        """Change of heading once around, positive to the left [rad]."""
        return float(self.heading[-1] - self.heading[0])


def build_course(name: str, layout: Layout) -> Course:
    """A closed course from its segments, starting at the origin along the x axis.

    The corners are kept as they are and must turn by a full circle in total; the course is closed
    by the smallest change, in the sum of squares, of the lengths of its straights.

    Returns
    -------
    Course
        Sampled at most SPACING apart.

    Raises
    ------
    ConfigurationError
        The corners do not add up to a circle, a corner is too short for its clothoids, or a
        straight would have to become negative.
    """
    for segment in layout.segments:
        if isinstance(segment, Corner | Compound) and segment.arc < 0:
            raise ConfigurationError(f"course '{name}': {segment} is too short for its transitions")
    turning = sum(segment.angle for segment in layout.segments)
    if abs(abs(turning) - 2.0 * math.pi) > 1e-9:
        raise ConfigurationError(
            f"course '{name}': its corners turn by {math.degrees(turning):.6g}°, not by ±360°"
        )
    return _trace(name, replace(layout, segments=tuple(_close(name, layout.segments))))


@cache
def course_by_name(name: str) -> Course:
    """One of the courses of the proving ground; raises `ConfigurationError` where there is no such
    course.
    """
    if name not in LAYOUTS:
        raise ConfigurationError(
            f"there is no course '{name}'; there are {', '.join(sorted(LAYOUTS))}"
        )
    return build_course(name, LAYOUTS[name])


def _close(name: str, segments: Sequence[Segment]) -> list[Segment]:
    """The segments with the straights' lengths changed so that the end meets the start."""
    traced = _trace(name, Layout(tuple(segments)))
    headings = _headings_of_straights(segments)
    directions = np.stack([np.cos(headings), np.sin(headings)])
    change = -np.linalg.pinv(directions) @ np.array([traced.x[-1], traced.y[-1]])
    changes = iter(change.tolist())
    closed: list[Segment] = []
    for segment in segments:
        if isinstance(segment, Straight):
            segment = Straight(segment.length + next(changes))
            if segment.length < 0:
                raise ConfigurationError(
                    f"course '{name}': it closes only with a straight of {segment.length:.3g} m"
                )
        closed.append(segment)
    return closed


def _headings_of_straights(segments: Sequence[Segment]) -> FloatArray:
    """Heading [rad] of each straight, in the order of the segments."""
    headings = []
    heading = 0.0
    for segment in segments:
        heading += segment.angle
        if isinstance(segment, Straight):
            headings.append(heading)
    return np.array(headings)


def _trace(name: str, layout: Layout) -> Course:
    """Sample the segments as they are, whether or not the end meets the start."""
    nodes, curvatures, banks = _nodes(layout.segments)
    n_cells = math.ceil(nodes[-1] / SPACING)
    arc_length = np.linspace(0.0, nodes[-1], n_cells + 1)
    heading_at = _HeadingProfile(nodes, curvatures)
    x, y = _integrate_position(np.union1d(arc_length, nodes), heading_at, arc_length)
    return Course(
        name=name,
        arc_length=arc_length,
        x=x,
        y=y,
        heading=heading_at(arc_length),
        curvature=np.interp(arc_length, nodes, curvatures),
        bank=layout.crossfall + np.interp(arc_length, nodes, banks),
        grade=_grade(layout.heights, arc_length),
        friction=_friction(layout.friction, arc_length),
    )


def _nodes(segments: Sequence[Segment]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Arc lengths (M,), with the curvatures (M,) and banks (M,) between which both are linear."""
    pieces = np.array(
        [(0.0, 0.0, 0.0), *(piece for segment in segments for piece in segment.pieces())]
    )
    return np.cumsum(pieces[:, 0]), pieces[:, 1], pieces[:, 2]


def _grade(heights: Sequence[tuple[float, float]], arc_length: FloatArray) -> FloatArray:
    """Downward slope [rad] of a periodic cubic spline through heights [m] at shares of the lap."""
    if not heights:
        return np.zeros_like(arc_length)
    places = np.array([*(place for place, _ in heights), heights[0][0] + 1.0]) * arc_length[-1]
    spline = CubicSpline(
        places, [*(height for _, height in heights), heights[0][1]], bc_type="periodic"
    )
    return np.asarray(-np.arctan(spline(arc_length, 1)))


def _friction(patches: Sequence[tuple[float, float, float]], arc_length: FloatArray) -> FloatArray:
    """Scale of friction at each arc length; of overlapping patches the last one holds."""
    friction = np.ones_like(arc_length)
    for begin, end, scale in patches:
        place = arc_length / arc_length[-1]
        friction[(place >= begin) & (place < end)] = scale
    return friction


class _HeadingProfile:
    """Heading [rad] as a function of arc length: the exact integral of a piecewise linear
    curvature.
    """

    def __init__(self, nodes: FloatArray, curvatures: FloatArray) -> None:
        self._nodes = nodes
        self._curvatures = curvatures
        areas = 0.5 * np.diff(nodes) * (curvatures[1:] + curvatures[:-1])
        self._headings = np.concatenate([[0.0], np.cumsum(areas)])

    def __call__(self, arc_length: FloatArray) -> FloatArray:
        """Heading at these arc lengths [m], likewise an array [rad]."""
        before = np.clip(
            np.searchsorted(self._nodes, arc_length, side="right") - 1, 0, len(self._nodes) - 2
        )
        curvature = np.interp(arc_length, self._nodes, self._curvatures)
        mean = 0.5 * (self._curvatures[before] + curvature)
        return self._headings[before] + mean * (arc_length - self._nodes[before])


def _integrate_position(
    cells: FloatArray, heading_at: _HeadingProfile, arc_length: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position at ``arc_length`` by four-point Gauss-Legendre quadrature in each of the cells."""
    points, weights = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(cells)
    headings = heading_at((cells[:-1] + half)[:, None] + half[:, None] * points)
    keep = np.searchsorted(cells, arc_length)
    x = np.concatenate([[0.0], np.cumsum(half * (np.cos(headings) @ weights))])
    y = np.concatenate([[0.0], np.cumsum(half * (np.sin(headings) @ weights))])
    return x[keep], y[keep]
