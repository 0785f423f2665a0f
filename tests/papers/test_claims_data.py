"""The claims of the papers as data: claims.yaml of each paper, and the record of the claims that
they replaced.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import ksnn_tables
import pytest
import yaml

import vehest_papers
from vehest_papers.heavy_ekf import paper as heavy_ekf
from vehest_papers.ksnn import paper as ksnn

FOLDER = Path(vehest_papers.__file__).parent
RESULTS = Path(__file__).parents[2] / "results"
CLAIMS_BEFORE = {
    "learned_ukf": 42,
    "learned_ukf_sim": 12,
    "heavy_ekf": 52,
    "cnn_ukf": 42,
    "ksnn": 44,
}
"""Study -> rows of its tables of claims before claims were data."""
PAPERS = ("ksnn", "learned_ukf", "heavy_ekf", "cnn_ukf")
ROUNDING = 0.012  # relative: two printed figures of three digits each, and their ratio


def read_claims(paper: str) -> dict[str, Any]:
    text = (FOLDER / paper / "claims.yaml").read_text(encoding="utf-8")
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def read_mapping() -> list[dict[str, str]]:
    with (FOLDER / "claims_before.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def published_figures(paper: str) -> dict[tuple[str, str, str, str, str], float]:
    """(table, part, test set, candidate, metric) -> figure of the paper's tables."""
    return {
        (table["table"], table["part"], table["test_set"], row["candidate"], row["metric"]): row[
            "published"
        ]
        for table in read_claims(paper)["tables"]
        for row in table["rows"]
    }


def table_of(paper: str, table: str, test_set: str) -> dict[tuple[str, str], float]:
    """(candidate, metric) -> figure of one table on one test set."""
    return {
        (candidate, metric): value
        for (name, _, test, candidate, metric), value in published_figures(paper).items()
        if (name, test) == (table, test_set)
    }


def test_every_claim_before_is_mapped_exactly_once():
    rows = read_mapping()
    keys = [(row["paper"], row["old_claim"], row["data"]) for row in rows]
    assert len(set(keys)) == len(keys)
    assert {study: sum(row["paper"] == study for row in rows) for study in CLAIMS_BEFORE} == (
        CLAIMS_BEFORE
    )
    assert len(rows) == sum(CLAIMS_BEFORE.values())


def test_mapping_names_claims_that_exist_and_says_why_others_were_removed():
    ids = {paper: {claim["id"] for claim in read_claims(paper)["claims"]} for paper in PAPERS}
    for row in read_mapping():
        assert row["id"], row["old_claim"]
        assert row["reason"], row["old_claim"]
        if row["id"] != "removed":
            assert set(row["id"].split()) <= ids[row["paper"]], row["old_claim"]


@pytest.mark.parametrize("paper", PAPERS)
def test_paper_is_cited_by_its_doi(paper: str):
    citation = yaml.safe_load((RESULTS.parent / "CITATION.cff").read_text(encoding="utf-8"))
    content = read_claims(paper)
    titles = {
        reference["doi"]: reference["title"]
        for reference in citation["references"]
        if "doi" in reference
    }
    assert titles[content["doi"]].lower() in content["reference"].lower()


@pytest.mark.parametrize("paper", PAPERS)
def test_every_candidate_is_declared_and_used(paper: str):
    content = read_claims(paper)
    used_candidates = {
        claim[key] for claim in content["claims"] for key in ("candidate", "other") if key in claim
    }
    used_candidates |= {row["candidate"] for table in content["tables"] for row in table["rows"]}
    assert used_candidates <= set(content["candidates"])
    assert set(content["candidates"]) - used_candidates <= {"zero", "static_map"}


@pytest.mark.parametrize("paper", PAPERS)
def test_rows_of_tables_are_unique(paper: str):
    n_rows = sum(len(table["rows"]) for table in read_claims(paper)["tables"])
    assert len(published_figures(paper)) == n_rows


@pytest.mark.parametrize("paper", PAPERS)
def test_published_figures_of_claims_agree_with_the_tables(paper: str):
    figures: dict[tuple[str, str, str, str], set[float]] = {}
    for (_, part, test, candidate, metric), value in published_figures(paper).items():
        figures.setdefault((part, test, candidate, metric), set()).add(value)
    assert all(len(values) == 1 for values in figures.values())
    for claim in read_claims(paper)["claims"]:
        if "metric" not in claim:
            continue
        for candidate, value in claim.get("published", {}).items():
            part = claim["part"]
            if candidate == claim.get("other"):
                part = claim.get("other_part", part)
            key = (part, claim["test_set"], candidate, claim["metric"])
            if key in figures:
                assert figures[key] == {value}, claim["id"]


