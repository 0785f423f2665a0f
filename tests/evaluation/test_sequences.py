"""Ranges cut into sequences, each estimated anew, from the reference state where the protocol says
so.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_estimate
from vehest.evaluation.metrics import Protocol, reference_state, sequences
from vehest.run.evaluate import protocol_from_config

PAPER = {
    "rate_hz": 100,
    "warm_up_seconds": 0,
    "skip_seconds": 2,
    "sequence_seconds": 10,
    "initial_state": True,
}
INITIAL_STATES = [
    "estimator=kalman",
    "estimator.noise.yaw_rate=0.01",
    "estimator.noise.ay=0.5",
    "estimator.noise.steer=0.01",
]


def recording(seconds, start_time=100.0):
    time = np.arange(round(100.0 * seconds)) / 100.0
    channels = {
        name: np.sin(time + shift)
        for shift, name in enumerate(("vx_ref", "vy_ref", "yaw_rate_ref"))
    }
    return Recording("r", "car", 100.0, start_time, channels)


def test_sequences_start_at_the_range_start_and_omit_the_remainder():
    drive = recording(35.0)
    spans = [Span("d", "r"), Span("d", "r", 103.0, 114.0), Span("d", "r", 100.0, 105.0)]
    pieces = sequences(spans, lambda span: drive, Protocol(sequence_seconds=10.0, rate_hz=100.0))
    assert [(piece.start, piece.stop) for piece in pieces] == [
        (100.0, 110.0),
        (110.0, 120.0),
        (120.0, 130.0),
        (103.0, 113.0),
    ]
    assert {len(drive.cut(piece.start, piece.stop)) for piece in pieces} == {1000}
    with pytest.raises(DataError, match="lasts as long as a sequence of 10 s"):
        sequences(spans[2:], lambda span: drive, Protocol(sequence_seconds=10.0, rate_hz=100.0))
    drive = recording(5.0)
    state = reference_state(drive, Span("d", "r", 101.0, 103.0))
    assert state == {
        "vx": drive["vx_ref"][100],
        "vy": drive["vy_ref"][100],
        "yaw_rate": drive["yaw_rate_ref"][100],
    }
    with pytest.raises(DataError, match="recording 'r' has no 'yaw_rate_ref' at 100 s"):
        reference_state(drive.select(["vx_ref", "vy_ref"]), Span("d", "r"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sequence_seconds": 2}, "sequence_seconds must be longer than skip_seconds"),
        ({"sequence_seconds": 10.005}, "a whole number of samples at 100 Hz"),
        ({"warm_up_seconds": 1}, "set evaluation.warm_up_seconds=0"),
    ],
)
def test_a_protocol_that_makes_no_sense_is_refused(changes, message):
    assert protocol_from_config(PAPER) == Protocol(100.0, 0.0, 2.0, 10.0, True)
    with pytest.raises(ConfigurationError, match=message):
        protocol_from_config({**PAPER, **changes})


@pytest.fixture
def steered(place):
    """A split with tests only: one range of 30 s and one of 13 s."""
    place.add_steered()
    ranges = [{"recording": "second"}, {"recording": "first", "start": 5, "stop": 18}]
    split = {
        "name": "whole",
        "dataset": "steered",
        "train": [],
        "validation": [],
        "tests": {"test": ranges},
    }
    (Path("conf") / "split" / "whole.yaml").write_text(yaml.safe_dump(split))
    return place


def test_each_sequence_is_estimated_anew_from_its_true_state(steered):
    arguments = [*INITIAL_STATES, "split=whole", "tracking=none"]
    assert steered("train", *arguments)[0] == 0
    code, _, err = steered(
        "eval", *arguments, *(f"evaluation.{key}={value}" for key, value in PAPER.items())
    )
    assert code == 0, err
    (metrics,) = Path("outputs").rglob("evaluate/*/metrics.csv")
    with open(metrics, encoding="utf-8") as stream:
        figures = {line["metric"]: float(line["value"]) for line in csv.DictReader(stream)}
    assert figures["n_sequences"] == 4
    assert {"rmse_yaw_rate", "nees", "nis", "coverage_1sigma", "coverage_2sigma"} <= set(figures)
    assert not {"rmse_vx", "mse_weighted"} & set(figures), "the filter takes vx as measured"
    estimates = [
        read_estimate(metrics.parent / "test" / f"{position}.parquet") for position in range(4)
    ]
    assert [(len(estimate), estimate.start_time) for estimate in estimates] == [
        (1000, 0.0),
        (1000, 10.0),
        (1000, 20.0),
        (1000, 5.0),
    ]
    for estimate in estimates:
        assert np.sqrt(estimate.covariance[0].diagonal()).max() < 1e-3, (
            "the state was known at the first sample"
        )
