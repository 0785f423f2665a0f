"""Groups as tasks of a Ray cluster, or as jobs of a SLURM queue through submitit; each can also be
tried on this machine alone.

Group -> TaskSpec -> `run_task` on a machine: same versions? same output root? -> Done -> artefacts
in the driver's output root

Keys of members make a task idempotent. Ray repeats one that is lost with its worker or machine,
submitit a job whose time is up; both go on from the last checkpoint. Machines that do not share the
output root get inputs through Ray's object store and return artefacts.
"""

from __future__ import annotations

import logging
import os
import platform
import shutil
import signal
import socket
import tempfile
import threading
import time
from collections import ChainMap, Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import chdir, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import MANIFEST, commit, library_versions, read_artefact
from vehest.data.errors import ConfigurationError, MissingError, number_of
from vehest.data.files import remove_leftovers, written_aside
from vehest.data.limits import Limits, current_limits, use_limits
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group, Member, existing
from vehest.run.launchers.local import POLL_SECONDS, Done, Files, Reporter, default_jobs, guarded
from vehest.run.signals import StopSignals, TimeLimit
from vehest.version import __version__

MAX_ATTEMPTS = 3  # attempts at a group whose tasks end without a report
# environment variables of Ray -> values that hold unless the user sets others
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # by default 15
    "RAY_task_oom_retries": str(MAX_ATTEMPTS - 1),  # by default without end
}
"""Environment variables of Ray, unless they are set otherwise."""
QUEUE_SECONDS = {"local": 0.2, "slurm": 2.0}  # cluster -> s between two polls of the jobs
STOP = "stop"  # file that asks all SLURM jobs to end
PARAMETERS = {
    "account": "slurm_account",
    "constraint": "slurm_constraint",
    "memory_gb": "mem_gb",
    "minutes": "timeout_min",
    "partition": "slurm_partition",
    "qos": "slurm_qos",
}
"""Name in ``--slurm NAME=VALUE`` -> parameter of submitit."""


class NotShared(Exception):
    """Raised on a machine, named in the message, that does not share the output root and received
    no copies.
    """


@dataclass(frozen=True)
class TaskSpec:
    """A group as it is sent to a machine of a cluster, with the driver's paths; relative ones refer
    to ``folder``.
    """

    position: int  # index of the group among those that are launched
    group: Group  # group of tasks to run
    folder: Path  # folder to which the driver's relative paths refer
    mark: Path  # folder in the driver's output root; a machine that finds it shares the root
    versions: Mapping[str, str]  # versions of the driver, which the machine must have too
    limits: Limits  # limits of input sizes


def new_mark(output: Path) -> Path:
    """A new folder in an output root, which only its owner can read."""
    folder = output.resolve() / "clusters"
    folder.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix="run-", dir=folder))


def task_of(position: int, group: Group, output: Path, mark: Path) -> TaskSpec:
    """Make the task for a group.

    Parameters
    ----------
    position : int
        Of the group among those that are launched.
    group : Group
        What is to be done.
    output : Path
        Output root of the driver.
    mark : Path
        Folder by which a machine recognises that it shares the root.
    """
    return TaskSpec(
        position,
        group,
        output if output.is_absolute() else Path.cwd(),
        mark,
        versions_here(),
        current_limits(),
    )


def run_task(spec: TaskSpec, copies: Files | None, should_stop: Callable[[], bool]) -> Done:
    """Run a group on a machine of a cluster; ``copies`` are the artefacts that it reads, none where
    machines share the output root.

    Parameters
    ----------
    spec : TaskSpec
        What the driver sent.
    copies : mapping or None
        Folder of an artefact -> its files.
    should_stop : callable
        Asked between batches.

    Returns
    -------
    Done
        With the files of new artefacts, where the root is not shared.

    Raises
    ------
    MissingError
        The machine has other versions, or copies cannot be written.
    NotShared
        There is neither a shared output root nor copies.
    """
    versions = versions_here()
    unlike = [
        f"{name} {versions.get(name, 'missing')} instead of {version}"
        for name, version in spec.versions.items()
        if versions.get(name) != version
    ]
    if unlike:
        raise MissingError(
            f"{socket.gethostname()} has {', '.join(unlike)}; install the same versions on every "
            "machine"
        )
    shared = spec.mark.is_dir()
    if not shared and copies is None:
        raise NotShared(socket.gethostname())
    spec.folder.mkdir(parents=True, exist_ok=True)
    with chdir(spec.folder), use_limits(spec.limits):
        if not shared:
            unpack(copies or {})
        outcome = guarded(spec.group.run, should_stop, lambda _: None)
        files = (
            {}
            if shared or isinstance(outcome, Failure)
            else pack(folders_of(outcome).difference(copies or ()))
        )
    return Done(spec.position, outcome, files)


