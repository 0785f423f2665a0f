"""Where the logs lie, and the three files that `vehest new` writes: all of them or none."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml

from vehest.data.errors import ConfigurationError, printable
from vehest.data.files import written_aside


@dataclass(frozen=True)
class Located:
    """Where files lie.

    Args:
        path: their folder; relative to the working folder where it is inside of it.
        files: as given.
        pattern: that they match.
        exclude: stems of further files that match, and do not belong to them.
    """

    path: str
    files: tuple[Path, ...]
    pattern: str
    exclude: tuple[str, ...] = ()


def located(files: Sequence[Path], source: str) -> Located:
    """Folder and pattern of files.

    Raises:
        ConfigurationError: they lie in several folders, two have the same stem, or no pattern tells them from others beside them.
    """
    folders = {file.resolve().parent for file in files}
    if len(folders) > 1:
        listed = ", ".join(sorted(str(folder) for folder in folders))
        raise ConfigurationError(f"the files lie in several folders ({listed}); put them into one, or make a data set of each folder")
    folder = folders.pop()
    names = sorted({file.name for file in files})
    stems = [Path(name).stem for name in names]
    doubled = sorted({stem for stem in stems if stems.count(stem) > 1})
    if doubled:
        raise ConfigurationError(f"two files are called '{doubled[0]}'; a recording's name must be unique")
    here = Path.cwd()
    path = os.path.relpath(folder, here) if folder.is_relative_to(here) else str(folder)
    if source == "rosbag":
        return Located(path, tuple(files), "")
    end = _common_end(names)
    patterns = [names[0]] if len(names) == 1 else [f"{_common_start(names)}*{end}", f"*{end}"]
    beside = [file.name for file in folder.iterdir() if file.is_file()]
    for pattern in patterns:
        others = sorted(name for name in beside if fnmatch(name, _escaped(pattern)) and name not in names)
        if not others:
            return Located(path, tuple(files), _escaped(pattern))
    if source in ("tabular", "text_log"):
        return Located(
            path,
            tuple(files),
            _escaped(patterns[0]),
            tuple(Path(name).stem for name in beside if fnmatch(name, _escaped(patterns[0])) and name not in names),
        )
    raise ConfigurationError(
        f"'{folder}' holds others beside these files ({others[0]}); put those that belong together into a folder of their own"
    )


def _common_start(names: Sequence[str]) -> str:
    same = 0
    while all(name[: same + 1] == names[0][: same + 1] for name in names) and same < min(map(len, names)):
        same += 1
    return names[0][:same].rstrip("0123456789")


def _common_end(names: Sequence[str]) -> str:
    return _common_start([name[::-1] for name in names])[::-1]


def _escaped(pattern: str) -> str:
    """Brackets of a name stand for themselves."""
    return pattern.replace("[", "[[]")


@dataclass(frozen=True)
class Written:
    """A file to be written.

    Args:
        file: where.
        text: its content.
        purpose: what it is for, in a line.
    """

    file: Path
    text: str
    purpose: str


def refuse_existing(files: Sequence[Path], *, force: bool) -> None:
    """See that nothing is overwritten.

    Raises:
        ConfigurationError: a file is there, and ``force`` is not given.
    """
    there = [str(file) for file in files if os.path.lexists(file)]
    if there and not force:
        raise ConfigurationError(f"'{there[0]}' is there already; take another name, or --force to write it anew")


def write_all(files: Sequence[Written], *, force: bool) -> None:
    """Write files, each whole, and none before all of them are ready.

    Raises:
        ConfigurationError: one is there, and ``force`` is not given.
        MissingError: the disk is full, or a folder cannot be written to.
    """
    refuse_existing([one.file for one in files], force=force)
    with ExitStack() as stack:
        for one in files:
            stack.enter_context(written_aside(one.file)).write_text(one.text, encoding="utf-8")


def flow(value: Any) -> str:
    """A value in YAML on one line."""
    if "${" in str(value):
        raise ConfigurationError(f"'{printable(str(value)[:60])}' holds '${{', which configurations read as a reference; rename it")
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=10_000, sort_keys=False).strip()
    return text.removesuffix("...").strip()


def dataset_text(dataset: Mapping[str, Any], comments: Mapping[str, str], head: Sequence[str], tail: Sequence[str]) -> str:
    """A file in conf/dataset: a key a line, channels and transforms an entry a line, with what is known of each behind it."""
    lines = [f"# {line}" for line in head]
    for key, value in dataset.items():
        if key in ("channels", "topics") and value:
            lines.append(f"{key}:{' ' * 36}# {comments[key]}" if key in comments else f"{key}:")
            lines += [_commented(f"  {name}: {flow(entry)}", comments.get(f"{key}.{name}", "")) for name, entry in value.items()]
        elif key == "transforms":
            if value:
                lines.append("transforms:")
                lines += [_commented(f"  - {flow(entry)}", comments.get(f"transforms.{entry['name']}", "")) for entry in value]
        else:
            lines.append(_commented(f"{key}: {flow(value)}", comments.get(key, "")))
    return "\n".join([*lines, *tail, ""])


def _commented(text: str, comment: str) -> str:
    return f"{text:<44} # {printable(comment)}" if comment else text
