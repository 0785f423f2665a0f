"""Honest files, made once by vehest's own commands and by the writers that the tests use; generators copy and spoil them."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from conftest import planar_drive
from fuzz.case import Case, template
from place import DATASET, STEERED
from single_track_drive import linear_drive
from vehest.cli import main

SECONDS, RATE_HZ = 30.0, 50.0
SPLIT: dict[str, Any] = {
    "name": "mine",
    "dataset": "mine",
    "train": [{"recording": "one"}],
    "validation": [{"recording": "two"}],
    "tests": {"test": [{"recording": "three"}]},
}
PIPELINE: dict[str, Any] = {
    "study": "small",
    "title": "A small study",
    "report": "drive",
    "split": "mine",
    "sweeps": [
        ["estimator=luenberger", "estimator.rate_hz=20", "training.grid=1", "training.max_evaluations=5"],
        ["estimator=ksnn", "estimator.n_hidden=0", "training.max_epochs=1"],
    ],
    "evaluation": {"rate_hz": 20},
}
KSNN = ("estimator=ksnn", "estimator.n_hidden=0", "split=mine", "training.max_epochs=1", "tracking=none")
LUENBERGER = (
    "estimator=luenberger",
    "estimator.rate_hz=20",
    "training.grid=1",
    "training.max_evaluations=5",
    "split=mine",
    "tracking=none",
)
STEERED_SPLIT = SPLIT | {"name": "steered", "dataset": "steered"}
KALMAN = ("estimator=kalman", "estimator.rate_hz=50", "split=steered", "tracking=none")


def table(seed: int, seconds: float = SECONDS, rate_hz: float = RATE_HZ) -> pd.DataFrame:
    """A drive with columns of names and units of its own, as conf/dataset/mine.yaml describes them."""
    drive = planar_drive(seconds, rate_hz, seed=seed, noise=0.02)
    return pd.DataFrame(
        {
            "Time": drive.time,
            "Speed": drive["vx"] * 3.6,
            "Yaw": np.degrees(drive["yaw_rate"]),
            "LatAcc": -drive["ay"],
            "LongAcc": drive["ax"],
            "Vy": drive["vy_ref"],
        }
    )


def lap(seed: int = 9, seconds: float = SECONDS, rate_hz: float = RATE_HZ) -> pd.DataFrame:
    """A drive whose columns are called like channels, in SI units."""
    drive = planar_drive(seconds, rate_hz, seed=seed, noise=0.02)
    return pd.DataFrame({"time": drive.time, **{name: drive[name] for name in ("vx", "yaw_rate", "ay", "ax", "vx_ref", "vy_ref")}})


def run(*words: str) -> None:
    """A command of vehest, which must succeed, in the current folder."""
    former, code = (sys.argv, dict(os.environ)), 0
    os.environ |= {"VEHEST_DATA": str(Path.cwd() / "raw")}
    for name in ("VEHEST_OUTPUT", "MLFLOW_TRACKING_URI"):
        os.environ.pop(name, None)
    sys.argv = ["vehest", *words]
    try:
        main()
    except SystemExit as leave:
        code = int(leave.code or 0)
    finally:
        sys.argv = former[0]
        os.environ.clear()
        os.environ.update(former[1])
    if code:
        raise RuntimeError(f"'vehest {' '.join(words)}' leaves with {code}")


def write_yaml(path: Path, content: Any) -> None:
    """An honest YAML file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, allow_unicode=True, sort_keys=False), encoding="utf-8")


@template
def drives(folder: Path) -> None:
    """Three tables of a car, with its data set, split and pipeline; a lap with columns called like channels."""
    (folder / "raw").mkdir()
    for seed, name in enumerate(("one", "two", "three"), start=1):
        table(seed).to_csv(folder / "raw" / f"{name}.csv", index=False)
    lap().to_csv(folder / "lap.csv", index=False)
    lap().to_parquet(folder / "lap.parquet")
    write_yaml(folder / "conf" / "dataset" / "mine.yaml", DATASET)
    write_yaml(folder / "conf" / "split" / "mine.yaml", SPLIT)
    write_yaml(folder / "pipelines" / "small.yaml", PIPELINE)


@template
def steered(folder: Path) -> None:
    """Three tables with a steering angle, for filters that know a car; and the Kalman filter of their split."""
    (folder / "raw" / "steered").mkdir(parents=True)
    for seed, name in enumerate(("one", "two", "three"), start=1):
        drive = linear_drive(SECONDS, seed=seed)[0]
        content = pd.DataFrame({"t": drive.time, **{channel: drive[channel] for channel in STEERED}})
        content.to_csv(folder / "raw" / "steered" / f"{name}.csv", index=False)
    channels = {name: {"column": name, "unit": unit} for name, unit in STEERED.items()}
    dataset = DATASET | {"name": "steered", "path": "${root}/steered", "time": {"column": "t", "unit": "s"}, "channels": channels}
    write_yaml(folder / "conf" / "dataset" / "steered.yaml", dataset)
    write_yaml(folder / "conf" / "split" / "steered.yaml", STEERED_SPLIT)


@template
def study(folder: Path) -> None:
    """The same with everything that its pipeline makes."""
    drives(folder)
    run("run", "small", "tracking=none", "--jobs", "1", "--quiet")


def warm_up(folder: Path) -> None:
    """Run what commands have in common once in this process: kernels are loaded, plugins of Hydra found, first imports done."""
    drives(folder)
    steered(folder)
    run("estimate", "lap.csv", "-o", "out.parquet")
    run("estimate", "lap.parquet", "-o", "out.csv")
    for command in ("check", "show", "align"):
        run("data", command, "lap.csv", *(("-e", "offsets") if command == "align" else ()))
    run("ingest", "mine")
    run("downsample", "steered", "rate_hz=20")
    run("train", *KALMAN)
    run("config", "train", "estimator=gru")
    run("data", "channels")


def models_in(case: Case) -> list[Path]:
    """Model folders of the copied study."""
    return sorted((case.place / "outputs" / "train").iterdir())
