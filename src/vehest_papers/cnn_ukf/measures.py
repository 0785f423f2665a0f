"""The paper's indicators of candidates on manoeuvres, resampled together, and relative changes from one to another with their intervals."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.evaluation.metrics import Scored
from vehest.evaluation.significance import CONFIDENCE
from vehest_papers.cnn_ukf.manoeuvres import group_of, is_nonlinear
from vehest_papers.cnn_ukf.subjects import Manoeuvres, Run, Runs
from vehest_papers.kit.reading import sideslip_error
from vehest_papers.kit.sampled import SampledErrors, resampled
from vehest_papers.kit.statements import Change, Measured, short

N_RESAMPLES = 4000
MSE = "mse"
MSE_NL = "mse_nonlinear"
ME = "max_error"
ME_NL = "max_error_nonlinear"
BALANCED = "balanced"  # mean over manoeuvres of their RMSE, by which seeds and settings are chosen

Sums = tuple[FloatArray, FloatArray]  # of each manoeuvre a sum and what it is divided by, (M,) each


def sums_of(manoeuvres: Manoeuvres, indicator: str) -> Sums:
    """What an indicator is made of, manoeuvre by manoeuvre."""
    errors = [
        np.concatenate([sideslip_error(part) for part in parts]) for parts in manoeuvres.values()
    ]
    beyond = [
        np.concatenate([is_nonlinear(part) for part in parts]) for parts in manoeuvres.values()
    ]
    if indicator in (MSE_NL, ME_NL):
        errors = [error[kept] for error, kept in zip(errors, beyond, strict=True)]
    if indicator == BALANCED:
        return np.array([float(np.sqrt(np.mean(np.square(error)))) for error in errors]), np.ones(
            len(errors)
        )
    if indicator in (ME, ME_NL):
        found = [float(np.abs(error).max()) if len(error) else 0.0 for error in errors]
        return np.array(found), np.array([float(len(error) > 0) for error in errors])
    return np.array([float(np.square(error).sum()) for error in errors]), np.array(
        [float(len(error)) for error in errors]
    )


class ManoeuvreErrors(SampledErrors):
    """Candidates on one test, all on the same resamples of whole manoeuvres; seeds of each candidate are drawn on their own.

    Args:
        runs: candidate -> its seeds; all over the same manoeuvres.
        name: of the test; resamples of tests with different names are independent.
        paired: candidates whose runs are the same trainings under other conditions are drawn together.
    """

    def __init__(self, runs: Runs, name: str, *, paired: bool = False) -> None:
        super().__init__(runs, paired=paired)
        self.runs = runs
        self.manoeuvres = list(next(iter(runs.values()))[0].test)
        self.groups = [group_of(manoeuvre) for manoeuvre in self.manoeuvres]
        generator = np.random.default_rng(zlib.crc32(name.encode()))
        self._counts = resampled(len(self.manoeuvres), N_RESAMPLES, generator)
        self._seed = int(generator.integers(2**31))
        self._known: dict[tuple[str, str, str], Measured] = {}

    def get(self, candidate: str, indicator: str, group: str = "") -> Measured:
        """An indicator of a candidate, over all manoeuvres or those of a group."""
        key = candidate, indicator, group
        if key not in self._known:
            pieces = [sums_of(run.test, indicator) for run in self.runs[candidate]]
            kept = np.array([group in ("", own) for own in self.groups], dtype=np.float64)
            sums = np.stack([own for own, _ in pieces]) * kept
            sizes = pieces[0][1] * kept
            self._known[key] = self.measured(sums, sizes, int(np.count_nonzero(kept)))
        return self._known[key]

    def measured(self, sums: FloatArray, sizes: FloatArray, count: int | None = None) -> Measured:
        """A mean, of sums by seed and manoeuvre (S, M) over sizes (M,)."""
        total = np.maximum(self._counts @ sizes, 1e-12)
        values = self._counts @ sums.T / total[:, None]
        generator = np.random.default_rng(self._seed if self.paired else zlib.crc32(sums.tobytes()))
        return self.figure(values, len(sizes) if count is None else count, generator)

    def change(self, first: str, second: str, indicator: str, group: str = "") -> Change:
        """From the second candidate to the first."""
        return Change.of(self.get(first, indicator, group), self.get(second, indicator, group))

    def in_words(self, candidate: str, indicator: str, group: str = "") -> str:
        """The figure with its interval: ``0.12 [0.09, 0.15]``."""
        own = self.get(candidate, indicator, group)
        low, high = own.interval
        return f"{short(own.value)} [{short(low)}, {short(high)}]"

    def of_statistic(
        self, candidate: str, statistic: Callable[[Sequence[Run], FloatArray], float]
    ) -> tuple[float, float, float]:
        """Any figure of a candidate's seeds and how often each manoeuvre counts, with the 2.5 and 97.5 % of 500 resamples."""
        runs = self.runs[candidate]
        generator = np.random.default_rng(self._seed)
        found = []
        for number, counts in enumerate(self._counts[:501]):
            picked = (
                runs
                if number == 0
                else [runs[at] for at in generator.integers(len(runs), size=len(runs))]
            )
            found.append(statistic(picked, counts))
        low, high = np.nanquantile(found[1:], [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
        return found[0], float(low), float(high)


def whole(parts: Sequence[Scored]) -> FloatArray:
    """Errors of a manoeuvre [deg]."""
    return np.concatenate([sideslip_error(part) for part in parts])
