"""Simulated data sets: how they are asked for, and how their drives went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.data.store import read_recording
from vehest.run.artefacts import Artefact
from vehest.run.config import Config, compose_config, key_of
from vehest.sources.base import SIMULATED


@dataclass(frozen=True)
class Outcome:
    """How the drives of one data set went.

    Args:
        drives: how many there are.
        hours: of them all.
        spun: names of those in which the car span.
        left_road: names of those in which it left the road.
        not_completed: names of those that ended before their manoeuvre did, for whatever reason.
    """

    drives: int
    hours: float
    spun: Sequence[str]
    left_road: Sequence[str]
    not_completed: Sequence[str]

    def as_plain(self) -> dict[str, Any]:
        """As JSON knows it."""
        return asdict(self)


def simulation_config(dataset: str, overrides: Sequence[str]) -> Config:
    """The configuration of a simulated data set's ingest; ``seed=1`` among the overrides is short for ``dataset.seed=1``.

    Raises:
        ConfigurationError: the data set is not simulated, or an override makes no sense.
    """
    spelt_out = [f"dataset.{override.lstrip('+')}" if key_of(override).lstrip("+") == "seed" else override for override in overrides]
    config = compose_config("ingest", [f"dataset={dataset}", *spelt_out])
    if config["dataset"].get("source") != SIMULATED:
        raise ConfigurationError(f"data set '{dataset}' is not simulated but read from files; run 'vehest ingest {dataset}'")
    return config


def outcome_of(ingested: Artefact) -> Outcome:
    """How the drives went, from what their recordings say of it.

    Raises:
        DataError: a recording is damaged.
    """
    hours, names = 0.0, []
    flagged: dict[str, list[str]] = {"spun": [], "left_road": [], "not_completed": []}
    for name in sorted(ingested.outputs):
        recording = read_recording(ingested.folder / name, ["vx"])
        flags: Mapping[str, Any] = recording.provenance.get("flags", {})
        hours += len(recording) / recording.rate_hz / 3600.0
        names.append(recording.id)
        for flag, holds in (("spun", flags.get("spun")), ("left_road", flags.get("left_road")), ("not_completed", not flags["completed"])):
            if holds:
                flagged[flag].append(recording.id)
    return Outcome(len(names), hours, **flagged)
