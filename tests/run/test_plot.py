"""`vehest plot` and `vehest estimate --plot`: pictures and a page of a drive, complete or not at
all.
"""

import re
from pathlib import Path

import pytest

from conftest import planar_drive
from vehest.data.store import write_recording

STARTS = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml", ".html": b"<!doctype html>"}


@pytest.fixture
def log(place):
    write_recording(planar_drive(20.0, 100.0, seed=4, noise=0.02), Path("drive.parquet"))
    return place


@pytest.mark.parametrize("ending", STARTS)
def test_recording_is_drawn_in_every_format(log, ending):
    outcome = log.told("plot", "drive.parquet", "-o", f"drive{ending}")
    assert outcome["has_reference"]
    content = Path(f"drive{ending}").read_bytes()
    assert content.startswith(STARTS[ending])
    if ending == ".html":  # the page loads nothing
        assert b'src="data:image/svg+xml' in content
        loads = rb"<(?:script|img|iframe)[^>]*\ssrc=\"(?!data:)|<link\b|@import|url\((?!data:|#)"
        assert re.findall(loads, content) == []


def test_estimates_are_drawn_during_and_after_the_estimation(log):
    words = ["estimate", "drive.parquet", "estimator.wheelbase=2.5", "-o", "beta.parquet"]
    outcome = log.told(*words, "--plot", "drive.svg")
    assert outcome["plot"] == "drive.svg"
    afterwards = log.told("plot", "drive.parquet", "beta.parquet", "-o", "again.svg")
    assert afterwards["estimates"] == ["beta.parquet"]
    assert Path("drive.svg").read_bytes() == Path("again.svg").read_bytes()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["plot", "drive.parquet", "-o", "drive.jpg"], "pictures are written as"),
        (["plot", "no.parquet"], "no.parquet"),
        (["plot", "dataset=tabular"], "name the file of a recording"),
        (["plot", "drive.parquet", "-o", "folder.png"], "'folder.png' is a folder"),
        (["plot", "drive.parquet", "--start", "50"], "no samples between 50 s"),
        (["estimate", "drive.parquet", "-o", "b.csv", "--plot", "b.png"], "as .parquet"),
        (["estimate", "drive.parquet", "-o", "b.parquet", "--plot", "b.gif"], "are written as"),
        (["estimate", "drive.parquet", "-o", "b.parquet", "--plot", "folder.png"], "is a folder"),
    ],
)
def test_mistakes_are_a_single_error_and_write_nothing(log, words, says):
    Path("folder.png").mkdir()
    before = set(Path().iterdir())
    log.refused(*words, says=[says])
    assert set(Path().iterdir()) == before
