"""The paper's statements on its methods, one entry each, with the comparisons that decide it; rules: docs/cnn_ukf.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import stats

from vehest.constants import FloatArray
from vehest.report.style import fixed
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.limited import AS_TUNED, OF_THE_FULL_SET, Limited
from vehest_papers.cnn_ukf.manoeuvres import GROUPS, is_nonlinear
from vehest_papers.cnn_ukf.measures import ME, ME_NL, MSE, MSE_NL, ManoeuvreErrors, whole
from vehest_papers.cnn_ukf.networks import Outputs
from vehest_papers.cnn_ukf.perturbed import NOMINAL, Perturbed
from vehest_papers.cnn_ukf.subjects import Run
from vehest_papers.kit.claims import Claim, Verdict, verdict_below, verdict_of_all
from vehest_papers.kit.reading import with_interval
from vehest_papers.kit.statements import Change, Compared, Expected, Measured, Statement, short

LEVEL = 0.10
UNCLAIMED = "not in it"  # in the place of the paper's figure, where it claims nothing
HEADERS = {MSE: "MSE", MSE_NL: "MSE_nl", ME: "ME", ME_NL: "ME_nl"}
WEAK = ("braking in the turn", "J-turn", "skidpad")
AROUND_PEAK = 10  # samples before and after
HIGH = 5.0
LOW = 1.0  # deg of |β|
OutputsOf = Mapping[
    str, Sequence[Sequence[Outputs]]
]  # hybrid -> outputs of its networks, seed by seed, manoeuvre by manoeuvre


def on_accuracy(main: ManoeuvreErrors, data: str) -> list[Statement | Claim]:
    """Table II, Figures 5 to 7."""
    found: list[Statement | Claim] = []
    for indicator, header in HEADERS.items():
        tests = [
            Compared(other, main.change(paper.CNN, other, indicator))
            for other in (paper.MODEL, paper.DATA, paper.DEEP)
        ]
        known = ", ".join(
            _known(paper.CNN, other, indicator) for other in (paper.MODEL, paper.DATA, paper.DEEP)
        )
        found.append(Statement(f"CNN-UKF lowest: {header}", f"{known} %", data, tests))
    below = [
        Compared(HEADERS[own], Change.of(main.get(paper.CNN, own), None), "lower", shown="ratio")
        for own in (ME, ME_NL)
    ]
    found.append(Statement("CNN-UKF's ME and ME_nl below 1°", "0.979°, 0.776°", data, below))
    tests = [
        Compared(f"{HEADERS[indicator]} {other}", main.change(paper.DEEP, other, indicator))
        for indicator in (MSE, ME, ME_NL)
        for other in (paper.MODEL, paper.DATA)
    ]
    found.append(
        Statement("DE-UKF below model and data-driven: MSE, ME, ME_nl", "−9 to −46 %", data, tests)
    )
    found.append(
        level(
            "DE-UKF level with data-driven: MSE_nl",
            "0 %",
            data,
            main.change(paper.DEEP, paper.DATA, MSE_NL),
        )
    )
    kinds: tuple[tuple[str, Expected], ...] = (
        (MSE, "higher"),
        (MSE_NL, "higher"),
        (ME, "lower"),
        (ME_NL, "lower"),
    )
    tests = [
        Compared(HEADERS[own], main.change(paper.MODEL, paper.DATA, own), expected)
        for own, expected in kinds
    ]
    found.append(
        Statement(
            "model above data-driven in MSE, MSE_nl, below it in ME, ME_nl",
            "+68, +76, −14, −12 %",
            data,
            tests,
        )
    )
    found += [_narrowest(main, data), _nearest_zero(main, data), _groups(main, data)]
    tests = [
        Compared(group, main.change(paper.MODEL, paper.CNN, MSE_NL, group), "higher")
        for group in WEAK
        if group in main.groups
    ]
    found.append(
        Statement(
            "model weak in braking, J-turn, skidpad: MSE_nl above CNN-UKF's", "Fig. 6", data, tests
        )
    )
    found.append(_peaks(main, data))
    return found


def on_parts(main: ManoeuvreErrors, data: str) -> list[Statement | Claim]:
    """Why: training through the filter, adaptive noise, the pseudo-measurement; and what the paper does not compare with."""

    def without(
        name: str, words: str, known: str, indicators: Sequence[str] = (MSE_NL,)
    ) -> Statement:
        tests = [
            Compared(HEADERS[own], main.change(paper.CNN, name, own))
            for own in indicators
            if name in main
        ]
        return Statement(words, known, data, tests, "not trained here")

    entries = [
        without(
            paper.BEFORE,
            "training through the filter lowers MSE and MSE_nl",
            "“mutualistic”",
            (MSE, MSE_NL),
        ),
        without(
            "process noise constant", "adaptive process noise lowers MSE_nl", "“helps improve”"
        ),
        without("σ_DD constant", "adaptive distrust lowers MSE_nl", "“best level of distrust”"),
        without(
            "without pseudo-measurement", "the pseudo-measurement lowers MSE_nl", "“guides it”"
        ),
        without(paper.PLAIN, "smooth tyres in CNN-UKF lower MSE_nl", UNCLAIMED),
    ]
    for hybrid, own_filter in paper.OWN_FILTER.items():
        if hybrid in main and own_filter in main:
            tests = [
                Compared(HEADERS[own], main.change(hybrid, own_filter, own))
                for own in (MSE, MSE_NL)
            ]
            entries.append(Statement(f"{hybrid} below its own filter", UNCLAIMED, data, tests))
    if paper.SMOOTH in main:
        tests = [
            Compared(HEADERS[own], main.change(paper.SMOOTH, paper.MODEL, own))
            for own in (MSE, MSE_NL)
        ]
        entries.append(
            Statement("smooth tyres better than plain in the filter alone", UNCLAIMED, data, tests)
        )
    if paper.FREE in main:
        tests = [
            Compared(HEADERS[own], main.change(paper.CNN, paper.FREE, own)) for own in (MSE, MSE_NL)
        ]
        entries.append(
            Statement("CNN-UKF below a filter alone with free noise", UNCLAIMED, data, tests)
        )
    others = [name for name in (paper.ZERO, paper.STATIC_MAP, paper.DATA_SHEET) if name in main]
    tests = [Compared(name, main.change(paper.CNN, name, MSE)) for name in others]
    entries.append(
        Statement("MSE of CNN-UKF below v = 0, static map, data sheet", UNCLAIMED, data, tests)
    )
    for name, words, known in (
        (
            paper.Z_SCORES,
            "III-A: inputs in [0, 1] better than z-scores (data-driven)",
            "“best results”",
        ),
        (
            paper.RECURRENT,
            "IV-C: data-driven below a recurrent network, both with tyre forces",
            "cited",
        ),
    ):
        tests = [
            Compared(HEADERS[own], main.change(paper.DATA, name, own))
            for own in (MSE, MSE_NL)
            if name in main
        ]
        entries.append(Statement(words, known, data, tests, "not trained here"))
    return list(entries)


def on_networks(main: ManoeuvreErrors, outputs: OutputsOf, data: str) -> list[Statement | Claim]:
    """Figure 8: distrust and process noise."""
    found: list[Statement | Claim] = []
    correlations = []
    words = []
    for hybrid in paper.HYBRIDS:
        value, low, high = _over_samples(main, outputs[hybrid], _rank_correlation)
        correlations.append((low, high))
        words.append(f"{hybrid} {with_interval(value, low, high, 2)}")
    found.append(
        _of_ends(
            "σ_DD rises with the network's error (rank correlation)",
            "Fig. 8c",
            "; ".join(words),
            data,
            correlations,
            0.0,
        )
    )
    value, low, high = _over_samples(main, outputs[paper.CNN], _decades)
    other, other_low, other_high = _over_samples(main, outputs[paper.DEEP], _decades)
    ours = (
        f"{with_interval(value, low, high, 1)} and {with_interval(other, other_low, other_high, 1)}"
    )
    apart: Verdict = (
        "reproduced" if low > other_high else "not reproduced" if high < other_low else "undecided"
    )
    found.append(
        Claim(
            "CNN-UKF's σ_DD spans more decades than DE-UKF's (1 to 99 %)",
            "3 and 1",
            ours,
            data,
            apart,
            "intervals",
        )
    )
    for words_of_claim, known, statistic, limit in (
        (
            "σ_ψ̇ rises by two decades where |β| ≥ 5° (ratio of medians to below 1°)",
            "100",
            _rise_of_yaw_rate,
            100.0,
        ),
        ("σ_Vy rises where non-linear (ratio of medians)", "rises", _rise_of_vy, 1.0),
    ):
        value, low, high = _over_samples(main, outputs[paper.CNN], statistic)
        ours = f"{short(value)} [{short(low)}, {short(high)}]"
        found.append(_of_ends(words_of_claim, known, ours, data, [(low, high)], limit))
    return found


def on_robustness(found: Perturbed, data: str) -> list[Statement | Claim]:
    """Figure 14."""
    comparisons = [ManoeuvreErrors(runs, "test", paired=True) for runs in found.stiffness]
    rises = {}
    for candidate in (paper.MODEL, *paper.HYBRIDS):
        worst = max(comparisons, key=lambda own, candidate=candidate: own.get(candidate, MSE).value)  # type: ignore[misc]
        rises[candidate] = _difference(worst, comparisons[NOMINAL], candidate)
    entries: list[Statement | Claim] = [
        Statement(
            "±10 % stiffness: the hybrids' worst MSE rises less than the model's",
            "Fig. 14",
            data,
            [
                Compared(hybrid, Change.of(rises[hybrid], rises[paper.MODEL]))
                for hybrid in paper.HYBRIDS
            ],
        ),
        Statement(
            "DE-UKF's rises less than CNN-UKF's",
            "Fig. 14",
            data,
            [Compared("", Change.of(rises[paper.DEEP], rises[paper.CNN]))],
        ),
    ]
    unpaired = [ManoeuvreErrors(runs, "test") for runs in found.stiffness]
    changes = [own.change(paper.CNN, paper.DEEP, MSE_NL) for own in unpaired]
    verdicts = [verdict_below(*own.ends(), 1.0) for own in changes]
    below = verdicts.count("reproduced")
    above = verdicts.count("not reproduced")
    low = min(own.ends()[0] for own in changes)
    high = max(own.ends()[1] for own in changes)
    ours = f"below in {below}, above in {above} of {len(changes)}; −{short(100 * (1 - low))} to {short(100 * (high - 1))} %"
    entries.append(
        Claim(
            "CNN-UKF below DE-UKF in MSE_nl in all nine combinations",
            "all",
            ours,
            data,
            verdict_of_all(verdicts),
            "intervals",
        )
    )
    if found.tuned:
        own = ManoeuvreErrors(
            {"tuned": found.tuned, "as trained": found.stiffness[0][paper.DEEP]}, "test"
        )
        words = "MSE_nl lower with p₁, p₂ tuned anew where stiffness is off by −10 %"
        tests = own.change("tuned", "as trained", MSE_NL)
        entries.append(Statement(words, "IV-C", data, [Compared("", tests)]))
    return entries


def on_limited(limited: Limited | None, data: str) -> list[Statement | Claim]:
    """Table III and Figure 13; filters are those of the full set."""
    if limited is None:
        words = (
            "limited set: data-driven last",
            "limited set: hybrids level with the model",
            "limited set: CNN-UKF's β_DD below DE-UKF's",
            "limited set: p₁, p₂ want tuning anew",
        )
        known = ("+29 %", "−3 %", "Fig. 13", "IV-C")
        return [
            Claim(own, there, "–", "none", "not testable on this data", "not trained here")
            for own, there in zip(words, known, strict=True)
        ]
    own = limited.comparison
    last = [
        Compared(
            f"{HEADERS[indicator]} {other}", own.change(paper.DATA, other, indicator), "higher"
        )
        for indicator in (MSE, MSE_NL)
        for other in (paper.MODEL, *paper.HYBRIDS)
    ]
    angles = {name: own.measured(*squares(limited.outputs[name])) for name in paper.HYBRIDS}
    tuned = limited.scaling.change(AS_TUNED, OF_THE_FULL_SET, MSE_NL)
    return [
        Statement("limited set: data-driven last: MSE, MSE_nl", "+29 to +43 %", data, last),
        *[
            level(
                f"limited set: {hybrid} level with the model: MSE_nl",
                "−3 %",
                data,
                own.change(hybrid, paper.MODEL, MSE_NL),
            )
            for hybrid in paper.HYBRIDS
        ],
        Statement(
            "limited set: MSE of CNN-UKF's β_DD below DE-UKF's",
            "Fig. 13",
            data,
            [Compared("", Change.of(angles[paper.CNN], angles[paper.DEEP]))],
        ),
        Statement(
            "limited set: MSE_nl lower with p₁, p₂ tuned anew", "IV-C", data, [Compared("", tuned)]
        ),
    ]


def not_testable() -> list[Claim]:
    """Claims that this data cannot test."""
    entries = (
        ("errors on the BMW's recordings", "Tables II, III", "the recordings are not public"),
        (
            "intelligent bearings as good as wheel force transducers",
            "cited",
            "no such sensors here",
        ),
    )
    return [
        Claim(words, known, "–", "none", "not testable on this data", why)
        for words, known, why in entries
    ]


def level(words: str, known: str, data: str, change: Change) -> Claim:
    """The claim that two figures are level: within ±10 %, by the interval of their relative change."""
    return Claim(
        words, known, change.in_percent(), data, _level(change), f"against ±{100 * LEVEL:.0f} %"
    )


def _level(change: Change) -> Verdict:
    low, high = change.ends()
    within = low >= 1.0 - LEVEL and high <= 1.0 + LEVEL
    without = high < 1.0 - LEVEL or low > 1.0 + LEVEL
    return "reproduced" if within else "not reproduced" if without else "undecided"


def is_own_filter(main: ManoeuvreErrors, hybrid: str, shift: float) -> bool:
    """Whether a hybrid is to be called its own filter: it hardly listens, or its errors are level with its filter's."""
    if shift < 0.05:
        return True
    own = paper.OWN_FILTER[hybrid]
    return own in main and all(
        _level(main.change(hybrid, own, indicator)) == "reproduced" for indicator in (MSE, MSE_NL)
    )


