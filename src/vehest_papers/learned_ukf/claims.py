"""The first page: what the paper claims, each claim with the rule by which it gets its verdict, and what came out here.

All claims and rules below were fixed before any test figure of this study was computed:

- **A pair** (`PAIRS`): one method has the lower weighted MSE of two. Difference of the mean losses over all seeds and sequences, paired
  block bootstrap over whole sequences and over seeds, corrected by Holm within the pairs of a test. Reproduced if the corrected interval
  lies on the paper's side of zero, not reproduced if it lies on the other side, undecided if it holds zero. NNTF_UH* and NNTF_UH
  have the same weights: their difference is taken seed by seed.
- **A factor** (`FACTORS`): the loss is at most so many times the other's; the 95 % interval of the ratio against the factor.
- **A percentile** (`PERCENTILES`): the same of the 99th percentile of the weighted absolute error, its interval by the same resampling.
- **A state** of Figure 5 counts as lower or higher where the 95 % interval of the difference of mean squares leaves zero out; a claim about
  several states is reproduced if all are as claimed, not reproduced if one is the other way round, else undecided.
- **Friction**: converged as soon as it stays within `TOLERANCE` of its mean over the last two seconds of the sequence; the claim is
  reproduced if the interval of the median time lies below the unscored two seconds, and, of the final value, if its interval lies
  within `NEAR` of the paper's nominal value; not reproduced if the interval lies beyond; else undecided.
- **Instability**: reproduced if at least half of the seeds lose a sequence without repair, not reproduced if none does, else undecided.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from scipy import stats

from vehest.evaluation.significance import CONFIDENCE, Interval
from vehest.report.style import fixed
from vehest_papers.kit.claims import Claim, Verdict, verdict_below, verdict_of_all
from vehest_papers.kit.reading import with_interval
from vehest_papers.kit.statements import corrected
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.candidates import SETS
from vehest_papers.learned_ukf.errors import Losses

TOLERANCE = 0.05  # of the friction
NEAR = 0.1  # of the paper's nominal friction

A = "tyre_a"
D = "tyre_d"

PAIRS: Mapping[str, Sequence[tuple[str, str]]] = {
    A: (
        (paper.NNTF_UH, paper.GRU),
        (paper.NNTF_UH, paper.LSTM),
        (paper.NN_U, paper.NN),
        (paper.NNT_U, paper.NNT),
        (paper.NNTF_U, paper.NNTF),
        (paper.NNTF_UH, paper.NNTF_U),
        (paper.NNTF, paper.NNT),
        (paper.NNTF_U, paper.NNT_U),
        (paper.NN_U, paper.NNTF_UH),
        (paper.NNTF, paper.PC),
    ),
    D: (
        (paper.NNTF_UH, paper.GRU),
        (paper.NNTF_UH, paper.LSTM),
        (paper.NNTF_UH, paper.NN_U),
        (paper.NNTF, paper.PCR),
        (paper.NNTF_U, paper.NNTF),
        (paper.NNTF_UH, paper.NNTF_U),
        (paper.NNTF_UH_LOW, paper.NNTF_UH),
    ),
}
"""Test set -> (lower in the paper, higher in the paper), of weighted MSE."""

FACTORS: Sequence[tuple[str, str, str, float, str]] = (
    (A, paper.NNTF_UH, paper.GRU, 0.83, "17 % below"),
    (D, paper.NNTF_UH, paper.NN, 1.0 / 3.0, "3 times smaller"),
    (D, paper.NNTF_UH, paper.GRU, 1.0 / 4.0, "4 times smaller"),
)
"""Test set, method, other method, largest ratio of their MSE, the paper's words."""

PERCENTILES: Sequence[tuple[str, str, str]] = (
    (A, paper.NNTF_UH, paper.GRU),
    (A, paper.NNTF_UH, paper.LSTM),
)
"""Test set, lower and higher 99th percentile of the weighted absolute error."""


def verdict_of(low: float, high: float, limit: float = 0.0) -> tuple[Verdict, str]:
    """Of a figure that the paper has below a limit."""
    verdict = verdict_below(low, high, limit)
    words = {
        "reproduced": "below",
        "not reproduced": "above",
        "undecided": "holds" if not limit else "holds the limit",
    }[verdict]
    return verdict, f"interval {words}{'' if limit else ' zero'}"


def pair_claims(errors: Losses, test: str, data: str) -> list[Claim]:
    """Those of `PAIRS` on a test, corrected by Holm among themselves."""
    pairs = [pair for pair in PAIRS[test] if all(name in errors.squared for name in pair)]
    found = corrected([errors.of_pair(first, second) for first, second in pairs])
    claims = []
    for (first, second), (own, _) in zip(pairs, found, strict=True):
        verdict, why = verdict_of(own.low, own.high)
        known = paper.TABLES[test]
        words = (
            f"{fixed(known[first].mse, 4)} and {fixed(known[second].mse, 4)}"
            if first in known and second in known
            else "–"
        )
        values = " and ".join(
            fixed(float(errors.squared[name].mean()), 4) for name in (first, second)
        )
        ours = f"{values}; difference {with_interval(own.value, own.low, own.high, 4)}"
        claims.append(
            Claim(
                f"{first} below {second}",
                words + _tyre_c(test),
                ours,
                f"{data}, {SETS[test]}",
                verdict,
                why,
            )
        )
    return claims


def factor_claims(errors: Mapping[str, Losses], data: str) -> list[Claim]:
    """Those of `FACTORS`."""
    claims = []
    for test, first, second, limit, words in FACTORS:
        if first not in errors[test].squared or second not in errors[test].squared:
            continue
        value, low, high = errors[test].ratio(first, second)
        verdict, why = verdict_of(low, high, limit)
        claim = f"{first}'s MSE at most {fixed(limit, 2)} of {second}'s"
        claims.append(
            Claim(
                claim,
                words + _tyre_c(test),
                with_interval(value, low, high, 2),
                f"{data}, {SETS[test]}",
                verdict,
                why,
            )
        )
    return claims


