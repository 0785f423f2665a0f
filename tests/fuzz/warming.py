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
    "gtsam",
    "torch",
    "pooch",
    "requests",
    "netrc",
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
    from vehest.stages.artefacts import commit

    commit()
