"""The scorecard: what committed claims and errors give, and what a small study with a planted truth
shows.
"""

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from vehest_papers import planted_truth, scorecard
from vehest_papers.kit.verdicts import VERDICTS

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"


@pytest.fixture(scope="module")
def files():
    return scorecard.scorecard_files(RESULTS)


def test_the_published_scorecard_is_what_its_inputs_give(files):
    for name, text in files.items():
        assert (RESULTS / name).read_text(encoding="utf-8") == text, "run make scorecard"


def test_every_old_claim_is_mapped_and_every_paper_is_counted(files):
    changed = list(csv.DictReader(files["scorecard/changed_verdicts.csv"].splitlines()))
    before = (scorecard.CLAIMS_FOLDER / "claims_before.csv").read_text(encoding="utf-8")
    assert len(changed) == len(list(csv.DictReader(before.splitlines())))
    rows = list(csv.DictReader(files["scorecard.csv"].splitlines()))
    page = files["scorecard.md"].split("## Verdicts on the papers' claims")[1]
    table = [line.strip("|").split("|") for line in page.splitlines() if line.startswith("|")]
    cells = [row[1:] for row in table[2 : 3 + len(VERDICTS)]]
    counts = np.array(
        [[int(cell.replace("–", "0").split("(")[0]) for cell in row] for row in cells]
    )
    of_papers = [
        sum(row["paper"] == paper and row["row"] == "claim" for row in rows)
        for paper in scorecard.PAPERS
    ]
    assert counts[-1].tolist() == counts[:-1].sum(axis=0).tolist() == of_papers


def test_values_of_tables_are_lower_or_higher_where_ours_differ(files):
    rows = [
        row
        for row in csv.DictReader(files["scorecard.csv"].splitlines())
        if row["row"] == "table" and row["verdict"] in ("agrees", "lower", "higher")
    ]
    assert {"lower", "higher"} <= {row["verdict"] for row in rows}
    for row in rows:
        published = float(row["published"].rsplit(" ", 1)[1])
        ours = float(row["ours"].removesuffix("]").rsplit(" [", 1)[0].rsplit(" ", 1)[1])
        sides = {"lower": ours < published, "higher": ours > published, "agrees": True}
        assert sides[row["verdict"]], row


def test_readme_names_and_links_the_four_papers(files):
    first_screen = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()[:16]
    text = "\n".join(first_screen)
    assert "results/scorecard.md" in text
    for doi in re.findall(r"\[doi:([^\]]+)\]", files["scorecard.md"]):
        assert f"https://doi.org/{doi}" in text


def test_a_study_with_errors_is_judged_and_a_stale_page_is_noticed(tmp_path, capsys):
    """One real paper with invented errors: NNTF_UH has half the loss of GRU in each block."""
    results = tmp_path / "results"
    shutil.copytree(RESULTS / "scorecard", results / "scorecard")
    tables = results / "learned_ukf" / "tables"
    tables.mkdir(parents=True)
    rng = np.random.default_rng(0)
    lines = ["part,candidate,seed,test_set,metric,block,value,size"]
    for name, level in (("NNTF_UH", 0.5), ("GRU", 1.0), ("zero", 40.0)):
        for seed in range(3):
            for block in range(20):
                value = level * np.exp(0.3 * rng.normal())
                lines.append(f"real,{name},{seed},tyre_a,mse_weighted,{block},{value},100")
    (tables / "blocks.csv").write_text("\n".join(lines) + "\n")
    training = [
        "candidate,epochs,epochs_paper,training,reason",
        "NNTF_UH,100 + 100,1000 + 1000,insufficient,",
    ]
    (tables / "training.csv").write_text("\n".join(training) + "\n")
    scorecard.main(["--results", str(results)])
    page = (results / "scorecard.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if "than GRU on the tyre used for" in line)
    assert "*direction only*" in row  # the paper has a ratio of 0.83
    assert "100 + 100 / 1000 + 1000, insufficient" in row
    assert re.search(r"ratio 0\.[45]\d+ \[0\.", row)
    table = next(line for line in page.splitlines() if line.startswith("| NNTF\\_UH | `mse_"))
    assert "*inconclusive*" in table or "*lower*" in table
    scorecard.main(["--results", str(results), "--check"])
    (results / "scorecard.md").write_text(page.replace("direction only", "reproduced"))
    with pytest.raises(SystemExit) as caught:
        scorecard.main(["--results", str(results), "--check"])
    assert caught.value.code == 3
    assert "run make scorecard" in capsys.readouterr().out


def test_simulated_studies_have_the_truth_that_is_planted():
    """A hundred studies each: without effect few differences, with a large one most are
    reproduced.
    """
    traces = planted_truth.read_traces(RESULTS / "scorecard" / "error_traces.csv")
    design = planted_truth.DESIGNS[2]
    none = planted_truth.rates(traces, design, 3, "no effect", 100)
    effect = planted_truth.rates(traces, design, 3, "the paper's effect", 100)
    assert float(none["wrong"]) <= 12.0
    assert float(effect["reproduced"]) >= 65.0
    assert float(effect["size_covered"]) >= 88.0
    assert effect["contradicted"] == "0.0"


def test_published_rates_are_nominal_with_three_seeds():
    with open(RESULTS / "scorecard" / "planted_truth.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(planted_truth.DESIGNS) * 2 * len(planted_truth.TRUTHS)
    assert {row["studies"] for row in rows} == {str(planted_truth.N_STUDIES)}
    for row in rows:
        if row["seeds"] == "3":
            assert float(row["size_covered"]) >= 93.0
            if row["truth"] == "no effect":
                assert float(row["wrong"]) <= 7.0


@pytest.mark.slow
def test_published_rates_follow_from_the_committed_errors():
    traces = planted_truth.read_traces(RESULTS / "scorecard" / "error_traces.csv")
    with open(RESULTS / "scorecard" / "planted_truth.csv", encoding="utf-8") as stream:
        published = {
            (row["design"], row["seeds"], row["truth"]): row for row in csv.DictReader(stream)
        }
    for design in planted_truth.DESIGNS:
        row = planted_truth.rates(traces, design, 3, "no effect", planted_truth.N_STUDIES)
        assert row == published[design.name, "3", "no effect"]
