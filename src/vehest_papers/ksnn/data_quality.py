"""Table I and Figures 4 and 5 of Da Lio et al. 2023: what the drives are like, and how much noise
the kinematics see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vehest.data.recording import Recording
from vehest_papers.kit.spectra import (
    Periodogram,
    lateral_velocity_rate,
    periodogram,
    process_noise,
)


@dataclass(frozen=True)
class Statistics:
    """A row of Table I."""

    u_min: float  # lowest forward speed [m/s]
    u_max: float  # highest forward speed [m/s]
    v_low: float  # 0.01 quantile of the lateral velocity [m/s]
    v_high: float  # 0.99 quantile of the lateral velocity [m/s]
    yaw_rate_min: float  # [rad/s]
    yaw_rate_max: float  # [rad/s]
    ay: float  # 0.99 quantile of |a_y| [m/s²]
    length_km: float  # distance driven
    minutes: float  # duration

    @property
    def velocity_over_ay(self) -> float:
        """Mean size of both quantiles of the lateral velocity over that of a_y [s]."""
        return (self.v_high - self.v_low) / (2.0 * self.ay)


PUBLISHED: Mapping[str, Statistics] = {
    "C-1": Statistics(11.5, 63.7, -1.03, 1.3, -0.67, 0.61, 11.33, 35.4, 19.0),
    "C-2": Statistics(11.1, 61.2, -1.28, 1.43, -0.67, 0.63, 11.60, 24.1, 12.6),
    "F-1": Statistics(10.1, 61.2, -1.66, 1.80, -0.56, 0.55, 10.55, 45.8, 25.7),
    "F-2": Statistics(7.6, 65.4, -1.73, 1.62, -0.59, 0.59, 10.78, 33.6, 18.1),
}
"""Da Lio et al. 2023, Table I."""

PUBLISHED_BIAS: Mapping[str, float] = {"corvette": 0.10, "ferrari": -0.03}
"""Mean of v̇ - (a_y - ωu_m) by car [m/s²]: Da Lio et al. 2023, Section VII-A1."""


def statistics(recordings: Sequence[Recording]) -> Statistics:
    """Table I's figures over all samples of some recordings with vx, yaw_rate, ay and vy_ref."""
    speed, yaw_rate, ay, velocity = (
        np.concatenate([recording[name] for recording in recordings])
        for name in ("vx", "yaw_rate", "ay", "vy_ref")
    )
    low, high = np.quantile(velocity, [0.01, 0.99])
    return Statistics(
        u_min=float(speed.min()),
        u_max=float(speed.max()),
        v_low=float(low),
        v_high=float(high),
        yaw_rate_min=float(yaw_rate.min()),
        yaw_rate_max=float(yaw_rate.max()),
        ay=float(np.quantile(np.abs(ay), 0.99)),
        length_km=sum(float(recording["vx"].sum() / recording.rate_hz) for recording in recordings)
        / 1000.0,
        minutes=sum(recording.duration for recording in recordings) / 60.0,
    )


def spectra_of(recordings: Sequence[Recording]) -> tuple[Periodogram, Periodogram]:
    """Periodograms of dv/dt and of the process noise dv/dt - (a_y - ωu) [(m/s²)²/Hz] of recordings
    at one rate.
    """
    rate_hz = recordings[0].rate_hz
    return (
        periodogram([lateral_velocity_rate(recording) for recording in recordings], rate_hz),
        periodogram([process_noise(recording) for recording in recordings], rate_hz),
    )


def velocity_ratio(first: Sequence[Recording], second: Sequence[Recording]) -> float:
    """v over ay of the first car over that of the second one (`Statistics.velocity_over_ay`)."""
    return statistics(first).velocity_over_ay / statistics(second).velocity_over_ay
