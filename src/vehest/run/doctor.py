"""What works on this machine and what is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import sysconfig
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vehest.run.artefacts import library_versions
from vehest.run.config_files import packaged_conf, packaged_pipelines

EXTRAS = {
    "ros": ("rosbags", "ROS 2 bags"),
    "factor-graph": ("gtsam", "factor graphs"),
    "bus": ("cantools", "CAN logs and replays"),
    "tuning": ("optuna", "noise levels tuned by Optuna"),
    "ray": ("ray", "trainings on many machines"),
    "slurm": ("submitit", "trainings as SLURM jobs"),
}
"""Extra -> the package it brings, and what needs it."""


@dataclass(frozen=True)
class Item:
    """One thing that was looked at."""

    level: Literal["ok", "warning", "error"]
    name: str
    message: str


def examine() -> list[Item]:
    """Look at everything that vehest relies on."""
    looks = (_python, _configuration, _torch, _kernels, _compiler, _extras, _data, _output, _disk, _cores, _graphics)
    return [look() for look in looks]


def _python() -> Item:
    versions = ", ".join(f"{name} {version}" for name, version in library_versions().items())
    return Item("ok", "python", f"{platform.python_version()}; {versions}")


def _configuration() -> Item:
    missing = [folder for folder in (packaged_conf(), packaged_pipelines()) if not folder.is_dir()]
    if missing:
        return Item("error", "configuration", f"'{missing[0]}' is not there; install vehest again")
    return Item("ok", "configuration", f"{packaged_conf()}; ./conf is searched first" if Path("conf").is_dir() else str(packaged_conf()))


def _torch() -> Item:
    import torch

    value = torch.ones(2, requires_grad=True)
    (value * value).sum().backward()
    return Item("ok", "torch", f"{torch.__version__}, autograd works")


def _kernels() -> Item:
    def compile_and_run() -> float:
        import numpy as np

        from vehest.estimators.kernels.luenberger import observe

        return float(observe(np.array([[0.5, 20.0, 9.0, 0.0]]), 5.0, 0.1, 0.01)[0][0])

    return _tried("compiled recursions", compile_and_run, "numba compiles and runs", "numba does not work; use training.compiled=false")


def _compiler() -> Item:
    compiler = next((path for name in ("c++", "g++", "clang++") if (path := shutil.which(name))), None)
    headers = Path(sysconfig.get_paths()["include"]) / "Python.h"
    if compiler is None:
        return Item("warning", "C++ compiler", "none found; torch.compile is not available, the eager path is used")
    if not headers.is_file():
        return Item("warning", "C++ compiler", f"{compiler}, but Python's headers are missing; torch.compile is not available")
    return Item("ok", "C++ compiler", compiler)


def _extras() -> Item:
    absent = [f"{what} need 'vehest[{extra}]'" for extra, (package, what) in EXTRAS.items() if importlib.util.find_spec(package) is None]
    if absent:
        return Item("warning", "extras", f"{'; '.join(absent)}: pip install it where you need it")
    return Item("ok", "extras", f"{', '.join(EXTRAS)} are there")


def _data() -> Item:
    root = os.environ.get("VEHEST_DATA")
    if not root:
        return Item("warning", "recordings", "VEHEST_DATA is not set; only simulated data sets work without root=FOLDER")
    if not Path(root).is_dir():
        return Item("error", "recordings", f"VEHEST_DATA is '{root}', which is no folder")
    return Item("ok", "recordings", root)


def _output() -> Item:
    folder = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not os.access(existing, os.W_OK):
        return Item("error", "output", f"'{folder}' cannot be written; set VEHEST_OUTPUT or give output=FOLDER")
    return Item("ok", "output", str(folder))


def _disk() -> Item:
    try:
        free = shutil.disk_usage(".").free / 1e9
    except OSError as error:
        return Item("warning", "disk", f"the working folder cannot be looked at ({error.strerror}); change to another")
    level: Literal["ok", "warning"] = "ok" if free > 1.0 else "warning"
    return Item(level, "disk", f"{free:.1f} GB free here")


def _cores() -> Item:
    from vehest.run.launchers.local import default_jobs

    return Item("ok", "cores", f"{default_jobs()}; as many jobs run side by side")


def _graphics() -> Item:
    import torch

    if torch.cuda.is_available():
        return Item("ok", "GPU", f"{torch.cuda.get_device_name(0)}; vehest's trainings run on the processor")
    return Item("ok", "GPU", "none; vehest needs none")


def _tried(name: str, attempt: Callable[[], float], good: str, bad: str) -> Item:
    try:
        attempt()
    except Exception as error:
        return Item("warning", name, f"{bad} ({type(error).__name__}: {str(error).splitlines()[0][:100] if str(error) else ''})")
    return Item("ok", name, good)
