"""Statements of the paper with the comparisons that decide them, and what becomes of them together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vehest.evaluation.significance import holm
from vehest.studies.kit.claims import Claim, Verdict
from vehest_papers.ksnn.comparing import CONFIDENCE, Change, short

Outcome = Literal["as claimed", "the other way round", "not told apart"]
Expected = Literal["lower", "higher"]


@dataclass(frozen=True)
class Compared:
    """One comparison.

    Args:
        label: which, in the cell of the table; several of one label show the first alone.
        change: of what is claimed to be lower, or higher, to the other; none where there is nothing to compare.
        expected: what is claimed of it.
        beyond: relative change that it is claimed to lie below, or above.
        shown: as a relative change, a ratio of powers in decibels, or a ratio, times ``limit`` where it was divided by that.
        limit: see ``shown``.
    """

    label: str
    change: Change | None
    expected: Expected = "lower"
    beyond: float = 0.0
    shown: Literal["percent", "ratio", "decibels"] = "percent"
    limit: float = 1.0

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
    """A statement of the paper.

    Args:
        claim: in a few words.
        paper: its figures.
        data: what ours come from.
        tests: that must all come out as claimed.
        missing: why it cannot be tested, where nothing is there to compare.
    """

    claim: str
    paper: str
    data: str
    tests: Sequence[Compared]
    missing: str = "no such candidates here"


def outcomes(tests: Sequence[Compared]) -> list[tuple[Outcome, float]]:
    """What becomes of comparisons that are judged together, corrected by Holm, and the confidence at which their intervals stand."""
    values = [own.change.p_value(own.beyond) if own.change is not None else math.nan for own in tests]
    known = [position for position, value in enumerate(values) if math.isfinite(value)]
    adjusted = dict(zip(known, holm([values[position] for position in known]), strict=True))
    found: list[tuple[Outcome, float]] = []
    for position, own in enumerate(tests):
        if position not in adjusted:
            found.append(("not told apart", CONFIDENCE))
            continue
        assert own.change is not None
        factor = max(adjusted[position] / values[position], 1.0) if values[position] > 0 else float(len(known))
        if adjusted[position] >= 1.0 - CONFIDENCE:
            outcome: Outcome = "not told apart"
        else:
            below = own.change.log_ratio < math.log1p(own.beyond)
            outcome = "as claimed" if below == (own.expected == "lower") else "the other way round"
        found.append((outcome, 1.0 - (1.0 - CONFIDENCE) / factor))
    return found


def decided(entries: Sequence[Statement | Claim]) -> list[Claim]:
    """Claims with their verdicts, in order; the comparisons of a statement are corrected together by Holm."""
    claims = []
    for entry in entries:
        if isinstance(entry, Claim):
            claims.append(entry)
            continue
        tests = [test for test in entry.tests if test.change is not None]
        claims.append(_claim(entry, [(test, *found) for test, found in zip(tests, outcomes(tests), strict=True)]))
    return claims


def _claim(statement: Statement, found: Sequence[tuple[Compared, Outcome, float]]) -> Claim:
    if not found:
        return Claim(statement.claim, statement.paper, "–", statement.data, "not testable on this data", statement.missing)
    words, shown = [], set[str]()
    for test, _, confidence in found:
        if test.label not in shown:
            words.append(test.in_words(confidence))
        shown.add(test.label)
    results = [outcome for _, outcome, _ in found]
    turned, open_ones = results.count("the other way round"), results.count("not told apart")
    verdict: Verdict = "not reproduced" if turned else "undecided" if open_ones else "reproduced"
    why = "by more than chance"
    if turned or open_ones:
        parts = ((len(found) - turned - open_ones, "as claimed"), (turned, "contrary"), (open_ones, "open"))
        why = ", ".join(f"{number} {word}" for number, word in parts if number)
    return Claim(statement.claim, statement.paper, "; ".join(words), statement.data, verdict, why)


def counted(claim: str, paper: str, ours: str, data: str, found: Sequence[bool], why: str) -> Claim:
    """A claim that every one of some cases is to show: all, none or some of them."""
    if not found:
        return Claim(claim, paper, "–", data, "not testable on this data", "nothing to compare")
    verdict: Verdict = "reproduced" if all(found) else "not reproduced" if not any(found) else "undecided"
    return Claim(claim, paper, ours, data, verdict, why)