def versions_here() -> dict[str, str]:
    """Versions that must be equal on all machines, so that results are those of one: name ->
    version.
    """
    return {
        "vehest": f"{__version__} {commit()}".strip(),
        "python": platform.python_version(),
        **library_versions(),
    }


def inputs_of(group: Group) -> set[Path]:
    """Folders of the artefacts that a group reads: recordings, references, models that trainings
    start from, and its own artefacts that exist already.
    """
    data = [job.data for job in group.jobs]
    if group.evaluation is not None:
        data += [group.evaluation.data, group.evaluation.references]
    starts = {Path(start) for job in group.jobs if (start := job.training.get("start_from"))}
    return (
        folders_of(existing(group))
        | {artefact.folder for artefacts in data for artefact in artefacts.values()}
        | starts
    )


def folders_of(members: Sequence[Member]) -> set[Path]:
    """Folders of the artefacts of members."""
    return {artefact.folder for member in members for artefact in member.made}


def pack(folders: set[Path]) -> Files:
    """Read the files of artefacts, their manifests included: folder -> files."""
    return {
        folder: {
            file.relative_to(folder).as_posix(): file.read_bytes()
            for file in folder.rglob("*")
            if file.is_file()
        }
        for folder in folders
    }


def unpack(packed: Files) -> None:
    """Write artefacts into their folders, each completely or not at all, unless they exist.

    Raises
    ------
    DataError
        A copy is damaged.
    MissingError
        A folder cannot be written to, or the disk is full.
    """
    for folder, files in packed.items():
        if not (folder / MANIFEST).is_file() or (folder / MANIFEST).read_bytes() != files[MANIFEST]:
            remove_leftovers(folder.parent)
            with written_aside(folder, replace_folder=True) as aside:
                for name, content in files.items():
                    (aside / name).parent.mkdir(parents=True, exist_ok=True)
                    (aside / name).write_bytes(content)
                read_artefact(aside)


