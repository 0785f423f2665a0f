"""Surfaces: how slippery the road is, as a scale of the tyres' friction along the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated
from vehest.simulation.random_streams import SURFACE, random_stream


@dataclass(frozen=True)
class Surface:
    """Friction of a road.

    Either one scale all along or, with ``patches``, patches of which each has a scale drawn between
    ``patches`` and ``friction``, uniformly, and a length drawn from ``patch_length``, uniformly.
    Friction changes over two metres between them.

    Raises
    ------
    ConfigurationError
        A scale is outside 0.05 … 1.5 or a length makes no sense.
    """

    name: str = "dry"  # name of the surface in recordings
    # scale of the tyres' friction; 1 is the dry road of the vehicle's tyre data
    friction: float = 1.0
    patches: float | None = None  # lowest scale of a patch; None: no patches
    patch_length: tuple[float, float] = (20.0, 80.0)  # shortest and longest patch [m]
    # seed of the patches; None: that of the drive
    seed: Annotated[int, Field(ge=0), "a whole number, zero or positive"] | None = None

    def __post_init__(self) -> None:
        lowest = self.friction if self.patches is None else self.patches
        if not 0.05 <= lowest <= self.friction <= 1.5:
            raise ConfigurationError(
                f"surface '{self.name}': friction must lie between 0.05 and 1.5 and its patches "
                f"below it, not {self.friction} and {lowest}"
            )
        if not 5.0 <= self.patch_length[0] <= self.patch_length[1] < math.inf:
            raise ConfigurationError(
                f"surface '{self.name}': patches are at least 5 m long, not {self.patch_length}"
            )

    def along(
        self, distance: FloatArray, drive_seed: int, length: float | None = None
    ) -> FloatArray:
        """Scale of the tyres' friction along the way, (N,).

        Parameters
        ----------
        distance : array, shape (N,)
            Distances at which to evaluate it [m], zero or positive, uniform.
        drive_seed : int
            Draws the patches if the surface has no seed.
        length : float or None
            Of a lap, after which the same patches come again [m]; None: never.

        Returns
        -------
        FloatArray
            (N,), linear over the metre before and the metre after the end of a patch.
        """
        if self.patches is None:
            return np.full(distance.shape, self.friction)
        around = length if length is not None else float(distance[-1]) + 1.0
        ends, scales = self._draw(around, self.seed if self.seed is not None else drive_seed)
        nodes = np.concatenate(
            [[0.0], np.repeat(ends[:-1], 2) + np.tile([-1.0, 1.0], len(ends) - 1), [around]]
        )
        return np.interp(np.mod(distance, around), nodes, np.repeat(scales, 2))

    def _draw(self, around: float, seed: int) -> tuple[FloatArray, FloatArray]:
        """Ends [m] and scales of the patches of one lap; the last one is as long as it must be."""
        generator = random_stream(seed, SURFACE)
        low = self.friction if self.patches is None else self.patches
        ends = np.cumsum(
            generator.uniform(*self.patch_length, math.ceil(around / self.patch_length[0]) + 1)
        )
        scales = generator.uniform(low, self.friction, len(ends))
        inside = ends < around - self.patch_length[0]
        return np.append(ends[inside], around), scales[: int(inside.sum()) + 1]


SURFACES: dict[str, Surface] = {
    "dry": Surface(),
    "wet": Surface("wet", 0.7),
    "patchy": Surface("patchy", 1.0, patches=0.5),
}
"""Named surfaces; the scales are assumed: wet asphalt has about seven tenths of the dry road's
friction, puddles or gravel half.
"""


def surface_from_config(configuration: str | Mapping[str, Any] | None) -> Surface:
    """A surface from its name, or from a mapping of Surface's arguments; none is the dry road;
    raises `ConfigurationError` otherwise.
    """
    if configuration is None:
        return SURFACES["dry"]
    if isinstance(configuration, str):
        if configuration not in SURFACES:
            raise ConfigurationError(
                f"there is no surface '{configuration}'; there are {', '.join(SURFACES)}"
            )
        return SURFACES[configuration]
    return validated(Surface, {"name": "own", **configuration}, "surface", error=ConfigurationError)
