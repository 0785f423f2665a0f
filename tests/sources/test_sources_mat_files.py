"""MAT files of version 5 to 7 against SciPy's reader, and damaged in every way."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.sources.revs.mat_files import read_mat_file

STAMPS = np.arange(50) / 100


def small_file(path: Path, compressed: bool) -> bytes:
    values = np.sin(STAMPS)
    structs = {"insData": {name: {"value": values[:, None], "time": STAMPS[:, None]} for name in ("vxCG", "vyCG")}, "note": "text"}
    savemat(path, structs, do_compression=compressed)
    return path.read_bytes()


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?"])
def test_numbers_are_those_that_scipy_reads(tmp_path: Path, dtype: str, compressed: bool) -> None:
    written = {"s": {"long": np.arange(1000).astype(dtype)[:, None], "flat": np.ones((1, 3), dtype), "one": np.ones(1, dtype)}}
    savemat(tmp_path / "a.mat", {**written, "plain": np.arange(5.0)}, do_compression=compressed)
    expected = loadmat(tmp_path / "a.mat", simplify_cells=True)
    arrays = read_mat_file(tmp_path / "a.mat")
    assert set(arrays) == {"s", "plain"}
    np.testing.assert_array_equal(arrays["plain"].numbers(), expected["plain"])
    fields = arrays["s"].fields()
    assert list(fields) == ["long", "flat", "one"]
    for name, field in fields.items():
        np.testing.assert_array_equal(field.numbers(), np.atleast_1d(expected["s"][name]).astype(float))


def test_what_is_no_row_of_real_numbers_is_none(tmp_path: Path) -> None:
    odd: dict[str, Any] = {
        "complex": np.ones(3) * 1j,
        "square": np.ones((2, 2)),
        "text": "text",
        "cells": np.array([1, "a"], dtype=object),
        "nested": {"a": 1.0},
        "empty": np.empty((0, 0)),
    }
    savemat(tmp_path / "a.mat", {"s": odd, "several": np.zeros(2, dtype=[("a", "f8")])})
    arrays = read_mat_file(tmp_path / "a.mat")
    fields = arrays["s"].fields()
    assert {name: field.numbers() is None for name, field in fields.items()} == dict.fromkeys(odd, True) | {"empty": False}
    np.testing.assert_array_equal(fields["empty"].numbers(), [])
    assert fields["square"].fields() == {}
    assert arrays["several"].fields() == {}


def big_endian_file(path: Path) -> None:
    """x = [1 2 3], stored as whole numbers of one byte, as MATLAB does to save room; written by a big-endian machine."""
    flags = struct.pack(">IIII", 6, 8, 6, 0)
    shape = struct.pack(">IIii", 5, 8, 1, 3)
    name = struct.pack(">HHc3x", 1, 1, b"x")
    numbers = struct.pack(">HH3bx", 3, 1, 1, 2, 3)
    body = flags + shape + name + numbers
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x0100) + b"MI" + struct.pack(">II", 14, len(body)) + body)


def test_big_endian_files_are_read(tmp_path: Path) -> None:
    big_endian_file(tmp_path / "a.mat")
    np.testing.assert_array_equal(loadmat(tmp_path / "a.mat")["x"], [[1, 2, 3]])
    np.testing.assert_array_equal(read_mat_file(tmp_path / "a.mat")["x"].numbers(), [1.0, 2.0, 3.0])


def everything(path: Path) -> dict[str, list[float]]:
    """All numbers in a file's structs."""
    found = {}
    for name, array in read_mat_file(path).items():
        for inner, field in array.fields().items():
            for leaf, numbers in field.fields().items():
                values = numbers.numbers()
                found[f"{name}.{inner}.{leaf}"] = [] if values is None else values.tolist()
    return found


def everything_or_line(path: Path) -> dict[str, list[float]] | str:
    """All numbers, or the one line that refuses the file."""
    try:
        return everything(path)
    except DataError as error:
        return str(error)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_truncated_file_is_one_line_or_lacks_whole_variables(tmp_path: Path, compressed: bool) -> None:
    content = small_file(tmp_path / "a.mat", compressed)
    whole, refused = everything(tmp_path / "a.mat"), 0
    assert len(whole) == 4
    for length in range(0, len(content), 7):
        (tmp_path / "cut.mat").write_bytes(content[:length])
        found = everything_or_line(tmp_path / "cut.mat")
        if isinstance(found, str):
            refused += 1
            assert "cut.mat" in found
            assert "\n" not in found
        else:
            assert found == {name: values for name, values in whole.items() if name in found}
    assert refused > 0.7 * len(content) / 7


