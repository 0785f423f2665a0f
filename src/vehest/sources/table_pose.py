"""Poses of a motion capture system in a table's columns, and the reference channels that are made
of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import validated
from vehest.sources.clocks import Clock
from vehest.sources.columns import Column, column_from_config
from vehest.sources.pose import PoseOptions

UNITS = {"x": "m", "y": "m", "yaw": "rad"}  # coordinate of a pose -> its SI unit


@dataclass(frozen=True)
class TablePose(PoseOptions):
    """Declaration of columns of poses."""

    x: Column  # column of the position x and its unit, z up
    y: Column  # column of the position y and its unit
    yaw: Column  # column of the yaw angle and its unit
    # angle from the rigid body's x axis to the car's forward axis, counter-clockwise [rad]
    yaw_offset: float = 0.0

    @property
    def columns(self) -> dict[str, Column]:
        """Declarations of the columns ``x``, ``y`` and ``yaw``, by these names."""
        return {"x": self.x, "y": self.y, "yaw": self.yaw}

    def channels_of(
        self, values: Mapping[str, FloatArray], clock: Clock, location: str
    ) -> dict[str, FloatArray]:
        """Reference channels on the recording's clock, on which poses are differentiated: offline,
        by half a window.

        Parameters
        ----------
        values : mapping
            Columns of the table in the file's unit, shape (T,) each.
        clock : Clock
            Clock of the recording; the table's rows are brought onto it.
        location : str
            The file, for messages.

        Returns
        -------
        dict
            As of `PoseOptions.references`, one sample a tick.

        Raises
        ------
        DataError
            A pose is no number, or there are fewer than the filter's window has samples.
        """
        poses = {
            name: column.to_si(values[column.column], UNITS[name])
            for name, column in self.columns.items()
        }
        for name, samples in poses.items():
            odd = np.flatnonzero(~np.isfinite(samples))
            if len(odd):
                raise DataError(
                    f"{location}: pose column '{self.columns[name].column}' holds no number in "
                    f"{len(odd)} rows of the run, first in row {odd[0] + 1}; leave them out by "
                    "drop_rows"
                )
        positions = np.stack([clock.align(poses[axis]) for axis in "xy"], axis=1)
        yaw = clock.align(np.unwrap(poses["yaw"]))
        return self.references(positions, yaw, 1.0 / clock.rate_hz, self.yaw_offset, location)


def table_pose_from_config(entry: Any, location: str) -> TablePose:
    """A data set's declaration of poses in columns.

    Raises
    ------
    ConfigurationError
        A column or unit is missing, or one is unknown or of another quantity.
    """
    pose = validated(TablePose, entry, location, error=ConfigurationError)
    for name, unit in UNITS.items():
        column_from_config(entry[name], f"{location}: {name}", unit)
    return pose
