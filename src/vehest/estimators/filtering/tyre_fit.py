"""Fit of axle curves, force over slip angle, to drives whose sideslip angle was measured.

A recording holds no tyre forces. Those of the axles follow from what the car as a whole does, with
small steering angles assumed (Di Biase, Lenzo & Timpone 2020, Eqs. 1, 2, 5, 6):

    F_F + F_R = m a_y,   a_F F_F - a_R F_R = J dr/dt,
    α_F = δ - (β + a_F r/u),   α_R = -(β - a_R r/u)

The paper has its forces from another tool, TRICK, which also provides the vertical ones; here an
axle carries what it carries at rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.vehicle.dugoff import LoadedCar
from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.rational_tyres import rational_axle

Kind = Literal["linear", "rational"]  # kind of an axle's curve, see `axle_force`

PARAMETERS: dict[str, tuple[str, ...]] = {
    "linear": ("cornering_stiffness",),
    "rational": ("c1", "c2"),
}
"""Names of an axle's parameters, by the kind of its curve: [N/rad]; [rad²], [N/rad]."""

# parameter -> smallest and largest value that a fit may give
BOUNDS = {"cornering_stiffness": (1e2, 1e8), "c1": (1e-5, 1.0), "c2": (1e2, 1e8)}
# rad, slip angle at which road tyres have their largest force: two in three between 6 and 13
# degrees, assumed
PEAK_SLIP = math.radians(9.0)
PEAK_SPREAD = 0.4  # standard deviation of the logarithm of `PEAK_SLIP`
# mean and standard deviation of ln c₁; the peak lies at √(2c₁)
ROAD_TYRE_LOG_C1 = (
    math.log(0.5 * PEAK_SLIP**2),
    2.0 * PEAK_SPREAD,
)
# smallest spread of the residuals over the scale of forces, since a curve may fit exactly
MIN_SPREAD = 1e-6
PASSES = 3  # fits, each of which weighs the prior of c₁ against the residuals of the last one
# s, window of the polynomial (Savitzky & Golay) by which forces and slips are smoothed
SMOOTHING_SECONDS = 0.5
SMOOTHING_ORDER = 2  # degree of the smoothing polynomial; a window of as few samples is refused
BLOCK_SECONDS = 10.0  # s; residuals further apart than this count as independent
MIN_SAMPLES = 100  # samples fast enough in all recordings together; fewer are refused
NORMAL_95 = 1.959964  # half width of the 95 % interval of a Gaussian, in standard deviations


@dataclass(frozen=True, eq=False)
class AxleMotion:
    """Slip angles and lateral forces of the axles along drives, N samples in all; the rows are the
    front and the rear axle.
    """

    slip: FloatArray  # slip angles, positive where they make a force to the left, (2, N) [rad]
    force: FloatArray  # lateral forces, (2, N) [N]
    block: NDArray[np.int64]  # number of the segment of time to which a sample belongs, (N,)
    # forward speed [m/s], steering angle [rad] and longitudinal acceleration [m/s²], (3, N); NaN:
    # not measured
    driven: FloatArray


@dataclass(frozen=True, eq=False)
class TyreFit:
    """Fitted force curves of both axles, and the samples that they were fitted to."""

    kind: Kind  # kind of both curves
    front: FloatArray  # parameters of the front axle in the order of `PARAMETERS`, (P,)
    rear: FloatArray  # those of the rear axle
    covariance: FloatArray  # covariance of the front and of the rear parameters, (2, P, P)
    residual_rms: FloatArray  # root mean square residual of front and rear force, (2,) [N]
    slip: FloatArray  # slip angles that were fitted to, (2, N) [rad]
    force: FloatArray  # forces that were fitted to, (2, N) [N]

    @property
    def interval(self) -> FloatArray:
        """Half width of the 95 % confidence interval of each parameter, (2, P)."""
        return NORMAL_95 * np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def curve(self, axle: Literal["front", "rear"], slip: FloatArray) -> FloatArray:
        """Lateral force of an axle [N] at slip angles [rad], of the same shape."""
        return axle_force(self.kind, getattr(self, axle), slip)


def axle_force(kind: Kind, parameters: FloatArray, slip: FloatArray) -> FloatArray:
    """Lateral force of an axle at slip angles (...) [rad], (...) [N].

    Parameters in the order of `PARAMETERS`, (P,).

    C α (Eq. 3), or c₂ α · 2c₁/(α² + 2c₁) (Eq. 4 at friction 1 and the load at rest).
    """
    c1, c2 = (math.inf, parameters[0]) if kind == "linear" else parameters
    force: FloatArray = rational_axle(slip, c1, c2, 1.0).force
    return force


