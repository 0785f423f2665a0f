"""Launchers have one interface: this machine's cores, a Ray cluster and a SLURM queue."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from vehest.data.errors import ConfigurationError, MissingError
from vehest.run.console import Messages
from vehest.run.group import Group
from vehest.run.launchers.local import Done, LocalLauncher, Reporter, default_jobs
from vehest.run.launchers.options import LAUNCHERS, LauncherOptions
from vehest.run.signals import StopSignals, TimeLimit


class Launcher(Protocol):
    """Runs groups; outcomes come back to this process, which alone tracks and draws."""

    @property
    def cores(self) -> int:
        """Groups that can run at a time."""

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done]:
        """Run groups as `local.launch` runs tasks, with members as outcomes; on a cluster only the begin of a group is reported.

        Raises:
            MissingError: there is no cluster, it takes no tasks, or one of its machines cannot run them.
        """

    def close(self) -> None:
        """Release processes and connections."""


def chosen_launcher(options: LauncherOptions, jobs: int | None, output: Path, messages: Messages) -> Launcher:
    """The launcher of a command; without ``jobs`` it runs as many groups at a time as there are cores.

    Raises:
        ConfigurationError: there is no such launcher, or it takes no such option.
        MissingError: a package that it needs is not installed, or there is no SLURM here.
    """
    name = options.launcher
    if name not in LAUNCHERS:
        raise ConfigurationError(f"--launcher must be one of {', '.join(LAUNCHERS)}, not '{name}'")
    if options.address and name == "local":
        raise ConfigurationError("--address is for --launcher ray and slurm, not for local")
    if options.slurm and name != "slurm":
        raise ConfigurationError(f"--slurm is for --launcher slurm, not for {name}")
    if name == "local":
        return LocalLauncher(jobs or default_jobs())
    from vehest.run.launchers.on_ray import RayLauncher
    from vehest.run.launchers.on_slurm import SlurmLauncher, slurm_parameters

    if name == "slurm" and options.address not in (None, "local"):
        raise ConfigurationError(f"--address must be left out for --launcher slurm, or be 'local' to try it here, not '{options.address}'")
    parameters = slurm_parameters(options.slurm)
    package = {"ray": "ray", "slurm": "submitit"}[name]
    if importlib.util.find_spec(package) is None:
        raise MissingError(f"--launcher {name} needs {package}, which is not installed: pip install 'vehest[{name}]'")
    if name == "slurm":
        return SlurmLauncher(options.address or "slurm", jobs, parameters, output, messages)
    return RayLauncher(options.address, jobs, output, messages)
