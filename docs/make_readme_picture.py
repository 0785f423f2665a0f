"""Draw docs/images/ferrari_20_seconds.png, the picture of README.md: real data, the GRU with its band and the static map.

Run by ``make readme_picture``; the only argument is the output root in which the study `ferrari_drive` is finished.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from vehest.constants import FloatArray
from vehest.report.style import DOUBLE_COLUMN, REFERENCE_COLOUR, new_figure

OUT = Path(__file__).parent / "images" / "ferrari_20_seconds.png"
START, STOP = (
    645.0,
    665.0,
)  # the busiest 20 s of the test range, as in results/ferrari_drive/figures/zoom_test.png
ESTIMATES = {
    "GRU with its 90 % band": ("gru-states_5-seed4-on-ferrari_drive", "#8e2da8", "solid"),
    "static map (baseline)": ("static_map-static_map-seed0-on-ferrari_drive", "#17a2b8", "dashed"),
}
RECORDING = "ferrari_250lm-20hz-*/20140222_01_01_03_250lm.parquet"


def draw(root: Path) -> None:
    """Sideslip angle, reference and estimates with the band of the first, above the lateral acceleration."""
    from vehest import read_recording

    recording = read_recording(next((root / "downsample").glob(RECORDING)))
    rows = (recording.time >= START) & (recording.time <= STOP)
    time = recording.time[rows]
    with new_figure(DOUBLE_COLUMN, 3.4) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3.0, 1.0))
        for label, (folder, colour, dash) in ESTIMATES.items():
            estimate = _columns(next((root / "evaluate").glob(f"{folder}-*/test/0.parquet")))
            if dash == "solid":
                low = estimate["sideslip"] - estimate["band_sideslip"]
                high = estimate["sideslip"] + estimate["band_sideslip"]
                top.fill_between(estimate["time"], low, high, color=colour, alpha=0.18, linewidth=0)
            looks = {"color": colour, "linestyle": dash, "linewidth": 1.4, "label": label}
            top.plot(estimate["time"], estimate["sideslip"], **looks)
        reference = np.degrees(np.arctan2(recording["vy_ref"], recording["vx"]))[rows]
        looks = {"color": REFERENCE_COLOUR, "linewidth": 1.4, "label": "reference (GNSS/INS)"}
        top.plot(time, reference, **looks)
        bottom.plot(time, recording["ay"][rows], color="#444444", linewidth=1.0)
        top.set_ylabel("sideslip angle [deg]")
        bottom.set_ylabel("$a_y$ [m/s²]")
        bottom.set_xlabel("time of the recording [s]")
        bottom.set_xlim(START, STOP)
        top.legend(loc="upper left", frameon=False)
        figure.align_ylabels()
        figure.savefig(OUT, facecolor="white", dpi=150)


def _columns(file: Path) -> dict[str, FloatArray]:
    """Time [s], sideslip angle and half width of its band [deg], of the drawn samples."""
    table = pq.read_table(file)
    columns = {name: table[name].to_numpy() for name in ("time", "sideslip", "band_sideslip")}
    rows = (columns["time"] >= START) & (columns["time"] <= STOP)
    return {
        name: samples[rows] if name == "time" else np.degrees(samples[rows])
        for name, samples in columns.items()
    }


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