def _known(first: str, second: str, indicator: str) -> str:
    one, other = (getattr(paper.TABLE_II[name], indicator) for name in (first, second))
    change = 100.0 * (one / other - 1.0)
    return fixed(change, 0 if abs(change) >= 1 else 1)


def _of_ends(
    words: str, known: str, ours: str, data: str, ends: Sequence[tuple[float, float]], limit: float
) -> Claim:
    """The claim that all of some figures lie above a limit, by their intervals."""
    verdict = verdict_of_all([verdict_below(-high, -low, -limit) for low, high in ends])
    return Claim(words, known, ours, data, verdict, f"against {limit:g}")


def _nonlinear_moments(run: Run) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each manoeuvre, where |ay| ≥ 4 m/s²: sum of errors, of their squares, and number, (M,) each."""
    rows = []
    for parts in run.test.values():
        error = whole(parts)[np.concatenate([is_nonlinear(part) for part in parts])]
        rows.append((error.sum(), np.square(error).sum(), len(error)))
    first, second, count = np.array(rows, dtype=np.float64).T
    return first, second, count


def _narrowest(main: ManoeuvreErrors, data: str) -> Statement:
    """Standard deviations of the error where non-linear, over all manoeuvres (Figure 5)."""
    spread = {}
    for name in paper.OF_FOUR:
        seeds = []
        for run in main.runs[name]:
            first, second, count = _nonlinear_moments(run)
            seeds.append(
                second
                - count
                * (first.sum() / count.sum())
                * (2.0 * first / np.maximum(count, 1.0) - first.sum() / count.sum())
            )
        spread[name] = main.measured(np.stack(seeds), count)
    tests = [
        Compared(name, Change.of(spread[paper.CNN], spread[name]))
        for name in (paper.MODEL, paper.DATA, paper.DEEP)
    ]
    return Statement(
        "Fig. 5: CNN-UKF's errors spread least (variance, non-linear)", "lowest s.d.", data, tests
    )


def _nearest_zero(main: ManoeuvreErrors, data: str) -> Claim:
    """Means of the error where non-linear (Figure 5)."""

    def statistic(runs: Sequence[Run], counts: FloatArray) -> float:
        moments = [_nonlinear_moments(run) for run in runs]
        return float(
            np.mean(
                [
                    float(counts @ first) / max(float(counts @ count), 1.0)
                    for first, _, count in moments
                ]
            )
        )

    means = {name: main.of_statistic(name, statistic) for name in paper.OF_FOUR}
    ours = "; ".join(f"{name} {with_interval(*own, 3)}°" for name, own in means.items())
    farthest = {name: max(abs(low), abs(high)) for name, (_, low, high) in means.items()}
    nearest = {
        name: 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
        for name, (_, low, high) in means.items()
    }
    largest = farthest.pop(paper.CNN)
    least = nearest.pop(paper.CNN)
    verdict: Verdict = "undecided"
    if largest < min(nearest.values()) or least > min(farthest.values()):
        verdict = "reproduced" if largest < min(nearest.values()) else "not reproduced"
    return Claim(
        "Fig. 5: CNN-UKF's mean error nearest zero (non-linear)",
        "yes",
        ours,
        data,
        verdict,
        "intervals",
    )


def _groups(main: ManoeuvreErrors, data: str) -> Claim:
    """In how many groups of manoeuvres CNN-UKF has the lowest MSE_nl of the four (Figure 6)."""
    groups = [group for group in GROUPS.values() if group in main.groups]
    of_four = {group: [main.get(name, MSE_NL, group) for name in paper.OF_FOUR] for group in groups}
    values = np.array(
        [
            [
                np.concatenate([[math.log(max(own.value, 1e-300))], own.draws])
                for own in of_four[group]
            ]
            for group in groups
        ]
    )
    best = np.argmin(values, axis=1) == paper.OF_FOUR.index(paper.CNN)  # (groups, draws)
    drawn = best.sum(axis=0)
    low, high = np.quantile(drawn[1:], [0.025, 0.975])
    named = ", ".join(group for group, own in zip(groups, best[:, 0], strict=True) if own) or "none"
    ours = f"{drawn[0]} [{low:.0f}, {high:.0f}] of {len(groups)}: {named}"
    verdict: Verdict = "reproduced" if low >= 5 else "not reproduced" if high < 5 else "undecided"
    return Claim(
        "Fig. 6: CNN-UKF best in MSE_nl in five groups or more",
        "5 of 7",
        ours,
        data,
        verdict,
        "against 5",
    )


def _peaks(main: ManoeuvreErrors, data: str) -> Statement:
    """Absolute errors about the largest |β| of each slalom (Figure 7)."""
    kept = np.array([float(group == "slalom") for group in main.groups])
    measured = {}
    for name in paper.OF_FOUR:
        seeds = []
        for run in main.runs[name]:
            found = []
            for parts in run.test.values():
                at = int(np.abs(np.concatenate([part.sideslip_ref for part in parts])).argmax())
                found.append(
                    float(
                        np.abs(whole(parts)[max(at - AROUND_PEAK, 0) : at + AROUND_PEAK + 1]).mean()
                    )
                )
            seeds.append(np.array(found) * kept)
        measured[name] = main.measured(np.stack(seeds), kept, int(kept.sum()))
    tests = [
        Compared(name, Change.of(measured[paper.CNN], measured[name]))
        for name in (paper.MODEL, paper.DATA, paper.DEEP)
    ]
    return Statement(
        f"Fig. 7: CNN-UKF errs least at the slaloms' peaks ({int(kept.sum())} peaks)",
        "yes",
        data,
        tests,
    )


def _difference(worst: ManoeuvreErrors, nominal: ManoeuvreErrors, candidate: str) -> Measured:
    """By how much a candidate's worst MSE exceeds its MSE as identified, drawn together."""
    one = worst.get(candidate, MSE)
    other = nominal.get(candidate, MSE)
    draws = np.log(np.maximum(np.exp(one.draws) - np.exp(other.draws), 1e-9))
    each = np.log(np.maximum(np.exp(one.of_each) - np.exp(other.of_each), 1e-9))
    return Measured(max(one.value - other.value, 1e-9), draws, each, one.n_blocks)


