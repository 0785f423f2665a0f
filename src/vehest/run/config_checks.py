"""What stands between configuration files of somebody else and Hydra, which reads YAML and resolves references without bounds."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml

from vehest.data.errors import ConfigurationError, DataError, VehestError, printable
from vehest.data.limits import Limits, check_limit, current_limits
from vehest.data.schema import FURTHER_KEYS, validated
from vehest.data.text_files import check_yaml, read_text
from vehest.data.transforms import Preparation
from vehest.run.config_files import local_conf

REFERENCE = re.compile(r"\$\{([^${}]*)\}")
VARIABLE = re.compile(r"oc\.env:\s*[A-Za-z_][A-Za-z0-9_]*\s*(,[^${}]*)?")


def check_local_files() -> None:
    """See that every file in ./conf can be read within the limits and takes no influence on Hydra itself.

    A file that is no YAML is left to Hydra, which names it if it takes part.

    Raises:
        ConfigurationError: a file is no regular one, not UTF-8, too long, too deep, repeats itself too often, or names Hydra's own options.
    """
    folder = local_conf()
    total = 0
    for file in _yaml_files(folder) if folder is not None else ():
        try:
            status = os.stat(file)
            total += status.st_size
            check_limit("text_bytes", total, f"the files in '{folder}' are {total} bytes long together")
            _check_file(file, (status.st_mtime_ns, status.st_size, status.st_ino), current_limits())
        except VehestError as error:
            raise ConfigurationError(str(error)) from None
        except OSError as error:
            raise ConfigurationError(f"cannot read '{file}': {error.strerror}") from None


def _yaml_files(folder: Path) -> Iterator[Path]:
    """Configuration files below a folder; a folder that links lead back to is entered once."""
    entered: set[Path] = set()
    for here, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in sorted(folders) if (Path(here) / name).resolve() not in entered]
        entered.add(Path(here).resolve())
        check_limit("nodes", len(entered), f"'{folder}' holds {len(entered)} folders")
        yield from (Path(here) / name for name in sorted(names) if name.endswith((".yaml", ".yml")))


@cache
def _check_file(file: Path, state: tuple[int, int, int], limits: Limits) -> None:
    """Check one file; the state of its bytes and the limits in force say when that is to be done again."""
    text = read_text(file)
    try:
        check_yaml(text, f"'{file}'")
        content = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        if isinstance(content, str):  # which Hydra reads once more
            check_yaml(content, f"'{file}'")
            if not isinstance(yaml.safe_load(content), str):
                raise DataError(f"'{file}' holds the text '{printable(content[:40])}' where a mapping belongs")
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        return
    except (AttributeError, LookupError):  # PyYAML's own, of `!!timestamp soon` and `!!bool perhaps`
        raise DataError(f"'{file}' cannot be read as YAML (a value is not what its tag, such as !!timestamp, says)") from None
    if not isinstance(content, dict):
        return
    defaults = content.get("defaults")
    named = [str(entry) for entry in defaults] if isinstance(defaults, list) else [str(defaults or "")]
    if any(str(key).split(".")[0] == "hydra" for key in content) or any(re.search(r"\bhydra\b", entry) for entry in named):
        raise ConfigurationError(f"'{file}' names options of Hydra itself, which vehest does not take from files; leave them out")
    if any(".." in entry for entry in named):
        raise ConfigurationError(f"'{file}' names files outside of its folder in its defaults; put them into conf/")
    if re.search(r"^#\s*@package\s+hydra\b", text, re.MULTILINE):
        raise ConfigurationError(f"'{file}' puts itself into Hydra's own options, which vehest does not take from files")


def check_references(content: Any) -> None:
    """See that references in a composed configuration name keys or environment variables, and stay within the limits when followed.

    Args:
        content: plain values with references as they are written, ``${root}/revs``.

    Raises:
        ConfigurationError: a reference that computes something, one inside another, a circle, or too much altogether.
    """
    _References(content).size((), content)


class _References:
    """Sizes of values with what their references stand for, each worked out once."""

    def __init__(self, root: Any) -> None:
        self._root = root
        self._sizes: dict[tuple[str, ...], int] = {}
        self._open: set[tuple[str, ...]] = set()

    def size(self, path: tuple[str, ...], value: Any) -> int:
        """Characters and values, about."""
        if path in self._sizes:
            return self._sizes[path]
        name = ".".join(path)
        if path in self._open:
            raise ConfigurationError(f"{name} refers to itself; give it a value")
        if len(path) + len(self._open) > 4 * current_limits().depth:
            raise ConfigurationError(f"{name} nests, or is referred to, deeper than {current_limits().depth} levels")
        self._open.add(path)
        size = 1
        if isinstance(value, dict):
            size += sum(self.size((*path, str(key)), inner) for key, inner in value.items())
        elif isinstance(value, list):
            size += sum(self.size((*path, str(position)), inner) for position, inner in enumerate(value))
        elif isinstance(value, str):
            size += len(value) + sum(self._size_of(reference, path) for reference in self._references(value, name))
        self._open.remove(path)
        check_limit("text_bytes", size, f"{name or 'the configuration'} stands for {size} characters", ConfigurationError)
        self._sizes[path] = size
        return size

    def _references(self, text: str, name: str) -> list[str]:
        found = REFERENCE.findall(text)
        rest = REFERENCE.sub("", text).replace("\\${", "")
        for reference in found:
            if ":" in reference and not VARIABLE.fullmatch(reference.strip()):
                raise ConfigurationError(
                    f"{name} holds '${{{reference[:60]}}}'; only ${{KEY}} and ${{oc.env:VARIABLE,DEFAULT}} are followed"
                )
        if "${" in rest:
            raise ConfigurationError(f"{name} holds a reference inside a reference, or one that does not end: {text[:60]!r}; write it out")
        return [reference.strip() for reference in found if ":" not in reference]

    def _size_of(self, reference: str, path: tuple[str, ...]) -> int:
        """Size of what a reference names; 0 where there is nothing, which the one who resolves it will say."""
        dots = len(reference) - len(reference.lstrip("."))
        start = path[: max(len(path) - dots, 0)] if dots else ()
        parts = [part for part in re.split(r"[.\[\]]+", reference[dots:]) if part]
        target = (*start, *parts)
        value = self._root
        for part in target:
            if isinstance(value, dict):
                value = next((inner for key, inner in value.items() if str(key) == part), None)
            elif isinstance(value, list) and part.isdigit() and int(part) < len(value):
                value = value[int(part)]
            else:
                return 0
        return self.size(target, value)


@dataclass(frozen=True)
class Tracking:
    """``tracking``: where runs are logged.

    Args:
        name: ``mlflow`` or ``none``.
        uri: of the server or store; None is a local one in the output root.
        experiment: name that runs are kept under.
    """

    name: Literal["mlflow", "none"]
    uri: str | None = None
    experiment: str = "vehest"


@dataclass(frozen=True)
class Named:
    """A group of options whose ``name`` says by whose schema the others are read."""

    __pydantic_config__ = FURTHER_KEYS
    name: str


@dataclass(frozen=True)
class Root:
    """What every command's configuration has; groups that a command does not have are None."""

    __pydantic_config__ = FURTHER_KEYS
    output: str
    limits: dict[str, Any]
    downsample: Preparation
    root: str | None = None
    tracking: Tracking | None = None
    estimator: Named | None = None
    split: dict[str, Any] | None = None
    dataset: dict[str, Any] | None = None
    training: dict[str, Any] | None = None
    evaluation: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if not self.output or "\0" in self.output:
            raise ConfigurationError(f"output must name a folder, not {self.output!r}")


def check_shape(config: Any, command: str) -> None:
    """See that a composed configuration has the groups that every command knows; what is in them is read where it is used.

    Raises:
        ConfigurationError: a value of the wrong type.
    """
    folder = local_conf()
    where = f"'{folder / command}.yaml'" if folder is not None and (folder / f"{command}.yaml").is_file() else ""
    validated(Root, config, where, error=ConfigurationError)
