"""The paper's statements on errors, one entry each: Sections VIII-A to VIII-D and VIII-H."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from vehest.report.style import fixed
from vehest_papers.kit.claims import Claim, Verdict
from vehest_papers.kit.statements import Change, Compared, Expected, Statement, outcomes, short
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.comparing import SegmentErrors
from vehest_papers.ksnn.schemes import THIRD, Scheme, segments_on

ABOUT_A_QUARTER = (0.20, 0.30)
EXPLAINED = 0.10
LITTLE = 0.02
N_DRAWS = 4000


def on_accuracy(schemes: Sequence[Scheme]) -> list[Statement | Claim]:
    """Sections VIII-A to VIII-C, over both schemes."""
    data = schemes[0].kind
    first = schemes[0]
    plain = [
        Compared(f"{_brief(name)}, {other}", first.change(name, other, first.own, "fvu"))
        for name in paper.WITH_BIAS
        for other in paper.PLAIN
    ]
    linear = [
        Compared(
            _label(scheme),
            scheme.change(paper.LINEAR, paper.NONLINEAR, scheme.other, "rmse_vy"),
            "lower",
            beyond=LITTLE,
        )
        for scheme in schemes
    ]
    return [
        Statement(
            "Luenberger leaves about 25 % (20 to 30 %) of v's variance on either car",
            "0.235 and 0.253; 0.243 and 0.233",
            data,
            _quarter(schemes),
        ),
        Statement(
            "GRU, LSTM explain over 90 % on the own car",
            "FVU 0.118, 0.112; 0.108, 0.098",
            data,
            [
                _below(scheme, name, scheme.own, EXPLAINED)
                for scheme in schemes
                for name in paper.PLAIN
            ],
        ),
        Statement(
            "and are worse than Luenberger on the other",
            "+10, +9 %; +113, +99 %",
            data,
            _pairs(schemes, paper.PLAIN, paper.LUENBERGER, "higher"),
        ),
        *[_diagonal(scheme) for scheme in schemes],
        Statement(
            "biases: lower FVU on the own car",
            "−38, −42 %; −29, −37 %",
            data,
            _biases(schemes, own=True),
        ),
        Statement(
            "no biases: lower FVU on the other",
            "−37, −33 %; −61, −46 %",
            data,
            _biases(schemes, own=False),
        ),
        Statement(
            "with biases below GRU, LSTM on the own car", "0.082, 0.077 against 0.112", data, plain
        ),
        Statement(
            "with biases below Luenberger on the other",
            "−5, −15 %",
            data,
            _pairs([first], paper.WITH_BIAS, paper.LUENBERGER, "lower"),
        ),
        Statement(
            "no biases: the cars further alike, FVU other over own",
            "1.1 against 2.9; 3.1 against 11",
            data,
            _alike(schemes),
        ),
        Statement(
            "nonlinear no bias: RMSE(v) on the other car below Luenberger's",
            "−24; −16 %",
            data,
            _pairs(schemes, (paper.NONLINEAR,), paper.LUENBERGER, "lower", "rmse_vy"),
        ),
        Statement(
            "and below GRU's, LSTM's",
            "−28, −27; −41, −38 %",
            data,
            _nonlinear(schemes, paper.PLAIN, "rmse_vy"),
        ),
        Statement(
            "the same by FVU, Luenberger",
            "−43; −25 %",
            data,
            _pairs(schemes, (paper.NONLINEAR,), paper.LUENBERGER, "lower"),
        ),
        Statement(
            "the same by FVU, GRU, LSTM",
            "−48, −47; −65, −62 %",
            data,
            _nonlinear(schemes, paper.PLAIN, "fvu"),
        ),
        Statement(
            "and below every other KS-NN's",
            "−5 to −40; −2 to −62 %",
            data,
            _nonlinear(schemes, (paper.LINEAR, *paper.WITH_BIAS), "fvu"),
        ),
        Statement(
            "not in the paper: below the static map",
            "–",
            data,
            _pairs(schemes, (paper.NONLINEAR,), paper.STATIC_MAP, "lower"),
        ),
        *[_few_parameters(scheme) for scheme in schemes],
        Statement(
            "best linear at most 2 % above best nonlinear in RMSE(v)", "+2; +1 %", data, linear
        ),
        _most_specialised(schemes),
        _third_car(schemes),
    ]


def _label(scheme: Scheme, word: str = "") -> str:
    number = scheme.name.rsplit("_", 1)[-1]
    return f"S{number} {word}".strip()


def _pairs(
    schemes: Sequence[Scheme],
    first: Sequence[str],
    second: str,
    expected: Expected,
    metric: str = "fvu",
) -> list[Compared]:
    """From one category to several on the other car."""
    return [
        Compared(
            _label(scheme, _brief(name) if len(first) > 1 else ""),
            scheme.change(name, second, scheme.other, metric),
            expected,
        )
        for scheme in schemes
        for name in first
    ]


def _nonlinear(schemes: Sequence[Scheme], others: Sequence[str], metric: str) -> list[Compared]:
    return [
        Compared(
            _label(scheme, _brief(name)), scheme.change(paper.NONLINEAR, name, scheme.other, metric)
        )
        for scheme in schemes
        for name in others
    ]


def _brief(category: str) -> str:
    return category.removeprefix("KS-NN ")


def _quarter(schemes: Sequence[Scheme]) -> list[Compared]:
    low, high = ABOUT_A_QUARTER
    tests = []
    for scheme in schemes:
        for word, test in (("own", scheme.own), ("other", scheme.other)):
            own = scheme.measured(paper.LUENBERGER, test, "fvu")
            if own is not None:
                tests += [
                    Compared(
                        _label(scheme, word),
                        Change.of(own, None, low),
                        "higher",
                        shown="ratio",
                        limit=low,
                    ),
                    Compared(
                        _label(scheme, word),
                        Change.of(own, None, high),
                        "lower",
                        shown="ratio",
                        limit=high,
                    ),
                ]
    return tests


def _below(scheme: Scheme, category: str, test: str, limit: float) -> Compared:
    own = scheme.measured(category, test, "fvu")
    change = None if own is None else Change.of(own, None, limit)
    return Compared(_label(scheme, category), change, "lower", shown="ratio", limit=limit)


def _biases(schemes: Sequence[Scheme], *, own: bool) -> list[Compared]:
    kinds = list(zip(paper.WITH_BIAS, paper.WITHOUT_BIAS, strict=True))
    return [
        Compared(
            _label(scheme, "linear" if with_bias == paper.LINEAR_BIAS else "nonlinear"),
            scheme.change(with_bias, without, scheme.own, "fvu")
            if own
            else scheme.change(without, with_bias, scheme.other, "fvu"),
        )
        for scheme in schemes
        for with_bias, without in kinds
    ]


def _alike(schemes: Sequence[Scheme]) -> list[Compared]:
    tests = []
    for scheme in schemes:
        for with_bias, without in zip(paper.WITH_BIAS, paper.WITHOUT_BIAS, strict=True):
            first, second = (
                scheme.other_over_own(scheme.name_of(name)) for name in (without, with_bias)
            )
            word = "linear" if without == paper.LINEAR else "nonlinear"
            if first is not None and second is not None:
                words = f"{_label(scheme, word)} {short(math.exp(first.log_ratio))} against {short(math.exp(second.log_ratio))},"
                tests.append(Compared(words, first.over(second)))
    return tests


def _diagonal(scheme: Scheme) -> Claim:
    """Whether every structure explains more of the own car than of the other."""
    tests = [
        Compared(name, change, "higher")
        for name in scheme.structures()
        if (change := scheme.other_over_own(name)) is not None
    ]
    found = outcomes(tests)
    above = sum(own.change is not None and own.change.log_ratio > 0 for own in tests)
    significant = sum(outcome == "as claimed" for outcome, _ in found)
    below = sum(outcome == "the other way round" for outcome, _ in found)
    easier = scheme.other_over_own(scheme.name_of(paper.STATIC_MAP))
    ours = f"{above} of {len(tests)} above; by more than chance {significant} above, {below} below"
    if easier is not None:
        ours += f"; static map's FVU other over own {easier.as_ratio()}"
    claim = f"all dots above the diagonal, {scheme.title.lower()}"
    if not tests or all(own.change is None or not own.change.error > 0 for own in tests):
        return Claim(
            claim, "39 of 39", "–", scheme.kind, "not testable on this data", "tests too short"
        )
    verdict = "not reproduced" if below else "reproduced" if above == len(tests) else "undecided"
    why = (
        "some significantly below"
        if below
        else "all above"
        if above == len(tests)
        else "some below, by chance or not"
    )
    return Claim(
        claim,
        "all" if scheme.name.endswith("1") else "all of Table V",
        ours,
        scheme.kind,
        verdict,  # type: ignore[arg-type]
        why,
    )


def _few_parameters(scheme: Scheme) -> Claim:
    """Rank correlation over structures of the number of parameters and the FVU on the other car."""
    claim = f"few parameters generalise: rank correlation of parameters and FVU on the other car, {scheme.title.lower()}"
    names = scheme.structures([name for name in paper.CATEGORIES if name != paper.LUENBERGER])
    counts = {
        f"{row['estimator']}/{row['variant']}": float(row["n_parameters"])
        for row in scheme.runs.to_dict("records")
    }
    errors = scheme.errors(scheme.other)
    points = np.array(
        [
            (counts[name], errors.value(name, "fvu"))
            for name in names
            if math.isfinite(errors.value(name, "fvu"))
        ]
    )
    known = [
        (own.n_parameters, own.fvu(scheme.other))
        for name, own in scheme.published.items()
        if name != paper.LUENBERGER
    ]
    theirs = (
        fixed(float(stats.spearmanr(*np.array(known).T).statistic), 2) + " over its table"
        if known
        else "–"
    )
    if len(points) < 8:
        return Claim(
            claim, theirs, "–", scheme.kind, "not testable on this data", "too few structures"
        )
    value = float(stats.spearmanr(*points.T).statistic)
    generator = np.random.default_rng(0)
    drawn = [
        float(
            stats.spearmanr(*points[generator.integers(len(points), size=len(points))].T).statistic
        )
        for _ in range(N_DRAWS // 4)
    ]
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    verdict = "reproduced" if low > 0 else "not reproduced" if high < 0 else "undecided"
    ours = f"{fixed(value, 2)} [{fixed(low, 2)}, {fixed(high, 2)}] over {len(points)} structures"
    return Claim(claim, theirs, ours, scheme.kind, verdict, "interval over structures")  # type: ignore[arg-type]


def _most_specialised(schemes: Sequence[Scheme]) -> Claim:
    """Fig. 6 names the most specialised candidate of scheme 2: nonlinear feedback with biases."""
    scheme = schemes[-1]
    claim = "Fig. 6: the most specialised candidate (lowest FVU on the own car) is nonlinear + bias"
    errors = scheme.errors(scheme.own)
    names = {name: category for name, category in scheme.structures().items() if name in errors}
    best: dict[str, str] = {}
    for name, category in names.items():
        if category not in best or errors.value(name, "fvu") < errors.value(best[category], "fvu"):
            best[category] = name
    if paper.NONLINEAR_BIAS not in best or len(best) < 2:
        return Claim(
            claim,
            "FVU 0.033",
            "–",
            scheme.kind,
            "not testable on this data",
            "no such candidates here",
        )
    lowest = min(names, key=lambda name: errors.value(name, "fvu"))
    tests = [
        Compared(_brief(category), errors.change(best[paper.NONLINEAR_BIAS], name, "fvu"))
        for category, name in best.items()
        if category != paper.NONLINEAR_BIAS
    ]
    found = [outcome for outcome, _ in outcomes(tests)]
    verdict = (
        "not reproduced"
        if "the other way round" in found
        else "reproduced"
        if set(found) == {"as claimed"}
        else "undecided"
    )
    other = scheme.errors(scheme.other)
    ours = f"{names[lowest]} {lowest.split('/')[1]}: {errors.in_words(lowest, 'fvu')}, on the other car {other.in_words(lowest, 'fvu')}"
    return Claim(
        claim,
        "FVU 0.033",
        ours,
        scheme.kind,
        verdict,  # type: ignore[arg-type]
        "against the best of each other category",
    )


def _third_car(schemes: Sequence[Scheme]) -> Statement:
    """What the paper leaves to future work: a car that neither teaches nor stops."""
    tests = [
        Compared(_label(scheme, _brief(name)), scheme.change(paper.NONLINEAR, name, THIRD, "fvu"))
        for scheme in schemes
        if THIRD in scheme.part.split.tests
        for name in (paper.LUENBERGER, *paper.PLAIN, paper.STATIC_MAP)
    ]
    claim = "a third car, neither learnt nor stopped on: nonlinear no bias below Luenberger, GRU, LSTM, static map (FVU)"
    return Statement(claim, "future work", schemes[0].kind, tests, "no third car here")


def on_regularisation(with_it: Scheme, without: Scheme) -> list[Statement]:
    """Section VIII-H and Table VII: the same two structures stopped on the other car, and on the own one."""
    shared: dict[str, SegmentErrors] = {}
    for test in (with_it.own, with_it.other):
        segments = {}
        for word, scheme in (("with", with_it), ("without", without)):
            for category in (paper.LSTM, paper.NONLINEAR):
                models = [
                    own
                    for own in scheme.part.models
                    if f"{own.estimator}/{own.variant}" == without.name_of(category)
                ]
                segments[f"{category}, {word}"] = [segments_on(model, test) for model in models]
        shared[test] = SegmentErrors(segments, test)

    def change(category: str, test: str) -> Change | None:
        return shared[test].change(f"{category}, without", f"{category}, with", "fvu")

    data = with_it.kind
    kept, lost = (change(category, with_it.other) for category in (paper.NONLINEAR, paper.LSTM))
    less = kept.over(lost) if kept is not None and lost is not None else None
    return [
        Statement(
            "VIII-H, scheme 2 without regularisation: LSTM lower on the own car",
            "−57 %",
            data,
            [Compared("", change(paper.LSTM, with_it.own))],
        ),
        Statement(
            "LSTM higher on the other",
            "+74 %",
            data,
            [Compared("", change(paper.LSTM, with_it.other), "higher")],
        ),
        Statement(
            "KS-NN loses less than LSTM there",
            "+8 against +74 %",
            data,
            [Compared(f"KS-NN {kept.in_percent() if kept else '–'}; over LSTM's", less)],
        ),
    ]


def on_sideslip(drive: Scheme | None) -> list[Statement]:
    """Section VIII-D and Table VI in words, on the real drive."""
    data = "–" if drive is None else f"{drive.kind}, one file"
    known = {
        "−30; −54 %": (paper.FACTOR_GRAPH, paper.KALMAN),
        "−45, −30, −23 %": (paper.LUENBERGER, *paper.PLAIN),
        "not in the paper": (paper.STATIC_MAP,),
    }
    statements = []
    for words, names in known.items():
        tests = (
            []
            if drive is None
            else [
                Compared(
                    _short(name), drive.change(paper.NONLINEAR, name, drive.own, "rmse_sideslip")
                )
                for name in names
            ]
        )
        claim = f"RMSE(β): nonlinear no bias below {', '.join(_short(name) for name in names)}"
        statements.append(Statement(claim, words, data, tests, "the recording is not here"))
    return statements


def _short(category: str) -> str:
    return {paper.FACTOR_GRAPH: "FG", paper.KALMAN: "KF", paper.STATIC_MAP: "static map"}.get(
        category, category
    )


def on_minutes(curve: SegmentErrors | None, least: str, scheme: Scheme, where: str) -> Statement:
    """Sample efficiency: the smallest amount that was learnt from."""
    tests = []
    if curve is not None:
        tests = [
            Compared(name, curve.change(f"{paper.NONLINEAR}@{least}", f"{name}@{least}", "fvu"))
            for name in paper.PLAIN
        ]
    claim = f"sample-efficient: from {least} min in all nonlinear no bias below GRU, LSTM, {where} (FVU)"
    return Statement(claim, "not quantified", scheme.kind, tests, "no part with fewer minutes")


def on_steering(pairs: Sequence[tuple[Scheme, Scheme]]) -> list[Statement]:
    """Section I-B: with the steering angle an estimator depends on the car."""
    found: dict[str, list[Compared]] = {"own": [], "other": []}
    for with_it, without in pairs:
        for word, test in (("own", with_it.own), ("other", with_it.other)):
            segments = {
                name: [
                    segments_on(model, test)
                    for model in scheme.part.models
                    if model.estimator == "velocity_gru"
                ]
                for name, scheme in (("with", with_it), ("without", without))
            }
            change = SegmentErrors(segments, test).change("with", "without", "fvu")
            found[word].append(
                Compared(_label(with_it), change, "lower" if word == "own" else "higher")
            )
    data = pairs[0][0].kind if pairs else "–"
    missing = "no parts with and without steering"
    return [
        Statement(
            "steering angle as an input: lower FVU on the own car",
            "implied",
            data,
            found["own"],
            missing,
        ),
        Statement(
            "and higher on the other",
            "“can decrease the robustness”",
            data,
            found["other"],
            missing,
        ),
    ]


def on_pairs(pairs: Sequence[Scheme]) -> Claim:
    """Pairs of small cars: how often the structure pays on the other car."""
    claim = "the same on pairs of small cars: nonlinear no bias below Luenberger, GRU and LSTM on the other car (FVU)"
    if not pairs:
        return Claim(
            claim, "–", "–", "–", "not testable on this data", "the recordings are not here"
        )
    rivals = (paper.LUENBERGER, *paper.PLAIN)
    tests = [
        (scheme, Compared(name, scheme.change(paper.NONLINEAR, name, scheme.other, "fvu")))
        for scheme in pairs
        for name in rivals
    ]
    found = [
        (scheme, outcome)
        for (scheme, _), (outcome, _) in zip(
            tests, outcomes([own for _, own in tests]), strict=True
        )
    ]
    of = {scheme.name: [outcome for own, outcome in found if own is scheme] for scheme in pairs}
    all_below = sum(set(own) == {"as claimed"} for own in of.values())
    turned = sum("the other way round" in own for own in of.values())
    static = [
        Compared("", scheme.change(paper.NONLINEAR, paper.STATIC_MAP, scheme.other, "fvu"))
        for scheme in pairs
    ]
    beaten = sum(outcome == "as claimed" for outcome, _ in outcomes(static))
    ours = f"{all_below} of {len(pairs)} pairs; the other way round somewhere in {turned}; below the static map in {beaten}"
    verdict: Verdict = (
        "reproduced"
        if all_below == len(of)
        else "not reproduced"
        if not all_below or turned
        else "undecided"
    )
    return Claim(claim, "not tested", ours, pairs[0].kind, verdict, "by pair, corrected by Holm")
