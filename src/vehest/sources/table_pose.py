"""Poses of a motion capture system in a table's columns, and the reference channels that are made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import validated
from vehest.sources.clocks import Clock
from vehest.sources.columns import Column, column_from_config
from vehest.sources.pose import POSE_CHANNELS, planar_motion, require_filter, require_pose_channels

UNITS = {"x": "m", "y": "m", "yaw": "rad"}


@dataclass(frozen=True)
class TablePose:
    """How reference channels are made of poses; see `vehest.sources.pose.planar_motion`.

    Args:
        x: column of the position and its unit, z up.
        y: the same.
        yaw: column of the yaw angle and its unit.
        window: samples of the Savitzky-Golay filter.
        order: of its polynomial.
        yaw_offset: from the rigid body's x axis to the car's forward axis, counter-clockwise [rad].
        lever_x: from the rigid body's origin forward to the reference point [m].
        lever_y: to the left [m].
        channels: which of vx_ref, vy_ref, yaw_rate_ref, sideslip_ref.
    """

    x: Column
    y: Column
    yaw: Column
    window: int = 9
    order: int = 2
    yaw_offset: float = 0.0
    lever_x: float = 0.0
    lever_y: float = 0.0
    channels: Annotated[tuple[str, ...], "a list of channels"] = POSE_CHANNELS

    @property
    def columns(self) -> dict[str, Column]:
        """Columns of ``x``, ``y`` and ``yaw``."""
        return {"x": self.x, "y": self.y, "yaw": self.yaw}

    def made_of(self, values: Mapping[str, FloatArray], clock: Clock, where: str) -> dict[str, FloatArray]:
        """Reference channels on the recording's clock, on which poses are differentiated: offline, by half a window.

        Raises:
            DataError: a pose is missing, or there are fewer than the filter's window.
        """
        poses = {name: column.to_si(values[column.column], UNITS[name]) for name, column in self.columns.items()}
        for name, samples in poses.items():
            odd = np.flatnonzero(~np.isfinite(samples))
            if len(odd):
                what = f"pose column '{self.columns[name].column}' holds no number in {len(odd)} rows of the run, first in row {odd[0] + 1}"
                raise DataError(f"{where}: {what}; leave them out by drop_rows")
        x, y, yaw = (clock.align(samples) for samples in (poses["x"], poses["y"], np.unwrap(poses["yaw"])))
        if len(x) < self.window:
            raise DataError(f"{where}: {len(x)} poses are fewer than the {self.window} of the filter's window")
        motion = planar_motion(
            np.stack([x, y], axis=1),
            yaw,
            1.0 / clock.rate_hz,
            window=self.window,
            order=self.order,
            mounting_yaw=self.yaw_offset,
            lever=(self.lever_x, self.lever_y),
        )
        return motion.channels(self.channels)


def table_pose_from_config(entry: Any, where: str) -> TablePose:
    """A data set's declaration of poses in columns.

    Raises:
        ConfigurationError: it lacks a column or a unit, or says something else.
    """
    pose = validated(TablePose, entry, where, error=ConfigurationError)
    for name, unit in UNITS.items():
        column_from_config(entry[name], f"{where}: {name}", unit)
    require_filter(pose.window, pose.order, where)
    require_pose_channels(pose.channels, where)
    return pose