@pytest.mark.parametrize("paper", PAPERS)
def test_ratios_are_those_of_the_published_figures(paper: str):
    for claim in read_claims(paper)["claims"]:
        published = claim.get("published", {})
        if "ratio" not in claim or claim.get("candidate") == claim.get("other"):
            continue
        if {claim["candidate"], claim.get("other")} <= set(published):
            ratio = published[claim["candidate"]] / published[claim["other"]]
            assert claim["ratio"] == pytest.approx(ratio, rel=ROUNDING), claim["id"]


@pytest.mark.parametrize("paper", PAPERS)
def test_published_figures_are_on_the_side_that_is_claimed(paper: str):
    for claim in read_claims(paper)["claims"]:
        if claim.get("kind") != "order" or "ratio" not in claim:
            continue
        assert (claim["ratio"] < 1.0) == (claim["direction"] == "lower"), claim["id"]


def test_ratios_of_heavy_ekf_are_those_of_the_report():
    orders = [
        claim
        for claim in read_claims("heavy_ekf")["claims"]
        if claim.get("kind") == "order" and "ratio" in claim
    ]
    pairs = {(claim["candidate"], claim["other"]) for claim in orders}
    assert pairs == set(heavy_ekf.GAINS)
    for claim in orders:
        gain = heavy_ekf.GAINS[claim["candidate"], claim["other"]]
        assert claim["ratio"] == pytest.approx(1.0 - gain / 100.0), claim["id"]


def test_fast_lap_of_heavy_ekf_is_that_of_the_report():
    fast = float(heavy_ekf.FAST[heavy_ekf.RATTE])
    assert table_of("heavy_ekf", "Section IV", "nominal_fast") == {("RATTE", "rmse_sideslip"): fast}


@pytest.mark.parametrize(
    ("table", "constants"), [("Table IV", ksnn_tables.TABLE_IV), ("Table V", ksnn_tables.TABLE_V)]
)
@pytest.mark.parametrize("test_set", ["c2", "f2"])
def test_tables_of_ksnn_are_those_of_the_report(table: str, constants: Any, test_set: str):
    expected: dict[tuple[str, str], float] = {}
    for candidate, row in constants.items():
        expected[candidate, "fvu"] = row.fvu(test_set)
        expected[candidate, "rmse_vy"] = row.rmse(test_set)
    assert table_of("ksnn", table, test_set) == expected


@pytest.mark.parametrize(
    ("table", "constants"), [("Table IV", ksnn_tables.TABLE_IV), ("Table V", ksnn_tables.TABLE_V)]
)
def test_structures_of_ksnn_are_those_of_the_report(table: str, constants: Any):
    rows = [
        row
        for table_entry in read_claims("ksnn")["tables"]
        if table_entry["table"] == table
        for row in table_entry["rows"]
    ]
    for row in rows:
        published = constants[row["candidate"]]
        words = f"{published.n_parameters} parameters"
        if published.structure != "–":
            words = f"{published.structure}, {words}"
        assert row["structure"] == words


def test_table_vi_of_ksnn_is_that_of_the_report():
    expected = {(name, "rmse_sideslip"): value for name, value in ksnn_tables.TABLE_VI.items()}
    assert table_of("ksnn", "Table VI", "test") == expected


def test_table_vii_of_ksnn_is_that_of_the_report():
    names = {ksnn.LSTM: "LSTM, 2 states", ksnn.NONLINEAR: "KS-NN nonlinear no bias, P = 2, Q = 2"}
    parts = {True: "scheme_2", False: "one_vehicle"}
    expected: dict[tuple[str, str, str, str, str], float] = {}
    for (category, regularised), row in ksnn_tables.TABLE_VII.items():
        for test_set in ("c2", "f2"):
            key = ("Table VII", parts[regularised], test_set, names[category])
            expected[(*key, "fvu")] = row.fvu(test_set)
            expected[(*key, "rmse_vy")] = row.rmse(test_set)
    figures = published_figures("ksnn")
    assert {key: value for key, value in figures.items() if key[0] == "Table VII"} == expected
