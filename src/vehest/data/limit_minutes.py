"""Limits ranges to a number of minutes, as if less had been recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from vehest.data.errors import ConfigurationError
from vehest.data.splits import Span

LEAST_SECONDS = 3.0  # of a piece; shorter ones hold no window after the start that is not scored


def limit_minutes(spans: Sequence[Span], seconds: float, at: float, bounds_of: Callable[[Span], tuple[float, float]]) -> tuple[Span, ...]:
    """A stretch of ranges laid end to end; it goes on at their start where it reaches their end. Ends of a few seconds are left out.

    Args:
        spans: ranges.
        seconds: time to keep [s]; all, if there is less.
        at: share of the ranges after which to begin, 0 to 1.
        bounds_of: first and last time of the recording of a range [s].

    Raises:
        ConfigurationError: ``seconds`` is not positive, or ``at`` not from 0 up to 1.
    """
    if not seconds > 0:
        raise ConfigurationError(f"split.minutes must be positive, not {seconds / 60.0:g}")
    if not 0.0 <= at < 1.0:
        raise ConfigurationError(f"split.minutes_at must be from 0 up to 1, not {at:g}")
    bounded = [_bounded(span, bounds_of) for span in spans]
    total = sum(span.stop - span.start for span in bounded)
    if seconds >= total:
        return tuple(spans)
    begin = at * total
    kept = _between(bounded, begin, min(begin + seconds, total))
    pieces = (*_between(bounded, 0.0, begin + seconds - total), *kept)
    return tuple(piece for piece in pieces if piece.stop - piece.start >= LEAST_SECONDS) or pieces


def _bounded(span: Span, bounds_of: Callable[[Span], tuple[float, float]]) -> Span:
    if math.isfinite(span.start) and math.isfinite(span.stop):
        return span
    first, last = bounds_of(span)
    return replace(span, start=max(span.start, first), stop=min(span.stop, last))


def _between(spans: Sequence[Span], begin: float, end: float) -> list[Span]:
    """Pieces of ranges laid end to end that lie between two times of that line [s]."""
    found, position = [], 0.0
    for span in spans:
        length = span.stop - span.start
        start, stop = max(begin - position, 0.0), min(end - position, length)
        if stop - start > 1e-9:
            found.append(replace(span, start=span.start + start, stop=span.start + stop))
        position += length
    return found
