"""What runs groups of members: one interface, behind which are this machine's cores or a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from vehest.data.errors import ConfigurationError
from vehest.run.console import Messages
from vehest.run.group import Group, Member, run_group
from vehest.run.launcher import Done, Reporter, Task, default_jobs, launch
from vehest.run.launchers.options import LAUNCHERS, LauncherOptions
from vehest.run.signals import StopSignals, TimeLimit


class Launcher(Protocol):
    """Runs groups somewhere; what ended comes back in this process, which alone tracks and draws."""

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
        """Let go of what it runs on."""


class LocalLauncher:
    """Runs groups in processes of this machine.

    Args:
        jobs: processes that run side by side; 1 runs everything in this one.
    """

    def __init__(self, jobs: int = 1) -> None:
        self.cores = jobs

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """See `Launcher`."""
        yield from launch([Task(group.name, partial(run_group, group)) for group in groups], self.cores, stop, report)

    def close(self) -> None:
        """Nothing is kept."""


def chosen_launcher(where: LauncherOptions, jobs: int | None, output: Path, messages: Messages) -> Launcher:
    """The launcher of a command.

    Args:
        where: what its options say.
        jobs: most groups at a time; none for as many as there are cores.
        output: the output root.
        messages: where the launcher says what happens.

    Raises:
        ConfigurationError: there is no such launcher, or it takes no such option.
        MissingError: what it needs is not installed.
    """
    if where.launcher not in LAUNCHERS:
        raise ConfigurationError(f"--launcher must be one of {', '.join(LAUNCHERS)}, not '{where.launcher}'")
    given = {"--address": where.address, "--store": where.store, "--slurm": where.slurm}
    takes = {"local": (), "ray": ("--address", "--store"), "slurm": ("--address", "--slurm")}
    for option, value in given.items():
        if value and option not in takes[where.launcher]:
            own = " and ".join(name for name, options in takes.items() if option in options)
            raise ConfigurationError(f"{option} is for --launcher {own}, not for {where.launcher}")
    if where.launcher == "local":
        return LocalLauncher(jobs or default_jobs())
    if where.launcher == "slurm":
        from vehest.run.launchers.on_slurm import SlurmLauncher

        return SlurmLauncher(where.address, jobs, where.slurm, output, messages)
    from vehest.run.launchers.on_ray import RayLauncher
    from vehest.run.launchers.store import Store

    return RayLauncher(where.address, jobs, None if where.store is None else Store(where.store), output, messages)