def percentile_claims(errors: Mapping[str, Losses], data: str) -> list[Claim]:
    """Those of `PERCENTILES`."""
    claims = []
    for test, first, second in PERCENTILES:
        if first not in errors[test].absolute or second not in errors[test].absolute:
            continue
        own = errors[test].percentile(first, second)
        verdict, why = verdict_of(own.low, own.high)
        known = [paper.TABLES[test][name].ae99 for name in (first, second)]
        words = " and ".join(fixed(value, 3) for value in known)
        ours = f"difference {with_interval(own.value, own.low, own.high, 3)}"
        claims.append(
            Claim(
                f"99%-AE of {first} below {second}'s",
                words,
                ours,
                f"{data}, {SETS[test]}",
                verdict,
                why,
            )
        )
    return claims


def friction_claims(median: Interval, final: Interval, data: str) -> list[Claim]:
    """How fast the friction of NNTF_UH converges on the unseen tyre from the start it was trained with, and to what."""
    nominal = paper.NOMINAL_FRICTION[D]
    fast, why = verdict_of(median.low, median.high, 2.0)
    low = nominal - NEAR
    high = nominal + NEAR
    near: Verdict = "undecided"
    if low < final.low and final.high < high:
        near = "reproduced"
    elif final.high < low or final.low > high:
        near = "not reproduced"
    words = {
        "reproduced": "interval within",
        "not reproduced": "interval beyond",
        "undecided": "interval holds a limit",
    }
    time = f"{with_interval(median.value, median.low, median.high, 2)} s"
    end = with_interval(final.value, final.low, final.high, 2)
    where = f"{data}, tyre D"
    return [
        Claim(
            "friction converges rapidly: median time below 2 s",
            "Figure 4, tyre C",
            time,
            where,
            fast,
            why,
        ),
        Claim(
            f"friction ends within {NEAR:g} of its nominal {nominal:g}",
            "Figure 4, tyre C, 0.43",
            end,
            where,
            near,
            words[near],
        ),
    ]


def instability_claims(lost: Mapping[str, Sequence[tuple[int, int]]], data: str) -> list[Claim]:
    """That the tyre network without friction becomes unstable on the unseen tyre; ``lost``: sequences lost without repair, and all."""
    claims = []
    for method, seeds in lost.items():
        bad = sum(own > 0 for own, _ in seeds)
        k = sum(own for own, _ in seeds)
        n = sum(own for _, own in seeds)
        ends = stats.binomtest(k, n).proportion_ci(CONFIDENCE)
        verdict: Verdict = (
            "reproduced" if 2 * bad >= len(seeds) else "not reproduced" if not bad else "undecided"
        )
        ours = f"{k} of {n} sequences lost, {100 * k / n:.0f} % [{100 * ends.low:.0f}, {100 * ends.high:.0f}]"
        why = f"{bad} of {len(seeds)} seeds lose one, unrepaired"
        claims.append(
            Claim(
                f"{method} becomes unstable",
                "a dash, tyre C",
                ours,
                f"{data}, tyre D",
                verdict,
                why,
            )
        )
    return claims


def states_claim(
    claim: str, words: str, expected: Mapping[str, tuple[Interval, float, bool]], data: str
) -> Claim:
    """About several states of Figure 5: difference of mean squares NNTF_U - NNTF, the error of NNTF, and whether the paper has it lower."""
    verdicts = []
    shown = []
    for state, (own, before, lower) in expected.items():
        verdicts.append(
            verdict_below(own.low, own.high) if lower else verdict_below(-own.high, -own.low)
        )
        low, value, high = (100.0 * end / before for end in (own.low, own.value, own.high))
        shown.append(f"{state.replace('_', ' ')} {with_interval(value, low, high, 0)} %")
    verdict = verdict_of_all(verdicts)
    words_of = {
        "reproduced": "all as claimed",
        "not reproduced": "one interval contradicts the claim",
        "undecided": "not all are told apart",
    }
    return Claim(claim, words, "; ".join(shown), data, verdict, words_of[verdict])


def difference_claim(
    claim: str, words: str, own: Interval, values: tuple[float, float], data: str
) -> Claim:
    """That the first of two mean losses is the lower one, by the 95 % interval of the difference."""
    verdict, why = verdict_of(own.low, own.high)
    shown = " and ".join(fixed(value, 4) for value in values)
    return Claim(
        claim,
        words,
        f"{shown}; difference {with_interval(own.value, own.low, own.high, 4)}",
        data,
        verdict,
        why,
    )


def not_testable(*, timed: bool = False) -> list[Claim]:
    """Claims that these files cannot test; ``timed``: the length of training sequences has a row of its own."""
    untestable: Verdict = "not testable on this data"
    rows = (
        ("every figure of Table II itself", "tyre C", "no recordings of tyre C; tyre D stands in"),
        (
            "RMS errors 0.062 and 0.070 m/s on tyre A",
            "0.062; 0.070 m/s",
            "the test is another part of tyre A's recordings",
        ),
        ("99th percentile of rear slip beyond 40°", "40°", "only 3 of the data set's files"),
        *(
            ()
            if timed
            else (
                (
                    "longer training sequences take longer an epoch",
                    "Figure 7",
                    "times are in no published file",
                ),
            )
        ),
    )
    return [Claim(claim, words, "–", "none", untestable, why) for claim, words, why in rows]


def _tyre_c(test: str) -> str:
    return ", tyre C" if test == D else ""
