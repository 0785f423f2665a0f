"""Options of a command: where trainings run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

LAUNCHERS = ("local", "ray", "slurm")


@dataclass(frozen=True)
class LauncherOptions:
    """Where trainings run: one of `LAUNCHERS`, the address of a cluster, and resources of SLURM jobs as ``NAME=VALUE``."""

    launcher: str = "local"
    address: str | None = None
    slurm: Sequence[str] = ()