class RayLauncher:
    """Runs groups on the Ray cluster at an address (``auto``: this machine's; None: that of
    ``RAY_ADDRESS``, else a local Ray that is started).

    By default ``RAY_ADDRESS``, else a Ray of its own.
    """

    def __init__(
        self, address: str | None, jobs: int | None, output: Path, messages: Messages
    ) -> None:
        self._address = address or os.environ.get("RAY_ADDRESS") or "local"
        self._jobs = jobs
        self._output = output
        self._messages = messages
        self._ray: Any = None
        self._task: Any = None
        self._mark = Path()
        # artefacts in Ray's object store; none while machines are taken to share the root
        self._stored: dict[Path, Any] | None = None

    @property
    def cores(self) -> int:
        """Cores of the cluster as it is now, ``jobs`` at most; 1 before it is connected."""
        n_cores = int(self._ray.cluster_resources().get("CPU", 1)) if self._ray else 1
        return min(n_cores, self._jobs or n_cores)

    def launch(
        self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter
    ) -> Iterator[Done]:
        """See `LocalLauncher`."""
        if self._ray is None:
            self._connect()
        waiting = deque(range(len(groups)))
        running = dict[Any, int]()
        stopping = False
        with stop.deferred():
            while waiting or running:
                if stop.requested() and not stopping:
                    stopping = True
                    waiting.clear()
                    for task in running:
                        self._ray.cancel(task)
                while waiting and len(running) < self.cores:
                    position = waiting.popleft()
                    running[self._begin(position, groups[position])] = position
                    report(position, None)
                for task in (
                    self._ray.wait(list(running), timeout=POLL_SECONDS)[0] if running else []
                ):
                    position = running.pop(task)
                    done = self._done(position, task)
                    if done is not None:
                        yield done
                    elif not stopping:
                        waiting.append(position)

    def close(self) -> None:
        """Disconnect from the cluster, or end a local Ray that was started."""
        if self._ray is not None:
            self._mark.rmdir()
            self._ray.shutdown()

    def _connect(self) -> None:
        """Connect to the cluster, or start a Ray of one's own, and print how many machines it has;
        the handler of SIGTERM, which Ray replaces, is restored.
        """
        os.environ.update(ENVIRONMENT | os.environ)
        import ray

        options: dict[str, Any] = (
            {"num_cpus": self._jobs, "include_dashboard": False} if self._address == "local" else {}
        )
        handler = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(
                address=self._address,
                log_to_driver=False,
                logging_level=logging.CRITICAL,
                **options,
            )
        except Exception as error:  # ConnectionError, RuntimeError, ValueError, … by what is wrong
            raise MissingError(
                f"there is no Ray cluster at '{self._address}' ({_line(error)}); ray start --head "
                "starts one"
            ) from error
        finally:
            signal.signal(signal.SIGTERM, handler)  # Ray replaces it
        # instead of standard output
        ray._private.worker.print_to_stdstream = lambda data, **_: self._messages.line(
            "again", "ray", data["lines"][0].partition("\n")[0]
        )
        self._ray, self._mark = ray, new_mark(self._output)
        self._task = ray.remote(num_cpus=1, max_retries=MAX_ATTEMPTS - 1)(_run)
        n_nodes = sum(node["Alive"] for node in ray.nodes())
        machines = f"{number_of(n_nodes, 'machine')}, {self.cores} cores"
        self._messages.line("note", "cluster", ray.get_runtime_context().gcs_address, machines)

    def _begin(self, position: int, group: Group) -> Any:
        """Send a group as a task, with copies of its inputs where machines do not share the output
        root.
        """
        spec = task_of(position, group, self._output, self._mark)
        copies = []
        if self._stored is not None:
            inputs = inputs_of(group)
            self._stored |= {
                folder: self._ray.put(pack({folder}))
                for folder in inputs
                if folder not in self._stored
            }
            copies = [self._stored[folder] for folder in inputs]
        return self._task.options(name=group.name).remote(spec, *copies)

    def _done(self, position: int, task: Any) -> Done | None:
        """The outcome of a task; None if it was cancelled before it began, or needs copies."""
        errors = self._ray.exceptions
        try:
            done: Done = self._ray.get(task)
        except errors.TaskCancelledError:
            return None
        except errors.RayTaskError as error:
            if not isinstance(error.cause, NotShared):
                raise MissingError(
                    f"a machine of the cluster cannot run tasks: {_line(error.cause or error)}"
                ) from error
            if self._stored is None:
                self._stored = {}
                detail = "does not share the output root: recordings and artefacts are sent"
                self._messages.line("note", "cluster", str(error.cause), detail)
            return None
        except errors.RayError as error:
            return Done(
                position,
                Failure(
                    f"{_line(error)} ({MAX_ATTEMPTS} times; --launcher local shows what ends it)"
                ),
            )
        unpack(done.made)
        return done


def _run(spec: TaskSpec, *copies: Files) -> Done:
    """The function that Ray runs as a task, and cancels by SIGINT."""
    cancelled = threading.Event()
    handler = signal.signal(signal.SIGINT, lambda *_: cancelled.set())
    try:
        return run_task(spec, ChainMap(*copies) if copies else None, cancelled.is_set)
    finally:
        signal.signal(signal.SIGINT, handler)


def _line(error: BaseException) -> str:
    """First line of an error, at most 200 characters."""
    return (str(error) or type(error).__name__).splitlines()[0][:200]


def slurm_parameters(words: Sequence[str]) -> dict[str, Any]:
    """Resources that jobs request from the queue, as parameters of submitit.

    Parameters
    ----------
    words : sequence of str
        NAME=VALUE each, of ``--slurm``.

    Returns
    -------
    dict
        Parameters of submitit; 2 GB, one core and an hour by default.

    Raises
    ------
    ConfigurationError
        Unless each is NAME=VALUE of `PARAMETERS`, positive where it must be.
    """
    parameters: dict[str, Any] = {
        "mem_gb": 2.0,
        "timeout_min": 60,
        "cpus_per_task": 1,
        "name": "vehest",
    }
    for word in words:
        name, _, value = word.partition("=")
        if name not in PARAMETERS or not value:
            raise ConfigurationError(
                f"--slurm '{word}' must be NAME=VALUE with one of the names {', '.join(PARAMETERS)}"
            )
        parameters[PARAMETERS[name]] = (
            _positive(name, value) if name in ("memory_gb", "minutes") else value
        )
    return {**parameters, "timeout_min": max(round(parameters["timeout_min"]), 1)}


def _positive(name: str, text: str) -> float:
    """A positive, finite number from its text; raises `ConfigurationError` otherwise."""
    with suppress(ValueError):
        if 0.0 < float(text) < float("inf"):
            return float(text)
    raise ConfigurationError(f"--slurm {name} must be a positive number, not '{text}'")


