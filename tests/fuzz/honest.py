"""Imports made beforehand, and honest files made once by vehest's own commands.

Generators copy and spoil these.
"""

import encodings
import importlib
import pkgutil
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import place
from conftest import planar_drive
from fuzz.case import template
from place import DATASET, SPLIT, write_drives, write_steered, write_yaml
from vehest.cli import main

SECONDS = 30.0
RATE_HZ = 50.0
SWEEPS = [
    [
        "estimator=luenberger",
        "estimator.rate_hz=20",
        "training.grid=1",
        "training.max_evaluations=5",
    ],
    ["estimator=ksnn", "estimator.n_hidden=0", "training.max_epochs=1"],
]
PIPELINE = place.PIPELINE | {"sweeps": SWEEPS, "evaluation": {"rate_hz": 20}}
KSNN = (
    "estimator=ksnn",
    "estimator.n_hidden=0",
    "split=mine",
    "training.max_epochs=1",
    "tracking=none",
)
LUENBERGER = (*SWEEPS[0], "split=mine", "tracking=none")
KALMAN = ("estimator=kalman", "estimator.rate_hz=50", "split=steered", "tracking=none")


def lap(seed=9, seconds=SECONDS, rate_hz=RATE_HZ):
    """A drive whose columns are called like channels, in SI units."""
    drive = planar_drive(seconds, rate_hz, seed=seed, noise=0.02)
    return pd.DataFrame(
        {
            "time": drive.time,
            **{name: drive[name] for name in ("vx", "yaw_rate", "ay", "ax", "vx_ref", "vy_ref")},
        }
    )


def run(*words):
    """A command of vehest, which must succeed, in the current folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VEHEST_DATA", str(Path.cwd() / "raw"))
        for name in ("VEHEST_OUTPUT", "MLFLOW_TRACKING_URI"):
            patch.delenv(name, raising=False)
        patch.setattr(sys, "argv", ["vehest", *words])
        try:
            main()
        except SystemExit as leave:
            if leave.code:
                raise RuntimeError(
                    f"'vehest {' '.join(words)}' leaves with {leave.code}"
                ) from leave


@template
def drives(folder):
    """Three tables of a car, with its data set, split and pipeline.

    A lap with columns called like channels.
    """
    write_drives(folder)
    lap().to_csv(folder / "lap.csv", index=False)
    write_yaml(folder / "conf" / "dataset" / "mine.yaml", DATASET)
    write_yaml(folder / "conf" / "split" / "mine.yaml", SPLIT)
    write_yaml(folder / "pipelines" / "small.yaml", PIPELINE)


@template
def steered(folder):
    """Three tables with a steering angle, for filters that know a car.

    And the Kalman filter of their split.
    """
    write_steered(folder, {"one": 1, "two": 2, "three": 3})
    write_yaml(
        folder / "conf" / "split" / "steered.yaml",
        SPLIT | {"name": "steered", "dataset": "steered"},
    )


@template
def study(folder):
    """The same with everything that its pipeline makes."""
    drives(folder)
    run("run", "small", "tracking=none", "--jobs", "1", "--quiet")


def warm_up(folder):
    """Run what commands have in common once in this process: kernels are loaded, plugins of Hydra
    found, first imports done.
    """
    drives(folder)
    steered(folder)
    lap().to_parquet(folder / "lap.parquet")
    run("estimate", "lap.csv", "-o", "out.parquet")
    run("estimate", "lap.parquet", "-o", "out.csv")
    for command in ("check", "show", "align"):
        run("data", command, "lap.csv", *(("-e", "offsets") if command == "align" else ()))
    run("ingest", "mine")
    run("downsample", "steered", "rate_hz=20")
    run("train", *KALMAN)
    run("config", "train", "estimator=gru")
    run("data", "channels")


# Libraries that are imported piece by piece while they work, and what they import then.
PIECES = (
    "asammdf", "asammdf.blocks", "rosbags.rosbag2", "rosbags.typesys", "mlflow", "optuna",
    "can.interfaces.virtual", "can.io.asc", "can.io.blf", "can.io.canutils", "cantools.database",
    "torch", "pooch", "requests", "netrc", "pydantic._internal._serializers",
)  # fmt: skip
PACKAGES = ("typer", "rich")


def import_everything():
    """Import all of vehest, the libraries that it loads when it needs them, and every text
    encoding.
    """
    import vehest
    import vehest_papers

    for module in (
        *pkgutil.walk_packages(vehest.__path__, "vehest."),
        *pkgutil.walk_packages(vehest_papers.__path__, "vehest_papers."),
    ):
        if module.name != "vehest.__main__":
            importlib.import_module(module.name)
    for name in PIECES:
        importlib.import_module(name)
    for name in PACKAGES:
        for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
            if not module.name.endswith("__main__"):
                with suppress(
                    ImportError, AssertionError
                ):  # of what is not installed, or made for another system
                    importlib.import_module(module.name)
    for module in pkgutil.iter_modules(encodings.__path__):
        if module.name not in ("mbcs", "oem", "cp65001"):
            importlib.import_module(f"encodings.{module.name}")
    from vehest.artefacts.artefact import commit

    commit()
    load_kernels()


def load_kernels():
    """Load what every estimate runs from the compile cache, which is unpickled: later that means
    that an input asked for it.
    """
    import vehest

    time = np.arange(1200) / 20.0
    yaw_rate = 0.3 * np.sin(0.7 * time) + 0.05 * np.sin(2.9 * time)
    vy = -2.0 * yaw_rate
    vx = 20.0 + np.sin(0.2 * time)
    channels = {
        "yaw_rate": yaw_rate,
        "vx": vx,
        "ay": np.gradient(vy, time) + vx * yaw_rate,
        "vy_ref": vy,
    }
    drive = vehest.Recording("drive", "car", 20.0, 0.0, channels, "simulated")
    for drives in ([drive], []):
        vehest.estimate(drive.without_references(), vehest.train("zero", drives, drives))
    stepper = vehest.online(vehest.load_model("pretrained"), 100.0)
    for _ in range(400):
        stepper.step({"vx": 20.0, "yaw_rate": 0.0, "ay": 0.0, "ax": 0.0})
