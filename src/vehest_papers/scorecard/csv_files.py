"""The scorecard's CSV files: every claim and table row, and what became of earlier verdicts."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from vehest.data.errors import DataError
from vehest.data.text_files import read_rows
from vehest_papers.kit.claim_files import Claim
from vehest_papers.kit.verdict_table import figure_in_words, without_line_breaks
from vehest_papers.kit.verdicts import Figure, Judgement, least_training
from vehest_papers.scorecard.judged import Study, verdict_on_value

CSV_COLUMNS = (
    "paper",
    "row",
    "id",
    "text",
    "source",
    "data",
    "part",
    "test_set",
    "metric",
    "published",
    "ours",
    "published_ratio",
    "size",
    "size_low",
    "size_high",
    "order",
    "order_low",
    "order_high",
    "p_value",
    "blocks",
    "seeds",
    "diverged",
    "power",
    "blocks_needed",
    "training",
    "epochs",
    "epochs_paper",
    "verdict",
    "reason",
)


def rows_of_all(studies: Sequence[Study]) -> str:
    """Content of scorecard.csv: a row for each value of a table, claim and added comparison."""
    return _csv(CSV_COLUMNS, [row for study in studies for row in _csv_rows(study)])


def changed_verdicts(studies: Sequence[Study], before: Path) -> str:
    """Claims as they were judged before this engine, with their verdicts now.

    Raises
    ------
    DataError
        A claim in ``before`` is mapped to an id that claims.yaml lacks.
    """
    columns = ("paper", "old_claim", "data", "old_verdict", "id", "verdict", "reason", "mapping")
    judged = {
        (study.paper.paper, name): judgement
        for study in studies
        for name, judgement in study.claims.items()
    }
    rows = []
    for row in read_rows(before, ("paper", "old_claim", "data", "verdict", "id", "reason")):
        ids = [] if row["id"] == "removed" else row["id"].split()
        missing = [name for name in ids if (row["paper"], name) not in judged]
        if missing:
            raise DataError(
                f"'{before}': {row['paper']} has no claim {missing[0]!r}; "
                "write an id of claims.yaml"
            )
        now = [judged[row["paper"], name] for name in ids]
        rows.append(
            {
                "paper": row["paper"],
                "old_claim": row["old_claim"],
                "data": row["data"],
                "old_verdict": row["verdict"],
                "id": row["id"],
                "verdict": "; ".join(judgement.verdict for judgement in now) or "removed",
                "reason": "; ".join(dict.fromkeys(judgement.reason for judgement in now)),
                "mapping": row["reason"],
            }
        )
    return _csv(columns, rows)


def _csv_rows(study: Study) -> list[dict[str, str]]:
    rows = []
    for table, row, judgement in study.rows:
        claim = Claim(
            "",
            f"{row.candidate} {row.structure}".strip(),
            table.table,
            candidate=row.candidate,
            part=table.part,
            test_set=table.test_set,
            metric=row.metric,
            published={row.candidate: row.published},
        )
        of_value = {"row": "table", "verdict": verdict_on_value(judgement, row.published)}
        rows.append(_csv_row(study, claim, judgement) | of_value)
    for claim in study.paper.claims:
        rows.append(_csv_row(study, claim, study.claims[claim.id]))
    return rows


def _csv_row(study: Study, claim: Claim, judgement: Judgement) -> dict[str, str]:
    name, state = least_training(claim, study.training)
    return {
        "paper": study.paper.paper,
        "row": "added comparison" if claim.is_added else "claim",
        "id": claim.id,
        "text": without_line_breaks(claim.claim),
        "source": claim.source,
        "data": study.paper.parts.get(claim.part, ""),
        "part": claim.part,
        "test_set": claim.test_set,
        "metric": claim.metric,
        "published": "; ".join(f"{name} {value}" for name, value in claim.published.items()),
        "ours": "; ".join(
            f"{name} {figure_in_words(figure)}" for name, figure in judgement.values.items()
        ),
        "published_ratio": _number(claim.published_ratio),
        **_ends("size", judgement.size),
        **_ends("order", judgement.order),
        "p_value": _number(judgement.p_value),
        "blocks": str(judgement.n_blocks or ""),
        "seeds": " ".join(str(number) for number in (judgement.n_seeds or {}).values()),
        "diverged": " ".join(str(number) for number in (judgement.diverged or {}).values()),
        "power": _number(judgement.power),
        "blocks_needed": str(judgement.blocks_needed or ""),
        "training": state.state if state is not None else "not applicable",
        "epochs": state.epochs if state is not None else "",
        "epochs_paper": study.paper.epochs_of(name),
        "verdict": judgement.verdict,
        "reason": judgement.reason,
    }


def _ends(name: str, figure: Figure | None) -> dict[str, str]:
    values = (None, None, None) if figure is None else (figure.value, figure.low, figure.high)
    keys = (name, f"{name}_low", f"{name}_high")
    return {key: _number(value) for key, value in zip(keys, values, strict=True)}


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _csv(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> str:
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()
