"""Tab completion of overrides, also after ``=``; reads YAML files only, so that it answers at once."""

from __future__ import annotations

import os
from typing import Any

from vehest.data.errors import VehestError
from vehest.data.text_files import read_yaml
from vehest.run.config_files import GROUPS, choices, conf_folders, summary


def complete_override(command: str, given: list[str], incomplete: str) -> list[tuple[str, str]]:
    """Candidates for the word that is being typed, each with a line of help.

    Shells that break words at ``=`` (bash) hand over ``estimator``, ``=``, ``gru`` as three words; they get the value alone.

    Args:
        command: whose configuration is overridden, for example ``train``.
        given: words before, of the overrides.
        incomplete: the word being typed.
    """
    key = _key_before(given, incomplete)
    if key is not None:
        text = incomplete.removeprefix("=")
        return [(value, note) for value, note in _values(command, key, given) if value.startswith(text)]
    candidates = [(f"{name}={value}", note) for name in _keys(command, given) for value, note in _values(command, name, given)]
    return [(text, note) for text, note in candidates if text.startswith(incomplete)]


def _key_before(given: list[str], incomplete: str) -> str | None:
    """The key whose value is being typed, where the shell has split the word at its ``=``."""
    if given and given[-1] == "=" and len(given) > 1:
        return given[-2]
    words = os.environ.get("COMP_WORDS", "").rstrip()
    if given and incomplete in ("", "=") and words.endswith("=") and "=" not in given[-1]:
        return given[-1]
    return None


def _keys(command: str, given: list[str]) -> list[str]:
    content = _content(command, given)
    return [group for group in GROUPS if group in content["groups"]] + list(content["options"])


def _values(command: str, key: str, given: list[str]) -> list[tuple[str, str]]:
    if key in GROUPS:
        return [(choice, summary(key, choice)) for choice in choices(key)]
    default = _content(command, given)["options"].get(key)
    if isinstance(default, bool):
        return [("true", ""), ("false", "")]
    return [] if default is None else [(str(default), "default")]


def _content(command: str, given: list[str]) -> dict[str, dict[str, Any]]:
    """Groups of a command with their chosen options, and dotted options with their defaults."""
    groups: dict[str, Any] = {}
    options: dict[str, Any] = {}
    _collect_root(command, groups, options)
    for word in given:
        name, _, value = word.partition("=")
        if name in groups and value:
            groups[name] = value
    for group, choice in groups.items():
        content = _yaml(f"{group}/{choice}.yaml") if choice else {}
        content = content.get(group, content) if isinstance(content.get(group), dict) else content
        options |= _dotted(group, {key: value for key, value in content.items() if key not in ("name", "defaults")})
    return {"groups": groups, "options": options}


def _collect_root(command: str, groups: dict[str, Any], options: dict[str, Any]) -> None:
    content = _yaml(f"{command}.yaml")
    for entry in content.get("defaults", []):
        if isinstance(entry, str) and entry != "_self_":
            _collect_root(entry, groups, options)
        elif isinstance(entry, dict):
            for group, choice in entry.items():
                groups[str(group)] = None if choice == "???" else choice
    for key, value in content.items():
        if key == "defaults":
            continue
        if isinstance(value, dict):
            options |= {f"{key}.{inner}": default for inner, default in value.items() if _is_plain(default)}
        elif _is_plain(value):
            options[str(key)] = value


def _dotted(prefix: str, content: dict[str, Any]) -> dict[str, Any]:
    """Plain values of nested groups by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            found |= _dotted(f"{prefix}.{key}", value)
        elif _is_plain(value):
            found[f"{prefix}.{key}"] = value
    return found


def _is_plain(value: Any) -> bool:
    return isinstance(value, bool | int | float | str) and not str(value).startswith(("${", "???")) and "\n" not in str(value)


def _yaml(name: str) -> dict[str, Any]:
    for folder in conf_folders():
        if (folder / name).is_file():
            try:
                content = read_yaml(folder / name)
            except VehestError:
                return {}
            return content if isinstance(content, dict) else {}
    return {}
