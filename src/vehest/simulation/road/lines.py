"""Lines across an open area: through cones and gates, and around a circle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from vehest.constants import FloatArray

SPACING = 0.5  # distance between the samples of a line [m]
CLEARANCE = 0.15  # room between the car and a cone [m]; assumed
_KNOTS = 1.5  # spacing of the points that are sought for the smoothest line [m]
# length [m] over which a change of curvature weighs as much as curvature itself; assumed, a fifth
# of a second at 30 m/s
_SMOOTH = 6.0


@dataclass(frozen=True)
class Gate:
    """A segment along the x axis between two rows of cones."""

    begin: float  # start of the segment [m]
    end: float  # end of the segment [m]
    right: float = -math.inf  # lateral position of the right row [m]; infinite where there is none
    left: float = math.inf  # lateral position of the left row [m]; infinite where there is none


@dataclass(frozen=True, eq=False)
class Line:
    """A path for a car, sampled every ``SPACING`` metres along itself; arrays of shape (N,)."""

    distance: FloatArray  # distance along the line [m]
    x: FloatArray  # position [m]
    y: FloatArray  # position [m]
    heading: FloatArray  # heading, not wrapped [rad]
    curvature: FloatArray  # curvature, positive to the left [1/m]


@lru_cache(maxsize=64)
def line_through(gates: tuple[Gate, ...], width: float, run_in: float, run_out: float) -> Line:
    """The smoothest line along the x axis that takes a car of a width [m] through gates, in the
    order of the axis.

    It makes the sum of the squares of the curvature, and of its change, as small as the gates
    allow. It leaves the axis at most 40 m before the first gate, and is back on it a third of
    ``run_out`` after the last. The length of the car, whose ends swing out a little where the line
    turns, is covered by the clearance.

    Parameters
    ----------
    gates : tuple of Gate
        In ascending order; a gate without a row on one side is open there.
    width : float
        Of the car, over all [m].
    run_in, run_out : float
        Length of the line before the first and after the last gate [m].

    Returns
    -------
    Line
        Through the middle of a gate that is no wider than the car and its clearance.
    """
    begin = gates[0].begin - run_in
    end = gates[-1].end + run_out
    straight_until = gates[0].begin - min(run_in, 40.0)
    straight_from = gates[-1].end + run_out / 3.0
    places = np.linspace(
        straight_until, straight_from, max(round((straight_from - straight_until) / _KNOTS), 8) + 1
    )
    room = 0.5 * width + CLEARANCE
    lower = np.full(len(places), -np.inf)
    upper = np.full(len(places), np.inf)
    for gate in gates:
        # A gate holds at its ends too, which lie between two points: the nearest points outside
        # them count as inside.
        inside = (places > gate.begin - 0.75 * _KNOTS) & (places < gate.end + 0.75 * _KNOTS)
        lower[inside] = np.maximum(lower[inside], gate.right + room)
        upper[inside] = np.minimum(upper[inside], gate.left - room)
    tight = lower > upper - 1e-3  # the gate is hardly wider than the car: right through the middle
    middle = 0.5 * (lower[tight] + upper[tight])
    lower[tight] = middle - 5e-4
    upper[tight] = middle + 5e-4
    step = places[1] - places[0]
    padded = np.eye(len(places) + 6)[:, 3:-3]  # straight on both sides
    bends = np.diff(padded, 2, axis=0) / step**2
    changes = _SMOOTH * np.diff(padded, 3, axis=0) / step**3
    lateral = least_within(bends.T @ bends + changes.T @ changes, lower, upper)
    around = np.concatenate(
        [places[0] + step * np.arange(-3, 0), places, places[-1] + step * np.arange(1, 4)]
    )
    return _sampled(around, np.pad(lateral, 3), begin, end)


def least_within(stiffness: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """The vector y (N,) within bounds (N,) for which yᵀ·stiffness·y is least, by the alternating
    direction method of multipliers.

    Parameters
    ----------
    stiffness : FloatArray
        (N, N), positive definite with at most three diagonals beside the main one.
    lower, upper : FloatArray
        (N,), infinite where y is free. They may be exceeded by ``_TOLERANCE``.

    Returns
    -------
    FloatArray
        (N,). The iteration ends once constraint and change are below ``_TOLERANCE``, or after
        ``_MAX_ITERATIONS``.

    Source: Boyd et al., "Distributed Optimization and Statistical Learning via the Alternating
    Direction Method of Multipliers", 2011, Section 5.2.
    """
    bounded = (np.isfinite(lower) | np.isfinite(upper)).astype(np.float64)
    system = stiffness + _PENALTY * np.diag(bounded)
    bands = np.array([np.pad(np.diagonal(system, above), (above, 0)) for above in (3, 2, 1, 0)])
    factor = cholesky_banded(bands)
    y = allowed = np.clip(np.zeros(len(lower)), lower, upper)
    multiplier = np.zeros(len(lower))
    for _ in range(_MAX_ITERATIONS):
        before = allowed
        y = cho_solve_banded(
            (factor, False), _PENALTY * bounded * (allowed - multiplier), check_finite=False
        )
        allowed = np.clip(y + multiplier, lower, upper)
        multiplier = bounded * (multiplier + y - allowed)
        if (
            max(np.abs(bounded * (y - allowed)).max(), np.abs(bounded * (allowed - before)).max())
            < _TOLERANCE
        ):
            break
    return np.asarray(y)


_PENALTY = 0.03  # penalty of the alternating direction method; the solution does not depend on it
_TOLERANCE = 1e-4  # tolerance of constraint and change, in the unit of y
_MAX_ITERATIONS = 3000  # largest number of iterations; then the iteration ends without an error


def _sampled(places: FloatArray, lateral: FloatArray, begin: float, end: float) -> Line:
    """The line through lateral positions at ``places`` [m], sampled at equal distances along
    itself, straight outside them.
    """
    offset = CubicSpline(places, lateral, bc_type="clamped")
    x = np.arange(begin, end, 0.1)
    inside = np.clip(x, places[0], places[-1])
    slope = np.where(inside == x, offset(inside, 1), 0.0)
    along = np.concatenate(
        [[0.0], np.cumsum(0.1 * np.sqrt(1.0 + (0.5 * (slope[1:] + slope[:-1])) ** 2))]
    )
    distance = np.arange(0.0, along[-1], SPACING)
    x = np.interp(distance, along, x)
    inside = np.clip(x, places[0], places[-1])
    slope, bend = (np.where(inside == x, offset(inside, order), 0.0) for order in (1, 2))
    y = np.where(inside == x, offset(inside), 0.0)
    return Line(distance, x, y, np.arctan(slope), bend / (1.0 + slope**2) ** 1.5)


def circle(radius: float, side: float, run_in: float, length: float, transition: float) -> Line:
    """A straight, a clothoid and an arc of a circle.

    Parameters
    ----------
    radius : float
        Of the circle [m].
    side : float
        1: to the left, -1: to the right.
    run_in, length, transition : float
        Lengths of the straight, of the arc and of the clothoid between them [m].

    Returns
    -------
    Line
        From the origin along the x axis.
    """
    distance = np.arange(0.0, run_in + transition + length, SPACING)
    curvature = side / radius * np.clip((distance - run_in) / transition, 0.0, 1.0)
    into_transition = np.clip(distance - run_in, 0.0, transition)
    heading = (
        side
        / radius
        * (0.5 * into_transition**2 / transition + np.maximum(distance - run_in - transition, 0.0))
    )
    # Simpson's rule over each sample; the heading between two samples is taken as linear, as good
    # as exact at this spacing.
    half = 0.5 * (heading[1:] + heading[:-1])
    x, y = (
        np.concatenate(
            [[0.0], np.cumsum(SPACING / 6.0 * (f(heading[:-1]) + 4.0 * f(half) + f(heading[1:])))]
        )
        for f in (np.cos, np.sin)
    )
    return Line(distance, x, y, heading, curvature)
