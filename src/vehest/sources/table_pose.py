"""Poses of a motion capture system in a table's columns, and the reference channels that are made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import validated
from vehest.data.units import factor_to_si
from vehest.sources.clocks import Clock
from vehest.sources.columns import Column, column_from_config
from vehest.sources.pose import POSE_CHANNELS, planar_motion, require_filter, require_pose_channels

UNITS = {"x": "m", "y": "m", "yaw": "rad"}


@dataclass(frozen=True)
class TablePoseOptions:
    """What a data set says of its poses."""

    x: dict[str, Any]
    y: dict[str, Any]
    yaw: dict[str, Any]
    window: int = 9
    order: int = 2
    yaw_offset: float = 0.0
    lever_x: float = 0.0
    lever_y: float = 0.0
    channels: Annotated[tuple[str, ...], "a list of channels"] = POSE_CHANNELS


@dataclass(frozen=True)
class TablePose:
    """How reference channels are made of poses; see `vehest.sources.pose.planar_motion`.

    Args:
        columns: of ``x``, ``y`` [m] and ``yaw`` [rad], z up.
        window: samples of the Savitzky-Golay filter.
        order: of its polynomial.
        yaw_offset: from the rigid body's x axis to the car's forward axis, counter-clockwise [rad].
        lever: from the rigid body's origin to the reference point, forward and left [m].
        channels: which of vx_ref, vy_ref, yaw_rate_ref, sideslip_ref.
    """

    columns: Mapping[str, Column]
    window: int
    order: int
    yaw_offset: float
    lever: tuple[float, float]
    channels: tuple[str, ...]

    def made_of(self, values: Mapping[str, FloatArray], clock: Clock, where: str) -> dict[str, FloatArray]:
        """Reference channels on the recording's clock, on which poses are differentiated: offline, by half a window.

        Raises:
            DataError: a pose is missing, or there are fewer than the filter's window.
        """
        found = {}
        for name, column in self.columns.items():
            samples = column.to_si(values[column.column], UNITS[name])
            odd = np.flatnonzero(~np.isfinite(samples))
            if len(odd):
                what = (
                    f"pose column '{column.column}' holds {len(odd)} values that are no numbers, the first in row {odd[0] + 1} of the run"
                )
                raise DataError(f"{where}: {what}; leave them out by drop_rows")
            found[name] = clock.align(np.unwrap(samples) if name == "yaw" else samples)
        if len(found["x"]) < self.window:
            raise DataError(f"{where}: {len(found['x'])} poses are fewer than the {self.window} of the filter's window")
        motion = planar_motion(
            np.stack([found["x"], found["y"]], axis=1),
            found["yaw"],
            1.0 / clock.rate_hz,
            window=self.window,
            order=self.order,
            mounting_yaw=self.yaw_offset,
            lever=self.lever,
        )
        return motion.channels(self.channels)


def table_pose_from_config(entry: Any, where: str) -> TablePose:
    """A data set's declaration of poses in columns.

    Raises:
        ConfigurationError: it lacks a column or a unit, or says something else.
    """
    options = validated(TablePoseOptions, entry, where, error=ConfigurationError)
    columns = {}
    for name, unit in UNITS.items():
        columns[name] = column_from_config(getattr(options, name), f"{where}: {name}")
        try:
            factor_to_si(columns[name].unit, unit)
        except DataError as error:
            raise ConfigurationError(f"{where}: {name}: {error}") from None
    window, order = require_filter(options.window, options.order, where)
    channels = require_pose_channels(options.channels, where)
    return TablePose(columns, window, order, options.yaw_offset, (options.lever_x, options.lever_y), channels)
