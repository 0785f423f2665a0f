"""Velocities in a car's axes from poses of motion capture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.data.errors import DataError

UpAxis = Literal["y", "z"]  # upward axis of poses
# reference channel that poses give
PoseChannel = Literal["vx_ref", "vy_ref", "yaw_rate_ref", "sideslip_ref"]
POSE_CHANNELS: tuple[PoseChannel, ...] = get_args(PoseChannel)  # channels that poses give


@dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """Options by which reference channels are made from poses."""

    window: int = 9  # length of the Savitzky-Golay filter [samples]
    order: int = 2  # order of its polynomial
    # distance from the rigid body's origin forward to the reference point, in the car's axes [m]
    lever_x: float = 0.0
    lever_y: float = 0.0  # distance to the left [m]
    channels: tuple[PoseChannel, ...] = POSE_CHANNELS  # reference channels that are made

    def __post_init__(self) -> None:
        if not 1 <= self.order < self.window or self.window % 2 == 0:
            raise ValueError(
                "window must be an odd number above order, and order at least 1, not "
                f"{self.window} and {self.order}"
            )

    def references(
        self,
        positions: FloatArray,
        yaw: FloatArray,
        interval: float,
        turned: float = 0.0,
        location: str = "poses",
        at: tuple[FloatArray, FloatArray] | None = None,
    ) -> dict[str, FloatArray]:
        """Reference channels: poses are differentiated by a Savitzky-Golay filter and the velocity
        is turned into the car's axes.

        Parameters
        ----------
        positions : FloatArray
            Of the rigid body's origin, x and y with z up, evenly sampled, shape (T, 2) [m].
        yaw : FloatArray
            Of the rigid body, unwrapped, shape (T,) [rad].
        interval : float
            Between two poses [s].
        turned : float
            From the rigid body's x axis to the car's forward axis, counter-clockwise [rad].
        location : str
            File and topic, for messages.
        at : tuple of FloatArray or None
            Times of the samples, shape (T,) [s], and others, shape (N,) [s], to which straight
            lines bring the velocities.

        Returns
        -------
        dict
            Those of ``channels``: velocities of the reference point [m/s], forward and to the left,
            yaw rate, positive to the left [rad/s], and sideslip angle [rad], shape (T,) or (N,)
            each.

        Raises
        ------
        DataError
            There are fewer poses than the filter's window has samples.

        Notes
        -----
        Source: Savitzky & Golay, Smoothing and differentiation of data by simplified least squares
        procedures, Anal. Chem. 36 (8), 1964.
        """
        if len(yaw) < self.window:
            raise DataError(
                f"{location}: {len(yaw)} poses are fewer than the {self.window} of the filter's "
                "window"
            )
        derivative = partial(
            scipy.signal.savgol_filter,
            window_length=self.window,
            polyorder=self.order,
            deriv=1,
            delta=interval,
        )
        velocity_x = derivative(positions[:, 0])
        velocity_y = derivative(positions[:, 1])
        yaw_rate = derivative(yaw)
        heading = scipy.signal.savgol_filter(yaw, self.window, self.order) + turned
        cosine = np.cos(heading)
        sine = np.sin(heading)
        channels = {
            "vx_ref": cosine * velocity_x + sine * velocity_y - yaw_rate * self.lever_y,
            "vy_ref": -sine * velocity_x + cosine * velocity_y + yaw_rate * self.lever_x,
            "yaw_rate_ref": yaw_rate,
        }
        if at is not None:
            channels = {
                name: np.interp(at[1], at[0], samples) for name, samples in channels.items()
            }
        channels["sideslip_ref"] = np.arctan2(channels["vy_ref"], channels["vx_ref"])
        return {name: channels[name] for name in self.channels}


def ground_plane(
    positions: FloatArray, orientations: FloatArray, up: UpAxis, location: str
) -> tuple[FloatArray, FloatArray]:
    """Positions in the ground plane and yaw, z up, of poses in the world.

    Parameters
    ----------
    positions : FloatArray
        x, y and z in the world, shape (T, 3) [m].
    orientations : FloatArray
        Quaternions x, y, z, w from the rigid body's axes to the world's, shape (T, 4).
    up : {'y', 'z'}
        Upward axis of both: ``y`` is usual in motion capture, ``z`` in ROS.
    location : str
        File and topic, for messages.

    Returns
    -------
    plane : FloatArray
        x and y, shape (T, 2) [m].
    yaw : FloatArray
        Unwrapped, counter-clockwise as seen from above, shape (T,) [rad].

    Raises
    ------
    DataError
        The length of a quaternion differs from 1 by 0.01 or more.
    """
    with np.errstate(over="ignore"):
        length = np.linalg.norm(orientations, axis=1)
    off = np.flatnonzero(~(np.abs(length - 1.0) < 0.01))
    if len(off):
        raise DataError(
            f"{location}: {len(off)} orientations are no unit quaternions, the first in message "
            f"{off[0] + 1} (length {length[off[0]]:.4g}); "
            f"was the body out of sight? cut the range out"
        )
    x, y, z, w = (orientations / length[:, None]).T
    plane = positions[:, :2]
    if up == "y":  # turned about x by 90°: y becomes z, z becomes -y
        plane = np.stack([positions[:, 0], -positions[:, 2]], axis=1)
        y, z = -z, y
    return plane, np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
