"""Files of conf/ and pipelines/, the choices they offer, and completion of overrides; without Hydra, so that all of it is quick."""

from __future__ import annotations

import os
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

from vehest.data.errors import VehestError

GROUPS = ("dataset", "split", "vehicle", "estimator", "training", "fault", "tracking")


def packaged(name: str) -> Path:
    """A folder that came with vehest, ``conf`` or ``pipelines``: inside the installed package, or beside src in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / name
    return inside if inside.is_dir() else package.parents[1] / name


def conf_folders() -> list[Path]:
    """Folders of configuration, the first one searched first: ./conf, if there is one, the packaged folder, that of the papers' studies."""
    local, ours = Path("conf"), packaged("conf")
    own = [local] if local.is_dir() and local.resolve() != ours.resolve() else []
    return [*own, ours, Path(__file__).resolve().parents[2] / "vehest_papers" / "conf"]


def conf_text(name: str) -> str:
    """The text of a file by its path below conf/, from the first folder that has it; empty where none has."""
    file = next((folder / name for folder in conf_folders() if (folder / name).is_file()), None)
    return "" if file is None else file.read_text(encoding="utf-8", errors="replace")


def choices(group: str) -> list[str]:
    """Names that a group offers, from all folders together."""
    return sorted({file.stem for folder in conf_folders() for file in (folder / group).glob("*.yaml")})


def summary(group: str, choice: str) -> str:
    """The first comment line of a choice's file, a sentence about it."""
    comments = takewhile(lambda line: not line or line.startswith("#"), conf_text(f"{group}/{choice}.yaml").splitlines())
    return next((line.lstrip("# ").rstrip() for line in comments if line and "@package" not in line), "")


def is_simulated(dataset: str) -> bool:
    """Whether the file of a data set declares it as simulated."""
    return "source: simulated" in conf_text(f"dataset/{dataset}.yaml").splitlines()


def is_file_name(word: str) -> bool:
    """Whether a word is no override; an existing file may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


def find_pipeline(name: str) -> Path | None:
    """A pipeline by path or by name: as given, then ./pipelines, then the packaged ones."""
    given = Path(name)
    file = f"{given.name.removesuffix('.yaml')}.yaml"
    return next((path for path in (given, Path("pipelines") / file, packaged("pipelines") / file) if path.is_file()), None)


def pipeline_names() -> list[str]:
    """Names of the pipelines in ./pipelines and in the package."""
    return sorted({file.stem for folder in (Path("pipelines"), packaged("pipelines")) for file in folder.glob("*.yaml")})


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
    from vehest.data.text_files import parse_yaml

    content = None
    with suppress(VehestError):
        content = parse_yaml(conf_text(name), name)
    return content if isinstance(content, dict) else {}
