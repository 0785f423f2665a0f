"""What a paper claims and tabulates, as data: claims.yaml, the file beside each paper's study."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

from vehest.data.errors import DataError
from vehest.data.schema import validated
from vehest.data.text_files import read_yaml

ADDED_SOURCE = "Not in the paper"  # `source` of comparisons that the paper does not make
BASELINES = ("zero", "static_map")
CLAIMS_FOLDER = Path(__file__).parents[1]  # a folder each paper

Kind = Literal["order", "equal", "limit", "measured"]
Origin = Literal["real", "simulated", "computed"]


@dataclass(frozen=True)
class Candidate:
    """An estimator that claims or tables name."""

    description: str
    epochs_paper: int | float | str | None = None  # None where nothing is trained


@dataclass(frozen=True)
class Claim:
    """One claim; which keys it has depends on its kind (docs/scorecard.md)."""

    id: str
    claim: str
    source: str
    kind: Kind | None = None  # None where the claim is not testable
    candidate: str | None = None
    other: str | None = None
    other_part: str | None = None  # of the other candidate, where it is not ``part``
    direction: Literal["lower", "higher"] | None = None
    limit: float | None = None  # in the metric's unit; with ``other``, of the ratio
    margin: float | None = None  # relative, of an equality
    part: str = ""
    test_set: str = ""
    metric: str = ""
    published: Mapping[str, float | str] = field(default_factory=dict)
    ratio: float | None = None  # the paper's candidate / other
    family: str | None = None  # claims whose p-values are corrected together
    measure: str | None = None  # function that returns one value for each block and seed
    unit: str | None = None
    note: str = ""
    not_testable: str | None = None  # which data are not public
    same_trainings: bool = False  # candidate and other are the same networks, seed by seed

    @property
    def is_added(self) -> bool:
        """Whether the comparison is ours, not the paper's."""
        return self.source == ADDED_SOURCE

    @property
    def names(self) -> list[str]:
        """Candidates that it compares."""
        return [name for name in (self.candidate, self.other) if name is not None]

    @property
    def published_ratio(self) -> float | None:
        """The paper's candidate / other, stated or of the two values that it tabulates."""
        if self.ratio is not None:
            return self.ratio
        values = [self.published.get(name) for name in self.names]
        if len(set(self.names)) == 2 and all(isinstance(value, float) for value in values):
            first, second = (float(value) for value in values if value is not None)
            return first / second if second > 0 else None
        return None


@dataclass(frozen=True)
class Row:
    """One value of a paper's table."""

    candidate: str
    metric: str
    published: float
    unit: str
    structure: str = ""  # of the network, as the table states it


@dataclass(frozen=True)
class Table:
    """A table of a paper, or figures of its text."""

    table: str
    part: str
    test_set: str
    rows: list[Row]
    note: str = ""


@dataclass(frozen=True)
class Paper:
    """A paper with its claims and tables."""

    paper: str
    reference: str
    doi: str
    study: str
    recommendation: str
    parts: Mapping[str, Origin]
    test_sets: Mapping[str, str]  # what each is, in a few words
    candidates: Mapping[str, Candidate]
    claims: list[Claim]
    tables: list[Table]
    rests_on: Mapping[str, list[str]] = field(default_factory=dict)
    """Claim's id -> verdicts with which the recommendation stands; empty: it is shown only."""

    def epochs_of(self, candidate: str) -> str:
        """Epochs of the paper's training; empty where it trains or declares no such candidate."""
        declared = self.candidates.get(candidate)
        epochs = None if declared is None else declared.epochs_paper
        return "" if epochs is None else str(epochs)

    def published(self, part: str, test_set: str, candidate: str, metric: str) -> float:
        """A figure of the paper's tables; NaN where it states none."""
        figures = {
            (table.part, table.test_set, row.candidate, row.metric): row.published
            for table in self.tables
            for row in table.rows
        }
        return figures.get((part, test_set, candidate, metric), math.nan)

    def metrics(self) -> list[tuple[str, str, str]]:
        """Part, test set and metric of every error that claims or tables name."""
        keys = [
            (part, claim.test_set, claim.metric)
            for claim in self.claims
            if claim.metric
            for part in (claim.part, claim.other_part or claim.part)
        ]
        keys += [
            (table.part, table.test_set, row.metric) for table in self.tables for row in table.rows
        ]
        return list(dict.fromkeys(keys))


_REQUIRED: Mapping[Kind, Sequence[str]] = {
    "order": ("candidate", "other", "direction", "part", "test_set", "metric"),
    "equal": ("candidate", "part", "test_set", "metric"),
    "limit": ("candidate", "direction", "limit", "part", "test_set", "metric"),
    "measured": ("limit", "measure", "part", "test_set"),
}
_USELESS: Mapping[Kind, Sequence[str]] = {
    "order": ("limit", "margin", "measure"),
    "equal": ("direction", "measure"),
    "limit": ("margin", "measure"),
    "measured": ("metric",),
}
_ID = re.compile(r"[a-z0-9_]+")


