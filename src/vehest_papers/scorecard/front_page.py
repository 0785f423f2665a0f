"""The scorecard's front page: the answer on one screen, then how far it can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from vehest.data.errors import number_of
from vehest.report.style import MISSING
from vehest_papers.kit.block_rows import MAX_IMPROVEMENT
from vehest_papers.kit.verdicts import ALPHA, TARGET_POWER, VERDICTS
from vehest_papers.scorecard.judged import DATA_KINDS, Study
from vehest_papers.scorecard.markdown import (
    evidence,
    filled,
    open_questions,
    recommendation,
    report_link,
    table,
)

TEMPLATE = Path(__file__).with_name("front_page.md.j2")
MET = ("reproduced", "direction only")
UNDECIDED = ("no significant difference", "inconclusive")
N_EVIDENCE_CLAIMS = 3  # below each recommendation; the page of the paper has all


def front_page(studies: Sequence[Study], results: Path) -> str:
    """Content of scorecard.md."""
    claims = _claims(studies)
    assessed = claims[claims["is_assessed"]]
    met = claims[claims["verdict"].isin(MET)]
    not_different = claims[claims["verdict"] == UNDECIDED[0]]
    is_powerful = (not_different["power"] >= TARGET_POWER) & ~not_different["is_provisional"]
    undecided = claims[claims["verdict"].isin(UNDECIDED)]
    values = {
        "claims": claims,
        "assessed": assessed,
        "undecided": undecided,
        "met_on_real": met[met["data"] == "real"],
        "n_undetected_effects": int(is_powerful.sum()),
        "target_power": round(100 * TARGET_POWER),
        "counts": {verdict: int((claims["verdict"] == verdict).sum()) for verdict in VERDICTS},
        "data": {kind: int((assessed["data"] == kind).sum()) for kind in DATA_KINDS},
        "n_table_values": sum(len(study.rows) for study in studies),
        "papers": [
            {
                "title": study.title,
                "page": study.page,
                "report": report_link(study, results, ""),
                "doi": study.paper.doi,
                "recommendation": recommendation(study),
                "evidence": evidence(study, N_EVIDENCE_CLAIMS),
                "open": open_questions(study, lambda names: number_of(len(names), "method")),
            }
            for study in studies
        ],
        "verdict_counts": _counts(studies, claims, "verdict", VERDICTS),
        "data_counts": _counts(studies, assessed, "data", DATA_KINDS),
        "max_improvement": round(100 * MAX_IMPROVEMENT),
        "nominal": round(100 * ALPHA),
        **_planted_truth(results / "scorecard" / "planted_truth.csv"),
    }
    return filled(TEMPLATE, values)


def _claims(studies: Sequence[Study]) -> pd.DataFrame:
    """Claims of all papers with what the page counts, a row each."""
    return pd.DataFrame(
        [
            {
                "paper": study.title,
                "verdict": study.claims[claim.id].verdict,
                "data": study.paper.parts.get(claim.part, ""),
                "power": study.claims[claim.id].power,
                "is_assessed": study.claims[claim.id].n_blocks > 0,
                "is_provisional": study.is_provisional(claim),
            }
            for study in studies
            for claim in study.claims_of_paper
        ]
    )


def _counts(
    studies: Sequence[Study], claims: pd.DataFrame, column: str, words: Sequence[str]
) -> str:
    """Number of claims with each word in a column, of all papers and of each; in brackets
    provisional ones.
    """
    groups = [claims, *(claims[claims["paper"] == study.title] for study in studies)]
    rows = [(word, *(_counted(group[group[column] == word]) for group in groups)) for word in words]
    rows.append(("all", *(_counted(group) for group in groups)))
    links = [f"[{study.title}]({study.page})" for study in studies]
    return table((column, "all", *links), rows, n_text=1)


def _counted(claims: pd.DataFrame) -> str:
    n_provisional = claims["is_provisional"].sum()
    if not len(claims):
        return MISSING
    return f"{len(claims)} ({n_provisional})" if n_provisional else str(len(claims))


def _planted_truth(path: Path) -> dict[str, object]:
    """Rates of verdicts on simulated studies, as `vehest_papers.planted_truth` wrote them."""
    rates = pd.read_csv(path)
    rates["met"] = rates["reproduced"] + rates["direction only"]
    by_truth = {
        truth: rows.set_index(["design", "seeds"]) for truth, rows in rates.groupby("truth")
    }
    effect = by_truth["the paper's effect"]
    columns = {
        "no effect: a difference is found": by_truth["no effect"]["wrong"],
        "the paper's effect: found": effect["met"],
        "half of it: found": by_truth["half of it"]["met"],
        "size in interval, at least": rates.groupby(["design", "seeds"])["size_covered"].min(),
    }
    wrong, detected, *_ = columns.values()
    n_seeds = int(rates["seeds"].max())
    rows = [
        (design, str(seeds), *(f"{values[design, seeds]:.1f}" for values in columns.values()))
        for design, seeds in effect.index
    ]
    return {
        "studies": rates["studies"].max(),
        "seeds": n_seeds,
        "reduction": round(100 * (1 - effect["ratio"].max())),
        "wrong": _range(wrong.xs(n_seeds, level="seeds")),
        "wrong_single": _range(wrong.xs(1, level="seeds")),
        "detected": _range(detected.xs(n_seeds, level="seeds")),
        "planted": table(("blocks", "seeds", *columns), rows, n_text=1),
    }


def _range(values: pd.Series[float]) -> str:
    return f"{values.min():.0f} to {values.max():.0f}"
