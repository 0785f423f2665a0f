"""The worked examples of docs/adding_an_estimator.md as a package of their own, installed into a
folder.
"""

import sys
from pathlib import Path

import pandas as pd
from compare_examples import CLASSES, install

from conftest import planar_drive
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.sources.base import source_names

NAMES = tuple(CLASSES)


def install_examples(folder, monkeypatch):
    """Install them into a new folder on sys.path, with their configuration in ./conf."""
    install(folder, Path())
    monkeypatch.syspath_prepend(str(folder))
    forget_examples()


def forget_examples():
    """Let names be looked for anew."""
    estimator_names.cache_clear()
    estimator_class.cache_clear()
    for name in NAMES:
        sys.modules.pop(name, None)


SOURCE = '''"""A source of another package: a text file with one speed [m/s] a line."""

from dataclasses import dataclass

import numpy as np

from vehest.sources.base import require_files
from vehest.sources.clocks import Clock
from vehest.sources.file_source import FileSource


@dataclass(frozen=True)
class SpeedOptions:
    path: str | None = None
    files: str = "*.txt"
    rate_hz: float = 10.0


class SpeedSource(FileSource):
    options_type = SpeedOptions
    version = "7"

    def _read(self, file, run):
        require_files([file], self.name)
        speed = np.loadtxt(file)
        clock = Clock(0.0, self.options.rate_hz, len(speed))
        return self._recording(file.stem, str(file), clock, {"vx": speed}, {"file": file.name})
'''


def install_source(folder, monkeypatch, content=SOURCE):
    """Install a package that offers the source ``speeds`` into a new folder on sys.path."""
    described = folder / "speed_logs-1.0.dist-info"
    described.mkdir(parents=True)
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: speed-logs\nVersion: 1.0\n")
    (described / "entry_points.txt").write_text(
        "[vehest.sources]\nspeeds = speed_logs:SpeedSource\n"
    )
    (folder / "speed_logs.py").write_text(content)
    monkeypatch.syspath_prepend(str(folder))
    forget_source()


def forget_source():
    """Let names of sources be looked for anew."""
    source_names.cache_clear()
    sys.modules.pop("speed_logs", None)


def write_laps():
    """Three drives with their reference, lap1.csv to lap3.csv in the current folder."""
    for number in (1, 2, 3):
        drive = planar_drive(25.0, 100.0, seed=number, noise=0.02)
        channels = ("vx", "yaw_rate", "ay", "ax", "vy_ref")
        pd.DataFrame({"time": drive.time, **{name: drive[name] for name in channels}}).to_csv(
            f"lap{number}.csv", index=False
        )
