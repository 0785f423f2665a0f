"""What a paper claims, held against what came out: the table on the first page of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import pandas as pd

from vehest.evaluation.ranking import Name, Ranking
from vehest.report.document import Column, Table
from vehest.report.style import fixed
from vehest_papers.kit.reading import with_interval

Verdict = Literal["reproduced", "not reproduced", "undecided", "not testable on this data"]

_COLUMNS = {
    "claim": "claim",
    "paper": "paper",
    "ours": "ours, with 95 % interval",
    "data": "data",
    "verdict": "verdict",
    "why": "why",
}


@dataclass(frozen=True)
class Claim:
    """One claim and what became of it."""

    claim: str  # what is claimed, of what, in a few words
    paper: str  # the paper's figure, in words
    ours: str  # our figure with its interval, in words
    data: str  # what ours comes from: ``real`` or ``simulated``, and which test
    verdict: Verdict  # whether the claim came out
    why: str  # what decided, in a clause


def claims_table(claims: Sequence[Claim], note: str = "") -> Table:
    """Table ``claims``: claim, paper, ours with interval, data, verdict."""
    rows = pd.DataFrame([asdict(own) for own in claims], columns=list(_COLUMNS))
    number = {verdict: sum(own.verdict == verdict for own in claims) for verdict in _VERDICTS}
    counts = (
        ", ".join(f"{n} {verdict}" for verdict, n in number.items() if n) or "nothing to compare"
    )
    caption = f"What the paper claims and what came out here: {counts}. {_RULE} {note}".strip()
    return Table("claims", caption, rows, {name: Column(title) for name, title in _COLUMNS.items()})


def order_claim(
    ranking: Ranking, lower: Name, higher: Name, titles: Mapping[Name, str], paper: str, data: str
) -> Claim:
    """The claim that ``lower`` has the lower RMSE(β) of two estimators, by the corrected interval of their difference."""
    claim = f"{titles[lower]} below {titles[higher]}"
    own = ranking.pairs.get((lower, higher))
    if own is None:
        missing = [titles[name] for name in (lower, higher) if name not in ranking.rmse]
        why = (
            f"no finite error of {' and '.join(missing)}"
            if missing
            else f"the test has {ranking.n_blocks} blocks only"
        )
        return Claim(claim, paper, "–", data, "not testable on this data", why)
    difference = with_interval(own.difference, own.low, own.high, 3, "°")
    figures = f"{fixed(ranking.rmse[lower], 3)}° and {fixed(ranking.rmse[higher], 3)}°; difference {difference}"
    verdict, why = _OF_ORDER[own.verdict]
    return Claim(claim, paper, figures, data, verdict, why)


def bound_claim(
    ranking: Ranking, name: Name, title: str, limit: float, paper: str, data: str
) -> Claim:
    """The claim that an estimator's RMSE(β) lies below a limit [deg], by the 95 % interval of its RMSE over blocks and seeds."""
    claim = f"{title} below {fixed(limit, 2)}°"
    if name not in ranking.intervals:
        return Claim(
            claim,
            paper,
            "–",
            data,
            "not testable on this data",
            f"the test has {ranking.n_blocks} blocks only",
        )
    low, high = ranking.intervals[name]
    verdict = verdict_below(low, high, limit)
    why = {"reproduced": "the interval lies below", "not reproduced": "the interval lies above"}
    words = why.get(verdict, "the interval holds the limit")
    return Claim(
        claim, paper, with_interval(ranking.rmse[name], low, high, 3, "°"), data, verdict, words
    )


def verdict_below(low: float, high: float, limit: float = 0.0) -> Verdict:
    """Of the claim that a figure lies below a limit, by its interval."""
    return "reproduced" if high < limit else "not reproduced" if low > limit else "undecided"


def verdict_of_all(verdicts: Sequence[Verdict]) -> Verdict:
    """Of a claim on several figures: reproduced if all are, not reproduced if one is not, else undecided."""
    if "not reproduced" in verdicts:
        return "not reproduced"
    return "reproduced" if set(verdicts) == {"reproduced"} else "undecided"


_VERDICTS: tuple[Verdict, ...] = (
    "reproduced",
    "not reproduced",
    "undecided",
    "not testable on this data",
)
_OF_ORDER: dict[str, tuple[Verdict, str]] = {
    "lower": ("reproduced", "the corrected interval of the difference lies below zero"),
    "higher": ("not reproduced", "the corrected interval of the difference lies above zero"),
    "not told apart": ("undecided", "the corrected interval of the difference holds zero"),
}
_RULE = "Intervals: paired block bootstrap; those of differences are corrected by Holm within their test."
