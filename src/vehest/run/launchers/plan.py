"""What a study would cost before it is begun, by what trainings of the same kinds took; what is guessed is called a guess."""

from __future__ import annotations

import heapq
import json
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.run.comparison import groups_of, prepare
from vehest.run.config import Config
from vehest.run.group import existing, is_finished
from vehest.run.launchers.standing import duration
from vehest.run.launchers.times import Cost, Times, bytes_of, next_lot
from vehest.run.launchers.worker import JOURNAL, inputs_of
from vehest.run.pipeline import Configs, Pipeline
from vehest.run.train import new_estimator
from vehest.run.workshop import NotThereYet, Workshop

LEAST_SECONDS = 10.0  # of a task
GUESS_MB = 700.0  # of a worker: Python, torch, numba and recordings of minutes
WORDS = {
    "same": "trainings with the same settings",
    "variant": "the same variant under other settings",
    "estimator": "other variants of the estimator",
    "guess": "nothing like it was trained here",
}


@dataclass(frozen=True)
class Unit:
    """A group of members that is to be done.

    Args:
        kinds: of each member, estimator and variant.
        costs: of each member.
    """

    kinds: Sequence[str]
    costs: Sequence[Cost]

    @property
    def seconds(self) -> float:
        """On one core [s]."""
        return sum(cost.seconds for cost in self.costs)


@dataclass(frozen=True)
class StudyCost:
    """What is left to do of a study.

    Args:
        study: its name.
        units: groups that are to be done.
        done: trainings that are finished.
        cores: that the time is for.
        input_bytes: of the recordings that groups read; none where they are not all ingested.
        peak_mb: most memory that a worker took in this output root [MB]; none where none was recorded.
        absent: parts that the study goes on without.
        lacking: jobs that recordings lack something for.
    """

    study: str
    units: Sequence[Unit]
    done: int
    cores: int
    input_bytes: int | None
    peak_mb: float | None
    absent: Sequence[str] = ()
    lacking: int = 0
    bases: Mapping[str, Counter[str]] = field(init=False)

    def __post_init__(self) -> None:
        bases: dict[str, Counter[str]] = {}
        for unit in self.units:
            for kind, cost in zip(unit.kinds, unit.costs, strict=True):
                bases.setdefault(cost.basis, Counter())[kind] += 1
        object.__setattr__(self, "bases", bases)

    @property
    def tasks(self) -> list[float]:
        """What each task of a cluster takes [s]."""
        waiting, seconds = deque(range(len(self.units))), [unit.seconds for unit in self.units]
        tasks = []
        while waiting:
            tasks.append(sum(seconds[at] for at in next_lot(waiting, seconds.__getitem__, LEAST_SECONDS)))
        return tasks

    @property
    def core_seconds(self) -> float:
        """Of all that is to be done [s]."""
        return sum(unit.seconds for unit in self.units)

    @property
    def seconds(self) -> float:
        """From the first task to the end of the last, each on the core that is free first [s]."""
        return makespan(self.tasks, self.cores)

    @property
    def output_bytes(self) -> float:
        """Of models, calibrations and evaluations [bytes]."""
        return sum(cost.bytes for unit in self.units for cost in unit.costs)

    @property
    def worker_mb(self) -> float:
        """Memory of a worker [MB]."""
        return self.peak_mb or GUESS_MB

    def figures(self) -> dict[str, Any]:
        """All of it as plain values."""
        return {
            "study": self.study,
            "trainings": sum(len(unit.costs) for unit in self.units),
            "done": self.done,
            "groups": len(self.units),
            "tasks": len(self.tasks),
            "core_hours": self.core_seconds / 3600,
            "core_hours_guessed": sum(c.seconds for unit in self.units for c in unit.costs if c.basis == "guess") / 3600,
            "cores": self.cores,
            "seconds": self.seconds,
            "worker_mb": self.worker_mb,
            "memory_recorded": self.peak_mb is not None,
            "input_bytes": self.input_bytes,
            "output_bytes": self.output_bytes,
            "by": {basis: dict(kinds) for basis, kinds in self.bases.items()},
            "absent": list(self.absent),
            "lacking": self.lacking,
        }

    def rows(self) -> Iterator[tuple[str, str]]:
        """What is printed: name and value."""
        n = sum(len(unit.costs) for unit in self.units)
        yield "trainings", f"{n} in {len(self.units)} groups" + (f"; {self.done} more are done" if self.done else "")
        yield "tasks", f"{len(self.tasks)}, of {LEAST_SECONDS:g} s or more where there is enough to do"
        guessed = sum(cost.seconds for unit in self.units for cost in unit.costs if cost.basis == "guess")
        share = f", {100 * guessed / self.core_seconds:.0f} % of it guessed" if guessed else ""
        yield "core hours", f"{self.core_seconds / 3600:.3g}{share}"
        basis = "the most that a worker took here" if self.peak_mb else "guessed"
        yield "memory", f"{self.worker_mb / 1000:.2g} GB a core, {self.worker_mb * self.cores / 1000:.3g} GB for {self.cores} ({basis})"
        read = "recordings are not all ingested" if self.input_bytes is None else f"{_size(self.input_bytes)} of recordings to each machine"
        yield "data", f"{read}; {_size(self.output_bytes)} of models, calibrations and evaluations back"
        yield "time", f"{duration(self.seconds)} on {self.cores} core{'s' if self.cores > 1 else ''}, report and ingest aside"
        for own, kinds in self.bases.items():
            yield "known by" if own != "guess" else "guessed", f"{WORDS[own]}: {_listed(kinds)}"
        for name in self.absent:
            yield "left out", f"{name}: its raw files are not here"
        if self.lacking:
            yield "left out", f"{self.lacking} jobs that the recordings lack something for"


