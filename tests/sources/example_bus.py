"""Write docs/examples/drive.asc and car.dbc, the CAN log of docs/bus.md: 20 s of a simulated drive
as frames.

`python tests/sources/example_bus.py RECORDING` takes a stored recording of the quickstart at 20 Hz,
such as outputs/downsample/sim_quickstart-20hz-…/drive_3.parquet. Frames are up to 2 ms late, and 1
% of them are lost.
"""

import sys
from pathlib import Path

from can_drive import write_log

import vehest

OUT = Path(__file__).parents[2] / "docs" / "examples"
START = 60.0
SECONDS = 20.0

if __name__ == "__main__":
    drive = vehest.read_recording(sys.argv[1])
    write_log(drive.cut(START, START + SECONDS), OUT, jitter=0.001, lost=0.01, seed=1)
