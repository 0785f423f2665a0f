"""The engine's verdicts on a paper's claims in words, and the table of them that the report of its
study shows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import MISSING, significant
from vehest_papers.kit.block_errors import Training, blocks_of, training_of
from vehest_papers.kit.block_rows import BLOCKS, TRAINING, BlockRow, TrainingRow, frame
from vehest_papers.kit.claim_files import Claim, Paper
from vehest_papers.kit.verdicts import VERDICTS, Figure, Judgement, judge_paper, least_training

CLAIMS = "claims"
DECIDED_CLAIMS = "decided_claims"
DECIDED = ("reproduced", "direction only", "met by a trivial baseline", "contradicted")
COLUMNS = {
    "claim": Column("claim"),
    "published": Column("paper"),
    "ours": Column("ours, 95 % interval"),
    "data": Column("data"),
    "verdict": Column("verdict"),
    "training": Column("training: epochs ours / paper"),
}


def claims_table(
    paper: Paper,
    blocks: Iterable[BlockRow],
    training: Iterable[TrainingRow],
    kinds: Mapping[str, str] | None = None,
) -> Table:
    """Table ``claims``: claim, paper, ours with interval, data, verdict, training.

    Parameters
    ----------
    paper
        Its claims.
    blocks, training
        The rows of blocks.csv and training.csv of the same report.
    kinds
        Part -> real or simulated, where a study has other data than the paper's claims.yaml says.

    Returns
    -------
    Table
        Its frame has further columns, which the CSV file alone shows: id, source, why.
    """
    trained = training_of(training)
    judgements = judge_paper(paper, blocks_of(blocks), trained)
    origins = {**paper.parts, **(kinds or {})}
    rows = [_row(paper, claim, judgements[claim.id], trained, origins) for claim in paper.claims]
    counts = Counter(judgements[claim.id].verdict for claim in paper.claims if not claim.is_added)
    numbers = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])
    caption = (
        "The paper's claims, judged from the errors by block and seed of tables/blocks.csv: "
        f"{numbers}. What decided each is in the CSV; `docs/scorecard.md` says what the verdicts "
        "mean."
    )
    return Table(CLAIMS, caption, pd.DataFrame(rows), COLUMNS)


def claim_files(
    claims: Table, blocks: Sequence[BlockRow], training: Sequence[TrainingRow]
) -> dict[str, pd.DataFrame]:
    """Name -> table, of the files from which the scorecard judges a study: the claims of
    `claims_table`, with the errors and trainings that decide them.
    """
    return {
        CLAIMS: claims.frame,
        BLOCKS: frame(blocks, BlockRow),
        TRAINING: frame(training, TrainingRow),
    }


def decided_claims(claims: Table) -> Table:
    """Those claims of `claims_table` that the study decides, without sources and trainings.

    The scorecard lists all of them.
    """
    decided = claims.frame[claims.frame["verdict"].isin(DECIDED)]
    columns = {name: COLUMNS[name] for name in ("claim", "published", "ours", "verdict")}
    caption = (
        f"The {len(decided)} claims that this study decides, of {len(claims.frame)}; the "
        f"[scorecard](../scorecard.md) has the others. {claims.caption}"
    )
    return Table(DECIDED_CLAIMS, caption, decided[list(columns)], columns)


def _row(
    paper: Paper,
    claim: Claim,
    judgement: Judgement,
    training: Mapping[str, Training],
    origins: Mapping[str, str],
) -> dict[str, str]:
    name, state = least_training(claim, training)
    is_testable = claim.not_testable is None
    return {
        "id": claim.id,
        "claim": without_line_breaks(claim.claim),
        "source": claim.source,
        "published": published_in_words(claim),
        "ours": figures_in_words(judgement, unit_of(claim)),
        "data": f"{origins[claim.part]}, {claim.test_set}" if is_testable else MISSING,
        "verdict": judgement.verdict,
        "training": epochs_in_words(paper, name, state),
        "why": judgement.reason,
    }


def figures_in_words(judgement: Judgement, unit: str, named: Callable[[str], str] = str) -> str:
    """Errors and both ratios with their intervals; ``named`` writes the name of a candidate."""
    words = []
    for name, figure in judgement.values.items():
        label = f"{named(name)} " if len(judgement.values) > 1 else ""
        words.append(f"{label}{figure_in_words(figure)}{unit}")
    if judgement.order is not None:
        words.append(f"mean of blocks' ratios {figure_in_words(judgement.order)}")
    if judgement.size is not None:
        words.append(f"ratio {figure_in_words(judgement.size)}")
    return "; ".join(words) or MISSING


def figure_in_words(figure: Figure) -> str:
    """A figure with its interval, where it has one."""
    if not math.isfinite(figure.low):
        return significant(figure.value)
    return f"{significant(figure.value)} [{significant(figure.low)}, {significant(figure.high)}]"


def published_in_words(claim: Claim, named: Callable[[str], str] = str) -> str:
    """The paper's values and ratio."""
    words = [
        f"{named(name)} {significant(value) if isinstance(value, float) else named(value)}"
        for name, value in claim.published.items()
    ]
    ratio = claim.published_ratio
    if ratio is not None:
        words.append(f"ratio {significant(ratio)}")
    return "; ".join(words) or MISSING


def epochs_in_words(paper: Paper, candidate: str, training: Training | None) -> str:
    """Epochs of the least trained candidate, the paper's, and what is known of the training."""
    of_paper = paper.epochs_of(candidate)
    if training is None or training.state == "not applicable":
        return f"{MISSING} / {of_paper}" if of_paper else MISSING
    ours = training.epochs or MISSING
    published = training.epochs_paper or of_paper or MISSING
    return f"{ours} / {published}, {training.state}"


def unit_of(claim: Claim) -> str:
    """The unit of a claim's figures with a space before it; empty for ratios."""
    return f" {claim.unit}" if claim.unit not in (None, "1") else ""


def without_line_breaks(text: str) -> str:
    """Text without line breaks."""
    return " ".join(text.split())
