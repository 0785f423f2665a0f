"""A few kills of the quickstart; `make kills` makes a hundred."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.apart

SCRIPT = Path(__file__).parents[1] / "kills" / "kills.py"


@pytest.mark.slow
def test_a_study_that_is_killed_ends_in_the_same_numbers_and_leaves_nothing_behind(tmp_path):
    table = tmp_path / "kills.csv"
    done = subprocess.run([sys.executable, SCRIPT, "--kills", "3", "--out", table], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(table, newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert ([row["stage"] for row in rows], {row["outcome"] for row in rows}) == (["ingest", "downsample", "train"], {"good"})