def squares(outputs: Sequence[Sequence[Outputs]]) -> tuple[FloatArray, FloatArray]:
    """Sums of β_DD's squared errors, (S, M), and samples, (M,)."""
    sums = np.array([[float(np.square(own.error).sum()) for own in seed] for seed in outputs])
    return sums, np.array([float(len(own.error)) for own in outputs[0]])


def _over_samples(
    main: ManoeuvreErrors,
    outputs: Sequence[Sequence[Outputs]],
    statistic: Callable[[Sequence[Outputs]], float],
) -> tuple[float, float, float]:
    """A figure of all samples, mean over seeds, with its interval over 200 resamples of manoeuvres and seeds."""
    generator = np.random.default_rng(0)
    count = len(main.manoeuvres)
    value = float(np.mean([statistic(seed) for seed in outputs]))
    drawn = []
    for _ in range(200):
        chosen = generator.integers(count, size=count)
        seeds = (
            generator.integers(len(outputs), size=len(outputs))
            if len(outputs) > 1
            else np.zeros(1, dtype=np.int64)
        )
        of_seed = {
            int(seed): statistic([outputs[int(seed)][int(at)] for at in chosen])
            for seed in set(seeds.tolist())
        }
        drawn.append(float(np.mean([of_seed[int(seed)] for seed in seeds])))
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return value, float(low), float(high)


