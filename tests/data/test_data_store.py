"""The store: what is read back is what was written, bit for bit, and a failure leaves what was
there before.
"""

import math
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import refusal

from vehest.data.channels import CHANNELS
from vehest.data.errors import MissingError
from vehest.data.estimate import QUANTITIES, Estimate
from vehest.data.recording import Recording
from vehest.data.store import (
    is_stored_recording,
    read_estimate,
    read_recording,
    write_estimate,
    write_recording,
)

PROPERTY = settings(max_examples=25, deadline=None, derandomize=True, database=None)

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)  # -0.0 and denormals included
not_measured = st.integers(1, 2**51 - 1).map(
    lambda payload: np.array([0x7FF8 << 48 | payload], dtype=np.uint64).view(np.float64)[0]
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8) | finite,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@st.composite
def recordings(draw):
    length = draw(st.integers(1, 50))
    names = draw(st.lists(st.sampled_from(sorted(CHANNELS)), min_size=1, max_size=4, unique=True))
    gappy = frozenset(name for name in names if draw(st.booleans()))
    channels = {
        name: draw(
            arrays(np.float64, length, elements=finite | not_measured if name in gappy else finite)
        )
        for name in names
    }
    return Recording(
        id=draw(st.text(min_size=1, max_size=10)),
        vehicle=draw(st.text(max_size=10)),
        rate_hz=draw(st.floats(1e-3, 1e5)),
        start_time=draw(st.floats(-1e12, 1e12)),
        channels=channels,
        kind=draw(st.sampled_from(["real", "simulated"])),
        gappy=gappy,
        provenance=draw(st.dictionaries(st.text(max_size=5), json_values, max_size=3)),
    )


def simple(samples=(1.0, 2.0, 3.0), **changes):
    return Recording(
        "lap", "car", 100.0, 5.0, {"ay": np.asarray(samples, dtype=np.float64)}, **changes
    )


def bits(values):
    return np.ascontiguousarray(values, dtype=np.float64).view(np.uint64).tolist()


@PROPERTY
@given(recordings())
def test_a_recording_comes_back_bit_for_bit_with_all_it_says_about_itself(recording):
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recording.parquet"
        write_recording(recording, file)
        read = read_recording(file)
        assert list(read.channels) == list(recording.channels)
        for name, samples in recording.channels.items():
            assert bits(read[name]) == bits(samples), name
        for key in ("id", "vehicle", "rate_hz", "start_time", "kind", "gappy"):
            assert getattr(read, key) == getattr(recording, key), key
        assert dict(read.provenance) == dict(recording.provenance)
        assert [path.name for path in Path(folder).iterdir()] == [file.name]


