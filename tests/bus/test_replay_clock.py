"""Stamps of a log's frames that stand still, jump or go back: invalid after 0.2 s with a reason, as
online.
"""

import numpy as np
import pandas as pd
import pytest

from conftest import planar_drive
from vehest.run.replay import replay_log
from vehest.trust.clock import CLOCK_JUMPED, CLOCK_STOPPED, CLOCK_UNEVEN
from vehest.trust.health import reason_in_words

pytest.importorskip("can", reason="python-can is not installed: pip install 'vehest[bus]'")
pytest.importorskip("cantools", reason="cantools is not installed: pip install 'vehest[bus]'")

from can_drive import write_log
from replayed_drive import signals_for

from clock_faults import faulted_times

RATE = 100.0
SECONDS = 30.0
START = 22.0  # s, of each fault: after what a replay looks at beforehand
CHANNELS = ("yaw_rate", "vx", "ay", "ax")  # of the pre-trained model
FIRST_ROWS = {  # kind of fault -> reason, and rows (20 Hz) within which it shows
    "constant": (CLOCK_STOPPED, 6),
    "ahead_1_h": (CLOCK_JUMPED, 3),
    "half_rate": (CLOCK_UNEVEN, 12),
}


def replayed(folder, kind):
    """The estimates of a replay, a row each, whose frames have wrong stamps from `START` on."""
    written = write_log(planar_drive(SECONDS, RATE, seed=3), folder, ".log")
    lines = written.log.read_text(encoding="utf-8").splitlines()  # python-can writes no stamp back
    stamps = np.array([float(line[1 : line.index(")")]) for line in lines])
    cycles = np.round((stamps - stamps[0]) * RATE).astype(int)
    times = faulted_times(kind, np.arange(cycles[-1] + 1) / RATE, round(START * RATE), RATE)
    faulty = [
        f"({stamps[0] + times[cycle]:.6f}{line[line.index(')') :]}"
        for line, cycle in zip(lines, cycles, strict=True)
    ]
    written.log.write_text("\n".join(faulty) + "\n", encoding="utf-8")
    words = {"dbc": written.dbc, "signals": signals_for(CHANNELS), "speed": "max"}
    replay_log(written.log, out=folder / "out.csv", **words)
    return pd.read_csv(folder / "out.csv")


@pytest.mark.parametrize("kind", FIRST_ROWS)
def test_stamps_of_frames_that_fail_make_the_estimate_invalid_with_a_reason(tmp_path, kind):
    table = replayed(tmp_path, kind)
    reason, within = FIRST_ROWS[kind]
    flagged = (table["health_reason"] == reason_in_words(10_000.0 * reason)).to_numpy()
    invalid = (table["health"] == 2).to_numpy()
    before = round((START - 0.1) * 20)
    assert not flagged[:before].any()
    first = int(np.flatnonzero(flagged)[0])
    assert first <= before + 2 + within
    assert invalid[first : first + 15].all()
    if kind == "ahead_1_h":
        assert not flagged[first + 45 :].any(), (
            "a second of missing samples, a second of even stamps"
        )
        assert len(table) - first > 120
    else:
        assert invalid[first:].all()
