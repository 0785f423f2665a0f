"""Levels of simulated sensors from a configuration: a preset, and changes down to one error of one
sensor.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.simulation.sensors.levels import (
    NO_ERRORS,
    PRESETS,
    REFERENCES,
    Reference,
    SensorLevel,
    SensorLevels,
    without_errors,
)

OFF = "off"  # word that switches errors off; YAML reads False, a command line the text


def switched_off(levels: SensorLevels, *names: str) -> SensorLevels:
    """The same levels with some errors off; all other samples stay what they were, bit by bit.

    >>> levels = switched_off(SensorLevels(), "ay.noise", "tilt.bank", "reference", "*.drift")

    A name is an error of a sensor (``ay.noise``, ``imu.lever_x``, ``reference.heading.drift``), all
    errors of one (``ay``, ``tilt``, ``reference``), or one kind of error of every sensor but the
    reference (``*.noise``), or all of them (``*``).

    Parameters
    ----------
    levels : SensorLevels
        Levels to start from; they stay unchanged.
    *names : str
        What to switch off, in any order.

    Raises
    ------
    ConfigurationError
        There is no such sensor or error.
    """
    sensor_names = [
        entry.name
        for entry in fields(levels)
        if isinstance(getattr(levels, entry.name), SensorLevel)
    ]
    for name in names:
        first, *path = str(name).split(".")
        for sensor in sensor_names if first == "*" else [first]:
            levels = _off_at(levels, [sensor, *path], name)
    return levels


def sensor_levels_from_config(value: Any) -> SensorLevels:
    """Levels from a data set's ``sensors``: a preset's name, or a mapping that changes a ``preset``
    (by default ``default``)::

        {preset: race, reference: optical, ay: {noise: 0, offset: 0.05}, steer: off,
         tilt: {bank: off}, switched_off: ["*.drift"]}

    A sensor, ``imu``, ``tilt`` and ``reference`` take a mapping of what changes, or ``off``;
    ``reference`` also takes a kind, or a mapping with one.

    Raises
    ------
    ConfigurationError
        An unknown name, with those there are, or a value that makes no sense.
    """
    configuration = {"preset": value} if isinstance(value, str) else value or {}
    changes = {str(key): change for key, change in configuration.items()}
    preset = str(changes.pop("preset", "default"))
    if preset not in PRESETS:
        raise ConfigurationError(f"sensors '{preset}' is not one of: {', '.join(PRESETS)}")
    off = changes.pop("switched_off", ())
    if isinstance(off, str):
        off = [off]
    if not isinstance(off, Iterable) or isinstance(off, Mapping):
        raise ConfigurationError(
            f"sensors: switched_off is a list of names such as ay.noise, not {off!r}"
        )
    levels = _changed(PRESETS[preset], changes, "sensors", also=("preset", "switched_off"))
    return switched_off(levels, *off)


def _reference(kind: Any) -> Reference:
    """A reference by its kind; raises `ConfigurationError` for an unknown one."""
    if str(kind) not in REFERENCES:
        raise ConfigurationError(
            f"sensors: reference '{kind}' is not one of: {', '.join(REFERENCES)}"
        )
    return REFERENCES[str(kind)]


def _changed(
    current: Any, changes: Mapping[str, Any], label: str, also: tuple[str, ...] = ()
) -> Any:
    """A dataclass of levels with some of its fields changed, or all of them off."""
    names = [entry.name for entry in fields(current)]
    new = {}
    for key, change in changes.items():
        if key not in names:
            raise ConfigurationError(
                f"{label}: '{key}' is not one of: {', '.join([*names, *also])}"
            )
        new[key] = _changed_value(
            getattr(current, key),
            change,
            f"{label}: {key}" if label == "sensors" else f"{label}.{key}",
        )
    try:
        return replace(current, **new)
    except ConfigurationError as error:
        raise ConfigurationError(f"{label}: {error}") from None


def _changed_value(old: Any, change: Any, label: str) -> Any:
    """One field of a dataclass of levels as a configuration changes it: ``off``, a kind of
    reference, a mapping of inner changes, a truth value or a number.
    """
    if is_dataclass(old):
        if change is False or change == OFF:
            return without_errors(old)
        if isinstance(old, Reference) and isinstance(change, str):
            return _reference(change)
        if not isinstance(change, Mapping):
            raise ConfigurationError(
                f"{label} is a mapping of what changes, or off, not {change!r}"
            )
        changes = {str(key): value for key, value in change.items()}
        if isinstance(old, Reference) and "kind" in changes:
            old = _reference(changes.pop("kind"))
        return _changed(old, changes, label)
    if isinstance(old, bool):
        change = {"on": True, OFF: False}.get(change, change) if isinstance(change, str) else change
        if not isinstance(change, bool):
            raise ConfigurationError(f"{label} is on or off, not {change!r}")
        return change
    if isinstance(change, bool) or not isinstance(change, int | float):
        raise ConfigurationError(f"{label} is a number, not {change!r}")
    return float(change)


def _off_at(levels: Any, path: list[str], name: str) -> Any:
    """Levels with the errors at a path off; ``name`` is the whole path, for messages."""
    key = path[0]
    below = path[1:]
    choices = [entry.name for entry in fields(levels) if entry.name not in NO_ERRORS]
    if key not in choices:
        raise ConfigurationError(
            f"sensors: cannot switch off '{name}': '{key}' is not one of: {', '.join(choices)}"
        )
    old = getattr(levels, key)
    if not below:
        return replace(levels, **{key: without_errors(old)})
    if not is_dataclass(old):
        raise ConfigurationError(f"sensors: cannot switch off '{name}': '{key}' has no parts")
    return replace(levels, **{key: _off_at(old, below, name)})