def test_other_tools_read_the_same_numbers_and_writing_twice_gives_the_same_bytes(tmp_path):
    samples = np.random.default_rng(0).standard_normal(1000)
    write_recording(simple(samples), tmp_path / "r.parquet")
    table = pd.read_parquet(tmp_path / "r.parquet")
    assert list(table.columns) == ["ay"]
    assert bits(table["ay"].to_numpy()) == bits(samples)
    write_estimate(
        Estimate("r", "gru", 20.0, 450.0, {"vy": np.arange(3.0), "sideslip": np.zeros(3)}),
        tmp_path / "e.parquet",
    )
    assert pd.read_parquet(tmp_path / "e.parquet")["time"].tolist() == pytest.approx(
        [450.0, 450.05, 450.1], abs=1e-12
    )
    for name in ("a", "b"):
        write_recording(simple(np.arange(500) / 7.0), tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_channels_are_read_in_the_requested_order_and_missing_channels_are_named(tmp_path):
    channels = {name: np.full(3, float(k)) for k, name in enumerate(("vx", "ax", "ay"))}
    recording = Recording("r", "car", 10.0, 0.0, channels, gappy=frozenset({"ax"}))
    write_recording(recording, tmp_path / "r.parquet")
    read = read_recording(tmp_path / "r.parquet", ["ay", "vx"])
    assert {name: samples.tolist() for name, samples in read.channels.items()} == {
        "ay": [2.0] * 3,
        "vx": [0.0] * 3,
    }
    assert list(read.channels) == ["ay", "vx"]
    assert read.gappy == frozenset()
    write_recording(simple(), tmp_path / "r.parquet")
    message = refusal(lambda: read_recording(tmp_path / "r.parquet", ["vx"]))
    assert all(words in message for words in ("no channel 'vx'", "it has ay"))


@PROPERTY
@given(st.integers(1, 20), st.integers(1, 4), st.data())
def test_an_estimate_comes_back_with_its_covariance(length, n_states, data):
    values = arrays(np.float64, length, elements=finite | st.just(math.nan))
    covariance = data.draw(
        st.none() | arrays(np.float64, (length, n_states, n_states), elements=finite)
    )
    names = tuple(data.draw(st.permutations(list(QUANTITIES)))[:n_states])
    estimate = Estimate(
        recording_id=data.draw(st.text(max_size=8)),
        estimator="ekf",
        rate_hz=data.draw(st.floats(0.1, 1e4)),
        start_time=data.draw(st.floats(-1e10, 1e10)),
        channels={"vy": data.draw(values), "sideslip": data.draw(values)},
        mode=data.draw(st.sampled_from(["causal", "offline"])),
        covariance=covariance,
        covariance_of=() if covariance is None else names,
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "estimate.parquet"
        write_estimate(estimate, file)
        read = read_estimate(file)
    assert {name: bits(samples) for name, samples in read.channels.items()} == {
        name: bits(s) for name, s in estimate.channels.items()
    }
    about = ("recording_id", "estimator", "rate_hz", "start_time", "mode", "covariance_of")
    assert [getattr(read, key) for key in about] == [getattr(estimate, key) for key in about]
    if estimate.covariance is None:
        assert read.covariance is None
    else:
        assert read.covariance.shape == estimate.covariance.shape
        assert bits(read.covariance.ravel()) == bits(estimate.covariance.ravel())


def test_unreadable_and_unwritable_files_are_refused_and_leave_nothing(tmp_path):
    assert "JSON" in refusal(
        lambda: write_recording(simple(provenance={"when": object()}), tmp_path / "r.parquet")
    )
    assert list(tmp_path.iterdir()) == []
    message = refusal(lambda: read_recording(tmp_path / "none.parquet"), MissingError)
    assert all(words in message for words in ("there is no file", "none.parquet"))
    (tmp_path / "file").write_text("not a folder")
    assert "cannot write" in refusal(
        lambda: write_recording(simple(), tmp_path / "file" / "r.parquet"), MissingError
    )
    assert (tmp_path / "file").read_text() == "not a folder"


@pytest.mark.parametrize("n_bytes", [1, 4, 200, -8, -1])
def test_truncated_files_are_refused_in_a_single_line(tmp_path, n_bytes):
    write_recording(simple(np.arange(300.0)), tmp_path / "r.parquet")
    (tmp_path / "r.parquet").write_bytes((tmp_path / "r.parquet").read_bytes()[:n_bytes])
    assert "r.parquet' is truncated or damaged" in refusal(
        lambda: read_recording(tmp_path / "r.parquet")
    )
    assert not is_stored_recording(tmp_path / "r.parquet")


def test_no_flipped_bit_in_the_samples_goes_unnoticed(tmp_path):
    write_recording(simple(np.random.default_rng(1).standard_normal(64)), tmp_path / "r.parquet")
    intact = (tmp_path / "r.parquet").read_bytes()
    samples_end = (
        pq.ParquetFile(tmp_path / "r.parquet").metadata.row_group(0).column(0).total_compressed_size
        + 4
    )
    for position in range(samples_end - 400, samples_end, 7):
        damaged = bytearray(intact)
        damaged[position] ^= 0x10
        (tmp_path / "r.parquet").write_bytes(damaged)
        assert "damaged" in refusal(lambda: read_recording(tmp_path / "r.parquet"))


@pytest.mark.parametrize(
    "metadata",
    [
        None,
        {b"vehest": b"[1, 2]"},
        {b"vehest": b"not json"},
        {b"vehest": b'{"content": "recording"}'},
        {b"vehest": b"\xff"},
    ],
)
def test_foreign_parquet_files_are_refused_in_a_single_line(tmp_path, metadata):
    pq.write_table(
        pa.table({"ay": [1.0, 2.0]}).replace_schema_metadata(metadata), tmp_path / "foreign.parquet"
    )
    assert "foreign.parquet" in refusal(lambda: read_recording(tmp_path / "foreign.parquet"))


def test_a_recording_is_not_an_estimate_nor_the_other_way_round(tmp_path):
    write_recording(simple(), tmp_path / "r.parquet")
    write_estimate(
        Estimate("r", "gru", 20.0, 0.0, {"vy": np.zeros(3), "sideslip": np.zeros(3)}),
        tmp_path / "e.parquet",
    )
    assert "not an estimate" in refusal(lambda: read_estimate(tmp_path / "r.parquet"))
    assert "not a recording" in refusal(lambda: read_recording(tmp_path / "e.parquet"))
    assert is_stored_recording(tmp_path / "r.parquet")
    assert not is_stored_recording(tmp_path / "e.parquet")
    assert not is_stored_recording(tmp_path / "none.parquet")
