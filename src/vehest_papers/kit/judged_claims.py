"""Judged claims as text: the cells that reports and the scorecard share, and the table of claims of a report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import MISSING, significant
from vehest_papers.kit.block_errors import Training, errors_of, training_of
from vehest_papers.kit.block_rows import BlockRow, TrainingRow
from vehest_papers.kit.claim_files import CLAIMS_FOLDER, Claim, Paper, read_paper
from vehest_papers.kit.verdicts import VERDICTS, Figure, Judgement, judge_paper, least_training

_COLUMNS: Mapping[str, Column] = {
    "claim": Column("claim"),
    "published": Column("paper"),
    "ours": Column("ours, 95 % interval"),
    "data": Column("data"),
    "verdict": Column("verdict"),
    "training": Column("training"),
    "reason": Column("why"),
}
_RULES = (
    "Judged from errors by block and seed (tables/blocks.csv); of orders p-values are corrected by "
    "Holm within a family. Training: epochs ours / paper of the least trained candidate, and "
    "whether twice the epochs change its validation error by more than 3 %."
)


def judged_claims(
    paper: str, rows: Sequence[BlockRow], trained: Sequence[TrainingRow]
) -> list[Table]:
    """Table ``claims`` of a report, and ``claims_added`` where we compare what the paper does not.

    Parameters
    ----------
    paper : str
        Package of the paper, which has its claims.yaml.
    rows, trained
        What the report writes to tables/blocks.csv and tables/training.csv. A claim whose
        candidates have no rows is not assessed.
    """
    content = read_paper(CLAIMS_FOLDER / paper / "claims.yaml")
    training = training_of(trained)
    judged = judge_paper(content, errors_of(rows, f"study '{content.study}'"), training)
    tables = []
    for name, is_added, about in (
        ("claims", False, "Claims of the paper"),
        ("claims_added", True, "Comparisons that the paper does not make"),
    ):
        claims = [claim for claim in content.claims if claim.is_added == is_added]
        if claims:
            tables.append(_table(name, about, content, claims, judged, training))
    return tables


def _table(
    name: str,
    about: str,
    paper: Paper,
    claims: Sequence[Claim],
    judged: Mapping[str, Judgement],
    training: Mapping[str, Training],
) -> Table:
    counts = Counter(judged[claim.id].verdict for claim in claims)
    words = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])
    cells = []
    for claim in claims:
        candidate, state = least_training(claim, training)
        judgement = judged[claim.id]
        cells.append(
            {
                "id": claim.id,
                "claim": f"{one_line(claim.claim)} ({claim.source})",
                "published": published_text(claim),
                "ours": figures_text(judgement, unit_of(claim)),
                "data": origin_of(claim, paper) or MISSING,
                "verdict": judgement.verdict,
                "training": training_text(paper, candidate, state),
                "reason": judgement.reason or MISSING,
            }
        )
    return Table(name, f"{about}: {words}. {_RULES}", pd.DataFrame(cells), _COLUMNS)


def one_line(text: str) -> str:
    """Text without line breaks."""
    return " ".join(text.split())


def origin_of(claim: Claim, paper: Paper) -> str:
    """What a claim is tested on: ``real, tyre_a``; empty where it cannot be tested."""
    origin = paper.parts.get(claim.part, "") if claim.not_testable is None else ""
    return f"{origin}, {claim.test_set}" if origin else ""


def unit_of(claim: Claim) -> str:
    """Unit of the measured value after a space; empty where it has none."""
    return f" {claim.unit}" if claim.unit not in (None, "1") else ""


def published_text(claim: Claim) -> str:
    """The paper's values and their ratio."""
    words = [
        f"{name} {significant(value) if isinstance(value, float) else value}"
        for name, value in claim.published.items()
    ]
    ratio = claim.published_ratio
    if ratio is not None:
        words.append(f"ratio {significant(ratio)}")
    return "; ".join(words) or MISSING


def figures_text(judgement: Judgement, unit: str) -> str:
    """Errors and both ratios with their intervals."""
    words = []
    for name, figure in judgement.values.items():
        label = f"{name} " if len(judgement.values) > 1 else ""
        words.append(f"{label}{figure_text(figure)}{unit}")
    if judgement.size is not None:
        words.append(f"ratio {figure_text(judgement.size)}")
    if judgement.order is not None:
        words.append(f"mean of blocks' ratios {figure_text(judgement.order)}")
    return "; ".join(words) or MISSING


def figure_text(figure: Figure) -> str:
    """A value with its interval, where there is one."""
    if not math.isfinite(figure.low):
        return significant(figure.value)
    return f"{significant(figure.value)} [{significant(figure.low)}, {significant(figure.high)}]"


def training_text(paper: Paper, candidate: str, training: Training | None) -> str:
    """Epochs of the least trained candidate, the paper's, and what is known of the training."""
    declared = paper.candidates.get(candidate)
    of_paper = declared.epochs_paper if declared is not None else None
    if training is None or training.state == "not applicable":
        return MISSING if of_paper is None else f"{MISSING} / {of_paper}"
    ours = training.epochs or MISSING
    published = training.epochs_paper or (MISSING if of_paper is None else str(of_paper))
    return f"{ours} / {published}, {training.state}"
