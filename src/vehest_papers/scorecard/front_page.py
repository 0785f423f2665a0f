"""The scorecard's front page: the answer on one screen, then how far it can be trusted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from vehest.data.text_files import number_in, read_rows
from vehest.report.style import MISSING
from vehest_papers.kit.block_rows import MAX_IMPROVEMENT
from vehest_papers.kit.verdicts import ALPHA, TARGET_POWER, VERDICTS
from vehest_papers.scorecard.judged import DATA_KINDS, Study
from vehest_papers.scorecard.markdown import (
    counted,
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
NO_EFFECT = "no effect"
EFFECT = "the paper's effect"
HALF = "half of it"
N_CLAIMS_SHOWN = 3  # below each recommendation; the page of the paper has all


def front_page(studies: Sequence[Study], results: Path) -> str:
    """Content of scorecard.md."""
    counts: Counter[str] = Counter()
    data: Counter[str] = Counter()
    for study in studies:
        counts += study.counts(study.claims_of_paper)
        data += study.counts_of_data()
    claims = [
        (study.claims[claim.id], study.paper.parts.get(claim.part), study.is_provisional(claim))
        for study in studies
        for claim in study.claims_of_paper
    ]
    undecided = [
        is_provisional for judgement, _, is_provisional in claims if judgement.verdict in UNDECIDED
    ]
    met_on_real = [
        is_provisional
        for judgement, kind, is_provisional in claims
        if judgement.verdict in MET and kind == "real"
    ]
    effects_not_found = [
        judgement
        for judgement, _, is_provisional in claims
        if judgement.verdict == "no significant difference"
        and judgement.power >= TARGET_POWER
        and not is_provisional
    ]
    rates = _planted_truth(results / "scorecard" / "planted_truth.csv")
    values = {
        "n_claims": len(claims),
        "n_assessed": sum(len(study.assessed_claims) for study in studies),
        "n_provisional": sum(len(study.provisional_claims) for study in studies),
        "n_table_values": sum(len(study.rows) for study in studies),
        "counts": {verdict: counts[verdict] for verdict in VERDICTS},
        "n_undecided": len(undecided),
        "n_undecided_provisional": sum(undecided),
        "n_effects_not_found": len(effects_not_found),
        "target_power": round(100 * TARGET_POWER),
        "data": {kind: data[kind] for kind in DATA_KINDS},
        "n_met_on_real": len(met_on_real),
        "n_met_on_real_provisional": sum(met_on_real),
        "papers": [
            {
                "title": study.title,
                "page": f"scorecard/{study.paper.paper}.md",
                "report": report_link(study, results, ""),
                "doi": study.paper.doi,
                "recommendation": recommendation(study),
                "evidence": evidence(study, N_CLAIMS_SHOWN),
                "open": open_questions(study, _counted_names),
            }
            for study in studies
        ],
        "verdicts": _verdicts(studies),
        "basis": _basis(studies),
        "max_improvement": round(100 * MAX_IMPROVEMENT),
        "rates": rates,
        "nominal": round(100 * ALPHA),
        "planted": _planted_table(rates),
    }
    return filled(TEMPLATE, values)


def _verdicts(studies: Sequence[Study]) -> str:
    """Number of claims by verdict and paper, their sums first; in brackets provisional ones."""
    numbers = [
        (study.counts(study.claims_of_paper), study.counts(study.provisional_claims))
        for study in studies
    ]
    rows = []
    for verdict in VERDICTS:
        pairs = [(all_claims[verdict], provisional[verdict]) for all_claims, provisional in numbers]
        rows.append((verdict, *_with_sum(pairs)))
    totals = [(len(study.claims_of_paper), len(study.provisional_claims)) for study in studies]
    return _table_of_papers("verdict", studies, [*rows, ("all claims", *_with_sum(totals))])


def _basis(studies: Sequence[Study]) -> str:
    """Number of assessed claims by data and paper, with their sums."""
    rows = [
        (kind, *_with_sum([(study.counts_of_data()[kind], 0) for study in studies]))
        for kind in DATA_KINDS
    ]
    totals = [(len(study.assessed_claims), 0) for study in studies]
    return _table_of_papers("data", studies, [*rows, ("assessed", *_with_sum(totals))])


def _with_sum(pairs: Sequence[tuple[int, int]]) -> list[str]:
    sums = (sum(first for first, _ in pairs), sum(second for _, second in pairs))
    return [counted(*pair) for pair in [sums, *pairs]]


def _table_of_papers(heading: str, studies: Sequence[Study], rows: Iterable[Sequence[str]]) -> str:
    links = [f"[{study.title}](scorecard/{study.paper.paper}.md)" for study in studies]
    return table((heading, "all", *links), rows, n_text=1)


def _counted_names(names: Sequence[str]) -> str:
    return f"{len(names)} method{'s' if len(names) > 1 else ''}"


def _planted_truth(path: Path) -> dict[str, object]:
    """Rates of verdicts on simulated studies, as `vehest_papers.planted_truth` wrote them."""
    columns = ("design", "seeds", "truth", "ratio", "studies", "wrong", "reproduced")
    rows = read_rows(path, (*columns, "direction only", "size_covered"))
    designs: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        rates = designs.setdefault((row["design"], row["seeds"]), {})
        wrong, covered = (number_in(row, name, path) for name in ("wrong", "size_covered"))
        met = sum(number_in(row, name, path) for name in ("reproduced", "direction only"))
        rates |= {f"wrong, {row['truth']}": wrong, f"met, {row['truth']}": met}
        rates["covered"] = min(covered, rates.get("covered", 100.0))
    several = [rates for (_, seeds), rates in designs.items() if int(seeds) > 1]
    single = [rates for (_, seeds), rates in designs.items() if int(seeds) == 1]
    [n_seeds] = {seeds for _, seeds in designs if int(seeds) > 1}
    [ratio] = {number_in(row, "ratio", path) for row in rows if row["truth"] == EFFECT}
    return {
        "designs": designs,
        "seeds": n_seeds,
        "studies": rows[0]["studies"],
        "reduction": round(100 * (1 - ratio)),
        "wrong": _range(rates[f"wrong, {NO_EFFECT}"] for rates in several),
        "wrong_single": _range(rates[f"wrong, {NO_EFFECT}"] for rates in single),
        "met": _range(rates[f"met, {EFFECT}"] for rates in several),
    }


def _range(numbers: Iterable[float]) -> str:
    values = sorted(numbers)
    return f"{values[0]:.0f} to {values[-1]:.0f}"


def _planted_table(rates: dict[str, object]) -> str:
    designs = rates["designs"]
    assert isinstance(designs, dict)
    columns = (
        f"wrong, {NO_EFFECT}",
        f"met, {EFFECT}",
        f"met, {HALF}",
        "covered",
    )
    rows = [
        (design, seeds, *(f"{of_design[name]:.1f}" for name in columns))
        for (design, seeds), of_design in designs.items()
    ]
    headings = (
        "blocks",
        "seeds",
        "no effect: a difference is found",
        "the paper's effect: found",
        "half of it: found",
        "size in interval, at least",
    )
    return table(headings, rows, n_text=1) if rows else MISSING
