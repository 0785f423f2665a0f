"""Values by block and seed for those claims that are not comparisons of errors (``measure`` in
claims.yaml).

Each function returns an array of shape (S, B), S seeds by B manoeuvres unless it says otherwise;
NaN where a manoeuvre has no samples of what is measured. Two candidates have their seeds paired in
order.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy import stats

from vehest.constants import FloatArray
from vehest_papers.cnn_ukf.indicators import (
    MSE,
    MSE_NL,
    ManoeuvreErrors,
    nonlinear_samples,
    sideslip_errors,
)
from vehest_papers.cnn_ukf.manoeuvres import GROUPS
from vehest_papers.cnn_ukf.networks import Outputs
from vehest_papers.cnn_ukf.observability import PAPER_MEASUREMENTS
from vehest_papers.kit.measured import paired_seeds

HIGH_SIDESLIP = 5.0  # deg
LOW_SIDESLIP = 1.0  # deg
LATERAL_VELOCITY = 0  # column of Outputs.process
YAW_RATE = 1
Seeds = Sequence[Sequence[Outputs]]  # outputs of a network, seed by seed, manoeuvre by manoeuvre


def mean_error_over_least_of_others(
    main: ManoeuvreErrors, candidate: str, rivals: Sequence[str]
) -> FloatArray:
    """Contributions of the manoeuvres to |mean error| less the smallest |mean error| of the others
    [deg].

    Where |ay| is at least 4 m/s². Their mean over manoeuvres is the difference of the two
    magnitudes: the sign of each mean error is that over all manoeuvres.

    Parameters
    ----------
    main
        Candidates on the test.
    candidate, rivals
        The candidate that is compared, and those of which the smallest magnitude counts.
    """
    magnitudes = [_magnitude_parts(main, name) for name in rivals]
    smallest = min(magnitudes, key=lambda parts: float(parts.mean()))
    return np.subtract(*paired_seeds(_magnitude_parts(main, candidate), smallest))


def _magnitude_parts(main: ManoeuvreErrors, candidate: str) -> FloatArray:
    """Contributions of each manoeuvre to the magnitude of a mean error, (S, M) [deg].

    A contribution is the sum of the errors in the manoeuvre over the mean number of samples of a
    manoeuvre, with the sign that makes the mean over all manoeuvres of a seed positive.
    """
    sums = []
    for run in main.runs[candidate]:
        parts = list(run.test.values())
        errors = [sideslip_errors(part)[nonlinear_samples(part)] for part in parts]
        counts = sum(len(error) for error in errors) / len(errors)
        sums.append([float(error.sum()) / max(counts, 1.0) for error in errors])
    means = np.array(sums)
    return means * np.sign(means.mean(axis=1, keepdims=True))


def is_best_in_group(
    main: ManoeuvreErrors, candidate: str, rivals: Sequence[str]
) -> tuple[list[str], FloatArray]:
    """Groups of manoeuvres, and 1 where a seed has a lower MSE in non-linear driving than the mean
    of each other, (S, groups).
    """
    groups = [group for group in GROUPS.values() if group in main.groups]
    columns = []
    for group in groups:
        values = _values_of_seeds(main, candidate, group)
        limit = min(float(_values_of_seeds(main, name, group).mean()) for name in rivals)
        columns.append((values < limit).astype(np.float64))
    return groups, np.stack(columns, axis=1)


def _values_of_seeds(main: ManoeuvreErrors, candidate: str, group: str) -> FloatArray:
    """MSE of a group of manoeuvres in non-linear driving, pooled over its samples, (S,) [deg²]."""
    errors = main.errors(candidate, MSE_NL, group)
    return errors.sums.sum(axis=1) / max(float(errors.sizes.sum()), 1.0)


def distrust_correlations(outputs: Seeds) -> FloatArray:
    """Spearman's rank correlation of a network's deviation with the magnitude of its error.

    Parameters
    ----------
    outputs
        Outputs of the network, seed by seed, manoeuvre by manoeuvre.

    Returns
    -------
    array, shape (S, M)
        Over the samples of each manoeuvre; 0 where the deviation is constant.
    """

    def correlation(manoeuvre: Outputs) -> float:
        if np.ptp(manoeuvre.distrust) == 0:
            return 0.0
        return float(stats.spearmanr(manoeuvre.distrust, np.abs(manoeuvre.error)).statistic)

    return np.array([[correlation(manoeuvre) for manoeuvre in seed] for seed in outputs])


def distrust_decades_ratios(first: Seeds, second: Seeds) -> FloatArray:
    """Decades that the deviation of one network spans over those of another, from the 1st to the
    99th percentile.
    """
    return np.divide(*paired_seeds(_decades(first), _decades(second)))


def _decades(outputs: Seeds) -> FloatArray:
    """log₁₀ of the 99th over the 1st percentile of the deviation in each manoeuvre, (S, M)."""
    ends = np.array(
        [[np.percentile(manoeuvre.distrust, [1.0, 99.0]) for manoeuvre in seed] for seed in outputs]
    )
    return np.asarray(np.log10(ends[..., 1] / ends[..., 0]))


def yaw_rate_noise_rises(outputs: Seeds) -> FloatArray:
    """Median process noise of the yaw rate where |β| ≥ 5° over that where |β| < 1°.

    β is the reference; NaN in manoeuvres without samples of either kind.
    """

    def rise(manoeuvre: Outputs) -> float:
        angle = np.abs(manoeuvre.sideslip)
        return _ratio_of_medians(manoeuvre, YAW_RATE, angle >= HIGH_SIDESLIP, angle < LOW_SIDESLIP)

    return np.array([[rise(manoeuvre) for manoeuvre in seed] for seed in outputs])


def lateral_velocity_noise_rises(outputs: Seeds) -> FloatArray:
    """Median process noise of the lateral velocity in non-linear driving over that in linear
    driving.
    """
    return np.array(
        [
            [
                _ratio_of_medians(
                    manoeuvre, LATERAL_VELOCITY, manoeuvre.nonlinear, ~manoeuvre.nonlinear
                )
                for manoeuvre in seed
            ]
            for seed in outputs
        ]
    )


def _ratio_of_medians(outputs: Outputs, column: int, above: np.ndarray, below: np.ndarray) -> float:
    """Median of a standard deviation of the process noise over some samples, over that over others.

    Parameters
    ----------
    column
        `LATERAL_VELOCITY` or `YAW_RATE`.
    above, below
        Masks of the samples of numerator and denominator, (K,); NaN is returned if one is empty.
    """
    assert outputs.process is not None
    if not (above.any() and below.any()):
        return float("nan")
    noise = outputs.process[:, column]
    return float(np.median(noise[above]) / np.median(noise[below]))


def stiffness_rise_differences(
    conditions: Sequence[ManoeuvreErrors], nominal: ManoeuvreErrors, candidate: str, reference: str
) -> FloatArray:
    """Contributions of the manoeuvres to the rise of a candidate's MSE less that of another's
    [deg²].

    Each has its own worst combination of stiffnesses, by the MSE over all manoeuvres.

    Parameters
    ----------
    conditions
        Errors with each combination of wrong stiffnesses (Figure 14 of the paper).
    nominal
        Errors with the stiffnesses as identified.
    candidate, reference
        Filters whose rises are compared.
    """
    return np.subtract(
        *paired_seeds(
            _worst_rise(conditions, nominal, candidate), _worst_rise(conditions, nominal, reference)
        )
    )


def _worst_rise(
    conditions: Sequence[ManoeuvreErrors], nominal: ManoeuvreErrors, candidate: str
) -> FloatArray:
    """MSE with the worst combination of stiffnesses less the nominal MSE, by manoeuvre (S, M)
    [deg²].

    Differences of sums are divided by the mean number of samples of a manoeuvre, so that their mean
    over manoeuvres is the difference of the pooled errors.
    """
    errors = [condition.errors(candidate, MSE) for condition in (*conditions, nominal)]
    sizes = errors[0].sizes
    worst = max(errors, key=lambda condition: float(condition.sums.mean(axis=0).sum()))
    return np.asarray((worst.sums - errors[-1].sums) / sizes.mean())


def largest_ratios_over_stiffnesses(
    conditions: Sequence[ManoeuvreErrors], candidate: str, reference: str
) -> FloatArray:
    """MSE of a candidate over that of another in non-linear driving, at the stiffnesses where its
    geometric mean is largest.

    That the candidate is better at all stiffnesses is tested by the worst of them alone.

    Parameters
    ----------
    conditions
        Errors with each combination of stiffnesses.
    candidate, reference
        Filters of numerator and denominator.
    """
    ratios = []
    for condition in conditions:
        first, second = (condition.errors(name, MSE_NL) for name in (candidate, reference))
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios.append(np.divide(*paired_seeds(first.sums, second.sums)))
    return max(ratios, key=lambda condition: float(np.nanmean(np.log(condition))))


def ranks(table: pd.DataFrame, is_straight: bool) -> tuple[list[str], FloatArray]:
    """Steady turns, or straight drives, and the rank of the observation matrix in each, (1, B),
    with the paper's measurements.
    """
    rows = table[
        ((table["steer"] == 0.0) == is_straight) & (table["measured"] == PAPER_MEASUREMENTS)
    ]
    names = [f"{row.speed:g} m/s, {row.steer:g}°" for row in rows.itertuples()]
    return names, rows["rank"].to_numpy(dtype=np.float64)[None]
