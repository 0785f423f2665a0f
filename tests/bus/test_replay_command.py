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

CHANNELS = ("vx", "yaw_rate", "ax", "ay")
REPLAY = ("replay", "raw/bus/drive.asc", "--speed", "max")
NAMED = (*REPLAY, "--dbc", "raw/bus/car.dbc", "--signals", signals_for(CHANNELS))


@pytest.fixture
def bus(place):
    """A log of four seconds, its DBC, and a data set that describes both."""
    drive = planar_drive(4.0, 100.0, seed=2)
    write_log(drive, place.folder / "raw" / "bus", jitter=0.001, lost=0.01)
    described = {
        "kind": "simulated",
        "vehicle": "car",
        "licence": "none",
        "citation": "none",
        "source": "can",
        "rate_hz": 100,
        "path": "${root}/bus",
        "files": "*.asc",
        "dbc": "${root}/bus/car.dbc",
        "channels": {name: SIGNALS[name] for name in CHANNELS},
    }
    place.change("conf/dataset/bus.yaml", name="bus", **described)
    return place


def test_replay_prints_json_writes_a_table_and_reports_progress_in_plain_lines(bus):
    code, out, err = bus(*NAMED, "--json", "--quiet", "-o", "out.csv")
    assert (code, err) == (0, "")
    figures = json.loads(out)
    assert figures["samples_hz"] == 100.0
    assert figures["estimates"] == len(pd.read_csv("out.csv")) == 80
    assert figures["written"] == ["out.csv"]
    _, err = bus.done(*NAMED, "--write-dbc", "own.dbc", "--id", "0x100")
    assert "BO_ 256 VehestEstimate: 8" in Path("own.dbc").read_text()
    assert err.startswith("time ")
    assert "\x1b" not in err


def test_a_last_line_that_is_cut_short_is_named(bus):
    log = Path("raw/bus/drive.asc")
    lines = [line for line in log.read_text().splitlines() if "Rx" in line]
    text = log.read_text()
    log.write_text(text[: text.index(lines[-1]) + 20])
    _, err = bus.done(*NAMED, "--quiet")
    assert f"not read: last line '{lines[-1][:20].strip()}', which has no end" in err


def test_a_data_set_serves_replays_and_estimates_and_faults_are_a_line(bus):
    code, _, err = bus(*REPLAY, "--dataset", "bus", "--quiet", "-o", "online.csv")
    assert (code, err) == (0, "")
    bus.done("estimate", "raw/bus/drive.asc", "dataset=bus", "-o", "offline.csv")
    online = pd.read_csv("online.csv")
    offline = pd.read_csv("offline.csv")
    assert {"time", "vy", "sideslip", "health", "health_reason"} <= set(online) & set(offline)
    assert bus.refused("replay", "raw/bus/nothing.asc", "--dataset", "bus")[0] == 4
    assert bus.refused(*REPLAY)[0] == 2
    assert bus.refused("replay", "raw/bus/car.dbc", "--dataset", "bus")[0] == 3


def test_ctrl_c_ends_with_figures_and_the_written_estimates(bus, monkeypatch):
    def interrupt(self, figures, values, seconds):
        if figures.samples == 200:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(View, "show", interrupt)
    code, out, err = bus(*NAMED, "-o", "out.csv")
    assert code == 130
    assert "stopped: True" in out
    assert (err, len(pd.read_csv("out.csv"))) == ("error: stopped\n", 40)
