"""Two hundred malformed inputs end well, and a harness that would notice if they did not."""

import csv
import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.case import GENERATORS, PLANTED, Case, Command, load_families
from fuzz.families.planted import MISDEEDS
from fuzz.runner import Fuzzer
from fuzz.verdicts import VERDICTS, Outcome, differences, judge, snapshot

pytestmark = pytest.mark.apart

TESTS = Path(__file__).parents[1]


def rows_of(folder, *options):
    """Rows of a run of the harness, in a process of its own."""
    out = folder / "fuzz.csv"
    paths = [
        str(TESTS),
        str(TESTS / "sources"),
        str(TESTS.parent / "src"),
        os.environ.get("PYTHONPATH", ""),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-m", "fuzz", "--out", str(out), *options]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert out.is_file(), ended.stdout + ended.stderr
    with open(out, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_two_hundred_malformed_inputs_end_with_a_result_or_a_single_line(tmp_path):
    rows = rows_of(tmp_path, "--inputs", "200", "--jobs", "2")
    assert len(rows) == 200
    honest = [row for row in rows if row["honest"] == "True"]
    assert len(honest) >= 15
    load_families()
    assert {(row["family"], row["generator"]) for row in rows} == {
        (generator.family, generator.name)
        for generator in GENERATORS
        if generator.family != PLANTED
    }
    bad = [
        f"{row['verdict']}: {row['family']}/{row['generator']} {row['index']}: vehest "
        f"{row['command']}: {row['detail']}"
        for row in rows
    ]
    assert [line for line, row in zip(bad, rows, strict=True) if row["verdict"] != "ok"] == []


def test_each_misdeed_gets_its_verdict(tmp_path):
    rows = rows_of(
        tmp_path, "--family", "planted", "--inputs", str(len(MISDEEDS)), "--seconds", "6"
    )
    verdicts = {row["command"].removeprefix("PLANTED:"): row["verdict"] for row in rows}
    assert verdicts == {name: verdict for name, (verdict, _) in MISDEEDS.items()}
    for row in rows:
        if row["verdict"] == "slow":
            assert "planted.py" in row["detail"], "a command that is stopped says where it was"
    assert {"refused"} == set(VERDICTS) - {verdict for verdict, _ in MISDEEDS.values()}


def outcome(exit_code, stderr, changed=()):
    return Outcome(exit_code, 0.1, exit_code == -9, 0.1, 1.0, "", stderr, (), changed, "")


@pytest.mark.parametrize(
    ("honest", "ended", "verdict"),
    [
        (True, outcome(3, "error: no\n"), "refused"),
        (False, outcome(3, "error: no\n"), "ok"),
        (True, outcome(0, "warning something\n"), "ok"),
        (
            False,
            outcome(3, "done    ingest     a\nrunning ingest     b\nwarning c\nerror: no\n"),
            "ok",
        ),
        (False, outcome(3, "/a/b.py:3: RuntimeWarning: overflow\nerror: no\n"), "several lines"),
        (False, outcome(7, "error: no\n"), "exit1"),
        (False, outcome(-9, ""), "slow"),
        (False, outcome(-11, ""), "crash"),
        (False, outcome(0, "", ("up/up/up/place/outputs/a",)), "ok"),
        (False, outcome(0, "", ("up/up/up/place/out.csv",)), "ok"),
        (False, outcome(0, "", ("up/up/up/place/raw/one.csv",)), "outside"),
        (False, outcome(0, "", ("up/up/up/place/outputs.csv",)), "outside"),
        (False, outcome(3, "error: no\n", ("tmp/vehest-a",)), "leftovers"),
    ],
)
def test_an_outcome_is_judged_by_exit_code_lines_and_files(tmp_path, honest, ended, verdict):
    case = Case(tmp_path, tmp_path / "templates", random.Random(0), honest, 0)
    assert judge(case, Command(("ingest",), targets=("out.csv",)), ended)[0] == verdict


def test_written_files_are_detected_in_the_folders(tmp_path):
    for name in ("same", "longer", "gone"):
        (tmp_path / name).write_text("a")
    before = snapshot(tmp_path)
    (tmp_path / "longer").write_text("ab")
    (tmp_path / "gone").unlink()
    (tmp_path / "new").symlink_to("same")
    assert differences(before, snapshot(tmp_path)) == ("gone", "longer", "new")


def test_the_same_seed_and_index_make_the_same_input(tmp_path):
    def files(folder, seed, index):
        fuzzer = Fuzzer(folder, seed, ["tables"])
        generator, visit, honest = fuzzer.generator_of(index)
        case = fuzzer.case_of(index, visit, honest)
        command = generator.build(case)
        return command, {path.name: path.read_bytes() for path in case.place.iterdir()}

    for index in range(10):
        assert files(tmp_path / "a", 3, index) == files(tmp_path / "b", 3, index)
    assert files(tmp_path / "a", 3, 1) != files(tmp_path / "a", 4, 1)
