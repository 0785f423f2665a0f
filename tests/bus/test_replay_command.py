"""`vehest replay` as people call it: figures, files, one line for what is wrong, and a clean end by
Ctrl-C.
"""

import json
import signal
from pathlib import Path

import pandas as pd
import pytest

from conftest import planar_drive
from vehest.bus.view import View

pytest.importorskip("can", reason="python-can is not installed: pip install 'vehest[bus]'")
pytest.importorskip("cantools", reason="cantools is not installed: pip install 'vehest[bus]'")

from can_drive import SIGNALS, write_log
from replayed_drive import signals_for

SIGNAL_OPTION = signals_for(("vx", "yaw_rate", "ax", "ay"))


@pytest.fixture
def bus(place):
    """A log of ten seconds, its DBC, and a data set that describes both."""
    write_log(
        planar_drive(10.0, 100.0, seed=2), place.folder / "raw" / "bus", jitter=0.001, lost=0.01
    )
    channels = {name: SIGNALS[name] for name in ("vx", "yaw_rate", "ax", "ay")}
    described = {
        "kind": "simulated",
        "vehicle": "car",
        "licence": "none",
        "citation": "none",
        "source": "can",
        "rate_hz": 100,
    }
    described |= {
        "path": "${root}/bus",
        "files": "*.asc",
        "dbc": "${root}/bus/car.dbc",
        "channels": channels,
    }
    place.change("conf/dataset/bus.yaml", name="bus", **described)
    return place


def test_replay_prints_json_writes_a_table_and_reports_progress_in_plain_lines(bus):
    words = (
        "--dbc",
        "raw/bus/car.dbc",
        "--signals",
        SIGNAL_OPTION,
        "--speed",
        "max",
        "--json",
        "--quiet",
        "-o",
        "out.csv",
    )
    code, out, err = bus("replay", "raw/bus/drive.asc", *words)
    assert (code, err) == (0, "")
    figures = json.loads(out)
    assert figures["samples_hz"] == 100.0
    assert figures["estimates"] == len(pd.read_csv("out.csv")) == 200
    assert figures["written"] == ["out.csv"]
    words = (
        "--dbc",
        "raw/bus/car.dbc",
        "--signals",
        SIGNAL_OPTION,
        "--speed",
        "max",
        "--quiet",
        "--write-dbc",
        "own.dbc",
        "--id",
        "0x100",
    )
    assert bus("replay", "raw/bus/drive.asc", *words)[0] == 0
    assert "BO_ 256 VehestEstimate: 8" in Path("own.dbc").read_text()
    _, err = bus.done(
        "replay",
        "raw/bus/drive.asc",
        "--dbc",
        "raw/bus/car.dbc",
        "--signals",
        SIGNAL_OPTION,
        "--speed",
        "max",
    )
    assert err.startswith("time ")
    assert "\x1b" not in err


def test_a_data_set_serves_replays_and_estimates_and_faults_are_a_line(bus):
    code, _, err = bus(
        "replay",
        "raw/bus/drive.asc",
        "--dataset",
        "bus",
        "--speed",
        "max",
        "--quiet",
        "-o",
        "online.csv",
    )
    assert (code, err) == (0, "")
    bus.done("estimate", "raw/bus/drive.asc", "dataset=bus", "-o", "offline.csv")
    online = pd.read_csv("online.csv")
    offline = pd.read_csv("offline.csv")
    assert {"time", "vy", "sideslip", "health", "health_reason"} <= set(online) & set(offline)
    assert bus.refused("replay", "raw/bus/nothing.asc", "--dataset", "bus")[0] == 4
    assert bus.refused("replay", "raw/bus/drive.asc")[0] == 2
    assert bus.refused("replay", "raw/bus/car.dbc", "--dataset", "bus")[0] == 3


def test_ctrl_c_ends_with_figures_and_the_written_estimates(bus, monkeypatch):
    def interrupt(self, figures, values, seconds):
        if figures.samples == 400:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(View, "show", interrupt)
    words = (
        "--dbc",
        "raw/bus/car.dbc",
        "--signals",
        SIGNAL_OPTION,
        "--speed",
        "max",
        "-o",
        "out.csv",
    )
    code, out, err = bus("replay", "raw/bus/drive.asc", *words)
    assert code == 130
    assert "stopped: True" in out
    assert (err, len(pd.read_csv("out.csv"))) == ("error: stopped\n", 80)