def axle_motion(
    recordings: Sequence[Recording],
    parameters: SingleTrackParameters | LoadedCar,
    minimum_speed: float = 3.0,
    *,
    measured_forces: bool = False,
) -> AxleMotion:
    """Compute slip angles and lateral forces of the axles along drives, to fit curves to.

    Yaw acceleration is the slope of a second-order polynomial through half a second of the yaw rate
    (Savitzky and Golay); whatever else enters is smoothed by the same polynomial, so that slips and
    forces belong together. Future samples are used.

    Parameters
    ----------
    recordings : Sequence[Recording]
        With ``yaw_rate``, ``vx``, ``ay``, ``steer`` and ``sideslip_ref``, or ``vy_ref`` in its
        place.
    parameters : SingleTrackParameters | LoadedCar
        Mass, inertia and the places of the axles; cornering stiffnesses are not used.
    minimum_speed : float, default 3.0
        Slower samples are left out [m/s].
    measured_forces : bool, default False
        Take forces from the channels ``fy_fl`` to ``fy_rr``, which simulated cars have, instead of
        from accelerations.

    Raises
    ------
    DataError
        A channel is missing, or hardly any samples are left.
    """
    parts: list[AxleMotion] = []
    first_block = 0
    for recording in recordings:
        length = 2 * round(0.5 * SMOOTHING_SECONDS * recording.rate_hz) + 1
        if length <= SMOOTHING_ORDER:
            raise DataError(
                f"recording '{recording.id}': {recording.rate_hz:g} Hz are too few for a yaw "
                "acceleration; take 4 Hz or more"
            )
        if len(recording) < length:
            continue
        slip, force, inputs = _motion_of(
            recording, parameters, minimum_speed, length, measured_forces=measured_forces
        )
        block = first_block + np.arange(len(recording)) // round(BLOCK_SECONDS * recording.rate_hz)
        first_block = int(block[-1]) + 1
        usable = (
            (recording["vx"] >= minimum_speed)
            & np.isfinite(slip).all(0)
            & np.isfinite(force).all(0)
        )
        parts.append(
            AxleMotion(slip[:, usable], force[:, usable], block[usable], inputs[:, usable])
        )
    count = sum(len(part.block) for part in parts)
    if count < MIN_SAMPLES:
        named = ", ".join(f"'{recording.id}'" for recording in recordings) or "none"
        raise DataError(
            f"tyre curves: {count} samples faster than {minimum_speed:g} m/s with all channels "
            f"known, {MIN_SAMPLES} are needed (recordings: {named})"
        )
    return AxleMotion(
        np.concatenate([part.slip for part in parts], axis=-1),
        np.concatenate([part.force for part in parts], axis=-1),
        np.concatenate([part.block for part in parts]),
        np.concatenate([part.driven for part in parts], axis=-1),
    )


