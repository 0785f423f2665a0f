"""Statements of a paper with the comparisons that decide them: relative changes with their intervals, and the verdicts on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import stats

from vehest.constants import FloatArray
from vehest.evaluation.blocks import LEAST_BLOCKS
from vehest.evaluation.significance import CONFIDENCE, Interval, holm
from vehest.report.style import fixed
from vehest_papers.kit.claims import Claim, Verdict

Outcome = Literal["as claimed", "the other way round", "not told apart"]
Expected = Literal["lower", "higher"]


@dataclass(frozen=True, eq=False)
class Measured:
    """A figure of one candidate over all its seeds."""

    value: float  # an error of it, above zero
    draws: FloatArray  # logarithm of it in each resample, blocks and seeds drawn anew, (n,)
    of_each: FloatArray  # its logarithm for each seed alone, (S,)
    n_blocks: int  # blocks of the drive, or drives, that were resampled
    paired: bool = False  # whether the seeds are the very networks of the others it is compared with, and were drawn together with theirs

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, symmetric on a logarithmic axis; NaN where the test has too few blocks."""
        return Change.of(self, None).ends()


@dataclass(frozen=True)
class Change:
    """How a figure stands to another one, or to a limit, as a ratio."""

    log_ratio: float  # its logarithm
    error: float  # standard error of that
    dof: (
        float  # degrees of freedom of Student's t, by Welch and Satterthwaite from blocks and seeds
    )

    @classmethod
    def of(cls, first: Measured, second: Measured | None, limit: float = 1.0) -> Change:
        """Of one figure to another on the same or on another test, or to a limit.

        Figures whose draws are of the same resamples are paired; those of two tests are not.
        """
        draws = first.draws - (second.draws if second is not None else 0.0)
        parts = [own for own in (first, second) if own is not None]
        error = (
            float(np.std(draws)) if min(own.n_blocks for own in parts) >= LEAST_BLOCKS else math.nan
        )
        apart = [own.of_each for own in parts]
        if second is not None and first.paired and second.paired:
            apart = [first.of_each - second.of_each]
        of_seeds = [
            (float(np.var(own, ddof=1)) / len(own), len(own) - 1) for own in apart if len(own) > 1
        ]
        of_blocks = max(error**2 - sum(variance for variance, _ in of_seeds), 0.0)
        terms = [(of_blocks, min(own.n_blocks for own in parts) - 1), *of_seeds]
        spread = sum(variance**2 / max(free, 1) for variance, free in terms)
        dof = sum(variance for variance, _ in terms) ** 2 / spread if spread > 0 else math.inf
        ratio = first.value / (second.value if second is not None else 1.0) / limit
        return cls(math.log(ratio) if ratio > 0 else math.nan, error, dof)

    def p_value(self, beyond: float = 0.0) -> float:
        """Two-sided, of the hypothesis that the relative change is ``beyond``; NaN where nothing is known of it."""
        distance = abs(self.log_ratio - math.log1p(beyond))
        return (
            2.0 * float(stats.t.sf(distance / self.error, self.dof)) if self.error > 0 else math.nan
        )

    def ends(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Ends of the interval of the ratio."""
        half = float(stats.t.ppf(0.5 + confidence / 2.0, self.dof)) * self.error
        return math.exp(self.log_ratio - half), math.exp(self.log_ratio + half)

    def in_percent(self, confidence: float = CONFIDENCE) -> str:
        """In words: ``−24 % [−31, −16]``."""
        low, high = self.ends(confidence)
        value = percent(math.exp(self.log_ratio))
        return (
            f"{value} % [{percent(low)}, {percent(high)}]" if math.isfinite(low) else f"{value} %"
        )

    def as_ratio(self) -> str:
        """The ratio in words: ``2.1 [1.7, 2.6]``."""
        low, high = self.ends()
        value = math.exp(self.log_ratio)
        return (
            f"{short(value)} [{short(low)}, {short(high)}]" if math.isfinite(low) else short(value)
        )

    def in_decibels(self, confidence: float = CONFIDENCE) -> str:
        """The ratio of two powers in words: ``7.1 dB [5.2, 9.0]``."""
        value, low, high = (
            10.0 * math.log10(own) for own in (math.exp(self.log_ratio), *self.ends(confidence))
        )
        return (
            f"{fixed(value, 1)} dB [{fixed(low, 1)}, {fixed(high, 1)}]"
            if math.isfinite(low)
            else f"{fixed(value, 1)} dB"
        )

    def over(self, other: Change) -> Change:
        """The ratio of two ratios that share no resamples."""
        error = math.hypot(self.error, other.error)
        return Change(self.log_ratio - other.log_ratio, error, min(self.dof, other.dof))


def percent(ratio: float) -> str:
    """A ratio as a change in per cent, with its sign: ``−24``, ``+3``; below a half with a decimal, which shows the side of zero."""
    change = 100.0 * (ratio - 1.0)
    decimals = 0 if round(change) else 1
    rounded = round(change, decimals)
    return f"{'+' if rounded > 0 else ''}{fixed(change, decimals)}" if rounded else "0"


def short(value: float) -> str:
    """A positive number in as few digits as tell it apart: two decimals, three below 0.1."""
    return fixed(value, 3 if abs(value) < 0.1 else 2 if abs(value) < 10 else 0)


@dataclass(frozen=True)
class Compared:
    """One comparison."""

    label: str  # which, in the cell of the table; several of one label show the first alone
    change: (
        Change | None
    )  # of what is claimed to be lower, or higher, to the other; none where there is nothing to compare
    expected: Expected = "lower"  # what is claimed of it
    beyond: float = 0.0  # relative change that it is claimed to lie below, or above
    # as a relative change, a ratio of powers in decibels, or a ratio, times ``limit`` where it was divided by that
    shown: Literal["percent", "ratio", "decibels"] = "percent"
    limit: float = 1.0  # see ``shown``

    def in_words(self, confidence: float) -> str:
        """Label and figure with its interval."""
        assert self.change is not None
        if self.shown == "percent":
            words = self.change.in_percent(confidence)
        elif self.shown == "decibels":
            words = self.change.in_decibels(confidence)
        else:
            low, high = self.change.ends(confidence)
            words = short(self.limit * math.exp(self.change.log_ratio))
            if math.isfinite(low):
                words += f" [{short(self.limit * low)}, {short(self.limit * high)}]"
        return f"{self.label} {words}".strip()


@dataclass(frozen=True)
class Statement:
    """A statement of the paper."""

    claim: str  # in a few words
    paper: str  # its figures
    data: str  # what ours come from
    tests: Sequence[Compared]  # that must all come out as claimed
    missing: str = (
        "no such candidates here"  # why it cannot be tested, where nothing is there to compare
    )


def outcomes(tests: Sequence[Compared]) -> list[tuple[Outcome, float]]:
    """What becomes of comparisons that are judged together, corrected by Holm, and the confidence at which their intervals stand."""
    values = [
        own.change.p_value(own.beyond) if own.change is not None else math.nan for own in tests
    ]
    known = [position for position, value in enumerate(values) if math.isfinite(value)]
    adjusted = dict(zip(known, holm([values[position] for position in known]), strict=True))
    found: list[tuple[Outcome, float]] = []
    for position, own in enumerate(tests):
        if position not in adjusted:
            found.append(("not told apart", CONFIDENCE))
            continue
        assert own.change is not None
        factor = (
            max(adjusted[position] / values[position], 1.0)
            if values[position] > 0
            else float(len(known))
        )
        if adjusted[position] >= 1.0 - CONFIDENCE:
            outcome: Outcome = "not told apart"
        else:
            below = own.change.log_ratio < math.log1p(own.beyond)
            outcome = "as claimed" if below == (own.expected == "lower") else "the other way round"
        found.append((outcome, 1.0 - (1.0 - CONFIDENCE) / factor))
    return found


def corrected(differences: Sequence[Interval]) -> list[tuple[Interval, bool]]:
    """Differences of one table with intervals at the level that Holm asks of each, and whether that excludes zero."""
    found = []
    for own, p_value in zip(differences, holm([own.p_value for own in differences]), strict=True):
        factor = max(p_value / own.p_value, 1.0) if own.p_value > 0 else float(len(differences))
        low, high = own.at(1.0 - (1.0 - CONFIDENCE) / factor)
        found.append((replace(own, low=low, high=high), p_value < 1.0 - CONFIDENCE))
    return found


def decided(entries: Sequence[Statement | Claim]) -> list[Claim]:
    """Claims with their verdicts, in order; the comparisons of a statement are corrected together by Holm."""
    claims = []
    for entry in entries:
        if isinstance(entry, Claim):
            claims.append(entry)
            continue
        tests = [test for test in entry.tests if test.change is not None]
        claims.append(
            _claim(
                entry, [(test, *found) for test, found in zip(tests, outcomes(tests), strict=True)]
            )
        )
    return claims


def _claim(statement: Statement, found: Sequence[tuple[Compared, Outcome, float]]) -> Claim:
    if not found:
        return Claim(
            statement.claim,
            statement.paper,
            "–",
            statement.data,
            "not testable on this data",
            statement.missing,
        )
    words = []
    shown = set[str]()
    for test, _, confidence in found:
        if test.label not in shown:
            words.append(test.in_words(confidence))
        shown.add(test.label)
    results = [outcome for _, outcome, _ in found]
    turned = results.count("the other way round")
    open_ones = results.count("not told apart")
    verdict: Verdict = "not reproduced" if turned else "undecided" if open_ones else "reproduced"
    why = "by more than chance"
    if turned or open_ones:
        parts = (
            (len(found) - turned - open_ones, "as claimed"),
            (turned, "contrary"),
            (open_ones, "open"),
        )
        why = ", ".join(f"{number} {word}" for number, word in parts if number)
    return Claim(statement.claim, statement.paper, "; ".join(words), statement.data, verdict, why)


def counted(claim: str, paper: str, ours: str, data: str, found: Sequence[bool], why: str) -> Claim:
    """A claim that every one of some cases is to show: all, none or some of them."""
    if not found:
        return Claim(claim, paper, "–", data, "not testable on this data", "nothing to compare")
    verdict: Verdict = (
        "reproduced" if all(found) else "not reproduced" if not any(found) else "undecided"
    )
    return Claim(claim, paper, ours, data, verdict, why)
