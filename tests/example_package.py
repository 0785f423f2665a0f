"""The worked examples of docs/adding_an_estimator.md as a package of their own, installed into a folder."""

import shutil
import sys
from pathlib import Path

import pandas as pd

from conftest import planar_drive
from vehest.estimators.registry import estimator_class, estimator_names

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
CLASSES = {"saturating_ekf": "SaturatingEkf", "sliding_mode": "SlidingMode", "window_transformer": "WindowTransformer"}
NAMES = tuple(CLASSES)


def install_examples(folder, monkeypatch):
    """Put modules and entry points, as pip would install them, into a new folder on sys.path, and the configuration into ./conf."""
    about = folder / "vehest_examples-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: vehest-examples\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "\n".join(["[vehest.estimators]", *(f"{name} = {name}:{kind}" for name, kind in CLASSES.items())])
    )
    configurations = Path("conf") / "estimator"
    configurations.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        for file in (*EXAMPLES.glob(f"{name}.py"), *EXAMPLES.glob(f"{name}.c.j2")):
            shutil.copy(file, folder)
        shutil.copy(EXAMPLES / f"{name}.yaml", configurations)
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
        pd.DataFrame({"time": drive.time, **{name: drive[name] for name in channels}}).to_csv(f"lap{number}.csv", index=False)
