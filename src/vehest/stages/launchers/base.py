"""What runs groups of members: one interface, behind which are this machine's cores or a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from vehest.data.errors import ConfigurationError
from vehest.stages.console import Messages
from vehest.stages.group import Group, Member, run_group
from vehest.stages.launcher import Done, Reporter, Task, default_jobs, launch
from vehest.stages.signals import StopSignals, TimeLimit


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


def chosen_launcher(name: str, address: str | None, store: str | None, jobs: int | None, output: Path, messages: Messages) -> Launcher:
    """The launcher of a command.

    Args:
        name: ``local`` or ``ray``.
        address: of the cluster, for ``ray``.
        store: where artefacts are kept where machines share no folder, for ``ray``.
        jobs: most groups at a time; none for as many as there are cores.
        output: the output root.
        messages: where the launcher says what happens.

    Raises:
        ConfigurationError: there is no such launcher, or it takes no such option.
        MissingError: what it needs is not installed.
    """
    if name not in ("local", "ray"):
        raise ConfigurationError(f"--launcher must be local or ray, not '{name}'")
    if name == "local":
        for option, value in (("--address", address), ("--store", store)):
            if value is not None:
                raise ConfigurationError(f"{option} is for --launcher ray; the local launcher works in the output root of this machine")
        return LocalLauncher(jobs or default_jobs())
    from vehest.stages.launchers.on_ray import RayLauncher
    from vehest.stages.launchers.store import Store

    return RayLauncher(address, jobs, None if store is None else Store(store), output, messages)
