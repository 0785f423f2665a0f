"""Options of a command that say where trainings run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

LAUNCHERS = ("local", "ray", "slurm")


@dataclass(frozen=True)
class LauncherOptions:
    """Where trainings run.

    Args:
        launcher: one of `LAUNCHERS`.
        address: of the cluster, for ``ray``; ``local`` for ``slurm`` on this machine.
        slurm: resources of a job, ``NAME=VALUE`` each, for ``slurm``.
    """

    launcher: str = "local"
    address: str | None = None
    slurm: Sequence[str] = ()
