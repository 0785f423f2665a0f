"""The order of families on the other car: whether it is the paper's, and which difference between the cars brings it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import fixed, listed
from vehest_papers.kit.statements import Compared, outcomes
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.schemes import Scheme

Order = Literal["comes out", "does not come out", "is open"]
CAUSES = {
    "same_sensors": "the same sensors",
    "same_tyres": "the same tyres",
    "same_driving": "the same driving",
}
"""Start of a part's name -> what its two cars have in common."""

ORDER = tuple((name, paper.LUENBERGER) for name in paper.WITHOUT_BIAS) + tuple(
    (paper.LUENBERGER, name) for name in paper.PLAIN
)
"""Lower and higher FVU on the other car, as in both of the paper's schemes."""
NETWORKS = (*paper.WITHOUT_BIAS, *paper.WITH_BIAS, *paper.PLAIN)
IN_WORDS = "KS-NN without biases before Luenberger before GRU and LSTM"


def orders(schemes: Sequence[Scheme]) -> dict[str, Order]:
    """Name of a part -> what its order is, by four comparisons each that are corrected together by Holm."""
    tests = [
        Compared(f"{lower} below {higher}", own.change(lower, higher, own.other, "fvu"))
        for own in schemes
        for lower, higher in ORDER
    ]
    found = [outcome for outcome, _ in outcomes(tests)]
    states: dict[str, Order] = {}
    for position, scheme in enumerate(schemes):
        own = set(found[len(ORDER) * position : len(ORDER) * (position + 1)])
        states[scheme.name] = (
            "does not come out"
            if "the other way round" in own
            else "comes out"
            if own == {"as claimed"}
            else "is open"
        )
    return states


def headline(schemes: Sequence[Scheme], ablations: Mapping[str, Sequence[Scheme]]) -> str:
    """Sentences: whether the order of families is the paper's, who is first, the static map, and the causes."""
    found = orders(schemes)
    if set(found.values()) == {"comes out"}:
        words = f"**The paper's order of families comes out in both schemes:** on the other car {IN_WORDS}, each by more than chance."
    elif "does not come out" in found.values():
        where = listed(
            [
                scheme.title.lower()
                for scheme in schemes
                if found[scheme.name] == "does not come out"
            ]
        )
        words = f"**The paper's order of families does not come out** ({where}): on the other car it has {IN_WORDS}."
    else:
        words = (
            f"**The paper's order of families is not decided here:** on the other car it has {IN_WORDS}; no pair turns, "
            "not all are told apart."
        )
    sentences = [words]
    for scheme in schemes:
        errors = scheme.errors(scheme.other)
        shown = [
            name
            for name in scheme.chosen
            if name not in (paper.ZERO, paper.KINEMATIC) and scheme.name_of(name) in errors
        ]
        order = sorted(shown, key=lambda name: errors.value(scheme.name_of(name), "fvu"))
        listing = ", ".join(
            f"{name} {errors.value(scheme.name_of(name), 'fvu'):.3f}" for name in order[:3]
        )
        sentences.append(f"{scheme.title}, lowest FVU on the other car: {listing}.")
    sentences += _against_the_map(schemes)
    return " ".join(sentences) + "\n\n" + causes_in_words(schemes, found, ablations)


def _against_the_map(schemes: Sequence[Scheme]) -> list[str]:
    tests = [
        Compared(
            scheme.title.lower(),
            scheme.change(paper.NONLINEAR, paper.STATIC_MAP, scheme.other, "fvu"),
        )
        for scheme in schemes
    ]
    found = [outcome for outcome, _ in outcomes(tests)]
    if all(own.change is None for own in tests):
        return []
    beaten = [
        own.label for own, outcome in zip(tests, found, strict=True) if outcome == "as claimed"
    ]
    return [
        f"KS-NN nonlinear no bias is below the static map, two numbers of the car that was learnt on, by more than chance in "
        f"{listed(beaten) if beaten else 'neither scheme'}."
    ]


