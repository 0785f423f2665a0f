"""Checks the environment of vehest: what works on this machine and what is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vehest.artefacts.artefact import library_versions
from vehest.configuration.files import packaged
from vehest.data.text_files import first_line

EXTRAS = {
    "ros": ("rosbags", "ROS 2 bags"),
    "mdf": ("asammdf", "MDF measurements"),
    "bus": ("cantools", "CAN logs and replays"),
    "tuning": ("optuna", "noise levels tuned by Optuna"),
    "ray": ("ray", "trainings on many machines"),
    "slurm": ("submitit", "trainings as SLURM jobs"),
    "ui": ("flask", "MLflow's page of all runs"),
}
"""Extra -> the package it brings, and its use."""


@dataclass(frozen=True)
class Item:
    """Result of one check of the environment."""

    level: Literal["ok", "warning", "error"]  # severity
    name: str  # name of the part that was checked
    message: str  # the result, with the remedy where something is wrong


def examine() -> Iterator[Item]:
    """Check everything that vehest relies on.

    Yields
    ------
    Item
        Python and libraries, configuration, compiled recursions, extras, raw files, output root and
        disk. Nothing is written; the first call may compile for some seconds.
    """
    versions = ", ".join(f"{name} {version}" for name, version in library_versions().items())
    yield Item("ok", "python", f"{platform.python_version()}; {versions}")
    yield Item(
        "ok",
        "configuration",
        f"{packaged('conf')}{'; ./conf is searched first' if Path('conf').is_dir() else ''}",
    )
    yield _kernels()
    missing = [
        f"{use} need 'vehest[{extra}]'"
        for extra, (package, use) in EXTRAS.items()
        if importlib.util.find_spec(package) is None
    ]
    extras = (
        f"{'; '.join(missing)}: pip install it where you need it"
        if missing
        else f"{', '.join(EXTRAS)} are there"
    )
    yield Item("warning" if missing else "ok", "extras", extras)
    root = os.environ.get("VEHEST_DATA")
    if not root:
        yield Item(
            "warning",
            "recordings",
            "VEHEST_DATA is not set; only simulated data sets work without root=FOLDER",
        )
    elif not Path(root).is_dir():
        yield Item("error", "recordings", f"VEHEST_DATA is '{root}', which is no folder")
    else:
        yield Item("ok", "recordings", root)
    folder = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    existing = next((path for path in (folder, *folder.parents) if path.exists()), Path("/"))
    writable = os.access(existing, os.W_OK)
    refused = f"'{folder}' cannot be written; set VEHEST_OUTPUT or give output=FOLDER"
    yield Item("ok" if writable else "error", "output", str(folder) if writable else refused)
    free = shutil.disk_usage(".").free / 1e9
    yield Item("ok" if free > 1.0 else "warning", "disk", f"{free:.1f} GB free here")


def _kernels() -> Item:
    """Whether numba compiles and runs a recursion on this machine."""
    try:
        import numpy as np

        from vehest.estimators.luenberger import observe

        observe(np.array([[0.5, 20.0, 9.0, 0.0]]), 5.0, 0.1, 0.01)
    except Exception as error:
        return Item(
            "warning",
            "compiled recursions",
            f"numba does not work; use training.compiled=false ({first_line(error)})",
        )
    return Item("ok", "compiled recursions", "numba compiles and runs")
