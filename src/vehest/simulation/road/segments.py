"""Segments that courses are made of; their curvature is piecewise linear in arc length."""

from __future__ import annotations

import math
from dataclasses import dataclass

# length [m] of a segment along which curvature and bank are linear, then curvature [1/m] and bank
# [rad] at its end
Piece = tuple[float, float, float]


@dataclass(frozen=True)
class Straight:
    """A straight; its length [m] is nominal, see build_course."""

    length: float  # nominal length [m]

    @property
    def angle(self) -> float:
        """Change of heading [rad]."""
        return 0.0

    def pieces(self) -> list[Piece]:
        """The straight as one piece."""
        return [(self.length, 0.0, 0.0)]


@dataclass(frozen=True)
class Corner:
    """A corner: clothoid, circular arc, clothoid."""

    radius: float  # radius of the arc [m]
    angle: float  # change of heading, positive to the left [rad]
    transition: float  # length of each clothoid [m]
    # bank of the arc, growing along the clothoids; positive with the inner side lower [rad]
    banking: float = 0.0

    @property
    def bank(self) -> float:
        """Bank of the arc, positive with the left side higher [rad]."""
        return -math.copysign(self.banking, self.angle)

    @property
    def curvature(self) -> float:
        """Curvature of the arc, positive to the left [1/m]."""
        return math.copysign(1.0 / self.radius, self.angle)

    @property
    def arc(self) -> float:
        """Length of the circular part [m]; each clothoid turns by half its length times the arc's
        curvature.
        """
        return abs(self.angle) * self.radius - self.transition

    def pieces(self) -> list[Piece]:
        """Clothoid, arc, clothoid."""
        on_arc = (self.curvature, self.bank)
        return [(self.transition, *on_arc), (self.arc, *on_arc), (self.transition, 0.0, 0.0)]


@dataclass(frozen=True)
class Compound:
    """A corner whose radius changes: arcs joined by clothoids, without a straight between them.

    Each part turns by its own angle, half of the clothoids on either side included.

    Raises
    ------
    ValueError
        The parts do not agree.
    """

    parts: tuple[Corner, ...]  # corners to the same side, with the same transition

    def __post_init__(self) -> None:
        if len({(part.transition, part.angle > 0.0) for part in self.parts}) != 1:
            raise ValueError(
                f"the parts of a compound corner need one side and one transition: {self.parts}"
            )

    @property
    def angle(self) -> float:
        """Change of heading, positive to the left [rad]."""
        return sum(part.angle for part in self.parts)

    @property
    def arc(self) -> float:
        """Length of the shortest circular part [m]."""
        return min(part.arc for part in self.parts)

    def pieces(self) -> list[Piece]:
        """The parts' arcs with a clothoid before, between and after them."""
        return [piece for part in self.parts for piece in part.pieces()[:2]] + self.parts[
            -1
        ].pieces()[2:]


Segment = Straight | Corner | Compound  # segment of a course


def left(radius: float, degrees: float, transition: float, banking: float = 0.0) -> Corner:
    """A corner to the left: radius [m], angle [°], length of each clothoid [m], banking [°]."""
    return Corner(radius, math.radians(degrees), transition, math.radians(banking))


def right(radius: float, degrees: float, transition: float, banking: float = 0.0) -> Corner:
    """A corner to the right: radius [m], angle [°], length of each clothoid [m], banking [°]."""
    return Corner(radius, -math.radians(degrees), transition, math.radians(banking))
