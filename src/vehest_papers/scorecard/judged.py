"""A paper with its claims and table rows judged, and how many claims have which verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vehest_papers.kit.block_errors import (
    Training,
    read_blocks,
    read_training,
)
from vehest_papers.kit.block_rows import TrainingState
from vehest_papers.kit.claim_files import Claim, Paper, Row, Table, claims_of
from vehest_papers.kit.verdicts import Judgement, judge_paper, judge_row, least_training

PAPERS = ("ksnn", "learned_ukf", "heavy_ekf", "cnn_ukf")
TITLES = {
    "ksnn": "KS-NN",
    "learned_ukf": "Learned UKF",
    "heavy_ekf": "Heavy-vehicle EKF",
    "cnn_ukf": "CNN-UKF",
}
DATA_KINDS = ("real", "simulated", "computed")


@dataclass(frozen=True)
class Study:
    """A paper with its judged claims and table rows."""

    paper: Paper
    training: Mapping[str, Training]
    claims: Mapping[str, Judgement]  # id -> judgement
    rows: Sequence[tuple[Table, Row, Judgement]]

    @property
    def title(self) -> str:
        """Short name of the paper's method."""
        return TITLES[self.paper.paper]

    @property
    def page(self) -> str:
        """File of the paper's page, below results/."""
        return f"scorecard/{self.paper.paper}.md"

    @property
    def claims_of_paper(self) -> list[Claim]:
        """Claims without the comparisons that we added."""
        return [claim for claim in self.paper.claims if not claim.is_added]

    @property
    def assessed_claims(self) -> list[Claim]:
        """The paper's claims that errors by block decide."""
        return [claim for claim in self.claims_of_paper if self.claims[claim.id].n_blocks]

    @property
    def provisional_claims(self) -> list[Claim]:
        """Assessed claims with a candidate whose training was not shown to be sufficient."""
        return [claim for claim in self.assessed_claims if self.is_provisional(claim)]

    def is_provisional(self, claim: Claim) -> bool:
        """Whether a claim's least trained candidate was not shown to be trained sufficiently."""
        training = least_training(claim, self.training)[1]
        return is_provisional(self.claims[claim.id], training)

    def counts(self, claims: Iterable[Claim]) -> Counter[str]:
        """Verdict -> number of claims."""
        return Counter(self.claims[claim.id].verdict for claim in claims)

    def candidates(self, claims: Iterable[Claim], state: TrainingState) -> list[str]:
        """Candidates of some claims whose training has a state, in the paper's order."""
        names = {name for claim in claims for name in claim.names}
        return [
            name
            for name in self.paper.candidates
            if name in names and name in self.training and self.training[name].state == state
        ]

    def n_seeds(self) -> dict[str, int]:
        """Candidate -> most seeds that any of its errors is from, of those that are trained."""
        numbers: dict[str, int] = {}
        for judgement in [*self.claims.values(), *(entry[2] for entry in self.rows)]:
            for name, number in (judgement.n_seeds or {}).items():
                numbers[name] = max(number, numbers.get(name, 0))
        return {
            name: number
            for name, number in numbers.items()
            if name in self.training and self.training[name].state != "not applicable"
        }


def read_study(name: str, results: Path) -> Study:
    """Read a paper's claims and the errors by block of its study, and judge them."""
    paper = claims_of(name)
    tables = results / paper.study / "tables"
    blocks_file = tables / "blocks.csv"
    training_file = tables / "training.csv"
    blocks = read_blocks(blocks_file) if blocks_file.exists() else None
    training = read_training(training_file) if training_file.exists() else {}
    rows = [
        (table, row, judge_row(row, table, blocks, training))
        for table in paper.tables
        for row in table.rows
    ]
    return Study(paper, training, judge_paper(paper, blocks, training), rows)


def is_provisional(judgement: Judgement, training: Training | None) -> bool:
    """Whether a verdict rests on a training that was not shown to be sufficient."""
    is_sufficient = training is None or training.state in ("sufficient", "not applicable")
    return judgement.n_blocks > 0 and not is_sufficient


def verdict_on_value(judgement: Judgement, published: float) -> str:
    """The verdict on a table's value in words of its own: a difference on other data than the
    paper's contradicts no claim.
    """
    ours = next(iter(judgement.values.values()), None)
    if judgement.verdict == "reproduced":
        return "agrees"
    if judgement.verdict == "contradicted" and ours is not None:
        return "lower" if ours.value < published else "higher"
    return judgement.verdict
