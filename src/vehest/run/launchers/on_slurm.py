"""Groups as jobs of a SLURM cluster, through submitit, or as processes that submitit starts here to try it.

A group is a job. All jobs are handed to the queue at once; a job that dies is handed in again. A job whose time is up is put back into the
queue by submitit and goes on from its last checkpoint. Machines share the output root.
"""

from __future__ import annotations

import importlib.util
import shutil
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.limits import current_limits
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group, Member
from vehest.run.launchers.local import Done, Reporter, default_jobs
from vehest.run.launchers.task import (
    MARKS,
    TaskReport,
    TaskSpec,
    forget_mark,
    leave_mark,
    moved,
    new_run,
    received,
    run_task,
    versions_here,
)
from vehest.run.signals import StopSignals, TimeLimit

INSTALL = "pip install 'vehest[slurm]'"
HERE = "local"  # address under which submitit starts processes of this machine
MOST_DEATHS = 3  # of jobs at one group, after which the group is what ends them
MOST_REQUEUED = 100  # times that a job whose time was up goes on
POLL_SECONDS = {HERE: 0.2, "slurm": 2.0}
BEAT_SECONDS = {HERE: 0.5, "slurm": 5.0}
OPTIONS: Mapping[str, tuple[str, type]] = {
    "account": ("slurm_account", str),
    "constraint": ("slurm_constraint", str),
    "memory_gb": ("mem_gb", float),
    "minutes": ("timeout_min", float),
    "partition": ("slurm_partition", str),
    "qos": ("slurm_qos", str),
}
"""Name in ``--slurm NAME=VALUE`` -> parameter of submitit, and its type."""
DEFAULTS: Mapping[str, Any] = {"mem_gb": 2.0, "timeout_min": 60, "cpus_per_task": 1, "name": "vehest"}


def slurm_parameters(words: Sequence[str]) -> dict[str, Any]:
    """What jobs ask the queue for.

    Args:
        words: ``NAME=VALUE`` each, of `OPTIONS`.

    Raises:
        ConfigurationError: a word is not of this form, or its value is no positive number where it must be one.
    """
    found = dict(DEFAULTS)
    for word in words:
        name, _, value = word.partition("=")
        if name not in OPTIONS or not value:
            raise ConfigurationError(f"--slurm '{word}' must be NAME=VALUE with one of the names {', '.join(OPTIONS)}")
        key, kind = OPTIONS[name]
        if kind is float:
            try:
                number = float(value)
            except ValueError:
                number = 0.0
            if not 0.0 < number < float("inf"):
                raise ConfigurationError(f"--slurm {name} must be a positive number, not '{value}'")
            found[key] = max(round(number), 1) if key == "timeout_min" else number
        else:
            found[key] = value
    return found


