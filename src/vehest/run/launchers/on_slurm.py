"""Groups as jobs of a SLURM cluster, through submitit, or as processes that submitit starts here to try it.

A job does what a task on Ray does: a few groups, one after another, each known by its keys. All jobs are handed to the queue at once; the
parent waits, and hands in again, each group by itself, what a job that died had left. A job whose time is up is put back into the queue by
submitit and goes on from its last checkpoint. Machines share the output root.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import time
import uuid
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.limits import current_limits
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group, Member
from vehest.run.launcher import Done, Reporter, default_jobs
from vehest.run.launchers.returned import Returned
from vehest.run.launchers.times import Times, next_lot
from vehest.run.launchers.worker import JOURNAL, Order, Report, mark_shared, moved, run_order, this_world
from vehest.run.signals import StopSignals, TimeLimit

INSTALL = "pip install 'vehest[slurm]'"
HERE = "local"  # address under which submitit starts processes of this machine
SHORTEST, LONGEST = 10.0, 300.0  # s, what a job should last at least: queues take seconds to begin one, so longer where there is much to do
SIDE_BY_SIDE = 64  # jobs that a study is cut into at least, where each is still long enough and --jobs does not say
MOST_DEATHS = 3  # of jobs at one group, after which the group is what ends them
MOST_REQUEUED = 100  # times that a job whose time was up goes on
POLL_SECONDS = {HERE: 0.2, "slurm": 2.0}
BEAT_SECONDS = {HERE: 0.5, "slurm": 5.0}
STOP = "stop"  # in a run's journal: a file that asks all jobs to end
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
    """What a job does; submitit calls `checkpoint` when its time is nearly up, and hands the outcome in again."""

    def __call__(self, order: Order) -> Report:
        """Do a task until it is done or everything is to stop."""
        stop = order.output / JOURNAL / order.run / STOP
        return run_order(order, lambda _: stop.exists(), os.environ.get("SLURMD_NODENAME", ""))

    def checkpoint(self, order: Order) -> Any:
        """The same task again: what it has finished is found by its keys, and what was under way goes on from its checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, order)


@dataclass
class _Course:
    """Where a launch stands."""

    groups: Sequence[Group]
    waiting: deque[int]
    positions: Mapping[str, int]
    least: float
    again: deque[list[int]] = field(default_factory=deque)
    flying: list[tuple[Any, list[int]]] = field(default_factory=list)
    begun: set[int] = field(default_factory=set)
    deaths: Counter[int] = field(default_factory=Counter)
    read: dict[Path, int] = field(default_factory=dict)


