"""Every command that trains on a reference or scores against it says that it has another sign or
unit, or is stuck.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

NAMES = ("one", "two", "three")
RIGHT = {"column": "Vy", "unit": "m/s"}


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


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (_reversed, "signs are inconsistent"),
        (_in_another_unit, "correct the unit"),
        (_zero, "vy_ref: constant at 0 m/s throughout"),
        (_in_degrees, "sideslip_ref is in deg but read as rad; correct the unit"),
    ],
)
def test_every_command_that_scores_warns_of_each_recording(small, spoil, says):
    channels = small.change("conf/dataset/mine.yaml")["channels"]
    small.change(
        "conf/dataset/mine.yaml",
        channels={**channels, **spoil(small)},
        accept=["impossible", "unit"],
    )
    job = ("estimator=luenberger", "split=mine", "training.grid=1", "training.max_evaluations=5")
    model = small.told("train", *job, "tracking=none")["model"]
    for command in (
        ("train", *job),
        ("eval", *job),
        ("eval", *job),
        ("eval", "--model", model, "split=mine"),
        ("run", "small"),
        ("run", "small"),
        ("report", "small"),
        ("sweep", "estimator=zero", "split=mine"),
    ):
        _, err = small.done(*command, "tracking=none", "--quiet")
        for name in NAMES:
            lines = [
                line
                for line in err.splitlines()
                if line.startswith(f"warning data set 'mine', recording '{name}': ")
            ]
            assert any(says in line for line in lines), command


def test_right_references_are_not_warned_of(small):
    for command in ("run", "report"):
        assert "warning" not in small.done(command, "small", "tracking=none")[1]


def test_warnings_of_a_study_come_once_for_each_recording(small):
    channels = small.change("conf/dataset/mine.yaml")["channels"]
    small.change("conf/dataset/mine.yaml", channels={**channels, **_reversed(small)})
    part = {"split": "mine", "sweeps": [["estimator=zero"]], "title": "a part"}
    pipeline = small.change("pipelines/small.yaml")
    del pipeline["split"], pipeline["sweeps"]
    Path("pipelines/small.yaml").unlink()
    small.change(
        "pipelines/small.yaml",
        **pipeline | {"report": "own_car", "parts": {"all": part, "again": part}},
    )
    _, err = small.done("run", "small", "tracking=none")
    for name in NAMES:
        assert err.count(f"recording '{name}': ") == 1
