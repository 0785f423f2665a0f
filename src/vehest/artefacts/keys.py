"""What of a configuration enters keys: options that differ from their defaults.

    settings --`changed_options`--> options in the key of an artefact (`artefact.StagePlan`) and
                                    in the keys of a published study (`run.published`)
    keys of a published study, keys of today --`changed_keys`--> differing keys with their causes

An option that has its default is left out, so that a new option, and a line of YAML that only
repeats a default, change no key. The defaults themselves belong to the version of the class that
declares them (tests/golden/defaults.json).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

Keys = dict[str, dict[str, str]]
"""Keys of a study: step, such as ``scheme_1: train ksnn`` -> cause -> version or hash.

Causes are ``code``, ``configuration`` and ``data``.
"""

CONFIGURATION = "configuration"  # cause of a change: the configuration differs


def changed_keys(recorded: Keys, today: Keys) -> list[tuple[str, str]]:
    """Steps whose key differs from the recorded one, each with the cause; empty: results are valid.

    A cause that today's keys leave out, as that of raw files which are not here, is not compared.
    """
    changes = [
        (name, cause)
        for name, keys in recorded.items()
        for cause, key in today.get(name, {}).items()
        if keys.get(cause) != key
    ]
    changes += [(f"{name} added", CONFIGURATION) for name in today if name not in recorded]
    return changes + [(f"{name} removed", CONFIGURATION) for name in recorded if name not in today]


def hash_of(content: Any) -> str:
    """SHA-256 of plain values, in hexadecimal digits.

    Parameters
    ----------
    content : Any
        What JSON holds; other values count by their text. The order of keys does not matter.
    """
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def changed_options(settings: Any) -> dict[str, Any]:
    """Options of a dataclass's instance that differ from their defaults, as plain values.

    A group of settings inside is compared with the group that is the default there, option by
    option. An option without a default is always among them.
    """
    return {
        option.name: value
        for option in fields(settings)
        if (value := _changed(getattr(settings, option.name), default_of(option))) is not MISSING
    }


def default_of(option: Field[Any]) -> Any:
    """The default of a dataclass's field; `MISSING` where it has none."""
    return option.default if option.default_factory is MISSING else option.default_factory()


def _changed(value: Any, default: Any) -> Any:
    """A value as plain as a key needs it; `MISSING` where it is the default."""
    if isinstance(value, bool) is isinstance(default, bool) and value == default:
        return MISSING
    if not is_dataclass(value):
        return _plain(value)
    if type(value) is not type(default):
        return changed_options(value)
    return {
        option.name: plain
        for option in fields(value)
        if (plain := _changed(getattr(value, option.name), getattr(default, option.name)))
        is not MISSING
    }


def _plain(value: Any) -> Any:
    """A value with mappings, lists and settings inside as plain ones."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return changed_options(value) if is_dataclass(value) else value