def plan_study(pipeline: Pipeline, configs: Configs, workshop: Workshop, cores: int) -> StudyCost:
    """What is left to do of a study; makes nothing.

    Args:
        pipeline: the study.
        configs: its jobs.
        workshop: in a dry run.
        cores: that the time is for.

    Raises:
        ConfigurationError: it trains nothing.
        MissingError: raw files of a part that it needs are not here.
    """
    if pipeline.datasets:
        raise ConfigurationError(f"'{pipeline.file.name}' shows recordings and trains nothing; there is nothing to plan")
    times, units, absent = Times(workshop.output), [], []
    done = lacking = 0
    inputs: dict[Path, int] | None = {}
    for part in pipeline.parts:
        try:
            workshop.look_for_files(configs[part.name][0])
        except MissingError:
            if not part.optional:
                raise
            absent.append(part.title)
            continue
        try:
            prepared = prepare(configs[part.name], workshop)
            jobs = [config for position, config in enumerate(prepared.configs) if position not in prepared.failures]
            groups, unplanned = groups_of(jobs, workshop)
            lacking += len(prepared.failures) + len(unplanned)
        except NotThereYet:
            units += _units_of(configs[part.name], times)
            inputs = None
            continue
        except DataError:
            lacking += len(configs[part.name])
            continue
        for group in groups:
            missing = [member.job for member in existing(group) if not is_finished(group, member)]
            done += len(group.jobs) - len(missing)
            if missing:
                units.append(Unit([job.plan.label.rsplit("-seed", 1)[0] for job in missing], [times.cost_of(job) for job in missing]))
                if inputs is not None:
                    inputs |= {artefact.folder: bytes_of(artefact) for artefact in inputs_of(group, workshop.output)}
    read = None if inputs is None else sum(inputs.values())
    return StudyCost(pipeline.study, units, done, cores, read, recorded_peak(workshop.output), absent, lacking)


def _units_of(configs: Sequence[Config], times: Times) -> list[Unit]:
    """Groups of jobs whose recordings are not there yet, by their configurations alone."""
    groups: dict[str, list[tuple[str, Cost]]] = {}
    for config in configs:
        estimator = new_estimator(config["estimator"])
        training = {key: value for key, value in config["training"].items() if key != "checkpoint_seconds"}
        stem = f"{estimator.name}-{estimator.variant}"
        cost = times.cost(estimator.name, stem, {"estimator": dict(config["estimator"]), "training": training})
        groups.setdefault(json.dumps([estimator.batch_key, training], sort_keys=True, default=str), []).append((stem, cost))
    return [Unit([kind for kind, _ in group], [cost for _, cost in group]) for group in groups.values()]


def makespan(seconds: Sequence[float], cores: int) -> float:
    """Until the last task ends, if each is begun in its order by the core that is free first [s]."""
    free = [0.0] * cores
    for own in seconds:
        heapq.heappush(free, heapq.heappop(free) + own)
    return max(free)


def recorded_peak(output: Path) -> float | None:
    """The most memory that a worker of a cluster took in an output root [MB]; none where none has worked there."""
    peaks = []
    for file in sorted(output.glob(f"{JOURNAL}/*/*.jsonl")):
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                peaks.append(float(json.loads(line)["peak_mb"]))
            except (ValueError, KeyError, TypeError):
                continue
    return max(peaks, default=None)


def _size(size: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def _listed(kinds: Counter[str], most: int = 6) -> str:
    named = [f"{kind} ({times})" for kind, times in kinds.most_common(most)]
    return ", ".join(named) + (f" and {len(kinds) - most} more" if len(kinds) > most else "")
