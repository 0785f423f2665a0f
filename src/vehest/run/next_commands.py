"""Commands that are printed to be pasted into a shell: they find the data and the results of the
command that prints them.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence

from vehest.configuration.composition import Config, key_of, quoted

LOCATION = ("root", "output")  # keys of where raw files come from and results go
DEFAULT_OUTPUT = "outputs"


def command_line(command: str, words: Sequence[str]) -> str:
    """A command of vehest with its words, quoted for a shell where they need it."""
    return shlex.join(["vehest", *command.split(), *words])


def location_overrides(overrides: Sequence[str]) -> list[str]:
    """Those overrides of a command that say where raw files come from and results go."""
    return [override for override in overrides if key_of(override) in LOCATION]


def location_of_config(config: Config) -> list[str]:
    """Overrides that say where a configuration reads and writes, where the environment says
    otherwise.
    """
    usual = {
        "root": os.environ.get("VEHEST_DATA"),
        "output": os.environ.get("VEHEST_OUTPUT", DEFAULT_OUTPUT),
    }
    differing = {key: config.get(key) for key in LOCATION if config.get(key) != usual[key]}
    return [f"{key}={quoted(value)}" for key, value in differing.items() if value is not None]


def overrides_of_config(overrides: Sequence[str], config: Config) -> list[str]:
    """Those overrides whose group or key a command with this configuration has."""
    return [override for override in overrides if key_of(override).split(".")[0] in config]
