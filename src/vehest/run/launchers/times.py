"""What groups take, by what trainings of the same kind took: their times stand in every output root.

A member's time is that of its training (``train_seconds``, its share where members train as one batch), its calibration and its
evaluation. Looked for are, in this order, members with the same settings but another seed, members of the same variant under other
settings, and members of the same estimator; where there is none, the time is a guess and is called one.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Any, Literal

from vehest.data.errors import VehestError
from vehest.run.artefacts import Artefact, read_artefact
from vehest.run.group import Group
from vehest.run.train import STAGE as TRAIN
from vehest.run.train import TrainJob, read_fit_metrics

GUESS_SECONDS = 10.0  # of a member of which nothing like it was ever trained here
GUESS_BYTES = 300_000
MOST_KEPT = 48  # times of a kind
MOST_READ = 12  # artefacts of a kind that are looked at

Basis = Literal["same", "variant", "estimator", "guess"]


@dataclass(frozen=True)
class Cost:
    """What a member takes.

    Args:
        seconds: on one core [s].
        bytes: of its model, calibration and evaluation [bytes].
        basis: ``same`` settings, same ``variant``, same ``estimator``, or a ``guess``.
    """

    seconds: float
    bytes: float
    basis: Basis


@dataclass(frozen=True)
class _Recorded:
    settings: Mapping[str, Any]
    seconds: float
    bytes: float


class Times:
    """Costs by what is recorded in an output root; each kind is looked for once.

    Args:
        output: the output root.
    """

    def __init__(self, output: Path) -> None:
        self._output = output
        self._kinds: dict[str, list[_Recorded]] = {}
        self._costs: dict[str, Cost] = {}

    def seconds_of(self, group: Group) -> float:
        """What a group takes on one core [s]."""
        return sum(self.cost_of(job).seconds for job in group.jobs)

    def cost_of(self, job: TrainJob) -> Cost:
        """What a member takes, its seed aside."""
        return self.cost(str(job.estimator["name"]), _stem(job), _settings(job))

    def cost(self, estimator: str, stem: str, settings: Mapping[str, Any]) -> Cost:
        """What a member takes.

        Args:
            estimator: its name.
            stem: estimator and variant, as the label of a training begins.
            settings: ``estimator`` and ``training``, as the manifest of a training has them.
        """
        key = repr((stem, settings))
        if key not in self._costs:
            self._costs[key] = self._looked_up(estimator, stem, settings)
        return self._costs[key]

    def learn(self, group: Group, seconds: float) -> None:
        """Count a group that has just ended [s] among what is recorded."""
        for job in group.jobs:
            own = _Recorded(_settings(job), seconds / len(group.jobs), GUESS_BYTES)
            for start in (f"{_stem(job)}-seed", f"{job.estimator['name']}-"):
                known = self._recorded(start)
                known.append(own)
                del known[:-MOST_KEPT]
        self._costs = {key: cost for key, cost in self._costs.items() if cost.basis == "same"}

    def _looked_up(self, estimator: str, stem: str, settings: Mapping[str, Any]) -> Cost:
        alike = self._recorded(f"{stem}-seed")
        same = [own for own in alike if own.settings == settings]
        basis: Basis
        for basis, found in (("same", same), ("variant", alike), ("estimator", self._recorded(f"{estimator}-"))):  # type: ignore[assignment]
            if found:
                return Cost(statistics.median(own.seconds for own in found), statistics.median(own.bytes for own in found), basis)
        return Cost(GUESS_SECONDS, GUESS_BYTES, "guess")

    def _recorded(self, start: str) -> list[_Recorded]:
        if start not in self._kinds:
            folders = sorted((self._output / TRAIN).glob(f"{escape(start)}*"))[:MOST_READ]
            self._kinds[start] = [own for folder in folders if (own := self._read(folder)) is not None]
        return self._kinds[start]

    def _read(self, folder: Path) -> _Recorded | None:
        try:
            model = read_artefact(folder)
            if model.status != "complete":
                return None
            further = [self._longest(kind, model.label) for kind in ("calibrate", "evaluate")]
            seconds = read_fit_metrics(folder).get("train_seconds", 0.0) + sum(own.provenance.get("seconds", 0.0) for own in further if own)
        except (VehestError, OSError, TypeError):
            return None
        settings = {name: dict(model.config[name]) for name in ("estimator", "training") if name in model.config}
        return _Recorded(settings, seconds, sum(bytes_of(own) for own in [model, *further] if own))

    def _longest(self, stage: str, label: str) -> Artefact | None:
        """What followed a model in a stage; of several the one that took longest."""
        found = []
        for folder in sorted((self._output / stage).glob(f"{escape(label)}-*"))[:MOST_READ]:
            with suppress(VehestError, OSError):
                found.append(read_artefact(folder))
        return max(found, key=lambda own: float(own.provenance.get("seconds", 0.0)), default=None)


def _stem(job: TrainJob) -> str:
    return job.plan.label.rsplit("-seed", 1)[0]


def _settings(job: TrainJob) -> dict[str, Any]:
    return {name: job.plan.config[name] for name in ("estimator", "training")}


def bytes_of(artefact: Artefact) -> int:
    """Size of an artefact's files [bytes]."""
    return sum((artefact.folder / name).stat().st_size for name in artefact.outputs)


def next_lot(waiting: deque[int], seconds_of: Callable[[int], float], least: float) -> list[int]:
    """Take positions from the front until together they take as long as they should; what is left at the end may take less.

    Args:
        waiting: positions in their order, one at least.
        seconds_of: what a position takes [s].
        least: what a lot should take [s].
    """
    lot = [waiting.popleft()]
    held = seconds_of(lot[0])
    while waiting and held < least:
        lot.append(waiting.popleft())
        held += seconds_of(lot[-1])
    return lot
