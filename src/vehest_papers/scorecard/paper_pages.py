"""The scorecard's page of a paper: its methods, claims by verdict, and tables beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from vehest.report.style import MISSING, significant
from vehest_papers.kit.claim_files import Claim, Table
from vehest_papers.kit.verdict_table import (
    epochs_in_words,
    figures_in_words,
    without_line_breaks,
)
from vehest_papers.kit.verdicts import (
    DEFAULT_MARGIN,
    EQUALITY_CONFIDENCE,
    VERDICTS,
    least_training,
)
from vehest_papers.scorecard.judged import Study, is_provisional, verdict_on_value
from vehest_papers.scorecard.markdown import (
    escaped,
    evidence,
    filled,
    in_italics,
    open_questions,
    ratio_ours,
    ratio_published,
    recommendation,
    report_link,
    sentence_of,
    table,
)

TEMPLATE = Path(__file__).with_name("paper_page.md.j2")
HEADINGS = ("claim", "paper", "ours, 95 % interval", "data", "training", "why")


def paper_page(study: Study, results: Path) -> str:
    """Content of scorecard/PAPER.md."""
    paper = study.paper
    groups = [
        {"title": verdict.capitalize(), "table": _claims(study, claims)}
        for verdict in VERDICTS
        if (claims := _with_verdict(study, verdict))
    ]
    values: dict[str, object] = {
        "title": study.title,
        "report": report_link(study, results, "../"),
        "reference": without_line_breaks(paper.reference),
        "doi": paper.doi,
        "recommendation": recommendation(study),
        "evidence": evidence(study),
        "n_claims": len(study.claims_of_paper),
        "verdicts": _verdicts(study),
        "open": open_questions(study, lambda names: escaped("; ".join(names))),
        "methods": _methods(study),
        "test_sets": _test_sets(study),
        "groups": groups,
        "equality_confidence": round(100 * EQUALITY_CONFIDENCE),
        "margin": round(100 * DEFAULT_MARGIN),
        "added": _added(study),
        "tables": [
            {
                "title": name,
                "parts": [{"about": _about(study, of), "rows": _rows(study, of)} for of in tables],
            }
            for name, tables in groupby(paper.tables, lambda of: of.table)
        ],
    }
    return filled(TEMPLATE, values)


def _with_verdict(study: Study, verdict: str) -> list[Claim]:
    """The paper's claims that have a verdict, provisional ones last."""
    claims = [claim for claim in study.claims_of_paper if study.claims[claim.id].verdict == verdict]
    return sorted(claims, key=study.is_provisional)


def _verdicts(study: Study) -> str:
    counts = study.counts(study.claims_of_paper)
    provisional = study.counts(study.provisional_claims)
    rows = [
        (
            f"[{verdict}](#{verdict.replace(' ', '-')})",
            str(counts[verdict]),
            str(provisional[verdict] or MISSING),
        )
        for verdict in VERDICTS
        if counts[verdict]
    ]
    return table(("verdict", "claims", "of these provisional"), rows, n_text=1)


def _methods(study: Study) -> str:
    seeds = study.n_seeds()
    rows = [
        (
            escaped(name),
            escaped(without_line_breaks(candidate.description)),
            epochs_in_words(study.paper, name, study.training.get(name)),
            str(seeds.get(name, MISSING)),
        )
        for name, candidate in study.paper.candidates.items()
    ]
    headings = ("name", "method", "epochs ours / paper, and whether ours suffice", "seeds")
    return table(headings, rows, n_text=3)


def _test_sets(study: Study) -> str:
    paper = study.paper
    parts = [(claim.test_set, claim.part) for claim in paper.claims if claim.part]
    parts += [(of.test_set, of.part) for of in paper.tables]
    rows = []
    for name, description in paper.test_sets.items():
        kinds = dict.fromkeys(paper.parts[part] for test_set, part in parts if test_set == name)
        rows.append((escaped(name), " and ".join(kinds), escaped(without_line_breaks(description))))
    return table(("name", "ours are", "test set"), rows)


def _claims(study: Study, claims: Sequence[Claim]) -> str:
    """Claims of one verdict; where none is assessed without the columns of ours."""
    headings: tuple[str, ...] = HEADINGS
    rows = [_cells(study, claim) for claim in claims]
    if not any(study.claims[claim.id].n_blocks for claim in claims):
        headings, *rows = [(*cells[:2], cells[-1]) for cells in (headings, *rows)]
    return table(headings, rows)


def _added(study: Study) -> str:
    rows = [
        (study.claims[claim.id].verdict, *_cells(study, claim))
        for claim in study.paper.claims
        if claim.is_added
    ]
    return table(("verdict", *HEADINGS), rows) if rows else ""


def _cells(study: Study, claim: Claim) -> tuple[str, ...]:
    judgement = study.claims[claim.id]
    training = least_training(claim, study.training)[1]
    state = MISSING if training is None else training.state
    origin = MISSING
    if claim.not_testable is None:
        origin = f"{study.paper.parts[claim.part]}, {escaped(claim.test_set)}"
        if judgement.n_blocks > 1:
            origin += f", {judgement.n_blocks} blocks"
    source = "" if claim.is_added else f" ({escaped(claim.source)})"
    return (
        f"{sentence_of(claim)}{source}",
        ratio_published(claim),
        ratio_ours(claim, judgement),
        origin,
        in_italics(f"provisional: {state}", is_provisional=True)
        if study.is_provisional(claim)
        else state,
        escaped(judgement.reason),
    )


def _about(study: Study, of: Table) -> str:
    origin = study.paper.parts[of.part]
    description = escaped(without_line_breaks(study.paper.test_sets[of.test_set]))
    note = f" {escaped(without_line_breaks(of.note))}" if of.note else ""
    return f"**Ours {origin}, {escaped(of.test_set)}:** {description}.{note}"


def _rows(study: Study, of: Table) -> str:
    rows = []
    for row_table, row, judgement in study.rows:
        if row_table is not of:
            continue
        training = study.training.get(row.candidate)
        structure = f" ({row.structure})" if row.structure else ""
        unit = "" if row.unit == "1" else f" {row.unit}"
        verdict = verdict_on_value(judgement, row.published)
        rows.append(
            (
                escaped(row.candidate + structure),
                f"`{row.metric}`",
                f"{significant(row.published)}{unit}",
                figures_in_words(judgement, unit, escaped),
                in_italics(verdict, is_provisional(judgement, training)),
                study.paper.parts[of.part],
                epochs_in_words(study.paper, row.candidate, training),
            )
        )
    headings = (
        "method",
        "error",
        "published",
        "ours, 95 % interval",
        "verdict",
        "data",
        "epochs ours / paper",
    )
    return table(headings, rows)
