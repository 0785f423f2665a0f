"""Malformed MDF files: a formula is never evaluated, and whatever a file announces ends in one line
within limits.
"""

import os
import struct
import zlib

import numpy as np
import pytest
from mdf_log import read_mdf, write_mdf
from refusals import refusal

from vehest.data.limits import Limits, use_limits
from vehest.sources.mdf import read_measurement

asammdf = pytest.importorskip(
    "asammdf", reason="the measurements of these tests are written by asammdf"
)

FAST = np.arange(2001) / 100.0


def written(file, samples=FAST, conversion=None, version="4.10", **options):
    signals = [
        asammdf.Signal(np.asarray(samples), FAST, name="v", unit="m/s", conversion=conversion),
        asammdf.Signal(FAST, FAST, name="w"),
    ]
    return write_mdf(file, {"Only": signals}, version, **options)


def refused(file):
    message = refusal(lambda: read_mdf(file))
    assert file.name in message
    return message


def overwritten(file, block, offset, value):
    """Overwrite a number behind a block's head of 24 bytes; None stands for the block's own
    address.
    """
    content = bytearray(file.read_bytes())
    place = content.index(block)
    struct.pack_into("<Q", content, place + 24 + offset, place if value is None else value)
    file.write_bytes(content)
    return file


def conversion_of(version, description):
    from asammdf.blocks.conversion_utils import conversion_transfer, from_dict

    return conversion_transfer(from_dict(description), version=3 if version < "4" else 4)


@pytest.mark.parametrize(
    ("version", "place"),
    [
        *(
            ("4.10", place)
            for place in ("signal", "time channel", "nested", "deeply nested", "another signal")
        ),
        *(("3.30", place) for place in ("signal", "time channel", "another signal")),
        ("2.14", "signal"),
    ],
)
def test_a_formula_anywhere_refuses_the_file_and_is_never_evaluated(tmp_path, version, place):
    trace = tmp_path / "EXECUTED"
    payload = f"__import__('pathlib').Path({str(trace)!r}).touch() or X1*1"
    formula = {"formula": payload}
    file = tmp_path / "a.mf4"
    inner = conversion_of("4.10", formula)
    if place == "signal":
        written(file, FAST, formula, version)
    elif place == "time channel":
        written(file, clock=conversion_of(version, formula), version=version)
    elif place == "another signal":
        signals = [
            asammdf.Signal(FAST, FAST, name="v"),
            asammdf.Signal(FAST, FAST, name="other", conversion=formula),
        ]
        write_mdf(file, {"Only": signals}, version)
    else:
        table = {"val_0": 250.0, "text_0": b"error", "default_addr": inner}
        outer = {"val_0": 251.0, "text_0": b"error", "default_addr": conversion_of("4.10", table)}
        written(file, (np.arange(2001) % 200).astype("u1"), table if place == "nested" else outer)
    message = refused(file)
    assert (
        "has a conversion by a formula, which is not evaluated; export it as plain numbers"
        in message
    )
    assert (
        f"signal '{ {'time channel': 'time', 'another signal': 'other'}.get(place, 'v') }'"
        in message
    )
    assert not trace.exists()


def test_the_evaluators_are_replaced_where_a_formula_would_reach_them():
    from asammdf.blocks import v2_v3_blocks, v4_blocks

    from vehest.sources.readers import mdf

    before = {
        module: (module.evaluate, module.lambdify, module.symbols)
        for module in (v2_v3_blocks, v4_blocks)
    }
    temporary = mdf.mdf_v4.NamedTemporaryFile, mdf.mdf_v3.NamedTemporaryFile
    try:
        mdf.forbid_evaluation()
        for version, module in (("4.10", v4_blocks), ("3.30", v2_v3_blocks)):
            conversion = conversion_of(version, {"formula": "X1*2"})
            assert isinstance(conversion, module.ChannelConversion)
            with pytest.raises(TypeError, match="formulas are not evaluated"):
                conversion.convert(FAST)
    finally:
        for module, evaluators in before.items():
            module.evaluate, module.lambdify, module.symbols = evaluators
        mdf.mdf_v4.NamedTemporaryFile, mdf.mdf_v3.NamedTemporaryFile = temporary


