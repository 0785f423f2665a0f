"""Importing beforehand whatever a command imports, so that an import in a child means that an input asked for it."""

from __future__ import annotations

import encodings
import importlib
import pkgutil
from contextlib import suppress

# Libraries that are imported piece by piece while they work, and what they import then.
PIECES = (
    "asammdf",
    "asammdf.blocks",
    "rosbags.rosbag2",
    "rosbags.typesys",
    "mlflow",
    "optuna",
    "can.interfaces.virtual",
    "can.io.asc",
    "can.io.blf",
    "can.io.canutils",
    "cantools.database",
    "torch",
    "pooch",
    "requests",
    "netrc",
    "pydantic._internal._serializers",
)
PACKAGES = ("typer", "rich")


def import_everything() -> None:
    """Import all of vehest, the libraries that it loads when it needs them, and every text encoding."""
    import vehest
    import vehest_papers

    for module in (*pkgutil.walk_packages(vehest.__path__, "vehest."), *pkgutil.walk_packages(vehest_papers.__path__, "vehest_papers.")):
        if module.name != "vehest.__main__":
            importlib.import_module(module.name)
    for name in PIECES:
        importlib.import_module(name)
    for name in PACKAGES:
        for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
            if not module.name.endswith("__main__"):
                with suppress(ImportError, AssertionError):  # of what is not installed, or made for another system
                    importlib.import_module(module.name)
    for module in pkgutil.iter_modules(encodings.__path__):
        if module.name not in ("mbcs", "oem", "cp65001"):
            importlib.import_module(f"encodings.{module.name}")
    from vehest.run.artefacts import commit

    commit()
    load_kernels()


def load_kernels() -> None:
    """Load what every estimate runs from the compile cache, which is unpickled: later that means that an input asked for it."""
    import numpy as np

    import vehest

    time = np.arange(1200) / 20.0
    yaw_rate = 0.3 * np.sin(0.7 * time) + 0.05 * np.sin(2.9 * time)
    vy, vx = -2.0 * yaw_rate, 20.0 + np.sin(0.2 * time)
    channels = {"yaw_rate": yaw_rate, "vx": vx, "ay": np.gradient(vy, time) + vx * yaw_rate, "vy_ref": vy}
    drive = vehest.Recording("drive", "car", 20.0, 0.0, channels, "simulated")
    for drives in ([drive], []):
        vehest.estimate(vehest.train("zero", drives, drives), drive.without_references())
    stepper = vehest.online(vehest.load_model(), 100.0)
    for _ in range(400):
        stepper.step({"vx": 20.0, "yaw_rate": 0.0, "ay": 0.0, "ax": 0.0})