class SlurmTask:
    """Callable that a SLURM job runs.

    Submitit calls `checkpoint` when its time is nearly up, and submits the returned task again.
    """

    def __call__(self, spec: TaskSpec) -> Done:
        """Run a group until it is done or the driver asks for its end."""
        return run_task(spec, None, (spec.mark / STOP).exists)

    def checkpoint(self, spec: TaskSpec) -> Any:
        """The same task, to be submitted again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, spec)


class SlurmLauncher:
    """Runs groups as SLURM jobs, all in the queue at once, or, with ``cluster`` ``local``, as
    processes of this machine.
    """

    def __init__(
        self,
        cluster: str,
        jobs: int | None,
        parameters: Mapping[str, Any],
        output: Path,
        messages: Messages,
    ) -> None:
        if cluster == "slurm" and shutil.which("sbatch") is None:
            raise MissingError(
                "there is no SLURM here (no sbatch); run this where jobs are submitted, or try it "
                "with --address local"
            )
        self._cluster = cluster
        self._parameters = parameters
        self._output = output
        self._messages = messages
        self._jobs = jobs or (default_jobs() if cluster == "local" else None)
        self._executor: Any = None
        self._running: dict[Any, int] = {}
        self._lost: Counter[str] = Counter()  # jobs, by the name of their group

    def launch(
        self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter
    ) -> Iterator[Done]:
        """See `LocalLauncher`."""
        if self._executor is None:
            import submitit

            limit = {
                f"{self._cluster}_max_num_timeout": 100
            }  # times that a job whose time was up goes on
            self._executor = submitit.AutoExecutor(new_mark(self._output), self._cluster, **limit)
            self._executor.update_parameters(**self._parameters, slurm_array_parallelism=self._jobs)
        waiting = list(range(len(groups)))
        with stop.deferred():
            while waiting or self._running:
                if stop.requested():
                    waiting = []
                    self._call_off()
                room = (
                    self._jobs - len(self._running)
                    if self._jobs and self._cluster == "local"
                    else len(waiting)
                )
                self._running |= zip(
                    self._begin(groups, waiting[:room]), waiting[:room], strict=True
                )
                waiting = waiting[room:]
                for job, position in self._running.items():
                    if job.state in ("RUNNING", "COMPLETED"):
                        report(position, None)
                ended = [job for job in self._running if job.done()]
                if self._running and not ended:
                    time.sleep(QUEUE_SECONDS[self._cluster])
                for job in ended:
                    position = self._running.pop(job)
                    done = self._done(position, job, groups[position].name)
                    if done is not None:
                        yield done
                    elif not stop.requested():
                        waiting.append(position)

    def close(self) -> None:
        """Cancel the remaining jobs; logs of jobs that were lost are kept."""
        if self._executor is not None:
            self._call_off()
            if not self._lost:
                shutil.rmtree(self._executor.folder, ignore_errors=True)

    def _begin(self, groups: Sequence[Group], positions: Sequence[int]) -> Sequence[Any]:
        """Submit groups as one array of jobs."""
        specs = [
            task_of(position, groups[position], self._output, self._executor.folder)
            for position in positions
        ]
        try:
            return self._executor.map_array(SlurmTask(), specs) if specs else []
        except RuntimeError as error:
            reason = " ".join(str(error).split())[-300:]
            raise MissingError(
                f"SLURM takes no jobs ({reason}); check --slurm, and what this account may submit"
            ) from error

    def _call_off(self) -> None:
        """Ask running jobs to end after their batch, and cancel those that have not begun."""
        (self._executor.folder / STOP).touch()
        for job in [job for job in self._running if job.state in ("PENDING", "UNKNOWN")]:
            job.cancel(check=False)
            del self._running[job]

    def _done(self, position: int, job: Any, name: str) -> Done | None:
        """The outcome of a job; None if it ended without one."""
        log = f"its log: {job.paths.stderr}"
        try:
            return job.result()  # type: ignore[no-any-return]
        except RuntimeError as error:
            self._lost[name] += 1
            if not job.paths.result_pickle.exists():
                why = f"its job ended without an outcome ({str(job.state).lower()}); {log}"
                if self._lost[name] == MAX_ATTEMPTS:
                    return Done(position, Failure(f"{why} ({MAX_ATTEMPTS} times)"))
                self._messages.line("again", "train", name, why)
                return None
            lines = str(error).splitlines()
            reason = next(
                (line for line in reversed(lines) if "Error: " in line and "submitit" not in line),
                lines[0],
            )
            raise MissingError(
                f"a machine of the cluster cannot run jobs: {reason.strip()}; {log}"
            ) from error
