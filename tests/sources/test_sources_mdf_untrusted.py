"""MDF files that nobody vouches for: formulas are parsed and never run, chains and blocks are bounded, bits are those that stand there."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.limits import Limits, use_limits
from vehest.data.recording import Recording
from vehest.sources.base import open_source
from vehest.sources.mdf.blocks import BlockFile
from vehest.sources.mdf.conversions import same
from vehest.sources.mdf.data_blocks import records_of
from vehest.sources.mdf.files import read_measurement
from vehest.sources.mdf.formulas import FormulaError, parse_formula
from vehest.sources.mdf.layout import DataGroup, Field, Group, Piece
from vehest.sources.mdf.values import raw_values

asammdf = pytest.importorskip("asammdf", reason="the measurements of these tests are written by asammdf")

FAST = np.arange(2001) / 100.0


def written(file: Path, samples: Any = FAST, conversion: Any = None, version: str = "4.10", compression: int = 0) -> Path:
    with asammdf.MDF(version=version) as measurement:
        signals = [asammdf.Signal(np.asarray(samples), FAST, name="v", unit="m/s", conversion=conversion)]
        signals.append(asammdf.Signal(FAST, FAST, name="w"))
        measurement.append(signals, acq_name="Only", comment="Only", common_timebase=True)
        saved = Path(measurement.save(file, overwrite=True, compression=compression))
    return saved.rename(file)


def read(file: Path) -> Recording:
    channels = {"vx": {"column": "v", "unit": "m/s"}}
    dataset = {"name": "mine", "source": "mdf", "path": str(file.parent), "files": file.name, "rate_hz": 100, "channels": channels}
    (recording,) = open_source(dataset).recordings()
    return recording


def refusal(file: Path) -> str:
    with pytest.raises(DataError) as error:
        read(file)
    message = str(error.value)
    assert message.isprintable()
    assert file.name in message
    return message


def overwritten(file: Path, block: bytes, which: int, offset: int, layout: str, value: int | None) -> Path:
    """Overwrite a number behind a block's head of 24 bytes; None stands for the block's own address."""
    content = bytearray(file.read_bytes())
    place = -1
    for _ in range(which + 1):
        place = content.index(block, place + 1)
    struct.pack_into(layout, content, place + 24 + offset, place if value is None else value)
    file.write_bytes(content)
    return file


# --- formulas ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("X1*2+1", lambda x: x * 2 + 1),
        ("2 + 3 * X ^ 2", lambda x: 2 + 3 * x**2),
        ("-x1**2", lambda x: -(x**2)),
        ("2**-X", lambda x: 2.0**-x),
        ("2^3^2 - X", lambda x: 512 - x),
        ("(X + 1.5e-1) / (4 - .5)", lambda x: (x + 0.15) / 3.5),
        ("SQRT(abs(X)) + sin(X)*cos(X) - tan(X/9)", lambda x: np.sqrt(x) + np.sin(x) * np.cos(x) - np.tan(x / 9)),
        ("pow(X, 2) + exp(-X) + ln(X + 1) + log10(X + 1)", lambda x: x**2 + np.exp(-x) + np.log(x + 1) + np.log10(x + 1)),
        ("floor(X) + ceil(X) + atan(X) + tanh(X)", lambda x: np.floor(x) + np.ceil(x) + np.arctan(x) + np.tanh(x)),
        ("5", lambda x: np.full_like(x, 5.0)),
        ("1 - 2 - 3 + +X", lambda x: -4 + x),
    ],
)
def test_formulas_are_what_they_say(formula: str, value: Callable[[FloatArray], FloatArray]) -> None:
    x = np.linspace(0.0, 9.0, 50)
    np.testing.assert_allclose(parse_formula(formula)(x), value(x), rtol=1e-14)


@pytest.mark.parametrize(
    "formula",
    [
        "__import__('os').system('true')",
        "X.__class__",
        "X[0]",
        "eval(X)",
        "lambda: X",
        "X if X else 1",
        "X; X",
        "X = 3",
        "Y + 1",
        "X2",
        "sin X",
        "sin(X",
        "pow(X)",
        "1 +",
        "",
        "()",
        "2 X",
        "0x10",
        "1j",
        "X & 1",
        "X // 2",
        "+" * 5000 + "X",
        "(" * 500 + "X" + ")" * 500,
        "X" + "+X" * 100,
        "９",
    ],
)
def test_formulas_that_say_more_are_refused(formula: str) -> None:
    with pytest.raises(FormulaError):
        parse_formula(formula)


@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(st.text(alphabet="X1234.+-*/^() sincoexp,e_", max_size=40))
def test_any_text_is_a_formula_or_refused(text: str) -> None:
    with np.errstate(all="ignore"), contextlib.suppress(FormulaError):
        assert np.shape(parse_formula(text)(np.ones(3))) == (3,)


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_a_refused_formula_is_named_with_its_signal_and_what_to_do(tmp_path: Path, version: str) -> None:
    message = refusal(written(tmp_path / "a.mf4", FAST, {"formula": "X1 + \x1b[31m" if version == "4.10" else "Y\x1b[31m"}, version))
    assert "signal 'v': its formula" in message
    assert "\\x1b[31m" in message
    assert "export the signal as plain numbers" in message


# --- tables ------------------------------------------------------------------------------------------------------------------------


def test_whole_numbers_belong_to_both_ends_of_a_range(tmp_path: Path) -> None:
    table = {"lower_0": 0.0, "upper_0": 4.0, "phys_0": 7.0, "lower_1": 5.0, "upper_1": 9.0, "phys_1": 8.0, "default": -1.0}
    raw = np.arange(2001) % 12
    expected = np.select([raw <= 4, raw <= 9], [7.0, 8.0], -1.0)
    np.testing.assert_array_equal(read(written(tmp_path / "a.mf4", raw.astype("u1"), table))["vx"], expected)
    real = np.where(raw == 4, 4.5, raw)  # between two ranges
    expected = np.select([real < 4, (real >= 5) & (real < 9)], [7.0, 8.0], -1.0)
    np.testing.assert_array_equal(read(written(tmp_path / "b.mf4", real.astype("f8"), table))["vx"], expected)


def test_a_table_of_texts_is_read_where_no_sample_meets_a_text(tmp_path: Path) -> None:
    linear = asammdf.blocks.conversion_utils.from_dict({"a": 2.0, "b": 1.0})
    table = {"val_0": 250.0, "text_0": b"error", "default_addr": linear}
    raw = (np.arange(2001) % 200).astype("u1")
    np.testing.assert_array_equal(read(written(tmp_path / "a.mf4", raw, table))["vx"], 2.0 * raw + 1.0)
    raw[70] = 250
    assert "signal 'v' of group 0 'Only' holds text" in refusal(written(tmp_path / "b.mf4", raw, table))


# --- chains ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("block", "link", "what"),
    [(b"##DG", 0, "data groups"), (b"##CG", 0, "channel groups lead back"), (b"##CN", 0, "channels"), (b"##CN", 1, "channels")],
    ids=["data groups", "groups", "channels", "parts of a channel"],
)
def test_a_chain_that_leads_back_is_refused(tmp_path: Path, block: bytes, link: int, what: str) -> None:
    assert what in refusal(overwritten(written(tmp_path / "a.mf4"), block, 0, 8 * link, "<Q", None))


def test_a_list_of_data_that_leads_back_is_refused(tmp_path: Path) -> None:
    big = np.zeros((2001, 2000))  # so much that the writer makes a list of blocks
    with asammdf.MDF(version="4.10") as measurement:
        measurement.append([asammdf.Signal(big[:, k], FAST, name=f"c{k}" if k else "v") for k in range(700)], common_timebase=True)
        file = Path(measurement.save(tmp_path / "a.mf4", overwrite=True, compression=1))
    assert "lists of data blocks lead back" in refusal(overwritten(file, b"##DL", 0, 0, "<Q", None))


@pytest.mark.parametrize("version", ["3.30", "2.14"])
def test_a_chain_of_version_3_that_leads_back_is_refused(tmp_path: Path, version: str) -> None:
    file = written(tmp_path / "a.mf4", version=version)
    content = bytearray(file.read_bytes())
    (group,) = struct.unpack_from("<I", content, 68)
    struct.pack_into("<I", content, group + 4, group)
    file.write_bytes(content)
    assert "its data groups lead back" in refusal(file)


# --- what blocks unpack to ---------------------------------------------------------------------------------------------------------


def test_a_block_must_unpack_to_what_it_announces(tmp_path: Path) -> None:
    for announced, said in (
        (5 * 10**7, "announces 50000000"),
        (100, "unpacks to more than the 100 bytes"),
    ):
        file = overwritten(written(tmp_path / "a.mf4", compression=1), b"##DZ", 0, 8, "<Q", announced)
        assert said in refusal(file)


def test_more_bytes_than_the_limit_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    file = written(tmp_path / "a.mf4", np.zeros(2001), compression=1)
    with use_limits(Limits(memory=1)):
        assert "raise it: limits.memory=NUMBER" in refusal(file)


@pytest.mark.parametrize("samples", [10**7, 10**12, 2**64 - 1])
def test_samples_that_are_not_there_are_not_made(tmp_path: Path, samples: int) -> None:
    message = refusal(overwritten(written(tmp_path / "a.mf4"), b"##CG", 0, 56, "<Q", samples))
    assert "its header says" in message or "limits.samples" in message


def test_more_samples_than_the_limit_are_refused(tmp_path: Path) -> None:
    file = written(tmp_path / "a.mf4")
    with use_limits(Limits(samples=2000)):
        assert "raise it: limits.samples=NUMBER" in refusal(file)
    with use_limits(Limits(memory=32_015)):
        assert "raise it: limits.memory=NUMBER" in refusal(file)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mf4")
    with pytest.raises(DataError, match="is a pipe, not a file"):
        read_measurement(tmp_path / "pipe.mf4", {})


# --- records and bits --------------------------------------------------------------------------------------------------------------


def group_of(data: DataGroup, record_bytes: int, record_id: int = 0) -> Group:
    return Group(0, "g", 0, record_id, record_bytes, 0, data)


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_records_of_several_groups_are_told_apart(repeated: bool, cut: int) -> None:
    generator = np.random.default_rng(3)
    content, expected = b"", []
    for number in generator.integers(0, 3, 200).tolist():
        record = generator.integers(0, 256, 4 + number, dtype=np.uint8).tobytes()
        if number == 2:  # says its own length
            record = struct.pack("<I", len(record)) + record
        if number == 1:
            expected.append(record)
        content += bytes([number]) + record + bytes([number] if repeated else [])
    data = DataGroup(0, 1, repeated, {0: 4, 1: 5, 2: None})
    pieces = [Piece(at, min(cut, len(content) - at), min(cut, len(content) - at)) for at in range(0, len(content), cut)]
    file = BlockFile(io.BytesIO(content), Path("a.mf4"))
    found = np.concatenate(list(records_of(file, pieces, group_of(data, 5, 1), len(expected))))
    assert [row.tobytes() for row in found] == expected
    del data.sizes[0]
    with pytest.raises(DataError, match="a record is numbered 0, which no group is"):
        list(records_of(file, pieces, group_of(data, 5, 1), len(expected)))


def test_transposed_blocks_come_back_in_order() -> None:
    rows = np.arange(31 * 6, dtype=np.uint8).reshape(31, 6)
    packed = zlib.compress(rows.T.tobytes() + b"rest")
    file = BlockFile(io.BytesIO(packed), Path("a.mf4"))
    piece = Piece(0, len(packed), rows.size + 4, is_deflated=True, columns=6)
    found = np.concatenate(list(records_of(file, [piece], group_of(DataGroup(0, 0), 10), None)))  # records need not fit the matrix
    assert found.tobytes() == rows.tobytes() + b"rest"


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("bit", range(8))
@pytest.mark.parametrize("bits", [1, 2, 7, 8, 9, 13, 16, 24, 31, 33, 40, 57])
def test_numbers_of_any_bits_are_those_that_were_written(bits: int, bit: int, signed: bool, big: bool) -> None:
    byte, values = bit % 3, np.random.default_rng(bits).integers(0, 2**63, 20).tolist()
    length = (bit + bits + 7) // 8
    numbers = [value % 2**bits for value in values]
    noise = (2**bit - 1) | (-1 << (bit + bits)) % 2 ** (8 * length)  # of neighbours in the same bytes
    rows = [b"\xff" * byte + ((number << bit) | noise).to_bytes(length, "big" if big else "little") + b"\xff" for number in numbers]
    records = np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1)
    field = Field("signed" if signed else "unsigned", big, byte, bit, bits, None, False, "", same)
    expected = [number - 2**bits if signed and number >> (bits - 1) else number for number in numbers]
    np.testing.assert_array_equal(raw_values(records, field, 0), np.array(expected, dtype=object).astype(float))


# --- honest and long ---------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("compression", [0, 2])
def test_an_honest_hour_at_1_khz_passes(tmp_path: Path, compression: int) -> None:
    t = np.arange(3_600_000) / 1000.0
    names = [f"s{k}" for k in range(20)]
    with asammdf.MDF(version="4.10") as measurement:
        measurement.append([asammdf.Signal(np.sin(t + k), t, name=name) for k, name in enumerate(names)], common_timebase=True)
        file = Path(measurement.save(tmp_path / "a.mf4", overwrite=True, compression=compression))
    channels = {"vx": {"column": "s3", "unit": "m/s"}, "ay": {"column": "s7", "unit": "m/s²"}}
    dataset = {"name": "mine", "source": "mdf", "path": str(tmp_path), "rate_hz": 1000, "channels": channels}
    (recording,) = open_source(dataset).recordings()
    assert (len(recording), file.exists()) == (3_600_000, True)
    np.testing.assert_allclose(recording["ay"], np.sin(t + 7), rtol=0, atol=1e-9)
