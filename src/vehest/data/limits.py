"""How much work a file may ask for: bounds with defaults that honest recordings stay far below, and a way to raise them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields
from typing import Any

from vehest.data.errors import ConfigurationError, DataError


@dataclass(frozen=True)
class Limits:
    """Bounds on what one input may take; an hour of 55 channels at 1 kHz stays below half of each.

    Args:
        samples: samples of one channel of a recording, also after its clock has been made even and after resampling.
        values: samples of one recording, all channels that are read together.
        columns: columns that the header of a table may name.
        unpacked_bytes: what one file may unpack to, in memory or on disk [bytes].
        expansion: how many times its packed size a file may unpack to, once that is more than 64 MiB.
        memory: what reading one file may take beyond ten times its size [bytes].
        filter_samples: reach of a filter, or length of an estimator's window, in samples.
        jobs: trainings of one sweep or study.
        links: blocks that one file may chain one after another.
        text_bytes: length of a configuration, manifest or other text that describes something [bytes].
        nodes: values in such a text, each counted as often as an alias repeats it.
        depth: how deep such a text may nest.
    """

    samples: int = 20_000_000
    values: int = 500_000_000
    columns: int = 10_000
    unpacked_bytes: int = 8 * 2**30
    expansion: int = 250
    memory: int = 1_600_000_000
    filter_samples: int = 1_000_000
    jobs: int = 10_000
    links: int = 1_000_000
    text_bytes: int = 16 * 2**20
    nodes: int = 500_000
    depth: int = 60

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ConfigurationError(f"limits.{field.name} must be a whole number from 1 on, not {value!r}")


_DEFAULTS = Limits()
_current: ContextVar[Limits] = ContextVar("limits", default=_DEFAULTS)


def current_limits() -> Limits:
    """The limits in force."""
    return _current.get()


@contextmanager
def use_limits(limits: Limits) -> Iterator[None]:
    """Put limits in force for a while."""
    token = _current.set(limits)
    try:
        yield
    finally:
        _current.reset(token)


def limits_from_config(config: Mapping[str, Any] | None) -> Limits:
    """Limits from ``limits`` of a configuration; what it does not name keeps its default.

    Raises:
        ConfigurationError: an unknown name, or a value that is no whole number from 1 on.
    """
    names = [field.name for field in fields(Limits)]
    if not isinstance(config, Mapping | None):
        raise ConfigurationError(f"limits must name some with their values, for example limits.jobs=20000, not {config!r}")
    for name in config or {}:
        if name not in names:
            raise ConfigurationError(f"limits.{name} is not a limit; there are: {', '.join(names)}")
    return Limits(**{str(name): value for name, value in (config or {}).items()})


def check_limit(name: str, value: float, what: str, error: type[ConfigurationError | DataError] = DataError) -> None:
    """See that a number stays within the limit ``name``.

    Args:
        name: field of `Limits`.
        value: what is asked for.
        what: for the message, ``"'lap.csv' would hold 4000000000 samples"``.
        error: what to raise.

    Raises:
        DataError: it does not (or ``error``).
    """
    limit = getattr(current_limits(), name)
    if not value <= limit:
        raise error(f"{what}, more than the limit of {limit}; if that is meant, raise it: limits.{name}=NUMBER")


def check_unpacked(file: object, packed: float, unpacked: float) -> None:
    """See that a file does not unpack to more than is allowed, in bytes and in proportion to its packed size.

    Raises:
        DataError: it does.
    """
    check_limit("unpacked_bytes", unpacked, f"'{file}' unpacks to {unpacked:.0f} bytes")
    if unpacked > 64 * 2**20:
        check_limit("expansion", unpacked / max(packed, 1.0), f"'{file}' unpacks to {unpacked / max(packed, 1.0):.0f} times its size")