def _thinned(parts: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([part[::10] for part in parts])


def _rank_correlation(outputs: Sequence[Outputs]) -> float:
    distrust = _thinned([own.distrust for own in outputs])
    error = _thinned([np.abs(own.error) for own in outputs])
    return float(stats.spearmanr(distrust, error).statistic) if np.ptp(distrust) > 0 else 0.0


def _decades(outputs: Sequence[Outputs]) -> float:
    low, high = np.percentile(_thinned([own.distrust for own in outputs]), [1.0, 99.0])
    return float(np.log10(high / low))


def _rise_of_yaw_rate(outputs: Sequence[Outputs]) -> float:
    values = _process(outputs, 1)
    angle = np.abs(_thinned([own.sideslip for own in outputs]))
    return _ratio(values[angle >= HIGH], values[angle < LOW])


def _rise_of_vy(outputs: Sequence[Outputs]) -> float:
    values = _process(outputs, 0)
    beyond = np.concatenate([own.nonlinear[::10] for own in outputs])
    return _ratio(values[beyond], values[~beyond])


def _process(outputs: Sequence[Outputs], which: int) -> FloatArray:
    return _thinned([own.process[:, which] for own in outputs if own.process is not None])


def _ratio(one: FloatArray, other: FloatArray) -> float:
    return float(np.median(one) / np.median(other)) if len(one) and len(other) else math.nan


def activity(outputs: OutputsOf, shifts: Mapping[str, Sequence[float]]) -> pd.DataFrame:
    """What of each hybrid is active: median shift of β for 1° of β_DD [deg], and quantiles of its deviations over all seeds, in words."""
    rows = []
    for name, seeds in outputs.items():
        every = [own for seed in seeds for own in seed]
        row: dict[str, object] = {"candidate": name, "shift": float(np.median(shifts[name]))}
        row["shift_range"] = f"{fixed(min(shifts[name]), 2)} … {fixed(max(shifts[name]), 2)}"
        row["distrust"] = _quantiles(_thinned([own.distrust for own in every]))
        for place, level_name in enumerate(("process_vy", "process_yaw_rate")):
            has = all(own.process is not None for own in every)
            row[level_name] = _quantiles(_process(every, place)) if has else "the filter's"
        rows.append(row)
    return pd.DataFrame(rows)


def _quantiles(values: FloatArray) -> str:
    return " / ".join(f"{value:.2g}" for value in np.percentile(values, [5, 50, 95]))
