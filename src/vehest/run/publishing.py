"""Publishes a study's report in results/, and reads the record of a published one.

report -> `publish_study` -> results/STUDY, provenance.json with keys -> `published_in`
"""

from __future__ import annotations

import csv
import io
import math
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vehest.artefacts.artefact import TIMINGS, Artefact
from vehest.artefacts.keys import Keys, changed_keys
from vehest.artefacts.locks import Lock, held
from vehest.data.errors import ConfigurationError, abbreviated, number_of
from vehest.data.files import remove_leftovers, written_aside
from vehest.data.schema import FURTHER_KEYS, validated
from vehest.data.text_files import read_json, write_json
from vehest.run.console import Messages

RESULTS = Path("results")  # folder of published studies in the repository
PAGE_ENDING = ".html"  # suffix of pages, which are not published
PROVENANCE = "provenance.json"  # name of the record of how results were made
PUBLISHED_WEIGHTS = "weights.safetensors"  # name of the file of weights
# folders of the repository whose files determine results
SOURCES_OF_RESULTS = ("src", "conf", "pipelines")
DIGITS = 6  # significant digits of numbers in published tables


@dataclass(frozen=True)
class Publication:
    """Record of a study's report in results/STUDY."""

    study: str  # name of the study
    # name of a part or data set that the study went on without -> the same for people
    absent: Mapping[str, str]
    keys: Keys  # `vehest.run.published.keys_of_study`
    n_not_trained: int = 0  # trainings that the report names as missing


@dataclass(frozen=True)
class TableRecord:
    """Record of how a table that no pipeline publishes was made (`vehest.run.table_records`)."""

    __pydantic_config__ = FURTHER_KEYS
    command: str  # command that makes the table
    commit: str  # commit of the repository at which it was made
    without_keys: str = ""  # part of the table that was made before keys were recorded; empty: none


@dataclass(frozen=True)
class Published:
    """The part of a published study's provenance.json that later runs compare."""

    __pydantic_config__ = FURTHER_KEYS
    kinds: dict[str, str] = field(default_factory=dict)  # data set -> ``real`` or ``simulated``
    parts: tuple[str, ...] = ()  # names of the parts
    absent: tuple[str, ...] = ()  # parts or data sets that it went on without
    keys: Keys = field(default_factory=dict)  # empty where they were not recorded yet
    n_not_trained: int = 0  # trainings that the report names as missing
    # records of the tables of a folder without a pipeline
    tables: dict[str, TableRecord] = field(default_factory=dict)


def published_in(folder: Path) -> Published | None:
    """Read the record of a published study, in results/STUDY; None where nothing is published.

    Raises
    ------
    DataError
        The record is damaged.
    ConfigurationError
        The record is damaged.
    """
    path = folder / PROVENANCE
    if not path.is_file():
        return None
    return validated(Published, read_json(path), f"'{path}'")


def publish_study(
    publication: Publication | None, report: Artefact, messages: Messages
) -> Path | None:
    """Copy a study's report without pages and times to results/STUDY, with keys in its provenance;
    returns the folder, if it is published.

    CSV files are published with six significant digits (`published_content`).

    A published report stays that shows data which this run could not read, or more trainings with
    the same keys. Where keys and all other files are the same, the provenance stays that of the
    first run with these results.

    Parameters
    ----------
    publication : Publication or None
        None: the study is not published.
    report : Artefact
        The drawn report.
    messages : Messages
        Prints why a study is not published, or where.

    Raises
    ------
    MissingError
        It cannot be written.
    ConfigurationError
        The folder holds something else or is reached by a link.
    """
    if publication is None:
        return None
    folder = RESULTS / publication.study
    former = published_in(folder) or Published()
    lost = [
        words
        for name, words in publication.absent.items()
        if name in former.kinds or name in former.parts
    ]
    if lost:
        messages.warn(f"not published: '{folder}' shows {lost[0]}, and this run could not read it")
        return None
    n_fewer = publication.n_not_trained - former.n_not_trained
    if n_fewer > 0 and former.keys and not changed_keys(former.keys, publication.keys):
        more = number_of(n_fewer, "training")
        messages.warn(f"not published: '{folder}' shows {more} that this run lacks")
        return None
    with held(Lock(report.folder.parents[1], "publish", publication.study), lambda: False):
        if _is_published(report, folder, publication):
            return folder
        if changed := uncommitted_changes():
            messages.warn(f"not published: {changed}")
            return None
        _publish(report, folder, publication)
        messages.line("done", "publish", str(folder))
    return folder


