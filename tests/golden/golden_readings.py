"""What is recorded of every real recording as its source reads it.

`make golden` records anew where VEHEST_DATA is set.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
from golden_numbers import digest_of, this_machine

from vehest.configuration.composition import compose_config
from vehest.sources.base import open_source

FILE = Path(__file__).with_name("readings.json")
DIGITS = 12
NAMES = (
    "av21 dart dart_as_f1tenth f1tenth f1tenth_as_full_size f1tenth_bag ferrari_250lm "
    "ferrari_250lm_unlabelled roboracer saloon_standstill tum"
)
VBOX = ("vbo", "dataset.path=${root}/vbox", "dataset.clock=interpolate")
READINGS = {name: (name,) for name in NAMES.split()} | {
    "vbox": VBOX
}  # data set, and what else is set


def read(name, root):
    """Recording -> rate [Hz], start time [s], and for each channel a digest of its samples and
    their root mean square.
    """
    dataset, *otherwise = READINGS[name]
    config = compose_config("ingest", [f"dataset={dataset}", f"root={root}", *otherwise])["dataset"]
    readings = {}
    for recording in open_source(config).recordings():
        channels = {}
        for channel, samples in recording.channels.items():
            mean_square = np.mean(np.square(samples[np.isfinite(samples)]))
            channels[channel] = [
                digest_of({channel: samples}, DIGITS)[:8],
                float(f"{np.sqrt(mean_square):.12g}"),
            ]
        readings[recording.id] = {
            "rate_hz": recording.rate_hz,
            "start_time": recording.start_time,
            "channels": channels,
        }
    return readings


if __name__ == "__main__":
    root = os.environ.get("VEHEST_DATA")
    if not root:
        sys.exit("readings: VEHEST_DATA is not set, nothing recorded")
    lines = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(read(name, root), separators=(',', ':'))}"
        for name in READINGS
    )
    FILE.write_text(
        f'{{"machine": {json.dumps(this_machine())},\n"readings": {{\n{lines}\n}}}}\n',
        encoding="utf-8",
    )
