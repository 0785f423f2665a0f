"""Tab completion of overrides, also after ``=``; reads YAML files without Hydra, so that it answers quickly."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

from vehest.data.errors import VehestError
from vehest.data.text_files import parse_yaml
from vehest.run.config_files import GROUPS, choices, conf_text, summary


def complete_override(command: str, given: list[str], incomplete: str) -> list[tuple[str, str]]:
    """Candidates for the word being typed, each with a line of help.

    Shells that break words at ``=`` (bash) pass ``estimator``, ``=``, ``gru`` as three words; they get the value alone.
    """
    groups, options = _content(command, given)

    def values(key: str) -> list[tuple[str, str]]:
        if key in GROUPS:
            return [(choice, summary(key, choice)) for choice in choices(key)]
        if isinstance(options.get(key), bool):
            return [("true", ""), ("false", "")]
        return [(str(options[key]), "default")] if key in options else []

    key = _key_before(given, incomplete)
    if key is not None:
        candidates, incomplete = values(key), incomplete.removeprefix("=")
    else:
        names = [*(group for group in GROUPS if group in groups), *options]
        candidates = [(f"{name}={value}", note) for name in names for value, note in values(name)]
    return [(text, note) for text, note in candidates if text.startswith(incomplete)]


def _key_before(given: list[str], incomplete: str) -> str | None:
    """The key whose value is being typed, where the shell has split the word at its ``=``."""
    if given and given[-1] == "=" and len(given) > 1:
        return given[-2]
    words = os.environ.get("COMP_WORDS", "").rstrip()
    if given and incomplete in ("", "=") and words.endswith("=") and "=" not in given[-1]:
        return given[-1]
    return None


def _content(command: str, given: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Groups of a command with their choices, and dotted options with their defaults."""
    groups, options = _root(command)
    groups |= {name: value for name, _, value in (word.partition("=") for word in given) if name in groups and value}
    for group, choice in groups.items():
        content = _yaml(f"{group}/{choice}.yaml")
        content = content[group] if isinstance(content.get(group), dict) else content
        options |= _options({key: value for key, value in content.items() if key not in ("name", "defaults")}, f"{group}.")
    return groups, options


def _root(command: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Groups and options of a root file and of those that it includes."""
    groups: dict[str, Any] = {}
    options: dict[str, Any] = {}
    content = _yaml(f"{command}.yaml")
    for entry in content.pop("defaults", []):
        further = (entry, {}) if isinstance(entry, dict) else _root(entry) if entry != "_self_" else ({}, {})
        groups, options = groups | further[0], options | further[1]
    return groups, options | _options(content)


def _options(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Plain values of nested groups by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            found |= _options(value, f"{prefix}{key}.")
        elif isinstance(value, bool | int | float | str) and not str(value).startswith(("${", "???")) and "\n" not in str(value):
            found[f"{prefix}{key}"] = value
    return found


def _yaml(name: str) -> dict[str, Any]:
    content = None
    with suppress(VehestError):
        content = parse_yaml(conf_text(name), name)
    return content if isinstance(content, dict) else {}
