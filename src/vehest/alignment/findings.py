"""Findings of checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["error", "warning", "note"]  # severity of a finding


@dataclass(frozen=True)
class Finding:
    """Outcome of a check."""

    level: Level  # ``error`` stops an ingest, ``warning`` needs a look, ``note`` is information
    check: str  # name of the check
    channel: str  # empty if it is about none or if the data do not decide which
    message: str  # fault, place and remedy
    # channels of which some are at fault, where ``channel`` is empty
    suspects: tuple[str, ...] = ()
