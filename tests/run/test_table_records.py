"""Records of tables that commands outside pipelines write, and `vehest report --check` on them."""

import json
from pathlib import Path

import pytest

from vehest.run import table_records
from vehest.run.publishing import PROVENANCE, RESULTS
from vehest.run.table_records import record_tables
from vehest.run.versions import VERSIONS, code_of

CHECK = ("report", "--check", "tables")
SCRIPT = "benchmarks/table.py"


@pytest.fixture
def table(place, monkeypatch):
    """A table in results/ with a record, and the folder of its script."""
    monkeypatch.setattr(table_records, "CHECKOUT", place.folder)
    monkeypatch.chdir(place.folder)
    script = place.folder / SCRIPT
    script.parent.mkdir()
    script.write_text('VERSION = "1"\nprint(1)\n')
    file = place.folder / RESULTS / "tables" / "a.csv"
    file.parent.mkdir(parents=True)
    file.write_text("rmse\n0.5\n")
    record_tables([file], "make a", [f"script {SCRIPT}", "train gru", "data mine"])
    return file


@pytest.fixture
def outcome(place, table):
    """Exit code and line of the check."""
    return lambda: place(*CHECK)[:2]


def test_a_table_is_up_to_date_until_its_content_script_or_stage_changes(
    place, table, outcome, monkeypatch
):
    assert outcome() == (0, "tables: up to date\n")
    keys = json.loads((table.parent / PROVENANCE).read_text())["keys"]
    assert keys["a.csv: train gru"] == {"code": code_of("train", "gru")}

    script = place.folder / SCRIPT
    script.write_text('VERSION = "1"\n# Another comment.\nprint(1)\n')
    assert outcome() == (0, "tables: up to date\n")
    script.write_text('VERSION = "2"\nprint(2)\n')
    assert outcome() == (3, f"tables: stale: code (a.csv: script {SCRIPT})\n")
    script.write_text('VERSION = "1"\n')

    table.write_text("rmse\n0.4\n")
    assert outcome() == (3, "tables: stale: data (a.csv: content)\n")
    table.write_text("rmse\n0.5\n")

    monkeypatch.setitem(VERSIONS, "train", "another")
    assert outcome() == (3, "tables: stale: code (a.csv: train gru)\n")


def test_a_table_without_a_record_and_one_that_is_gone_are_named(table, outcome):
    (table.parent / "b.csv").write_text("rmse\n")
    assert outcome() == (3, "tables: stale: data (b.csv without a record)\n")
    (table.parent / "b.csv").unlink()
    table.unlink()
    assert outcome() == (3, "tables: stale: data (a.csv: content)\n")


def test_rows_without_keys_leave_the_state_not_known(table, outcome):
    other = table.with_name("b.csv")
    other.write_text("rmse\n")
    record_tables([other], "make b", [], "rows of gru")
    assert outcome() == (3, "tables: not known: b.csv: rows of gru without keys (make b)\n")
    record_tables([other], "make b", [])
    assert outcome() == (0, "tables: up to date\n")


def test_a_trial_outside_results_is_not_recorded(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("rmse\n")
    record_tables([file], "make a", [])
    assert not (tmp_path / PROVENANCE).exists()


def test_every_folder_of_results_has_a_provenance():
    results = Path(__file__).parents[2] / RESULTS
    folders = {folder.name for folder in results.iterdir() if folder.is_dir()}
    # Times of one machine, each with its processor, commit and libraries; verdicts on committed files.
    others = {"benchmarks", "scorecard"}
    recorded = {file.parent.name for file in results.glob(f"*/{PROVENANCE}")}
    assert folders - others == recorded
