"""Vector autoregression.

Predicts the next sample of several channels; its errors are the innovations.

    y_k = c + A₁ y_{k-1} + … + A_p y_{k-p} + ε_k,  ε ~ N(0, S)

(Lütkepohl, New Introduction to Multiple Time Series Analysis, 2005, Eq. 2.1.1). Fitted by least
squares, once more without the rows that hold outliers; its order by BIC (Section 4.3.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vehest.constants import FloatArray
from vehest.data.errors import DataError

OUTLIER = 8.0  # robust standard deviations of a residual beyond which its row is left out
# smallest standard deviation of a channel's innovation, over that of the channel; it keeps S
# regular where a simulation has no noise
MIN_DEVIATION = 1e-7
# smallest and largest noise at a speed over that of all speeds
NOISE_FACTORS = (0.2, 5.0)
ROWS_A_NUMBER = 4  # samples that each coefficient needs at least


@dataclass(frozen=True, eq=False)
class Autoregression:
    """A fitted vector autoregression of C channels; predicts a sample from the p before it."""

    constant: FloatArray  # c, (C,)
    coefficients: FloatArray  # A₁ to A_p, (p, C, C)
    covariance: FloatArray  # S, (C, C)

    @property
    def order(self) -> int:
        """p, the number of former samples that a prediction uses."""
        return len(self.coefficients)

    def innovations(self, samples: FloatArray) -> FloatArray:
        """y_k less its prediction from the p samples before, (T, C).

        NaN for the first p and where a sample is not finite.
        """
        innovations = np.full(np.shape(samples), np.nan)
        if len(samples) > self.order:
            innovations[self.order :] = samples[self.order :] - self.constant
            for lag, coefficient in enumerate(self.coefficients, start=1):
                innovations[self.order :] -= (
                    samples[self.order - lag : len(samples) - lag] @ coefficient.T
                )
        return innovations


def fit_autoregression(pieces: Sequence[FloatArray], max_order: int = 10) -> Autoregression:
    """Fit orders 1 to ``max_order`` to the same rows of unbroken segments, and return the model of
    the order with the least BIC.

    Two passes find outliers: rows whose residual exceeds `OUTLIER` robust standard deviations in
    any channel are left out, unless they are 2 % or more. Channels are standardised first.

    Parameters
    ----------
    pieces : sequence of array
        (T, C) each; rows with a NaN among them or their regressors are left out.
    max_order : int
        Largest p.

    Returns
    -------
    Autoregression
        In the channels' units.

    Raises
    ------
    DataError
        There are fewer than `ROWS_A_NUMBER` rows for each coefficient of a channel.
    """
    n_channels = pieces[0].shape[1]
    regressors, targets = _rows(pieces, max_order)
    if len(targets) < ROWS_A_NUMBER * (1 + max_order * n_channels):
        raise DataError(
            f"{len(targets)} samples without gaps are too few for an autoregression of order "
            f"{max_order} in {n_channels} channels"
        )
    centre = targets.mean(0)
    spread = np.maximum(targets.std(0), 1e-12)
    regressors = (regressors - np.tile(centre, max_order)) / np.tile(spread, max_order)
    targets = (targets - centre) / spread
    is_regular = np.ones(len(targets), dtype=bool)
    for _ in range(2):
        left = _least_squares(regressors[is_regular], targets[is_regular], max_order * n_channels)
        residual = targets - left[0] - regressors @ left[1:]
        robust = 1.4826 * np.median(np.abs(residual), axis=0) + MIN_DEVIATION
        clipped = np.clip(residual, *np.percentile(residual, [0.5, 99.5], axis=0))
        robust = np.maximum(robust, 0.2 * np.sqrt(np.mean(np.square(clipped), 0)))
        odd = (np.abs(residual) > OUTLIER * robust).any(1)
        is_regular = ~odd if odd.mean() < 0.02 else is_regular
    chosen = left
    lowest = math.inf
    for order in range(1, max_order + 1):
        fitted = _least_squares(regressors[is_regular], targets[is_regular], order * n_channels)
        residual = (
            targets[is_regular]
            - fitted[0]
            - regressors[is_regular][:, : order * n_channels] @ fitted[1:]
        )
        covariance = residual.T @ residual / len(residual) + MIN_DEVIATION**2 * np.eye(n_channels)
        criterion = len(residual) * float(
            np.linalg.slogdet(covariance)[1]
        ) + fitted.size * math.log(len(residual))
        if criterion < lowest:
            lowest = criterion
            chosen = fitted
            best = covariance
    coefficients = (
        chosen[1:].reshape(-1, n_channels, n_channels).transpose(0, 2, 1) * spread[:, None] / spread
    )
    constant = centre + spread * chosen[0] - coefficients.sum(0) @ centre
    return Autoregression(constant, coefficients, best * np.outer(spread, spread))


def _rows(pieces: Sequence[FloatArray], order: int) -> tuple[FloatArray, FloatArray]:
    """Regressors (N, p·C), the latest sample first, and targets (N, C) of complete rows."""
    windows = [np.empty((0, order + 1, pieces[0].shape[1]))]
    windows += [
        sliding_window_view(piece, order + 1, axis=0).transpose(0, 2, 1)[:, ::-1]
        for piece in pieces
        if len(piece) > order
    ]
    rows = np.concatenate(windows)
    rows = rows[np.isfinite(rows).all((1, 2))]
    return rows[:, 1:].reshape(len(rows), order * rows.shape[2]), rows[:, 0]


def _least_squares(regressors: FloatArray, targets: FloatArray, columns: int) -> FloatArray:
    """Constant and coefficients of the first ``columns`` regressors, (1 + columns, C).

    Normal equations with a ridge of 1e-10, so that channels that depend on each other do not fail.
    """
    design = np.concatenate([np.ones((len(regressors), 1)), regressors[:, :columns]], axis=1)
    gram = design.T @ design
    # where one channel is another's multiple
    gram[np.diag_indices_from(gram)] += 1e-10 * len(design)
    return np.linalg.solve(gram, design.T @ targets)


def learn_noise_levels(
    innovations: FloatArray, covariance: FloatArray, speed: FloatArray, n_levels: int
) -> tuple[FloatArray, FloatArray]:
    """Root mean square of innovations as a function of speed, relative to their standard deviation
    over all speeds.

    Parameters
    ----------
    innovations : array
        (T, C); rows that are not finite are left out.
    covariance : array
        Covariance of all innovations, (C, C); only its diagonal is used.
    speed : array
        Speed of the car, (T,), in the unit of its channel; only its absolute value is used.
    n_levels : int
        Number L of speeds.

    Returns
    -------
    tuple
        Speeds, (L,), rising, at the medians of bins of speed (T,) with equal numbers of
        samples; and root mean squares there, (L, C), outliers cut off, within `NOISE_FACTORS`; they
        are interpolated linearly between the speeds.
    """
    is_finite = np.isfinite(innovations).all(1) & np.isfinite(speed)
    scaled = innovations[is_finite] / np.sqrt(np.diag(covariance))
    speed = np.abs(speed[is_finite])
    bins = np.array_split(np.argsort(speed, kind="stable"), n_levels)
    speeds = np.array([float(np.median(speed[rows])) for rows in bins])
    factors = np.array(
        [
            np.sqrt(np.mean(np.square(np.clip(scaled[rows], -OUTLIER / 2, OUTLIER / 2)), axis=0))
            for rows in bins
        ]
    )
    return speeds, np.clip(factors, *NOISE_FACTORS)