class OnSlurm:
    """A job; submitit calls `checkpoint` when its time is nearly up, and hands the outcome in again."""

    def __call__(self, spec: TaskSpec, stop: Path) -> TaskReport:
        """Run a group until it is done or the file ``stop`` is there."""
        return run_task(spec, {}, lambda _: stop.exists())

    def checkpoint(self, spec: TaskSpec, stop: Path) -> Any:
        """The same task again: finished artefacts are found by their keys, a training goes on from its checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, spec, stop)


class SlurmLauncher:
    """Runs groups as SLURM jobs.

    Args:
        address: none for SLURM, or ``local`` for processes of this machine.
        jobs: most jobs at a time; none for as many as the queue begins, here as there are cores.
        words: resources of a job, ``NAME=VALUE`` each.
        output: the output root, which all machines see under the same path.
        messages: prints jobs that are handed in again.

    Raises:
        ConfigurationError: an address or a word is not known.
        MissingError: submitit is not installed, or there is no SLURM here.
    """

    def __init__(self, address: str | None, jobs: int | None, words: Sequence[str], output: Path, messages: Messages) -> None:
        if address not in (None, HERE):
            raise ConfigurationError(f"--address must be left out for --launcher slurm, or be '{HERE}' to try it here, not '{address}'")
        self._parameters = slurm_parameters(words)
        if importlib.util.find_spec("submitit") is None:
            raise MissingError(f"--launcher slurm needs submitit, which is not installed: {INSTALL}")
        self._cluster = HERE if address == HERE else "slurm"
        if self._cluster == "slurm" and shutil.which("sbatch") is None:
            raise MissingError(f"there is no SLURM here (no sbatch); run this where jobs are submitted, or try it with --address {HERE}")
        self._most = jobs or (default_jobs() if self._cluster == HERE else None)
        self._output, self._messages = output, messages
        self._run = new_run()
        self._folder = output.resolve() / MARKS / f"slurm-{self._run}"
        self._executor: Any = None
        self._failed = False
        self._under_way = 0

    @property
    def cores(self) -> int:
        """Jobs at a time, as many as are allowed or else as have begun."""
        return self._most or max(1, self._under_way)

    @property
    def _stop(self) -> Path:
        """File that asks all jobs to end."""
        return self._folder / "stop"

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """See `Launcher`."""
        if stop.requested() or not groups:
            return
        self._prepare()
        waiting = deque(range(len(groups)))
        flying: dict[int, Any] = {}
        begun: set[int] = set()
        deaths: Counter[int] = Counter()
        with stop.deferred():
            while waiting or flying:
                for position, job in flying.items():
                    if position not in begun and job.state in ("RUNNING", "COMPLETED"):
                        begun.add(position)
                        report(position, None)
                self._under_way = len(begun & set(flying))
                if stop.requested():
                    waiting.clear()
                    self._call_off(flying, begun)
                else:
                    yield from self._hand_in(groups, waiting, flying, refused=not deaths and not flying)
                ended = [position for position, job in flying.items() if job.done()]
                if flying and not ended:
                    time.sleep(POLL_SECONDS[self._cluster])
                for position in ended:
                    done = self._ended(flying.pop(position), position, groups[position], deaths)
                    if done is not None:
                        yield done
                    elif not stop.requested():
                        begun.discard(position)
                        waiting.append(position)

    def close(self) -> None:
        """Forget what was handed over; logs of jobs that failed stay."""
        if self._executor is not None:
            forget_mark(self._output, self._run)
            if not self._failed:
                shutil.rmtree(self._folder, ignore_errors=True)

    def _prepare(self) -> None:
        if self._executor is not None:
            return
        import submitit

        leave_mark(self._output, self._run)
        self._folder.mkdir(mode=0o700)
        self._executor = submitit.AutoExecutor(self._folder, cluster=self._cluster, **{f"{self._cluster}_max_num_timeout": MOST_REQUEUED})
        self._executor.update_parameters(**self._parameters)
        if self._cluster == "slurm" and self._most:
            self._executor.update_parameters(slurm_array_parallelism=self._most)

    def _hand_in(
        self, groups: Sequence[Group], waiting: deque[int], flying: dict[int, Any], *, refused: bool
    ) -> Iterator[Done[list[Member]]]:
        """Give the queue all that waits, or as much as may run here; failures where it takes no more.

        Raises:
            MissingError: ``refused``, it takes no jobs from the start.
        """
        import submitit

        room = len(waiting) if self._cluster == "slurm" else self.cores - len(flying)
        positions = [waiting.popleft() for _ in range(min(room, len(waiting)))]
        if not positions:
            return
        root = self._output.resolve()
        fixed = (root, self._run, versions_here(), current_limits(), BEAT_SECONDS[self._cluster])
        specs = [TaskSpec(moved(groups[position], self._output, root), *fixed) for position in positions]
        try:
            handed = self._executor.map_array(OnSlurm(), specs, [self._stop] * len(specs))
        except (submitit.core.utils.FailedSubmissionError, submitit.core.utils.UncompletedJobError) as error:
            reason = " ".join(str(error).split())[-300:]
            why = f"SLURM takes no jobs ({reason}); check --slurm, and what this account may submit"
            if refused:
                raise MissingError(why) from error
            positions += waiting
            waiting.clear()
            yield from (Done(position, Failure(why, exit_code=MissingError.exit_code)) for position in positions)
            return
        flying |= dict(zip(positions, handed, strict=True))

    def _ended(self, job: Any, position: int, group: Group, deaths: Counter[int]) -> Done[list[Member]] | None:
        """The outcome of a job; none where it is to be handed in again, or was called off."""
        import submitit

        try:
            told: TaskReport = job.result()
        except submitit.core.utils.FailedJobError as error:  # a defect, or a package that a machine lacks
            self._failed = True
            reason = next((line for line in reversed(str(error).splitlines()) if "Error" in line and "submitit" not in line), str(error))
            return Done(position, Failure(f"{reason.strip()}; the job's log: {job.paths.stderr}", detail=str(error)))
        except submitit.core.utils.UncompletedJobError:
            self._failed = True
            deaths[position] += 1
            state = str(job.state).lower().replace("_", " ")
            if deaths[position] >= MOST_DEATHS:
                hint = f"{MOST_DEATHS} jobs with it ended without an outcome (the last: {state}); its log: {job.paths.stderr}"
                return Done(position, Failure(hint))
            detail = f"its job ended without an outcome ({state}); it goes on in another from its last checkpoint"
            self._messages.line("again", "train", group.name, detail)
            return None
        if told.unsuitable or told.apart:
            why = told.unsuitable or f"does not see the output root '{self._output.resolve()}'; mount it there under the same path"
            return Done(position, Failure(f"{told.host}: {why}", exit_code=MissingError.exit_code))
        outcome = received(told, self._output)
        return None if outcome is None else Done(position, outcome, told.seconds)

    def _call_off(self, flying: dict[int, Any], begun: set[int]) -> None:
        """Ask jobs to end after their batch, and take back those that have not begun."""
        self._stop.touch()
        if self._cluster == "slurm":
            for position in set(flying) - begun:
                with suppress(Exception):  # it has just ended
                    flying[position].cancel(check=False)
                del flying[position]
