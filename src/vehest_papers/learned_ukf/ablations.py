"""The parts beside the main one, and what they are compared with: diagonal noise, no pre-training, E terms, lengths of sequences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from vehest.report.document import Block, Table
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.claims import Claim, claims_table
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.additions import (
    Comparison,
    Subject,
    budgets_table,
    comparison_claims,
    corrected,
    differences_table,
    minima_claim,
    samples_seen,
)
from vehest_papers.learned_ukf.candidates import models_by_candidate
from vehest_papers.learned_ukf.errors import Losses
from vehest_papers.learned_ukf.lengths import epoch_claim, figure_7, length_comparisons, lengths

DIAGONAL = "diagonal"
CURVATURE = "curvature"
SCRATCH = "scratch"
LENGTH = "length_"
SHOWN = "Added after the tests had been seen for the methods above; rules fixed before these candidates were trained (docs/learned_ukf.md)."
CELLS = (
    "Cells: both MSE, then their difference with its interval, corrected by Holm within each tyre."
)
A = "tyre_a"


@dataclass
class Additions:
    """What the parts beside a main one give to the report."""

    comparisons: list[Comparison] = field(default_factory=list)
    subjects: list[Subject] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    appendix: list[Block] = field(default_factory=list)
    timed: bool = False

    def front(self) -> list[Table]:
        """The table of claims, if there are any."""
        table = claims_table(self.claims)
        counts = table.caption.split(". ")[0].removeprefix(
            "What the paper claims and what came out here: "
        )
        return (
            [replace(table, name="claims_added", caption=f"{SHOWN} {counts.capitalize()}. {CELLS}")]
            if self.claims
            else []
        )


def additions(
    name: str,
    part: PartArtefacts,
    beside: Mapping[str, PartArtefacts],
    errors: Mapping[str, Losses],
    kind: str,
) -> Additions:
    """All comparisons of the parts that are there."""
    own = Additions()
    groups = models_by_candidate(part)
    main = {title: Subject.of(part, title, errors=errors) for title in groups}
    scratch = _alone(beside, SCRATCH)
    if paper.NNTF_UH in main:
        trained = main[paper.NNTF_UH]
        _against(
            own,
            trained,
            _alone(beside, DIAGONAL),
            "full noise below diagonal noise",
            "diagonal too simple (III-B.3)",
        )
        _against(
            own,
            trained,
            scratch,
            f"{trained.title} below the same from scratch",
            "inefficient (III-B.4)",
            shared=False,
        )
    curved = _alone(beside, CURVATURE)
    if curved and paper.PC in main:
        own.comparisons.append(Comparison(curved, main[paper.PC]))
        own.subjects += [main[paper.PC], curved]
        if paper.NNTF in main:
            own.comparisons.append(
                Comparison(
                    main[paper.NNTF],
                    curved,
                    "NNTF below PC with the E terms",
                    "0.0085 and 0.0654",
                    (A,),
                    False,
                )
            )
    lasting = {title: other for title, other in beside.items() if title.startswith(LENGTH)}
    found = lengths(lasting) if lasting else []
    own.comparisons += length_comparisons(found) if found else []
    own.subjects += [one.subject for one in found]
    if not own.comparisons:
        return own
    differences = corrected(own.comparisons)
    own.claims += comparison_claims(own.comparisons, differences, kind)
    if scratch and paper.NNTF_UH in main:
        pre_trained = main[paper.NNTF_UH]
        own.claims.append(
            minima_claim(
                scratch, pre_trained, kind, samples_seen(scratch) / samples_seen(pre_trained)
            )
        )
    own.appendix += [
        "## Appendix: comparisons that were added",
        differences_table(own.comparisons, differences, name, kind.upper()),
        budgets_table(list(dict.fromkeys(own.subjects)), name, kind.upper()),
    ]
    if found:
        own.timed = True
        own.claims.append(epoch_claim(found))
        own.appendix += [
            "## Appendix: length of the training sequences",
            *figure_7(found, kind.upper()),
        ]
    return own


def _alone(beside: Mapping[str, PartArtefacts], name: str) -> Subject | None:
    if name not in beside:
        return None
    candidate = next(iter(models_by_candidate(beside[name])))
    return Subject.of(beside[name], candidate)


def _against(
    own: Additions,
    lower: Subject,
    higher: Subject | None,
    claim: str,
    words: str,
    *,
    shared: bool = True,
) -> None:
    if higher is not None:
        own.comparisons.append(Comparison(lower, higher, claim, words, shared=shared))
        own.subjects += [lower, higher]
