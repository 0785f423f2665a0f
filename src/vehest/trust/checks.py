"""Checks of the numbers of trust.yaml.

What compiled code indexes and computes with is validated where it becomes an object.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from vehest.data.channels import CHANNELS
from vehest.data.errors import DataError

MAX_NUMBER = 1e100
"""Largest size of a number without a narrower range: products of three stay finite."""


def check_channels(place: str, names: Sequence[str]) -> None:
    """Raise `DataError` unless channels exist and none occurs twice."""
    unknown = [name for name in names if name not in CHANNELS]
    if unknown:
        raise DataError(f"{place}: there is no channel '{unknown[0][:40]}'")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{place}: channel '{twice}' occurs twice")


def check_number(place: str, value: float, low: float, high: float = MAX_NUMBER) -> None:
    """Raise `DataError` unless a number lies between two others, both included; NaN does not.

    Parameters
    ----------
    place : str
        Where the number stands, for messages.
    value : float
        The number.
    low, high : float
        Limits. With the smallest positive number as ``low`` the message asks for a positive one.
    """
    if low == math.ulp(0.0) and not value > 0.0:
        raise DataError(f"{place} must be positive, not {value:.4g}")
    if not low <= value <= high:
        raise DataError(f"{place} must lie between {low:g} and {high:g}, not at {value:.4g}")


def check_numbers(
    place: str, values: Iterable[float], low: float, high: float = MAX_NUMBER
) -> None:
    """Raise `DataError` unless all numbers lie between two others, both included."""
    for value in values:
        check_number(place, value, low, high)


def check_shape(place: str, values: Any, *shape: int) -> None:
    """Raise `DataError` unless nested tuples have a shape and numbers up to `MAX_NUMBER`.

    Parameters
    ----------
    place : str
        Where the numbers stand, for messages.
    values : any
        Nested tuples, or a number without a shape.
    *shape : int
        Length of each dimension, the outermost first. NaN is refused.
    """
    if not shape:
        if not math.fabs(values) <= MAX_NUMBER:
            raise DataError(f"{place} holds {values:.4g}, beyond {MAX_NUMBER:g}")
        return
    if len(values) != shape[0]:
        raise DataError(f"{place} has {len(values)} entries, not {shape[0]}")
    for part in values:
        check_shape(place, part, *shape[1:])