def test_whole_numbers_belong_to_both_ends_of_a_range(tmp_path):
    table = {
        "lower_0": 0.0,
        "upper_0": 4.0,
        "phys_0": 7.0,
        "lower_1": 5.0,
        "upper_1": 9.0,
        "phys_1": 8.0,
        "default": -1.0,
    }
    raw = np.arange(2001) % 12
    expected = np.select([raw <= 4, raw <= 9], [7.0, 8.0], -1.0)
    np.testing.assert_array_equal(
        read_mdf(written(tmp_path / "a.mf4", raw.astype("u1"), table))["vx"], expected
    )
    real = np.where(raw == 4, 4.5, raw)  # between two ranges
    expected = np.select([real < 4, (real >= 5) & (real < 9)], [7.0, 8.0], -1.0)
    np.testing.assert_array_equal(
        read_mdf(written(tmp_path / "b.mf4", real.astype("f8"), table))["vx"], expected
    )


def test_a_table_of_texts_is_read_where_no_sample_meets_a_text(tmp_path):
    linear = asammdf.blocks.conversion_utils.from_dict({"a": 2.0, "b": 1.0})
    table = {"val_0": 250.0, "text_0": b"open", "default_addr": linear}
    raw = (np.arange(2001) % 200).astype("u1")
    np.testing.assert_array_equal(
        read_mdf(written(tmp_path / "a.mf4", raw, table))["vx"], 2.0 * raw + 1.0
    )
    raw[70] = 250
    assert "signal 'v' of group 0 'Only' holds text" in refused(
        written(tmp_path / "b.mf4", raw, table)
    )


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_a_conversion_that_leads_elsewhere_is_not_left_out(tmp_path, version):
    file = written(tmp_path / "a.mf4", conversion={"a": 2.0, "b": 1.0}, version=version)
    with asammdf.MDF(file) as measurement:
        at = measurement.groups[0].channels[1].address
    content = bytearray(file.read_bytes())
    link, layout = (at + 24 + 4 * 8, "<Q") if version == "4.10" else (at + 8, "<I")
    struct.pack_into(layout, content, link, at)  # the channel itself
    file.write_bytes(content)
    assert (
        "signal 'v' of group 0 'Only' has a conversion that cannot be read; the file is damaged"
        in refused(file)
    )


@pytest.mark.parametrize(("block", "link"), [(b"##DG", 0), (b"##CN", 1)])
def test_a_chain_that_leads_back_ends_in_one_line(tmp_path, block, link, monkeypatch):
    monkeypatch.setattr("vehest.sources.limited.SECONDS", 1.0)
    assert refused(overwritten(written(tmp_path / "a.mf4"), block, 8 * link, None))


def test_a_packed_block_beyond_the_memory_ends_in_one_line(tmp_path):
    file = written(tmp_path / "a.mf4", compression=1)
    content = file.read_bytes()
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(2**20)) for _ in range(400)) + packer.flush()
    content += bytes(-len(content) % 8)
    moved = content.replace(
        struct.pack("<Q", content.index(b"##DZ")), struct.pack("<Q", len(content))
    )
    head = struct.pack(
        "<4sIQQ2sBBIQQ", b"##DZ", 0, 48 + len(packed), 0, b"DT", 0, 0, 0, 400 * 2**20, len(packed)
    )
    file.write_bytes(moved + head + packed)
    with use_limits(Limits(memory=400_000_000)):
        assert refused(overwritten(file, b"##CG", 56, 400 * 2**20 // 24))  # bytes a record


def test_samples_that_are_not_there_or_beyond_the_limit_are_not_made_and_a_pipe_is_not_waited_for(
    tmp_path,
):
    file = written(tmp_path / "a.mf4")
    with use_limits(Limits(samples=2000)):
        assert "raise it: limits.samples=NUMBER" in refused(file)
    for samples in (10**7, 2**64 - 1):
        message = refused(overwritten(file, b"##CG", 56, samples))
        assert "its header says" in message or "limits.samples" in message
    os.mkfifo(tmp_path / "pipe.mf4")
    assert "is a pipe, not a file" in refusal(lambda: read_measurement(tmp_path / "pipe.mf4", {}))


@pytest.mark.slow
def test_an_honest_hour_at_1_khz_passes(tmp_path):
    t = np.arange(3_600_000) / 1000.0
    signals = [asammdf.Signal(np.sin(t + k), t, name=f"s{k}") for k in range(20)]
    channels = {"vx": {"column": "s3", "unit": "m/s"}, "ay": {"column": "s7", "unit": "m/s²"}}
    recording = read_mdf(
        write_mdf(tmp_path / "a.mf4", {"Only": signals}, compression=2),
        rate_hz=1000,
        channels=channels,
    )
    assert len(recording) == 3_600_000
    np.testing.assert_allclose(recording["ay"], np.sin(t + 7), rtol=0, atol=1e-9)
