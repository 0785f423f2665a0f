"""Groups as jobs of a SLURM cluster, through submitit, or as processes that submitit starts here to try it.

A job whose time is up is put back into the queue by submitit and goes on from its last checkpoint. Machines share the output root.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, MissingError
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group
from vehest.run.launchers.local import Done, Reporter, default_jobs
from vehest.run.launchers.task import TIMES, TaskSpec, new_mark, run_task, task_of
from vehest.run.signals import StopSignals, TimeLimit

MOST_REQUEUED = 100  # times that a job whose time was up goes on
POLL_SECONDS = {"local": 0.2, "slurm": 2.0}
STOP = "stop"  # file that asks all jobs to end
PARAMETERS = {"account": "slurm_account", "constraint": "slurm_constraint", "memory_gb": "mem_gb", "minutes": "timeout_min"}
PARAMETERS |= {"partition": "slurm_partition", "qos": "slurm_qos"}
"""Name in ``--slurm NAME=VALUE`` -> parameter of submitit."""


def slurm_parameters(words: Sequence[str]) -> dict[str, Any]:
    """What jobs ask the queue for.

    Raises:
        ConfigurationError: a word is not NAME=VALUE with a name of `PARAMETERS`, or its value is no positive number where it must be one.
    """
    found: dict[str, Any] = {"mem_gb": 2.0, "timeout_min": 60, "cpus_per_task": 1, "name": "vehest"}
    for word in words:
        name, _, value = word.partition("=")
        if name not in PARAMETERS or not value:
            raise ConfigurationError(f"--slurm '{word}' must be NAME=VALUE with one of the names {', '.join(PARAMETERS)}")
        found[PARAMETERS[name]] = _positive(name, value) if name in ("memory_gb", "minutes") else value
    return {**found, "timeout_min": max(round(found["timeout_min"]), 1)}


def _positive(name: str, text: str) -> float:
    with suppress(ValueError):
        if 0.0 < float(text) < float("inf"):
            return float(text)
    raise ConfigurationError(f"--slurm {name} must be a positive number, not '{text}'")


class SlurmTask:
    """A job; submitit calls `checkpoint` when its time is nearly up, and hands the outcome in again."""

    def __call__(self, spec: TaskSpec) -> Done:
        """Run a group until it is done or the driver asks for its end."""
        return run_task(spec, None, (spec.mark / STOP).exists)

    def checkpoint(self, spec: TaskSpec) -> Any:
        """The same task again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, spec)


class SlurmLauncher:
    """Runs groups as SLURM jobs, all in the queue at once, or on ``cluster`` local as processes of this machine.

    Raises:
        MissingError: there is no SLURM here.
    """

    def __init__(self, cluster: str, jobs: int | None, parameters: Mapping[str, Any], output: Path, messages: Messages) -> None:
        if cluster == "slurm" and shutil.which("sbatch") is None:
            raise MissingError("there is no SLURM here (no sbatch); run this where jobs are submitted, or try it with --address local")
        self._cluster, self._parameters, self._output, self._messages = cluster, parameters, output, messages
        self._jobs = jobs or (default_jobs() if cluster == "local" else None)
        self._executor: Any = None
        self._running: dict[Any, int] = {}
        self._lost: Counter[str] = Counter()  # jobs, by the name of their group

    @property
    def cores(self) -> int:
        """Jobs at a time, as many as are allowed or else as run now."""
        return self._jobs or max(1, sum(job.state == "RUNNING" for job in self._running))

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done]:
        """See `Launcher`."""
        if stop.requested() or not groups:
            return
        if self._executor is None:
            self._connect()
        waiting = list(range(len(groups)))
        with stop.deferred():
            while waiting or self._running:
                if stop.requested():
                    waiting = []
                    self._call_off()
                room = len(waiting) if self._cluster == "slurm" else self.cores - len(self._running)
                self._running |= zip(self._begin(groups, waiting[:room]), waiting[:room], strict=True)
                waiting = waiting[room:]
                for job, position in self._running.items():
                    if job.state in ("RUNNING", "COMPLETED"):
                        report(position, None)
                ended = [job for job in self._running if job.done()]
                if self._running and not ended:
                    time.sleep(POLL_SECONDS[self._cluster])
                for job in ended:
                    position = self._running.pop(job)
                    done = self._done(position, job, groups[position].name)
                    if done is not None:
                        yield done
                    elif not stop.requested():
                        waiting.append(position)

    def close(self) -> None:
        """Call off what is left; logs of jobs that were lost stay."""
        if self._executor is not None:
            self._call_off()
            if not self._lost:
                shutil.rmtree(self._executor.folder, ignore_errors=True)

    def _connect(self) -> None:
        import submitit

        limit = {f"{self._cluster}_max_num_timeout": MOST_REQUEUED}
        self._executor = submitit.AutoExecutor(new_mark(self._output), self._cluster, **limit)
        self._executor.update_parameters(**self._parameters, slurm_array_parallelism=self._jobs)

    def _begin(self, groups: Sequence[Group], positions: Sequence[int]) -> Sequence[Any]:
        specs = [task_of(position, groups[position], self._output, self._executor.folder) for position in positions]
        try:
            return self._executor.map_array(SlurmTask(), specs) if specs else []
        except RuntimeError as error:
            reason = " ".join(str(error).split())[-300:]
            raise MissingError(f"SLURM takes no jobs ({reason}); check --slurm, and what this account may submit") from error

    def _call_off(self) -> None:
        """Ask jobs to end after their batch, and take back those that have not begun."""
        (self._executor.folder / STOP).touch()
        for job in [job for job in self._running if job.state in ("PENDING", "UNKNOWN")]:
            job.cancel(check=False)
            del self._running[job]

    def _done(self, position: int, job: Any, name: str) -> Done | None:
        """The outcome of a job; none if it ended without one."""
        log = f"its log: {job.paths.stderr}"
        try:
            return job.result()  # type: ignore[no-any-return]
        except RuntimeError as error:
            self._lost[name] += 1
            if not job.paths.result_pickle.exists():
                why = f"its job ended without an outcome ({str(job.state).lower()}); {log}"
                if self._lost[name] == TIMES:
                    return Done(position, Failure(f"{why} ({TIMES} times)"))
                self._messages.line("again", "train", name, why)
                return None
            reason = next(
                (line for line in reversed(str(error).splitlines()) if "Error: " in line and "submitit" not in line),
                str(error).splitlines()[0],
            )
            raise MissingError(f"a machine of the cluster cannot run jobs: {reason.strip()}; {log}") from error