def uncommitted_changes() -> str:
    """Text on files that determine results and differ from the last commit; empty where there are
    none, or outside of a git checkout.

    Returns
    -------
    str
        Of `SOURCES_OF_RESULTS`; also where git has not answered within 60 s.
    """
    command = ["git", "status", "--porcelain", "--untracked-files=all", "--", *SOURCES_OF_RESULTS]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    except subprocess.TimeoutExpired:
        return "git has not answered in 60 s whether the work tree has changes; run it again"
    except (OSError, subprocess.SubprocessError):  # no git, or no repository
        return ""
    files = [line[3:] for line in result.stdout.splitlines()]
    if not files:
        return ""
    return (
        f"the work tree has changes that are not committed ({abbreviated(files, 3)}); "
        "commit them and run it again"
    )


def check_results_folder(folder: Path) -> None:
    """Raise `ConfigurationError` where a study cannot be published in a folder: it is reached by a
    link, or holds something else.
    """
    if any(part.is_symlink() for part in (folder, folder.parent)):
        raise ConfigurationError(
            f"'{folder}' leads elsewhere through a link; remove the link or set publish: false"
        )
    if not folder.is_dir():
        return
    remove_leftovers(folder)
    names = {file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()}
    if PROVENANCE not in names and names - {PUBLISHED_WEIGHTS}:
        raise ConfigurationError(
            f"'{folder}' holds files that vehest did not publish; move them away or set publish: "
            "false"
        )


def _contents(report: Artefact) -> dict[str, bytes]:
    """Files of a report that are published, name -> content."""
    names = [name for name in report.outputs if name != TIMINGS and not name.endswith(PAGE_ENDING)]
    return {name: published_content(report.folder / name) for name in names}


def _is_published(report: Artefact, folder: Path, publication: Publication) -> bool:
    """Whether a folder holds these results already, its provenance aside."""
    check_results_folder(folder)
    former = published_in(folder)
    if former is None or changed_keys(former.keys, publication.keys):
        return False
    if former.n_not_trained != publication.n_not_trained:
        return False
    present = {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }
    return present | {PROVENANCE: b""} == _contents(report) | {PROVENANCE: b""}


def _publish(report: Artefact, folder: Path, publication: Publication) -> None:
    """Replace the folder in one step by the report's files, with keys in its provenance."""
    contents = _contents(report)
    with written_aside(folder, replace_folder=True) as aside:
        for name, content in contents.items():
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            (aside / name).write_bytes(content)
        about = {**read_json(report.folder / PROVENANCE), "keys": publication.keys}
        if publication.n_not_trained:
            about["n_not_trained"] = publication.n_not_trained
        write_json(aside / PROVENANCE, about)


def published_content(file: Path) -> bytes:
    """Content of a report's file as it is published: numbers of a CSV file with `DIGITS`
    significant digits, which other machines reproduce; other files as they are.
    """
    if file.suffix != ".csv":
        return file.read_bytes()
    text = io.StringIO(newline="")
    with file.open(encoding="utf-8", newline="") as lines:
        csv.writer(text, lineterminator="\n").writerows(
            [_rounded(cell) for cell in row] for row in csv.reader(lines)
        )
    return text.getvalue().encode("utf-8")


def _rounded(cell: str) -> str:
    """Text of a number with more digits than `DIGITS`, rounded; whole numbers and other text
    unchanged.
    """
    try:
        value = float(cell)
    except ValueError:
        return cell
    is_short = (
        "." not in cell or len(cell) <= DIGITS or not math.isfinite(value) or value.is_integer()
    )
    return cell if is_short else repr(float(f"{value:.{DIGITS}g}"))
