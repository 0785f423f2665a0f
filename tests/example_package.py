"""The worked examples of docs/adding_an_estimator.md as a package of their own, installed into a folder."""

import sys
from pathlib import Path

import pandas as pd
from compare_examples import CLASSES, install

from conftest import planar_drive
from vehest.estimators.registry import estimator_class, estimator_names

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


def write_laps():
    """Three drives with their reference, lap1.csv to lap3.csv in the current folder."""
    for number in (1, 2, 3):
        drive = planar_drive(25.0, 100.0, seed=number, noise=0.02)
        channels = ("vx", "yaw_rate", "ay", "ax", "vy_ref")
        pd.DataFrame({"time": drive.time, **{name: drive[name] for name in channels}}).to_csv(
            f"lap{number}.csv", index=False
        )
