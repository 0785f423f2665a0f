"""Where trainings run, as a command is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

LAUNCHERS = ("local", "ray", "slurm")


@dataclass(frozen=True)
class LauncherOptions:
    """Where trainings run, as options of a command say it.

    Args:
        launcher: one of `LAUNCHERS`.
        address: of the cluster, for ``ray``; ``local`` for ``slurm`` on this machine.
        store: where artefacts are kept where machines share no folder, for ``ray``.
        slurm: what jobs ask the queue for, ``NAME=VALUE`` each, for ``slurm``.
    """

    launcher: str = "local"
    address: str | None = None
    store: str | None = None
    slurm: Sequence[str] = ()
