"""Launchers: one interface for this machine's cores, a Ray cluster and a SLURM queue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from vehest.data.errors import ConfigurationError
from vehest.run.console import Messages
from vehest.run.group import Group, Member
from vehest.run.launchers.local import Done, LocalLauncher, Reporter, default_jobs
from vehest.run.launchers.options import LAUNCHERS, LauncherOptions
from vehest.run.signals import StopSignals, TimeLimit


class Launcher(Protocol):
    """Runs groups; finished ones come back to this process, which alone tracks and draws."""

    @property
    def cores(self) -> int:
        """Groups that can run at a time."""

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """Run groups and yield them as they end; a group that fails is a value and keeps no other from running.

        Args:
            groups: begun in this order.
            stop: when a signal came or the time is up, running trainings are asked to end and no other is begun.
            report: called with a group's position and its progress (None when it starts), or what it waits for.

        Raises:
            MissingError: there is nothing to run on.
        """

    def close(self) -> None:
        """Release processes and connections."""


def chosen_launcher(options: LauncherOptions, jobs: int | None, output: Path, messages: Messages) -> Launcher:
    """The launcher of a command.

    Args:
        options: of the command.
        jobs: most groups at a time; none for as many as there are cores.
        output: the output root.
        messages: prints what happens on a cluster.

    Raises:
        ConfigurationError: there is no such launcher, or it takes no such option.
        MissingError: a package that it needs is not installed.
    """
    if options.launcher not in LAUNCHERS:
        raise ConfigurationError(f"--launcher must be one of {', '.join(LAUNCHERS)}, not '{options.launcher}'")
    if options.address and options.launcher == "local":
        raise ConfigurationError("--address is for --launcher ray and slurm, not for local")
    if options.slurm and options.launcher != "slurm":
        raise ConfigurationError(f"--slurm is for --launcher slurm, not for {options.launcher}")
    if options.launcher == "local":
        return LocalLauncher(jobs or default_jobs())
    if options.launcher == "slurm":
        from vehest.run.launchers.on_slurm import SlurmLauncher

        return SlurmLauncher(options.address, jobs, options.slurm, output, messages)
    from vehest.run.launchers.on_ray import RayLauncher

    return RayLauncher(options.address, jobs, output, messages)
