"""Commands that are printed to be pasted into a shell: they find the data and the results of the
command that prints them.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence

from vehest.configuration.composition import Config, key_of, quoted

LOCATION = ("root", "output")  # configuration keys of the folders of raw files and of results
DEFAULT_OUTPUT = "outputs"  # output root where none is given


def command_line(command: str, words: Sequence[str]) -> str:
    """Text of a command of vehest with its words, quoted for a shell where necessary."""
    return shlex.join(["vehest", *command.split(), *words])


def location_overrides(overrides: Sequence[str]) -> list[str]:
    """Those overrides of a command that set where raw files are read from and results are written
    to.
    """
    return [override for override in overrides if key_of(override) in LOCATION]


def location_of_config(config: Config) -> list[str]:
    """Overrides that set where a configuration reads and writes, where it departs from the
    environment.
    """
    usual = {
        "root": os.environ.get("VEHEST_DATA"),
        "output": os.environ.get("VEHEST_OUTPUT", DEFAULT_OUTPUT),
    }
    differing = {key: config.get(key) for key in LOCATION if config.get(key) != usual[key]}
    return [f"{key}={quoted(value)}" for key, value in differing.items() if value is not None]


def overrides_of_config(overrides: Sequence[str], config: Config) -> list[str]:
    """Those overrides whose group or key exists in a configuration."""
    return [override for override in overrides if key_of(override).split(".")[0] in config]
