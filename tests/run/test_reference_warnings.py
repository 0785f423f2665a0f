"""Every command that trains on a reference or scores against it says that it has another sign or
unit, or is stuck.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytestmark = pytest.mark.apart

NAMES = ("one", "two", "three")
RIGHT = {"column": "Vy", "unit": "m/s"}
JOB = ("estimator=luenberger", "split=mine", "training.grid=1", "training.max_evaluations=5")


def _column(name, values):
    """Give the tables of the data set a further column."""
    for file in Path("raw").glob("*.csv"):
        table = pd.read_csv(file)
        table.assign(**{name: values(table)}).to_csv(file, index=False)


def _reversed(place):
    return {"vy_ref": {**RIGHT, "sign": -1}}


def _in_another_unit(place):
    return {"vy_ref": {**RIGHT, "unit": "km/h"}}


def _zero(place):
    _column("Nothing", lambda table: np.zeros(len(table)))
    return {"vy_ref": {**RIGHT, "column": "Nothing"}}


def _in_degrees(place):
    _column("Slip", lambda table: np.degrees(np.arctan2(table["Vy"], table["Speed"] / 3.6)))
    return {"vy_ref": RIGHT, "sideslip_ref": {"column": "Slip", "unit": "rad"}}


@pytest.fixture
def small(place):
    place.change("pipelines/small.yaml", sweeps=[["estimator=zero"]])
    return place


def spoil(small, change):
    """Declare the reference otherwise than it is."""
    channels = small.change("conf/dataset/mine.yaml")["channels"] | change(small)
    small.change("conf/dataset/mine.yaml", channels=channels, accept=["impossible", "unit"])


def assert_warned(small, says, *command):
    _, err = small.done(*command, "tracking=none", "--quiet")
    for name in NAMES:
        start = f"warning data set 'mine', recording '{name}': "
        lines = [line for line in err.splitlines() if line.startswith(start)]
        assert any(says in line for line in lines), command


def test_every_command_that_scores_warns_of_each_recording(small):
    spoil(small, _reversed)
    model = small.told("train", *JOB, "tracking=none")["model"]
    for command in (
        ("train", *JOB),
        ("eval", *JOB),
        ("eval", *JOB),
        ("eval", "--model", model, "split=mine"),
        ("run", "small"),
        ("run", "small"),
        ("report", "small"),
        ("sweep", "estimator=zero", "split=mine"),
    ):
        assert_warned(small, "signs are inconsistent", *command)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_in_another_unit, "correct the unit"),
        (_zero, "vy_ref: constant at 0 m/s throughout"),
        (_in_degrees, "sideslip_ref is in deg but read as rad; correct the unit"),
    ],
)
def test_a_wrong_unit_a_stuck_reference_and_degrees_are_warned_of(small, change, says):
    spoil(small, change)
    assert_warned(small, says, "train", *JOB)


def test_right_references_are_not_warned_of(small):
    for command in ("run", "report"):
        assert "warning" not in small.done(command, "small", "tracking=none")[1]


def test_warnings_of_a_study_come_once_for_each_recording(small):
    spoil(small, _reversed)
    part = {"split": "mine", "sweeps": [["estimator=zero"]], "title": "a part"}
    Path("pipelines/small.yaml").unlink()
    parts = {"all": part, "again": part}
    small.change("pipelines/small.yaml", study="small", report="own_car", parts=parts)
    _, err = small.done("run", "small", "tracking=none")
    for name in NAMES:
        assert err.count(f"recording '{name}': ") == 1
