"""Chooses where groups run, this machine's cores, a Ray cluster or a SLURM queue.

Imports nothing heavy: the command line takes options from here.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vehest.data.errors import ConfigurationError, MissingError

if TYPE_CHECKING:
    from vehest.run.console import Messages
    from vehest.run.launchers.clusters import RayLauncher, SlurmLauncher
    from vehest.run.launchers.local import LocalLauncher

    Launcher = LocalLauncher | RayLauncher | SlurmLauncher  # any of the launchers

LAUNCHERS = ("local", "ray", "slurm")  # names of the launchers


@dataclass(frozen=True)
class RunOptions:
    """Options of a command that runs stages, as `vehest run --help` describes them."""

    force: bool = False  # run stages although their artefacts exist
    dry_run: bool = False  # whether what would be done is only printed
    quiet: bool = False  # print warnings alone
    jobs: int | None = None  # processes; None: one for each core
    track: bool = False  # log runs to MLflow
    minutes: float | None = None  # time limit of trainings [min]; None: none
    retrain: bool = False  # train although weights are published
    # train what is missing; None: unless the study is published without some trainings
    train_missing: bool | None = None
    publish_weights: bool = False  # add trained models to the published weights of the study
    launcher: str = "local"  # one of `LAUNCHERS`
    address: str | None = None  # address of a Ray cluster
    slurm: Sequence[str] = ()  # resources of SLURM jobs, NAME=VALUE


def chosen_launcher(options: RunOptions, output: Path, messages: Messages) -> Launcher:
    """The launcher that a command's options name.

    Without ``jobs`` it runs as many groups at a time as cores; ``messages`` prints what a cluster
    reports. Machines of a cluster may share the output root.

    Raises
    ------
    ConfigurationError
        Options that do not belong together, or an unknown launcher.
    MissingError
        The launcher's package is not installed, or there is no SLURM here.
    """
    name = options.launcher
    address = options.address
    jobs = options.jobs
    if name not in LAUNCHERS:
        raise ConfigurationError(f"--launcher must be one of {', '.join(LAUNCHERS)}, not '{name}'")
    if address and name == "local":
        raise ConfigurationError("--address is for --launcher ray and slurm, not for local")
    if options.slurm and name != "slurm":
        raise ConfigurationError(f"--slurm is for --launcher slurm, not for {name}")
    if name == "local":
        from vehest.run.launchers.local import LocalLauncher, default_jobs

        return LocalLauncher(jobs or default_jobs())
    from vehest.run.launchers.clusters import RayLauncher, SlurmLauncher, slurm_parameters

    if name == "slurm" and address not in (None, "local"):
        raise ConfigurationError(
            "--address must be left out for --launcher slurm, or be 'local' to try it here, not "
            f"'{address}'"
        )
    parameters = slurm_parameters(options.slurm)
    package = "submitit" if name == "slurm" else "ray"
    if importlib.util.find_spec(package) is None:
        raise MissingError(
            f"--launcher {name} needs {package}, which is not installed: pip install "
            f"'vehest[{name}]'"
        )
    if name == "slurm":
        return SlurmLauncher(address or "slurm", jobs, parameters, output, messages)
    return RayLauncher(address, jobs, output, messages)
