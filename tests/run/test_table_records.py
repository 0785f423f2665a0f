"""Records of tables that commands outside pipelines write, and `vehest report --check` on them."""

import json
import os
import re
import runpy
import subprocess
from pathlib import Path

import pytest
import unseen_car
from unseen_car import CARS, chosen_since, raw_files_of

from vehest.artefacts import artefact as artefacts
from vehest.data.errors import MissingError
from vehest.run import table_records
from vehest.run.publishing import PROVENANCE, RESULTS
from vehest.run.table_records import RowKeys, record_tables, today_of
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


def test_tables_without_a_record_and_removed_tables_are_named(table, outcome):
    (table.parent / "b.csv").write_text("rmse\n")
    assert outcome() == (3, "tables: stale: data (b.csv without a record)\n")
    (table.parent / "b.csv").unlink()
    table.unlink()
    assert outcome() == (3, "tables: stale: data (a.csv: content)\n")


def test_rows_without_keys_leave_the_state_undetermined(table, outcome):
    second_table = table.with_name("b.csv")
    second_table.write_text("rmse\n")
    record_tables([second_table], "make b", [], "rows of gru")
    assert outcome() == (3, "tables: not known: b.csv: rows of gru without keys (make b)\n")
    record_tables([second_table], "make b", [])
    assert outcome() == (0, "tables: up to date\n")
    rows = RowKeys({"ksnn": "train ksnn"}, {"gru": "train gru", "lstm": "train lstm"})
    record_tables([table], "make a", [], rows=rows)
    assert outcome() == (3, "tables: not known: a.csv: rows of lstm without keys (make a)\n")


def test_unchanged_rows_retain_their_original_keys(place, table, outcome, monkeypatch):
    gru = {"gru": "train gru"}
    script = f"script {SCRIPT}"
    record_tables([table], "make a", [script], rows=RowKeys(gru | {"lstm": "train lstm"}, {}))
    former = json.loads((table.parent / PROVENANCE).read_text())["keys"]
    record_tables([table], "make a", [script], rows=RowKeys({"ksnn": "train ksnn"}, gru))
    keys = json.loads((table.parent / PROVENANCE).read_text())["keys"]
    assert keys["a.csv: train gru"] == former["a.csv: train gru"]
    assert set(keys) == {
        "a.csv: content",
        f"a.csv: {script}",
        "a.csv: train gru",
        "a.csv: train ksnn",
    }
    assert outcome() == (0, "tables: up to date\n")

    monkeypatch.setitem(VERSIONS, "train", "another")
    (place.folder / SCRIPT).write_text('VERSION = "2"\n')
    record_tables([table], "make a", [script], rows=RowKeys({"ksnn": "train ksnn"}, gru))
    stale = f"tables: stale: code (a.csv: script {SCRIPT}, a.csv: train gru)\n"
    assert outcome() == (3, stale)
    record_tables([table], "make a", [script], rows=RowKeys({"ksnn": "train ksnn"} | gru, {}))
    assert outcome() == (0, "tables: up to date\n")


def test_a_trial_outside_results_is_not_recorded(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("rmse\n")
    record_tables([file], "make a", [])
    assert not (tmp_path / PROVENANCE).exists()


def test_records_without_raw_files_are_refused_and_the_former_record_stays(place, table):
    file = table.parent / PROVENANCE
    former = file.read_text()
    assert set(json.loads(former)["keys"]["a.csv: data mine"]) == {"code", "data"}
    (place.folder / "raw").rename(place.folder / "elsewhere")
    with pytest.raises(MissingError, match=r"cannot record 'a\.csv': raw files of data mine"):
        record_tables([table], "make a", ["data mine"])
    assert file.read_text() == former


def test_raw_files_of_no_data_set_are_compared(place, table, outcome):
    lap = place.folder / "raw" / "other" / "lap.mat"
    lap.parent.mkdir()
    lap.write_text("1")
    record_tables([table], "make a", ["files other/*.mat"])
    assert outcome() == (0, "tables: up to date\n")
    lap.write_text("2")
    assert outcome() == (3, "tables: stale: data (a.csv: files other/*.mat)\n")
    lap.unlink()
    note = "data not checked, raw files not here: other/*.mat"
    assert outcome() == (0, f"tables: up to date: {note}\n")
    with pytest.raises(MissingError, match="raw files of files other"):
        record_tables([table], "make a", ["files other/*.mat"])


def test_keys_of_the_unseen_cars_can_be_recorded(tmp_path):
    names = raw_files_of(CARS)
    assert {"data s90", "files stanford_tts/*.mat", "files autorally/mppi_*.mat"} <= set(names)
    for name in (*names, "report own_car", "evaluate self_calibrating"):
        assert today_of(f"report.md: {name}", tmp_path) is not None


def test_commands_of_the_car_benchmark_run_without_recordings_of_its_record(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHEST_DATA", "recordings")
    environments = []

    def run(command, env, **_):
        environments.append(env)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    program = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "own_car.py"))
    program["timed"](tmp_path, "--version")
    assert "VEHEST_DATA" not in environments[0]
    assert environments[0]["VEHEST_OUTPUT"] == str(tmp_path / "outputs")
    assert os.environ["VEHEST_DATA"] == "recordings"


def test_only_values_of_choices_count_as_chosen_since(monkeypatch):
    texts = {
        "a": "estimator: {grip: 14}  # m/s²\n",
        "b": "estimator:\n  grip: 14.0\n  memory: 150\n",
    }
    monkeypatch.setattr(unseen_car, "git", lambda _, name: texts[name.partition(":")[0]])
    assert chosen_since("a", "b") == ["memory"]


def test_the_commit_of_a_record_has_no_changes_but_those_in_results(place, monkeypatch):
    author = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    monkeypatch.setattr(artefacts, "CHECKOUT", place.folder)
    monkeypatch.chdir(place.folder)
    table = place.folder / "results" / "tables" / "a.csv"
    script = place.folder / "script.py"
    table.parent.mkdir(parents=True)
    for file in (table, script):
        file.write_text("1\n")
    for words in (["init", "-q"], ["add", "-A"], [*author, "commit", "-qm", "a"]):
        subprocess.run(["git", *words], check=True)
    commit = artefacts.commit.__wrapped__
    clean = commit()
    assert len(clean) == 12
    table.write_text("2\n")
    assert commit() == clean
    script.write_text("2\n")
    assert commit() == f"{clean}-dirty"


def test_every_folder_of_results_has_a_provenance():
    results = Path(__file__).parents[2] / RESULTS
    folders = {folder.name for folder in results.iterdir() if folder.is_dir()}
    # Times of one machine, each with its processor, commit and libraries; verdicts on committed
    # files.
    exempt = {"benchmarks", "scorecard"}
    recorded = {file.parent.name for file in results.glob(f"*/{PROVENANCE}")}
    assert folders - exempt == recorded


def test_every_recorded_data_set_has_the_digest_of_its_raw_files():
    """Without one a table is stale at once wherever the raw files are."""
    records = (Path(__file__).parents[2] / RESULTS).glob(f"*/{PROVENANCE}")
    keys = {
        f"{file.parent.name}/{stage}": key
        for file in records
        for stage, key in json.loads(file.read_text(encoding="utf-8")).get("keys", {}).items()
        if re.match(r"\S+\.\w+: (data|files) ", stage)
    }
    assert keys
    assert [stage for stage, key in keys.items() if "data" not in key] == []