def _motion_of(
    recording: Recording,
    parameters: SingleTrackParameters | LoadedCar,
    minimum_speed: float,
    length: int,
    *,
    measured_forces: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slip angles and forces of one drive, (2, T) each, and speed, steering angle and longitudinal
    acceleration (`AxleMotion.driven`), (3, T).
    """
    front, rear, mass, inertia = (
        float(value)
        for value in (
            parameters.cg_to_front_axle,
            parameters.cg_to_rear_axle,
            parameters.mass,
            parameters.yaw_inertia,
        )
    )

    def smoothed(samples: FloatArray, derivative: int = 0) -> FloatArray:
        """A signal or its derivative by a local polynomial; NaN at the ends and around gaps."""
        step = 1.0 / recording.rate_hz
        fitted = signal.savgol_filter(
            samples,
            length,
            SMOOTHING_ORDER,
            deriv=derivative,
            delta=step,
            mode="constant",
            cval=np.nan,
        )
        return np.asarray(fitted, dtype=np.float64)  # nothing at the ends and around gaps

    u = np.maximum(recording["vx"], minimum_speed)
    sideslip = (
        recording["sideslip_ref"]
        if "sideslip_ref" in recording
        else np.arctan2(recording["vy_ref"], u)
    )
    turn = recording["yaw_rate"] / u
    slip = np.stack(
        [smoothed(recording["steer"] - sideslip - front * turn), smoothed(rear * turn - sideslip)]
    )
    ax = smoothed(recording["ax"]) if "ax" in recording else np.full(len(u), np.nan)
    driven = np.stack([smoothed(u), smoothed(recording["steer"]), ax])
    if measured_forces:
        wheels = [recording[f"fy_{wheel}"] for wheel in ("fl", "fr", "rl", "rr")]
        return (
            slip,
            np.stack([smoothed(wheels[0] + wheels[1]), smoothed(wheels[2] + wheels[3])]),
            driven,
        )
    total = mass * smoothed(recording["ay"])
    moment = inertia * smoothed(recording["yaw_rate"], derivative=1)
    return slip, np.stack([rear * total + moment, front * total - moment]) / (front + rear), driven


def fit_motion(motion: AxleMotion, kind: Kind = "rational") -> TyreFit:
    """Least squares of both axle curves; raises `DataError` where forces run against slips.

    Drives that stay where tyres are nearly linear say nothing of c₁: it is known beforehand as well
    as `PEAK_SLIP` says of road tyres, a block of 10 s counting as one sample against it.

    The covariance is that of least squares whose residuals hang together within blocks of 10 s and
    may differ in size (a sandwich of blocks): residuals of neighbouring samples are hardly
    independent, and to count them so would make intervals far too narrow.

    Parameters
    ----------
    motion : AxleMotion
        Slip angles and forces.
    kind : str
        ``linear`` or ``rational``.

    Source: Di Biase, Lenzo & Timpone 2020, section III.B, Figure 3 and Table 1; blocks as in Liang
    & Zeger, Biometrika 73 (1), 1986.
    """
    axles = [
        _fitted(kind, slip, force, motion.block)
        for slip, force in zip(motion.slip, motion.force, strict=True)
    ]
    (front, rear), covariances, rms = zip(*axles, strict=True)
    return TyreFit(
        kind, front, rear, np.stack(covariances), np.array(rms), motion.slip, motion.force
    )


def _fitted(
    kind: Kind, slip: FloatArray, force: FloatArray, block: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray, float]:
    """Fit the curve of one axle: parameters, their covariance and the rms of residual forces.

    Logarithms are fitted, so that all stay positive.

    Parameters
    ----------
    kind : str
        ``linear`` or ``rational``.
    slip, force : array
        (N,) [rad] and [N].
    block : array
        Number of the block of time of each sample, (N,).

    Returns
    -------
    tuple
        Parameters (P,), their covariance (P, P) in the parameters' units, and the root mean square
        of residual forces [N].

    Raises
    ------
    DataError
        The axle never slips, or forces run against slip angles.
    """
    names = PARAMETERS[kind]
    low, high = (np.log([BOUNDS[name][side] for name in names]) for side in (0, 1))
    squares = float(slip @ slip)
    if not squares > 0.0:
        raise DataError(
            "tyre curves: the axles never slip, since the car goes straight on; fit them to "
            "drives with bends"
        )
    stiffness = float(slip @ force) / squares
    scale = math.sqrt(float(np.mean(force**2)))
    if not stiffness > 0.0:
        raise DataError(
            f"tyre curves: forces run against slip angles (slope {stiffness:.3g} N/rad); check "
            "the signs of steer, ay and vy_ref"
        )
    guess = {
        "cornering_stiffness": stiffness,
        "c1": math.exp(ROAD_TYRE_LOG_C1[0]),
        "c2": 1.2 * stiffness,
    }
    logarithms = np.clip(np.log([guess[name] for name in names]), low, high)
    _, member = np.unique(block, return_inverse=True)
    blocks = int(member.max()) + 1
    spread = math.sqrt(float(np.mean((force - stiffness * slip) ** 2)))

    def misfit(log_parameters: FloatArray, weight: float) -> FloatArray:
        """Weighted residuals of forces, and that of the prior of ln c₁ where c₁ is fitted."""
        residuals = weight * (axle_force(kind, np.exp(log_parameters), slip) - force)
        return (
            np.append(
                residuals,
                (log_parameters[names.index("c1")] - ROAD_TYRE_LOG_C1[0]) / ROAD_TYRE_LOG_C1[1],
            )
            if "c1" in names
            else residuals
        )

    for _ in range(PASSES):
        weight = math.sqrt(blocks / len(slip)) / max(spread, MIN_SPREAD * scale)
        solution = optimize.least_squares(
            misfit, logarithms, bounds=(low, high), xtol=1e-12, ftol=1e-12, args=(weight,)
        )
        logarithms = solution.x
        spread = math.sqrt(float(np.mean(solution.fun[: len(slip)] ** 2))) / weight
    of_data = solution.jac[: len(slip)]
    of_knowledge = solution.jac[len(slip) :]
    scores = of_data * solution.fun[: len(slip), None]
    sums = np.stack([np.bincount(member, weights=column) for column in scores.T], axis=1)
    curvature = np.linalg.pinv(solution.jac.T @ solution.jac)
    spread_of_scores = sums.T @ sums * blocks / max(blocks - 1, 1) + of_knowledge.T @ of_knowledge
    covariance = curvature @ spread_of_scores @ curvature
    parameters = np.exp(logarithms)
    return parameters, covariance * np.outer(parameters, parameters), spread
