"""Layouts of the proving ground's courses."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vehest.simulation.road.segments import Compound, Segment, Straight, left, right


@dataclass(frozen=True)
class Layout:
    """Layout of a course."""

    segments: tuple[Segment, ...]  # segments in the order in which they are driven
    # bank of the road all along, positive with the left side higher [rad]; corners add their own
    crossfall: float = 0.0
    # (share of the lap, height [m]), in ascending order; empty: a level course
    heights: tuple[tuple[float, float], ...] = ()
    # (share of the lap at its start, at its end, scale of the tyres' friction) of each patch; 1
    # elsewhere
    friction: tuple[tuple[float, float, float], ...] = ()


HANDLING = Layout(
    (
        Straight(443.0),
        left(60.0, 110.0, 30.0),
        Straight(56.0),
        right(45.0, 80.0, 25.0),
        Straight(77.0),
        left(32.0, 150.0, 20.0),
        Straight(137.0),
        right(110.0, 60.0, 40.0),
        Straight(23.0),
        left(80.0, 100.0, 35.0),
        Straight(77.0),
        right(26.0, 120.0, 18.0),
        Straight(69.0),
        left(38.0, 130.0, 22.0),
        Straight(50.0),
        left(150.0, 60.0, 50.0),
        Straight(54.0),
        right(70.0, 50.0, 30.0),
        Straight(54.0),
        left(50.0, 120.0, 25.0),
        Straight(83.0),
    )
)
"""A level course; all values are assumed, chosen for a wide range of radii in both directions."""

VAIRANO_LIKE = Layout(
    (
        Straight(120.0),
        right(59.0, 60.0, 25.0),
        Straight(236.0),
        left(35.0, 95.0, 22.0),
        Straight(10.0),
        right(39.0, 80.0, 25.0),
        Straight(130.0),
        left(63.0, 75.0, 35.0),
        Straight(10.0),
        left(112.0, 95.0, 50.0),
        Straight(130.0),
        right(89.0, 35.0, 40.0),
        Straight(10.0),
        left(108.0, 95.0, 35.0),
        Straight(612.0),
        left(54.0, 175.0, 25.0),
        Straight(144.0),
    ),
    crossfall=math.radians(1.0),
)
"""A handling course of 2.5 km in the manner of Vairano, Italy.

From Di Biase et al. 2020 are the length, the section with corners both ways at the beginning of the
lap, the long straight and the hairpin before the main straight. Radii, angles and the crossfall
(for drainage) are assumed.
"""

PALM_BEACH_LIKE = Layout(
    (
        Straight(714.0),
        right(48.0, 219.0, 40.0, banking=2.0),
        left(118.0, 39.0, 30.0, banking=1.0),
        Straight(369.0),
        left(67.0, 46.0, 20.0, banking=1.0),
        right(56.0, 78.0, 25.0, banking=2.0),
        left(245.0, 35.0, 40.0),
        Straight(118.0),
        left(48.0, 209.0, 40.0, banking=6.0),
        Compound((right(222.0, 49.0, 30.0, banking=1.0), right(64.0, 159.0, 30.0, banking=2.0))),
        Straight(188.0),
        right(57.0, 85.0, 25.0, banking=2.0),
        left(137.0, 16.0, 15.0),
        Compound((right(63.0, 70.0, 30.0, banking=2.0), right(109.0, 45.0, 30.0, banking=1.0))),
        Straight(224.0),
    ),
    heights=((0.0, 0.0), (0.3, 0.8), (0.55, -0.6), (0.8, 0.4)),
)
"""A race circuit of 3.28 km and 11 turns in the manner of Palm Beach International Raceway,
Florida.

Order, angles and radii of the corners were read off the path of a recording made there (Revs
Vehicle Dynamics Database, 20140222_01_01_03, a Ferrari 250 LM), then widened by a few metres for
the road's centre line to close at the published length of 3.288 km. The straight of six tenths of a
mile and the one corner with 6° of bank are as drivers describe the circuit; which corner it is, the
other banks and the heights of an almost level country are assumed.
"""

FAST_CIRCUIT = Layout(
    (
        Straight(909.0),
        right(90.0, 100.0, 40.0, banking=2.0),
        Straight(141.0),
        left(150.0, 60.0, 45.0),
        Straight(57.0),
        right(60.0, 130.0, 30.0, banking=1.0),
        Straight(392.0),
        left(45.0, 70.0, 22.0),
        right(80.0, 80.0, 30.0),
        Straight(291.0),
        right(200.0, 70.0, 50.0, banking=3.0),
        Straight(449.0),
        left(110.0, 40.0, 30.0),
        right(70.0, 150.0, 35.0, banking=2.0),
        Straight(159.0),
    ),
    crossfall=math.radians(1.0),
    heights=((0.0, 0.0), (0.25, 6.0), (0.55, -4.0), (0.8, 3.0)),
)
"""A clockwise race circuit of 3.8 km for fast cars; all values are assumed, none of a real one."""

HILL_CIRCUIT = Layout(
    (
        Straight(681.0),
        left(75.0, 80.0, 30.0, banking=4.0),
        Straight(53.0),
        left(180.0, 50.0, 45.0, banking=1.0),
        Straight(230.0),
        right(55.0, 100.0, 25.0, banking=1.0),
        Straight(31.0),
        left(100.0, 110.0, 40.0, banking=3.0),
        Straight(371.0),
        left(52.0, 140.0, 28.0, banking=2.0),
        Straight(230.0),
        right(130.0, 45.0, 40.0),
        Straight(390.0),
        right(230.0, 30.0, 40.0),
        Straight(158.0),
        left(65.0, 155.0, 30.0, banking=2.0),
        Straight(181.0),
    ),
    heights=((0.0, 0.0), (0.2, 12.0), (0.5, -8.0), (0.75, 5.0)),
)
"""An anticlockwise race circuit of 3.7 km up and down a hill, like no particular one; all values
are assumed.
"""

LAYOUTS: dict[str, Layout] = {
    "handling": HANDLING,
    "vairano_like": VAIRANO_LIKE,
    "palm_beach_like": PALM_BEACH_LIKE,
    "fast_circuit": FAST_CIRCUIT,
    "hill_circuit": HILL_CIRCUIT,
}
"""Name of a course -> its layout."""
