"""The scorecard: what committed claims and errors give, and what a small study with a planted truth
shows.
"""

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vehest_papers import planted_truth
from vehest_papers.kit.claim_files import CLAIMS_FOLDER
from vehest_papers.kit.verdicts import VERDICTS
from vehest_papers.scorecard import files as scorecard
from vehest_papers.scorecard.judged import PAPERS, read_study
from vehest_papers.scorecard.markdown import recommendation

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
MAX_FRONT_PAGE_WORDS = 1600  # numbers are not counted


@pytest.fixture(scope="module")
def files():
    return scorecard.scorecard_files(RESULTS)


@pytest.fixture(scope="module")
def rows(files):
    return pd.read_csv(RESULTS / "scorecard.csv", keep_default_na=False)


def section(page, heading):
    """Text below a heading of level two, up to the next one."""
    return page.split(f"## {heading}\n")[1].split("\n## ")[0]


def cells(text):
    """Rows of the first Markdown table of a text, without its headings."""
    lines = text[text.index("| ") :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_published_scorecard_follows_from_its_inputs(files):
    for name, text in files.items():
        assert (RESULTS / name).read_text(encoding="utf-8") == text, "run make scorecard"


def test_every_old_claim_is_mapped(files):
    changed = list(csv.DictReader(files["scorecard/changed_verdicts.csv"].splitlines()))
    before = (CLAIMS_FOLDER / "claims_before.csv").read_text(encoding="utf-8")
    assert len(changed) == len(list(csv.DictReader(before.splitlines())))


def test_counts_of_the_front_page_are_those_of_the_csv(files, rows):
    """Every number of the table and of the summary, counted anew in scorecard.csv."""
    claims = rows[rows["row"] == "claim"]
    is_assessed = claims["blocks"] != ""
    is_provisional = is_assessed & ~claims["training"].isin(["sufficient", "not applicable"])
    page = files["scorecard.md"]
    table = cells(section(page, "Verdicts"))
    assert [row[0] for row in table] == [*VERDICTS, "all"]
    for verdict, *numbers in table:
        has_verdict = claims["verdict"].eq(verdict) | (verdict == "all")
        for paper, number in zip(["all", *PAPERS], numbers, strict=True):
            chosen = has_verdict & (claims["paper"].eq(paper) | (paper == "all"))
            n_provisional = (chosen & is_provisional).sum()
            text = f"{chosen.sum()} ({n_provisional})" if n_provisional else f"{chosen.sum()}"
            assert number == ("–" if not chosen.any() else text), (verdict, paper)
    counts = claims["verdict"].value_counts()
    data = claims.loc[is_assessed, "data"].value_counts()
    is_met = claims["verdict"].isin(["reproduced", "direction only"]) & claims["data"].eq("real")
    is_undecided = claims["verdict"].isin(["no significant difference", "inconclusive"])
    has_power = pd.to_numeric(claims["power"]) >= 0.8
    sizeable = claims["verdict"].eq("no significant difference") & has_power & ~is_provisional
    summary = " ".join(section(page, "Summary").split())
    for sentence in (
        f"{is_assessed.sum()} of {len(claims)} claims so far. {counts['not assessed']} wait",
        f"{counts['not testable']} need data that are not public",
        f"{data['real']} of these {is_assessed.sum()} verdicts rest on real recordings, "
        f"{data['simulated']} on simulated drives",
        f"{counts['reproduced']} claims are reproduced. {counts['direction only']} more",
        f"{counts['met by a trivial baseline']} are met by a trivial baseline",
        f"{counts['contradicted']} are contradicted",
        f"{is_met.sum()} claims are reproduced or hold in their direction, "
        f"{(is_met & is_provisional).sum()} of them provisionally",
        f"{is_undecided.sum()} claims ({(is_undecided & is_provisional).sum()} provisionally)",
        f"In {sizeable.sum()} of them our test would",
        f"{is_provisional.sum()} of {is_assessed.sum()} verdicts, since",
    ):
        assert sentence in summary


def test_rates_of_the_front_page_are_those_of_the_simulated_studies(files):
    rates = pd.read_csv(RESULTS / "scorecard" / "planted_truth.csv")
    rates["met"] = rates["reproduced"] + rates["direction only"]
    several = rates[rates["seeds"] == 3]
    wrong = several.loc[several["truth"] == "no effect", "wrong"]
    met = several.loc[several["truth"] == "the paper's effect", "met"]
    summary = " ".join(section(files["scorecard.md"], "Summary").split())
    assert f"{wrong.min():.0f} to {wrong.max():.0f} % of the verdicts found one" in summary
    assert f"found in {met.min():.0f} to {met.max():.0f} % of the studies" in summary
    table = cells(section(files["scorecard.md"], "How often these verdicts are right"))
    for design, seeds, *numbers in table:
        chosen = rates[(rates["design"] == design) & (rates["seeds"] == int(seeds))]
        by_truth = chosen.set_index("truth")
        expected = (
            by_truth.loc["no effect", "wrong"],
            by_truth.loc["the paper's effect", "met"],
            by_truth.loc["half of it", "met"],
            chosen["size_covered"].min(),
        )
        assert [float(number) for number in numbers] == pytest.approx(expected)


def test_the_front_page_is_short_and_every_claim_is_on_one_page(files, rows):
    text = re.sub(r"\]\([^)]*\)|\||:?--:?", " ", files["scorecard.md"])
    n_words = sum(any(map(str.isalpha, word)) for word in text.split())
    assert n_words <= MAX_FRONT_PAGE_WORDS
    for paper in PAPERS:
        page = files[f"scorecard/{paper}.md"]
        of_paper = rows[rows["paper"] == paper]
        n_lines = sum(
            line.startswith("| ") and not line.startswith(("| :--", "| claim |", "| verdict |"))
            for line in section(page, "Claims").splitlines()
        )
        assert n_lines == (of_paper["row"] == "claim").sum()
        by_verdict = {row[0].split("]")[0].strip("[") for row in cells(section(page, "Verdicts"))}
        assert by_verdict == set(of_paper.loc[of_paper["row"] == "claim", "verdict"])
        n_values = sum(line.count("| `") for line in page.splitlines())
        assert n_values == (of_paper["row"] == "table").sum()


@pytest.mark.parametrize("name", PAPERS)
def test_no_recommendation_is_contradicted_by_the_verdicts_that_it_rests_on(name):
    """Prose is written by hand: a verdict that changes must not leave it as it was."""
    study = read_study(name, RESULTS)
    assert set(study.paper.rests_on) <= set(study.claims)
    assert {word for words in study.paper.rests_on.values() for word in words} <= set(VERDICTS)
    assert "has to be revised" not in recommendation(study)
    claim = next(iter(study.paper.rests_on))
    other = replace(study.claims[claim], verdict="inconclusive")
    changed = replace(study, claims={**study.claims, claim: other})
    assert recommendation(changed).startswith("**This advice has to be revised:** ")
    assert "is *inconclusive* now" in recommendation(changed)


def test_recommendations_agree_with_tables_that_have_no_claim():
    """What the recommendations say beyond the claims, in the tables of the two reports."""
    orders = pd.read_csv(RESULTS / "heavy_ekf" / "tables" / "orders_by_condition.csv")
    by_case = orders.set_index(["first", "second", "condition"])
    assert by_case.loc[("RATTE", "LINT", "crossfall, with state"), "outcome"] == "lower"
    ferrari = by_case.loc[("RATTE", "RATT", "Ferrari")]
    assert ferrari["low"] > 0.9
    assert ferrari["high"] < 1.1
    tuning = pd.read_csv(RESULTS / "heavy_ekf" / "tables" / "tuning.csv")
    is_level = (tuning["road"] == "level") & (tuning["state"] == "on")
    level = tuning[is_level & (tuning["tuned"] == "all six conditions")]
    assert level.filter(like="RATTE / LINT").squeeze().split("]")[1].startswith(" n.s.")
    shares = pd.read_csv(RESULTS / "ksnn" / "tables" / "sub_model_shares.csv")
    assert (shares.loc[shares["candidate"] == "KS-NN nonlinear no bias", "third"] > 50).all()


def test_values_of_tables_are_lower_or_higher_where_ours_differ(rows):
    is_compared = rows["verdict"].isin(["agrees", "lower", "higher"])
    compared = rows[is_compared & (rows["row"] == "table")].to_dict("records")
    assert {"lower", "higher"} <= {row["verdict"] for row in compared}
    for row in compared:
        published = float(row["published"].rsplit(" ", 1)[1])
        ours = float(row["ours"].removesuffix("]").rsplit(" [", 1)[0].rsplit(" ", 1)[1])
        sides = {"lower": ours < published, "higher": ours > published, "agrees": True}
        assert sides[row["verdict"]], row


def test_readme_names_and_links_the_four_papers(files):
    first_screen = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()[:16]
    text = "\n".join(first_screen)
    assert "results/scorecard.md" in text
    dois = re.findall(r"\[doi:([^\]]+)\]", files["scorecard.md"])
    assert len(dois) == len(PAPERS)
    for doi in dois:
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
    page = (results / "scorecard" / "learned_ukf.md").read_text(encoding="utf-8")
    claims = section(page, "Claims").split("### Direction only")[1].split("###")[0]
    row = next(line for line in claims.splitlines() if "than GRU on the tyre used for" in line)
    assert "*provisional: insufficient*" in row
    assert re.search(r"\| 0\.829 \| 0\.[45]\d+ \[0\.\d+, 0\.\d+\]<br>by block 0\.", row)
    method = next(line for line in page.splitlines() if line.startswith("| NNTF\\_UH | NNTF"))
    assert "100 + 100 / 1000 + 1000, insufficient | 3 |" in method
    table = next(line for line in page.splitlines() if line.startswith("| NNTF\\_UH | `mse_"))
    assert "| *inconclusive* |" in table
    scorecard.main(["--results", str(results), "--check"])
    edited = page.replace("### Direction only", "### Reproduced")
    (results / "scorecard" / "learned_ukf.md").write_text(edited)
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
