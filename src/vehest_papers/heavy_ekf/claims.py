"""The first page: what the paper claims of its filters, what came out here, and what the filters have to beat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from vehest.evaluation.ranking import Name, Ranking
from vehest.report.document import Table
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.standing import ranking_of, verdict_sentences
from vehest_papers.heavy_ekf import paper
from vehest_papers.kit.claims import Claim, bound_claim, claims_table, order_claim
from vehest_papers.kit.reading import metric_values, words_of_kinds

FAMILY = "rational_ekf"
BASELINE_TITLES = {
    "zero": "zero",
    "static_map": "static map",
    "kinematic": "kinematic",
    "data_sheet": "data sheet",
}
"""Estimators that the filters have to beat -> what they are called in tables."""
LAPS = "nominal_laps"
FAST = "nominal_fast"
REAL = "test"
ASKED = [(better, worse) for better, worse in paper.GAINS]


def titles_of(part: PartArtefacts) -> dict[Name, str]:
    """Estimator and variant -> what it is called in this report, for all models of a part."""
    names = {(model.estimator, model.variant) for model in part.models}
    return {
        name: paper.VARIANTS[name[1]]
        if name[0] == FAMILY
        else BASELINE_TITLES.get(name[0], ": ".join(name))
        for name in names
    }


def rankings_of(part: PartArtefacts) -> dict[str, Ranking]:
    """Test set -> its ranking, with the pairs whose order the paper claims among those compared."""
    variant_of = {title: variant for variant, title in paper.VARIANTS.items()}
    asked = [((FAMILY, variant_of[better]), (FAMILY, variant_of[worse])) for better, worse in ASKED]
    return {test: ranking_of(part, test, asked=asked) for test in part.split.tests}


def claims_blocks(
    truck: PartArtefacts, ferrari: PartArtefacts | None, others: Sequence[Claim]
) -> tuple[Table, str]:
    """The table of claims, those of the tests before ``others``, and a sentence a test on the best filter."""
    variant_of = {title: (FAMILY, variant) for variant, title in paper.VARIANTS.items()}
    titles = titles_of(truck)
    found = rankings_of(truck)
    data = words_of_kinds(truck)
    claims: list[Claim] = [
        bound_claim(
            found[LAPS],
            variant_of[paper.RATTE],
            paper.RATTE,
            0.5,
            f"{paper.LAPS[paper.RATTE]}°",
            f"{data}, three laps",
        ),
        bound_claim(
            found[FAST],
            variant_of[paper.RATTE],
            paper.RATTE,
            0.62,
            f"{paper.FAST[paper.RATTE]}°",
            f"{data}, fast lap",
        ),
    ]
    tests = [(test, f"{data}, {test.replace('_', ' ')}", titles, found[test]) for test in found]
    if ferrari is not None:
        real = rankings_of(ferrari)
        tests.append(
            (REAL, f"{words_of_kinds(ferrari)}, the Ferrari", titles_of(ferrari), real[REAL])
        )
    for test, words, own, ranking in tests:
        for better, worse in ASKED:
            known = f"{paper.GAINS[better, worse]:.0f} % below on its three laps"
            if test == FAST:
                known = f"{paper.FAST[better]}° and {paper.FAST[worse]}°"
            claims.append(
                order_claim(ranking, variant_of[better], variant_of[worse], own, known, words)
            )
    sentences = [verdict_sentences(ranking, own, words) for _, words, own, ranking in tests]
    note = (
        "The paper's recordings are real, of another vehicle. Twin: the paper's own single track as the plant, below; its intervals are "
        "paired over seeds."
    )
    return claims_table([*claims, *others], note), "\n\n".join(sentences)


def baseline_errors(part: PartArtefacts) -> Mapping[tuple[str, str], float]:
    """(baseline's title, test set) -> RMSE(β) [deg], as evaluated."""
    known = metric_values(part).items()
    return {
        (BASELINE_TITLES[own], test): value
        for (own, _, _, test, metric), value in known
        if metric == "rmse_sideslip" and own in BASELINE_TITLES
    }
