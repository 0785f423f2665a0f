"""Chooses where groups run, this machine's cores, a Ray cluster or a SLURM queue, and counts how far they are.

Imports nothing heavy: the command line reads its options here.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from vehest.data.errors import ConfigurationError, MissingError

if TYPE_CHECKING:
    from vehest.run.console import Messages
    from vehest.run.group import Group
    from vehest.run.launchers.local import Done, Reporter
    from vehest.run.signals import StopSignals, TimeLimit

LAUNCHERS = ("local", "ray", "slurm")


@dataclass(frozen=True)
class LauncherOptions:
    """Where trainings run: one of `LAUNCHERS`, the address of a cluster, and resources of SLURM jobs as ``NAME=VALUE``."""

    launcher: str = "local"
    address: str | None = None
    slurm: Sequence[str] = ()


class Launcher(Protocol):
    """Runs groups; outcomes come back to this process, which alone tracks and draws."""

    @property
    def cores(self) -> int:
        """Groups that can run at a time."""

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done]:
        """Run groups as `local.launch` runs tasks, with members as outcomes; on a cluster only the begin of a group is reported.

        Raises `MissingError` where there is no cluster, it takes no tasks, or one of its machines cannot run them.
        """

    def close(self) -> None:
        """Release processes and connections."""


def chosen_launcher(options: LauncherOptions, jobs: int | None, output: Path, messages: Messages) -> Launcher:
    """A command's launcher; without ``jobs`` it runs as many groups at a time as cores; raises `ConfigurationError` or `MissingError`."""
    name = options.launcher
    if name not in LAUNCHERS:
        raise ConfigurationError(f"--launcher must be one of {', '.join(LAUNCHERS)}, not '{name}'")
    if options.address and name == "local":
        raise ConfigurationError("--address is for --launcher ray and slurm, not for local")
    if options.slurm and name != "slurm":
        raise ConfigurationError(f"--slurm is for --launcher slurm, not for {name}")
    if name == "local":
        from vehest.run.launchers.local import LocalLauncher, default_jobs

        return LocalLauncher(jobs or default_jobs())
    from vehest.run.launchers.clusters import RayLauncher, SlurmLauncher, slurm_parameters

    if name == "slurm" and options.address not in (None, "local"):
        raise ConfigurationError(f"--address must be left out for --launcher slurm, or be 'local' to try it here, not '{options.address}'")
    parameters, package = slurm_parameters(options.slurm), "submitit" if name == "slurm" else "ray"
    if importlib.util.find_spec(package) is None:
        raise MissingError(f"--launcher {name} needs {package}, which is not installed: pip install 'vehest[{name}]'")
    if name == "slurm":
        return SlurmLauncher(options.address or "slurm", jobs, parameters, output, messages)
    return RayLauncher(options.address, jobs, output, messages)


@dataclass
class LaunchProgress:
    """Counts the groups of a launch, and estimates when the last will be done."""

    total: int
    core_seconds: float = 0.0
    done: int = 0
    failed: int = 0
    running: set[int] = field(default_factory=set)

    def ended(self, position: int, seconds: float, *, failed: bool) -> None:
        """A group has ended after so many seconds of a core."""
        self.running.discard(position)
        self.core_seconds += seconds
        self.failed += failed
        self.done += not failed

    def row(self, cores: int) -> Mapping[str, str]:
        """Heading -> value, nothing for a single group; time left as if groups took what ended ones did and running ones were half done."""
        running, ended = len(self.running), self.done + self.failed
        waiting = self.total - ended - running
        ahead = (waiting + 0.5 * running) / max(1, min(cores, waiting + running))
        left = timedelta(seconds=round(ahead * self.core_seconds / ended)) if ended else ""
        counts = {"done": self.done, "running": running, "waiting": waiting, "failed": self.failed}
        shown = {**counts, "core hours": f"{self.core_seconds / 3600:.3f}", "cores": cores, "left": left}
        return {name: str(value) for name, value in shown.items()} if self.total > 1 else {}
