"""The paper's indicators by manoeuvre and seed, and their values and ratios with 95 % intervals
over manoeuvres and seeds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.evaluation.metrics import Scored
from vehest_papers.cnn_ukf.manoeuvres import group_of, is_nonlinear
from vehest_papers.cnn_ukf.subjects import Manoeuvres, Runs
from vehest_papers.kit.block_errors import BlockErrors
from vehest_papers.kit.reading import sideslip_error
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Figure, paired_errors, ratio_of, value_of

MSE = "mse"
MSE_NL = "mse_nonlinear"
ME = "max_error"
ME_NL = "max_error_nonlinear"
VARIANCE_NL = "variance_nonlinear"
AT_PEAK = "error_at_peak"
BALANCED = "balanced"  # mean over manoeuvres of their RMSE, by which seeds and settings are chosen
PEAK_SAMPLES = 10  # before and after the largest sideslip angle, at 100 Hz

Sums = tuple[FloatArray, FloatArray]  # sum and size of each manoeuvre, (M,) each


def sums_of(manoeuvres: Manoeuvres, indicator: str) -> Sums:
    """Sum of an indicator's loss over each manoeuvre and the samples in it.

    Parameters
    ----------
    manoeuvres
        Recording -> what was scored of it, M of them.
    indicator
        One of `MSE`, `MSE_NL`, `ME`, `ME_NL`, `VARIANCE_NL`, `AT_PEAK` and `BALANCED`. Those that
        end in ``nonlinear`` take samples with |ay| ≥ 4 m/s² alone.

    Returns
    -------
    tuple of array
        Sums and sizes, (M,). Of squared errors [deg²], for `VARIANCE_NL` about the mean over all
        manoeuvres; maxima, the mean absolute error around the largest reference angle and the root
        mean square of a manoeuvre [deg] have size 1, maxima 0 where no sample counts.
    """
    errors = [sideslip_errors(parts) for parts in manoeuvres.values()]
    if indicator in (MSE_NL, ME_NL, VARIANCE_NL):
        errors = [
            error[nonlinear_samples(parts)]
            for error, parts in zip(errors, manoeuvres.values(), strict=True)
        ]
    counts = np.array([float(len(error)) for error in errors])
    if indicator == BALANCED:
        roots = [float(np.sqrt(np.mean(np.square(error)))) for error in errors]
        return np.array(roots), np.ones(len(errors))
    if indicator in (ME, ME_NL):
        largest = [float(np.abs(error).max()) if len(error) else 0.0 for error in errors]
        return np.array(largest), (counts > 0).astype(np.float64)
    if indicator == AT_PEAK:
        near = [
            error[_near_peak(parts)]
            for error, parts in zip(errors, manoeuvres.values(), strict=True)
        ]
        return np.array([float(np.abs(error).mean()) for error in near]), np.ones(len(near))
    mean = 0.0
    if indicator == VARIANCE_NL:
        mean = sum(float(error.sum()) for error in errors) / max(float(counts.sum()), 1.0)
    squares = [float(np.square(error - mean).sum()) for error in errors]
    return np.array(squares), counts


def sideslip_errors(parts: Sequence[Scored]) -> FloatArray:
    """Errors of a manoeuvre [deg]."""
    return np.concatenate([sideslip_error(part) for part in parts])


def nonlinear_samples(parts: Sequence[Scored]) -> NDArray[np.bool_]:
    """Whether a sample of a manoeuvre has |ay| of at least 4 m/s²."""
    return np.concatenate([is_nonlinear(part) for part in parts])


def _near_peak(parts: Sequence[Scored]) -> slice:
    angle = np.abs(np.concatenate([part.sideslip_ref for part in parts]))
    peak = int(angle.argmax())
    return slice(max(peak - PEAK_SAMPLES, 0), peak + PEAK_SAMPLES + 1)


class ManoeuvreErrors:
    """Candidates on one test: errors of each seed in each manoeuvre.

    Parameters
    ----------
    runs
        Candidate -> its seeds, all over the same manoeuvres.

    Attributes
    ----------
    manoeuvres : tuple of str
        Names of the recordings, M of them, which are the blocks of all errors.
    groups : list of str
        Group of each manoeuvre.
    """

    def __init__(self, runs: Runs) -> None:
        self.runs = runs
        self.manoeuvres = tuple(next(iter(runs.values()))[0].test)
        self.groups = [group_of(manoeuvre) for manoeuvre in self.manoeuvres]
        self._errors: dict[tuple[str, str], BlockErrors] = {}

    def __contains__(self, candidate: object) -> bool:
        return candidate in self.runs

    def seeds(self, candidate: str) -> tuple[int, ...]:
        """Seeds of a candidate."""
        return tuple(run.model.seed for run in self.runs[candidate])

    def errors(self, candidate: str, indicator: str, group: str = "") -> BlockErrors:
        """An indicator of a candidate, over all manoeuvres or those of a group, seed by seed: sums
        (S, M) and sizes (M,) as of `sums_of`.
        """
        key = candidate, indicator
        if key not in self._errors:
            pairs = [sums_of(run.test, indicator) for run in self.runs[candidate]]
            self._errors[key] = BlockErrors(
                tuple(str(seed) for seed in self.seeds(candidate)),
                self.manoeuvres,
                np.stack([sums for sums, _ in pairs]),
                pairs[0][1],
            )
        if not group:
            return self._errors[key]
        of_group = [
            name
            for name, name_of_group in zip(self.manoeuvres, self.groups, strict=True)
            if name_of_group == group
        ]
        return self._errors[key].of_blocks(tuple(of_group))

    def figure(self, candidate: str, indicator: str, group: str = "") -> Figure:
        """Mean over seeds with its interval."""
        return value_of(self.errors(candidate, indicator, group), indicator)[1]

    def ratio(self, first: str, second: str, indicator: str) -> Figure:
        """An indicator of the first candidate over that of the second, pooled over the manoeuvres
        in which both are finite, with its 95 % interval.
        """
        return ratio_of(
            paired_errors(
                self.errors(first, indicator), self.errors(second, indicator), indicator, "test"
            )
        )

    def text(self, candidate: str, indicator: str) -> str:
        """The value with its interval."""
        return figure_in_words(self.figure(candidate, indicator))
