"""Files and pipelines that a command line names: a missing one is reported before the libraries
are loaded that would read it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from vehest.configuration.files import choices, find_pipeline, pipeline_names
from vehest.data.errors import ConfigurationError, MissingError, closest, suggestion
from vehest.data.files import missing_file


def require_paths(paths: Iterable[str | Path | None]) -> None:
    """Raise an error for paths that do not exist; one that exists but cannot be read is reported by
    its reader.

    Parameters
    ----------
    paths : iterable of str, Path or None
        None stands for an option that was left out.

    Raises
    ------
    MissingError
        For the first of them; it names the closest file of the folder.
    """
    for path in paths:
        if path is None:
            continue
        with suppress(OSError, ValueError):  # such as a name that is too long, or a null character
            try:
                os.stat(path)
            except (FileNotFoundError, NotADirectoryError):
                raise missing_file(Path(path)) from None


def require_dataset_or_file(source: str) -> None:
    """Raise an error unless a word is a data set of conf/dataset or the path of a file.

    Raises
    ------
    MissingError
        The word is written like a path, and there is no such file.
    ConfigurationError
        It is neither a data set nor a file.
    """
    names = choices("dataset")
    if source in names or os.path.lexists(source):
        return
    path = Path(source)
    if path.suffix or path.name != source:
        require_paths([path])
    meant = suggestion(source, names) or ";"
    raise ConfigurationError(
        f"'{source}' is neither a data set nor a file{meant} 'vehest data list' lists the data sets"
    )


def require_pipeline(name: str, overrides: Sequence[str] = ()) -> Path:
    """The file of a pipeline, by its path or its name.

    Parameters
    ----------
    name : str
        Path, or name in ./pipelines or in the package.
    overrides : sequence of str
        Of the command; those that a command in the error's text needs too are repeated there.

    Returns
    -------
    Path
        Its file.

    Raises
    ------
    MissingError
        There is none; the error names the closest one.
    """
    file = find_pipeline(name)
    if file is not None:
        return file
    close = closest(Path(name).stem, pipeline_names())
    hint = f"; did you mean pipelines/{close}.yaml?" if close else ""
    if name in choices("dataset"):
        from vehest.run.next_commands import command_line, location_overrides  # with Hydra

        usable = command_line("data usable", [name, *location_overrides(overrides)])
        hint = f", only a data set: '{usable}' says what its recordings suffice for"
    raise MissingError(
        f"there is no pipeline '{name}'{hint} (there are: {', '.join(pipeline_names())})"
    )