class SlurmLauncher:
    """Runs groups as SLURM jobs.

    Args:
        address: none for SLURM, or ``local`` for processes of this machine.
        jobs: most jobs at a time; none for as many as the queue begins, here as there are cores.
        words: ``NAME=VALUE`` each, what jobs ask the queue for.
        output: the output root, which all machines see under the same path.
        messages: where deaths and what is left out are said.

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
        self._run = uuid.uuid4().hex[:12]
        self._times = Times(output)
        self._returned = Returned(output, self._times, messages)
        self._executor: Any = None
        self._token = ""
        self._failed = False
        self._under_way = 0

    @property
    def cores(self) -> int:
        """Jobs at a time, as many as are allowed or else as have begun."""
        return self._most or max(1, self._under_way)

    @property
    def _folder(self) -> Path:
        """Where jobs are handed over and write their logs."""
        return self._journal / "slurm"

    @property
    def _journal(self) -> Path:
        return self._output.resolve() / JOURNAL / self._run

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """See `Launcher`."""
        if stop.requested() or not groups:
            return
        self._prepare()
        positions = {job.plan.key: at for at, group in enumerate(groups) for job in group.jobs}
        course = _Course(groups, deque(range(len(groups))), positions, self._least(groups))
        with stop.deferred():
            while course.waiting or course.again or course.flying:
                self._listen(course, report)
                if stop.requested():
                    self._call_off(course)
                    if not course.flying:
                        return
                else:
                    yield from self._hand_in(course)
                ended = [entry for entry in course.flying if entry[0].done()]
                if not ended:
                    time.sleep(POLL_SECONDS[self._cluster])
                for entry in ended:
                    course.flying.remove(entry)
                    yield from self._ended(*entry, course, stopping=stop.requested())

    def close(self) -> None:
        """Forget what was handed over; logs of jobs that failed stay."""
        if self._executor is not None and not self._failed:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _prepare(self) -> None:
        if self._executor is not None:
            return
        import submitit

        self._token = mark_shared(self._output, self._run)
        self._folder.mkdir(mode=0o700)
        own = {"slurm_max_num_timeout": MOST_REQUEUED} if self._cluster == "slurm" else {"local_max_num_timeout": MOST_REQUEUED}
        self._executor = submitit.AutoExecutor(self._folder, cluster=self._cluster, **own)
        self._executor.update_parameters(**self._parameters)
        if self._cluster == "slurm" and self._most:
            self._executor.update_parameters(slurm_array_parallelism=self._most)

    def _listen(self, course: _Course, report: Reporter) -> None:
        """Tell of groups that jobs have begun since the last look."""
        for file in self._journal.glob("*.jsonl"):
            with suppress(OSError), open(file, "rb") as stream:
                stream.seek(course.read.get(file, 0))
                for line in stream:
                    if not line.endswith(b"\n"):
                        break
                    course.read[file] = course.read.get(file, 0) + len(line)
                    entry = json.loads(line)
                    position = course.positions.get(entry["keys"][0])
                    if position is not None and entry["event"] == "begun":
                        course.begun.add(position)
                        report(position, None)
        self._under_way = sum(not course.begun.isdisjoint(positions) for _, positions in course.flying)

    def _hand_in(self, course: _Course) -> Iterator[Done[list[Member]]]:
        """Give the queue all that waits, or as much as may run here; failures where it takes no more.

        Raises:
            MissingError: it takes no jobs from the start.
        """
        lots: list[list[int]] = []
        while (course.again or course.waiting) and (self._cluster == "slurm" or len(course.flying) + len(lots) < self.cores):
            lots.append(course.again.popleft() if course.again else self._next(course))
        if not lots:
            return
        import submitit

        try:
            handed = self._executor.map_array(OnSlurm(), [self._order(lot, course) for lot in lots])
        except (submitit.core.utils.FailedSubmissionError, submitit.core.utils.UncompletedJobError) as error:
            reason = " ".join(str(error).split())[-300:]
            why = f"SLURM takes no jobs ({reason}); check --slurm, and what this account may submit"
            if not course.flying and not course.deaths:
                shutil.rmtree(self._folder, ignore_errors=True)
                raise MissingError(why) from error
            left = [*(at for lot in lots for at in lot), *course.waiting, *(at for lot in course.again for at in lot)]
            course.waiting.clear()
            course.again.clear()
            yield from (Done(at, Failure(why, exit_code=MissingError.exit_code)) for at in left)
            return
        course.flying += zip(handed, lots, strict=True)

    def _next(self, course: _Course) -> list[int]:
        """The next groups that are one job."""
        return next_lot(course.waiting, lambda at: self._times.seconds_of(course.groups[at]), course.least)

    def _least(self, groups: Sequence[Group]) -> float:
        """What a job should last [s]; forced groups are one job each, since a second try would do all of them anew."""
        if any(group.force for group in groups):
            return 0.0
        total = sum(self._times.seconds_of(group) for group in groups)
        return min(max(total / (self._most or SIDE_BY_SIDE), SHORTEST), LONGEST)

    def _order(self, lot: Sequence[int], course: _Course) -> Order:
        here, root = self._output, self._output.resolve()
        return Order(
            groups=[(at, moved(course.groups[at], here, root)) for at in lot],
            inputs=[],
            output=root,
            run=self._run,
            token=self._token,
            store="",
            world=this_world(),
            limits=current_limits(),
            beat_seconds=BEAT_SECONDS[self._cluster],
        )

    def _ended(self, job: Any, lot: list[int], course: _Course, *, stopping: bool) -> Iterator[Done[list[Member]]]:
        import submitit

        try:
            told = job.result()
        except submitit.core.utils.FailedJobError as error:  # a defect, or what a machine lacks
            self._failed = True
            reason = next((line for line in reversed(str(error).splitlines()) if "Error" in line and "submitit" not in line), str(error))
            yield from (Done(at, Failure(f"{reason.strip()}; the job's log: {job.paths.stderr}", detail=str(error))) for at in lot)
        except submitit.core.utils.UncompletedJobError:
            if not stopping:
                yield from self._lost(job, lot, course)
        else:
            yield from self._reported(told, lot, course)

    def _reported(self, told: Report, lot: list[int], course: _Course) -> Iterator[Done[list[Member]]]:
        done, left = self._returned.read(told, lot, course.groups)
        yield from done
        if told.unsuitable:
            yield from (Done(at, Failure(f"{told.host}: {told.unsuitable}", exit_code=MissingError.exit_code)) for at in left)

    def _lost(self, job: Any, lot: list[int], course: _Course) -> Iterator[Done[list[Member]]]:
        """Hand in again what a dead job had, each group by itself, so that one which kills jobs takes no other along."""
        self._failed = True
        state = str(job.state).lower().replace("_", " ")
        for at in lot:
            course.deaths[at] += 1
            course.begun.discard(at)
            if course.deaths[at] >= MOST_DEATHS:
                hint = f"{MOST_DEATHS} jobs with it ended without an outcome (the last: {state}); its log: {job.paths.stderr}"
                yield Done(at, Failure(hint))
            else:
                detail = f"its job ended without an outcome ({state}); it goes on in another from its last checkpoint"
                self._messages.line("again", "train", course.groups[at].name, detail)
                course.again.append([at])

    def _call_off(self, course: _Course) -> None:
        """Ask jobs to end after their batch, and take back those that have begun no group."""
        if course.waiting or course.again or not (self._journal / STOP).exists():
            (self._journal / STOP).touch()
            course.waiting.clear()
            course.again.clear()
        if self._cluster == "slurm":
            for entry in [entry for entry in course.flying if course.begun.isdisjoint(entry[1])]:
                with suppress(Exception):  # it has just ended
                    entry[0].cancel(check=False)
                course.flying.remove(entry)
