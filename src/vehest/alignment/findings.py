"""What a check found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing that a check found.

    Args:
        level: ``error`` stops an ingest, ``warning`` needs a look, ``note`` is information.
        check: name of the check.
        channel: the channel concerned, empty if it is not about one or if the data do not decide which.
        message: what was found, where, and what to do.
    """

    level: Level
    check: str
    channel: str
    message: str


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