@pytest.mark.parametrize("compressed", [False, True])
def test_flipped_bytes_are_one_line_at_worst(tmp_path: Path, compressed: bool) -> None:
    content = small_file(tmp_path / "a.mat", compressed)
    whole, generator, refused = everything(tmp_path / "a.mat"), np.random.default_rng(0), 0
    for _ in range(1500):
        damaged = bytearray(content)
        for place in generator.integers(0, len(content), generator.integers(1, 4)):
            damaged[place] = generator.integers(0, 256)
        (tmp_path / "bad.mat").write_bytes(damaged)
        found = everything_or_line(tmp_path / "bad.mat")
        if isinstance(found, str):
            refused += 1
            assert "\n" not in found
            assert found.isprintable()
        else:  # zlib's checksum lets no wrong number pass; plain bytes have none
            assert not compressed or all(values == whole[name] for name, values in found.items() if name in whole)
    assert refused > 100


def test_a_compressed_array_that_announces_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    content = small_file(tmp_path / "a.mat", compressed=False)
    for announced, body in ((1 << 31, b"\0" * 100), (8, b"\0" * 1000)):
        packed = zlib.compress(struct.pack("<II", 14, announced) + body)
        (tmp_path / "b.mat").write_bytes(content[:128] + struct.pack("<II", 15, len(packed)) + packed)
        with pytest.raises(DataError, match="truncated or damaged"):
            everything(tmp_path / "b.mat")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no MAT file of version 5 to 7"),
        (b"time,vx\n1,2\n" * 100, "no MAT file of version 5 to 7"),
        (b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x0200) + b"IM" + bytes(384) + b"\x89HDF\r\n\x1a\n", "version 7.3"),
        (struct.pack("<5i", 0, 3, 1, 0, 2) + b"x\0" + bytes(240), "no MAT file of version 5 to 7"),  # version 4
        (
            b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + struct.pack("<II", 1, 8) + bytes(8),
            "where an array belongs",
        ),
    ],
)
def test_other_formats_are_named(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(DataError) as error:
        everything(tmp_path / "a.mat")
    assert said in str(error.value)
    with pytest.raises(DataError, match="is a folder, not a file"):
        read_mat_file(tmp_path)


def compressed_file(path: Path, body: bytes, announced: int | None = None) -> Path:
    """A file of one compressed array."""
    packed = zlib.compress(struct.pack("<II", 14, len(body) if announced is None else announced) + body)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + struct.pack("<II", 15, len(packed)) + packed)
    return path


HEAD = struct.pack("<IIII", 6, 8, 6, 0)


def test_an_array_that_announces_more_than_deflated_bytes_can_stand_for_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"a compressed array of .* bytes announces 2000000000"):
        read_mat_file(compressed_file(tmp_path / "a.mat", HEAD, 2_000_000_000))


def test_more_than_the_limits_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    file = compressed_file(
        tmp_path / "a.mat", HEAD + struct.pack("<IIii", 5, 8, 1, 10_000) + struct.pack("<HHcxxx", 1, 1, b"x") + bytes(80_000)
    )
    with use_limits(Limits(memory=50_000)), pytest.raises(DataError, match=r"raise it: limits.memory=NUMBER"):
        read_mat_file(file)
    small_file(tmp_path / "b.mat", compressed=True)
    with use_limits(Limits(samples=49)), pytest.raises(DataError, match=r"raise it: limits.samples=NUMBER"):
        everything(tmp_path / "b.mat")


@pytest.mark.parametrize("dimensions", [0, 1, 33, 100_000])
def test_an_array_of_hardly_any_or_very_many_dimensions_is_refused(tmp_path: Path, dimensions: int) -> None:
    shape = struct.pack("<II", 5, 4 * dimensions) + np.full(dimensions, 2**31 - 1, "<i4").tobytes() + bytes(-4 * dimensions % 8)
    with pytest.raises(DataError, match=r"an array cannot be of shape|is truncated or damaged"):
        read_mat_file(compressed_file(tmp_path / "a.mat", HEAD + shape + struct.pack("<HHcxxx", 1, 1, b"x")))


def test_a_struct_of_very_many_fields_is_refused(tmp_path: Path) -> None:
    names = struct.pack("<HHi", 5, 4, 1) + struct.pack("<II", 1, 2_000_000) + b"a" * 2_000_000
    struct_head = struct.pack("<IIII", 6, 8, 2, 0) + struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<HHcxxx", 1, 1, b"x")
    array = read_mat_file(compressed_file(tmp_path / "a.mat", struct_head + names))["x"]
    with pytest.raises(DataError, match="is truncated or damaged"):
        array.fields()


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mat")
    with pytest.raises(DataError, match="is a pipe, not a file"):
        read_mat_file(tmp_path / "a.mat")
