"""Bounds on the work that a file or a configuration may ask for: defaults that honest recordings
stay below, and a way to raise them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from pydantic import PositiveInt

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import validated


@dataclass(frozen=True)
class Limits:
    """Upper bounds of the size of one input; an hour of 55 channels at 1 kHz stays below each."""

    # samples of one channel of a recording, also after resampling
    samples: PositiveInt = 20_000_000
    columns: PositiveInt = 10_000  # columns that the header of a table may name
    # memory that reading one file may take beyond ten times its size [bytes]
    memory: PositiveInt = 1_600_000_000
    # reach of a filter, or length of an estimator's window, in samples
    filter_samples: PositiveInt = 1_000_000
    jobs: PositiveInt = 10_000  # trainings of one sweep or study
    # length of a configuration, manifest or other text that describes something [bytes]
    text_bytes: PositiveInt = 16 * 2**20


_DEFAULTS = Limits()  # limits where none are set
_current: ContextVar[Limits] = ContextVar("limits", default=_DEFAULTS)  # limits in force


def current_limits() -> Limits:
    """The limits in force."""
    return _current.get()


@contextmanager
def use_limits(limits: Limits) -> Iterator[None]:
    """Context in which limits are in force."""
    token = _current.set(limits)
    try:
        yield
    finally:
        _current.reset(token)


def limits_from_config(config: Mapping[str, Any] | None) -> Limits:
    """Limits from ``limits`` of a configuration; those that it leaves out are the default ones.

    Raises
    ------
    ConfigurationError
        A name or a value is none.
    """
    return validated(Limits, config or {}, "", error=ConfigurationError, group="limits")


def check_limit(
    name: str, value: float, subject: str, error: type[ConfigurationError | DataError] = DataError
) -> None:
    """Refuse a number above the limit ``name``, a field of `Limits`.

    Raises
    ------
    DataError
        It is above (or ``error``); its message begins with ``subject``, ``"'lap.csv' would hold
        4000000000 samples"``.
    """
    limit = getattr(current_limits(), name)
    if not value <= limit:
        raise error(
            f"{subject}, more than the limit of {limit}; if that is meant, raise it: "
            f"limits.{name}=NUMBER"
        )


def check_unpacked(file: object, packed: float, unpacked: float) -> None:
    """Refuse a file that unpacks to more than the limits allow.

    Parameters
    ----------
    file : object
        Its path, for messages.
    packed, unpacked : float
        Sizes [bytes].

    Raises
    ------
    DataError
        ``unpacked`` exceeds ``limits.memory`` and ten times ``packed`` together.
    """
    excess = unpacked - 10.0 * packed
    check_limit(
        "memory",
        excess,
        f"'{file}' unpacks to {unpacked:.0f} bytes, {excess:.0f} beyond ten times its size",
    )