def causes_in_words(
    schemes: Sequence[Scheme], found: Mapping[str, Order], ablations: Mapping[str, Sequence[Scheme]]
) -> str:
    """Which of the differences between the cars the order depends on, as far as one at a time can tell."""
    if not ablations:
        return "No difference between the cars was taken away here, so causes are not tested."
    without = {cause: orders(own) for cause, own in ablations.items()}
    numbered = {scheme.name[-1]: scheme for scheme in schemes}
    sentences = []
    for number, scheme in numbered.items():
        states = {
            cause: order
            for cause, own in without.items()
            for name, order in own.items()
            if name.endswith(number)
        }
        if not states:
            continue
        same = {
            order: [CAUSES[cause] for cause, own in states.items() if own == order]
            for order in dict.fromkeys(states.values())
        }
        listing = "; ".join(f"with {listed(own)} it {order}" for order, own in same.items())
        sentence = f"{scheme.title}: the order {found[scheme.name]}; {listing}."
        if found[scheme.name] == "comes out":
            lost = [CAUSES[cause] for cause, order in states.items() if order != "comes out"]
            sentence += (
                f" It needs that the cars do not have {listed(lost)}."
                if lost
                else " No single difference brings it: it survives without each of them."
            )
        elif "comes out" in states.values():
            gained = [CAUSES[cause] for cause, order in states.items() if order == "comes out"]
            sentence += (
                f" What stands against it is the difference that {listed(gained)} take away."
            )
        sentences.append(sentence)
    return "**Causes, one taken away at a time.** " + " ".join(
        [*sentences, *_what_is_left(schemes, ablations)]
    )


def _what_is_left(
    schemes: Sequence[Scheme], ablations: Mapping[str, Sequence[Scheme]]
) -> list[str]:
    """How far networks' FVU on the other car changes with each cause taken away, the median over families and schemes."""
    numbered = {scheme.name[-1]: scheme for scheme in schemes}
    shares: dict[str, float] = {}
    for cause, own in ablations.items():
        pairs = [
            (scheme, numbered[scheme.name[-1]]) for scheme in own if scheme.name[-1] in numbered
        ]
        ratios = [
            scheme.errors(scheme.other).value(scheme.name_of(name), "fvu")
            / whole.errors(whole.other).value(whole.name_of(name), "fvu")
            for scheme, whole in pairs
            for name in NETWORKS
            if name in scheme.chosen and name in whole.chosen
        ]
        if ratios:
            shares[cause] = float(np.median(ratios))
    if not shares:
        return []
    listing = ", ".join(
        f"{100.0 * share:.0f} % with {CAUSES[cause]}"
        for cause, share in sorted(shares.items(), key=lambda item: item[1])
    )
    return [
        f"Of the networks' FVU on the other car there remains, median over families and schemes: {listing}."
    ]


def causes_table(schemes: Sequence[Scheme], ablations: Mapping[str, Sequence[Scheme]]) -> Table:
    """FVU on the other car with one difference taken away at a time, a row a category, then the order."""
    columns = {f"S{scheme.name[-1]} as it is": scheme for scheme in schemes}
    for cause, own in ablations.items():
        columns |= {
            f"S{scheme.name[-1]} {CAUSES[cause].removeprefix('the ')}": scheme for scheme in own
        }
    ordered = {title: columns[title] for title in sorted(columns, key=lambda title: title[:2])}
    categories = dict.fromkeys(
        category
        for scheme in ordered.values()
        for category in scheme.chosen
        if category != paper.KINEMATIC
    )
    states = orders(list(schemes)) | {
        name: order for own in ablations.values() for name, order in orders(own).items()
    }
    rows: list[dict[str, str]] = []
    for category in categories:
        row = {"model": category}
        for title, scheme in ordered.items():
            errors = scheme.errors(scheme.other)
            name = scheme.name_of(category)
            row |= {
                title: fixed(errors.value(name, "fvu"), 3),
                f"{title}, interval": errors.in_words(name, "fvu"),
            }
        rows.append(row)
    rows.append(
        {"model": "the paper's order"}
        | {title: states[scheme.name] for title, scheme in ordered.items()}
    )
    caption = (
        "FVU on the other car where the two cars have one thing more in common than in the schemes; of each family the structure that "
        "validation chooses, three seeds in the ablations. Last row: by the corrected intervals of the differences; all intervals are in "
        "the CSV."
    )
    return Table(
        "causes",
        caption,
        pd.DataFrame(rows),
        {"model": Column("model"), **{title: Column(title) for title in ordered}},
    )
