"""Simulated data sets: their configuration, and how their drives ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.data.store import read_recording
from vehest.run.artefacts import Artefact
from vehest.run.config import Config, compose_config, key_of
from vehest.sources.base import SIMULATED


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


def outcome_of(ingested: Artefact) -> dict[str, Any]:
    """Number and hours of the drives, and the names of those that span, left the road or ended before their manoeuvre did.

    Raises:
        DataError: a recording is damaged.
    """
    hours = 0.0
    flagged: dict[str, list[str]] = {"spun": [], "left_road": [], "not_completed": []}
    for name in sorted(ingested.outputs):
        recording = read_recording(ingested.folder / name, ["vx"])
        flags: Mapping[str, Any] = recording.provenance.get("flags", {})
        hours += len(recording) / recording.rate_hz / 3600.0
        for flag, holds in (("spun", flags.get("spun")), ("left_road", flags.get("left_road")), ("not_completed", not flags["completed"])):
            if holds:
                flagged[flag].append(recording.id)
    return {"drives": len(ingested.outputs), "hours": hours, **flagged}