@cache
def claims_of(name: str) -> Paper:
    """Claims and tables of one of the papers that are re-created here."""
    return read_paper(CLAIMS_FOLDER / name / "claims.yaml")


def read_paper(path: Path) -> Paper:
    """Read claims.yaml.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        In one line: the file, the claim or table, the key, and what it must be.
    """
    source = f"'{path}'"
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise DataError(
            f"{source} must be a mapping with the keys paper, reference, claims, tables"
        )
    entries = content.get("claims")
    tables = content.get("tables")
    for key, value in (("claims", entries), ("tables", tables)):
        if not isinstance(value, list):
            raise DataError(f"{source}: {key} must be a list, empty ([]) where there are none")
    paper = validated(Paper, {**content, "claims": [], "tables": []}, source)
    claims = [_read_claim(entry, position, source) for position, entry in enumerate(entries or [])]
    paper = replace(
        paper,
        claims=claims,
        tables=[
            validated(Table, entry, f"{source}, table {position + 1}")
            for position, entry in enumerate(tables or [])
        ],
    )
    _check_names(paper, source)
    return paper


def _read_claim(entry: Any, position: int, source: str) -> Claim:
    name = entry.get("id") if isinstance(entry, dict) else None
    subject = (
        f"{source}, claim {name!r}" if isinstance(name, str) else f"{source}, claim {position + 1}"
    )
    claim = validated(Claim, entry, subject)
    if fault := _fault_of(claim):
        raise DataError(f"{subject}: {fault}")
    return claim


def _fault_of(claim: Claim) -> str:
    """What is wrong with a claim and what to write instead; empty where nothing is."""
    if not _ID.fullmatch(claim.id):
        return "id must consist of lower-case letters, digits and underscores"
    if claim.not_testable is not None:
        return "kind must be left out where not_testable is given" if claim.kind else ""
    if claim.kind is None:
        return f"kind is missing; it is one of: {', '.join(_REQUIRED)} (or give not_testable)"
    for key in _REQUIRED[claim.kind]:
        if getattr(claim, key) in (None, ""):
            return f"{key} is missing, which a claim of kind {claim.kind} needs"
    for key in _USELESS[claim.kind]:
        if getattr(claim, key) not in (None, ""):
            return f"{key} has no meaning in a claim of kind {claim.kind}; leave it out"
    return _fault_of_values(claim)


def _fault_of_values(claim: Claim) -> str:
    if claim.kind == "equal" and (claim.other is None) == (claim.limit is None):
        return "kind equal needs either other or limit"
    if claim.kind == "measured" and (claim.direction is None) == (claim.margin is None):
        return "kind measured needs either direction or margin beside its limit"
    if claim.kind == "order" and claim.candidate == claim.other and claim.other_part is None:
        return f"candidate and other are both {claim.other!r}; give other_part or another name"
    if claim.margin is not None and not 0.0 < claim.margin < 1.0:
        return f"margin must be between 0 and 1, a relative difference, not {claim.margin:g}"
    if claim.ratio is not None and not claim.ratio > 0:
        return f"ratio must be above 0, candidate / other, not {claim.ratio:g}"
    if claim.kind in ("limit", "equal") and claim.limit is not None and not claim.limit > 0:
        return f"limit must be above 0, in the metric's unit, not {claim.limit:g}"
    return ""


def _check_names(paper: Paper, source: str) -> None:
    """Refuse ids that occur twice, and candidates and parts that are not declared."""
    ids = [claim.id for claim in paper.claims]
    for claim in paper.claims:
        subject = f"{source}, claim {claim.id!r}"
        if ids.count(claim.id) > 1:
            raise DataError(f"{subject}: id occurs {ids.count(claim.id)} times; ids must be unique")
        if claim.not_testable is None:
            _check_declared(paper.candidates, claim.names, "candidates", subject)
            parts = [claim.part, *([claim.other_part] if claim.other_part else [])]
            _check_declared(paper.parts, parts, "parts", subject)
            _check_declared(paper.test_sets, [claim.test_set], "test_sets", subject)
    for name in paper.rests_on:
        if name not in ids:
            raise DataError(f"{source}, rests_on: no claim has the id {name!r}; write one that has")
    for table in paper.tables:
        subject = f"{source}, table {table.table!r}"
        _check_declared(
            paper.candidates, [row.candidate for row in table.rows], "candidates", subject
        )
        _check_declared(paper.parts, [table.part], "parts", subject)
        _check_declared(paper.test_sets, [table.test_set], "test_sets", subject)


def _check_declared(
    declared: Mapping[str, object], names: Sequence[str], key: str, subject: str
) -> None:
    for name in names:
        if name not in declared:
            raise DataError(
                f"{subject}: {name!r} is not among the {key} declared at the top of the file "
                f"({', '.join(declared)}); add it there or correct the name"
            )
