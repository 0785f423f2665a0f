"""Columns of numbers in MAT-files (versions 4, 5 and 7) by scipy, which evaluates nothing in them.

file -> variables -> fields of structures -> vectors, and matrices by column -> numbers by name
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatlabFunction, MatlabOpaque
from scipy.sparse import issparse

from vehest.data.errors import DataError, printable
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays

# first bytes of an HDF5 file, in a MAT-file of version 7.3 behind a header
HDF5 = b"\x89HDF\r\n\x1a\n"
HEADER = 512  # length of that header [bytes]
# fields that hold the samples of a signal, in small letters; they are left out of its name
SAMPLES = frozenset({"data", "signals", "value", "values"})
TIMES = frozenset({"t", "time", "times", "timestamp", "timestamps", "x"})  # fields of its times
UNITS = frozenset({"unit", "units"})  # fields of its unit
NAMES = frozenset({"label", "name"})  # fields of its name
MAX_DEPTH = 16  # largest number of structures within one another
MAX_WIDTH = 100  # largest number of columns of a matrix; a larger one is an image or a map
FieldPath = tuple[str, ...]  # variable and fields, and the number of a column in brackets


def read(file: Path, selected: Sequence[str] | None) -> tuple[Arrays, dict[str, Any]]:
    """Columns of numbers: vectors with more than one element, and columns of matrices.

    A column is called like its variable; within structures, by the path of fields without
    `SAMPLES`, such as ``lap.Speed``, and without what all columns have in front. A structure with a
    field of its name is called so, a column of a matrix has its number behind it, such as
    ``wheels(2)``. Times that repeat those of another signal are left out.

    Parameters
    ----------
    file : Path
        MAT-file of version 4, 5 or 7; 7.3 is HDF5 and is refused.
    selected : sequence of str or None
        Columns whose samples are returned; None for none of them.

    Returns
    -------
    arrays : dict
        Name -> samples in the file's unit, float64, (T,).
    summary : dict
        By name ``lengths``, numbers of samples, and ``units`` where the file states them;
        ``skipped``, what holds no column of numbers and why.

    Raises
    ------
    DataError
        It is of another format, damaged or holds more than the limits allow.
    """
    skipped: list[str] = []
    vectors: dict[FieldPath, NDArray[Any]] = {}
    units: dict[FieldPath, str] = {}
    for name, value in _variables(file).items():
        for path, vector, unit in _vectors((name,), value, skipped):
            path = path if path not in vectors else (*path, str(len(vectors)))
            vectors[path] = vector
            units[path] = unit
    vectors = _without_repeated_times(vectors)
    check_limit("columns", len(vectors), f"'{file}' has {len(vectors)} columns")
    names = dict(zip(vectors, _short_names(list(vectors)), strict=True))
    longest = max(map(len, vectors.values()), default=0)
    check_limit("samples", longest, f"'{file}' has {longest} rows")
    arrays = {
        names[path]: vector.astype(np.float64)
        for path, vector in vectors.items()
        if selected is not None and names[path] in selected
    }
    return arrays, {
        "lengths": {names[path]: len(vector) for path, vector in vectors.items()},
        "units": {names[path]: units[path] for path in vectors if units[path]},
        "skipped": skipped,
    }


def _variables(file: Path) -> dict[str, Any]:
    """Name -> value of each variable."""
    with open(file, "rb") as stream:
        head = stream.read(HEADER + len(HDF5))
    if HDF5 in (head[: len(HDF5)], head[HEADER:]):
        raise DataError(
            f"'{file}' is a MAT-file of version 7.3, which is HDF5; save it as version 7, in "
            f"MATLAB by S = load('{file.name}'); save('{file.stem}_v7.mat', '-struct', 'S', '-v7')"
        )
    try:
        return {
            name: value
            for name, value in loadmat(file, chars_as_strings=True).items()
            if not name.startswith("__")
        }
    except Exception as error:
        reason = printable(" ".join(str(error).split())[:160]) or type(error).__name__
        raise DataError(
            f"'{file}' cannot be read as a MAT-file ({reason}); is it damaged, or of another "
            f"format? MATLAB and Octave save by save('-v7', '{file.name}')"
        ) from None


def _vectors(
    path: FieldPath, value: Any, skipped: list[str]
) -> Iterator[tuple[FieldPath, NDArray[Any], str]]:
    """Path, samples and unit of each column in a value; ``skipped`` gets what holds none."""
    name = printable(_joined(path))
    if isinstance(value, MatlabFunction):
        skipped.append(f"variable '{name}', a function")
    elif isinstance(value, MatlabOpaque):
        skipped.append(
            f"{_object_in(value)}; save its columns as vectors, those of a table or "
            "timetable T in MATLAB by S = table2struct(timetable2table(T), 'ToScalar', true); "
            "save('lap.mat', '-struct', 'S')"
        )
    elif issparse(value) or value.ndim > 2 or value.dtype.kind not in "biufVO":
        if value.size > 1 and getattr(value.dtype, "kind", "") != "U":
            skipped.append(f"variable '{name}', which is no vector of real numbers")
    elif value.dtype.names:
        if len(path) > MAX_DEPTH:
            skipped.append(f"'{name}', in more than {MAX_DEPTH} structures within one another")
        else:
            yield from _vectors_of_structure(path, value.ravel(), skipped)
    elif value.dtype.kind == "O":
        if value.size:
            skipped.append(f"variable '{name}', a cell array")
    elif value.size > 1:
        table = value if len(value) >= value.shape[1] else value.T
        if table.shape[1] > MAX_WIDTH:
            skipped.append(f"variable '{name}', a matrix of {len(table)} x {table.shape[1]}")
        elif table.shape[1] == 1:
            yield path, table[:, 0], ""
        else:
            for number, column in enumerate(table.T, 1):
                yield (*path, f"({number})"), column, ""


def _vectors_of_structure(
    path: FieldPath, structures: NDArray[Any], skipped: list[str]
) -> Iterator[tuple[FieldPath, NDArray[Any], str]]:
    """`_vectors` of a structure, or of an array of them: of signals, or of one for each sample."""
    fields: tuple[str, ...] = structures.dtype.names or ()
    if len(structures) > 1 and not NAMES.intersection(map(str.lower, fields)):
        for field in fields:
            cells = structures[field]
            if all(cell.size == 1 and cell.dtype.kind in "biuf" for cell in cells):
                yield (*path, field), np.concatenate([cell.ravel() for cell in cells]), ""
            else:
                text = printable(_joined((*path, field)))
                skipped.append(f"field '{text}' of an array of structures")
        return
    for structure in structures:
        texts = {field.lower(): _text(structure[field]) for field in fields}
        name = next((texts[key] for key in NAMES if texts.get(key)), "")
        holds_samples = SAMPLES.intersection(texts)
        here = (*path[:-1], name) if name and holds_samples else path
        unit = next((texts[key] for key in UNITS if texts.get(key)), "")
        for field in fields:
            is_samples = field.lower() in SAMPLES
            for inner, vector, own_unit in _vectors((*here, field), structure[field], skipped):
                yield inner, vector, own_unit or (unit if is_samples else "")


def _text(value: Any) -> str:
    """The text in a field; empty where it holds none."""
    is_text = isinstance(value, np.ndarray) and value.dtype.kind == "U" and value.size == 1
    return str(value.item()).strip() if is_text else ""


def _object_in(value: MatlabOpaque) -> str:
    """Clause on an object that only MATLAB reads, whose name and class are among its fields."""
    own_name, _, kind, _ = value.ravel()[0].tolist()
    return f"variable '{printable(own_name.decode())}' is a {printable(kind.decode())}"


def _without_repeated_times(
    vectors: dict[FieldPath, NDArray[Any]],
) -> dict[FieldPath, NDArray[Any]]:
    """Columns without times that are those of a column before them."""
    kept: dict[FieldPath, NDArray[Any]] = {}
    times: list[NDArray[Any]] = []
    for path, vector in vectors.items():
        if path[-1].lower() in TIMES:
            if any(np.array_equal(vector, known) for known in times):
                continue
            times.append(vector)
        kept[path] = vector
    return kept


def _short_names(paths: Sequence[FieldPath]) -> list[str]:
    """Name of each path, without fields of samples, repeats and what all have in front, where they
    stay different.
    """
    named = [
        [part for part, _ in groupby(path) if part.lower() not in SAMPLES] or list(path)
        for path in paths
    ]
    fields = [[part for part in path if not part.startswith("(")] for path in named]
    n_common = min((len(path) - 1 for path in fields), default=0)
    while any(path[:n_common] != named[0][:n_common] for path in named):
        n_common -= 1
    short = [_joined(path[n_common:]) for path in named]
    counts = Counter(short)
    return [
        name if counts[name] == 1 else _joined(path)
        for name, path in zip(short, paths, strict=True)
    ]


def _joined(path: Sequence[str]) -> str:
    """Name of a path, such as ``lap.wheels(2)``."""
    return ".".join(path).replace(".(", "(")
