"""Parquet tables and recordings: types, lies in the metadata, bombs, flipped bytes."""

from __future__ import annotations

import json
import math
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from conftest import planar_drive
from fuzz.case import Case, Command, generator
from fuzz.honest import lap
from fuzz.mutations import CALL, NAMES, spoil_bytes, spoil_json
from vehest.data.store import write_recording

KEY = b"vehest"


def _table(seed: int = 9, seconds: float = 20.0) -> pa.Table:
    return pa.Table.from_pandas(lap(seed, seconds), preserve_index=False)


def _reads(case: Case, file: str, *overrides: str) -> Command:
    how = case.rng.randrange(4)
    if how <= 1:
        return Command(("estimate", file, *overrides, "-o", "out.csv"), targets=("out.csv",))
    return Command(("data", "check" if how == 2 else "show", file, *overrides))


@generator(weight=4)
def bytes_of_a_parquet_table(case: Case) -> Command:
    file = case.place / "lap.parquet"
    pq.write_table(_table(), file, compression=case.rng.choice(["snappy", "zstd", "gzip", "none", "brotli", "lz4"]))
    if not case.honest:
        content = file.read_bytes()
        at = case.rng.choice([0, max(0, len(content) - 2000), max(0, len(content) - 300)])  # the footer is what says how to read the rest
        file.write_bytes(content[:at] + spoil_bytes(content[at:], case.rng))
    return _reads(case, "lap.parquet")


@generator(weight=2)
def types(case: Case) -> Command:
    table, n = _table(), 1000
    wrong: list[Any] = [
        pa.array(["a"] * n),
        pa.array([datetime(2020, 1, 1) + timedelta(milliseconds=20 * k) for k in range(n)]),
        pa.array([timedelta(seconds=1)] * n),
        pa.array([[1.0]] * n),
        pa.array([{"a": 1.0}] * n),
        pa.array([None] * n, pa.float64()),
        pa.array(range(2**63 - n, 2**63), pa.int64()),
        pa.array(["a"] * n).dictionary_encode(),
        pa.array([math.nan] * n),
        pa.array([[0.0] * 1000] * n),
    ]
    name = case.rng.choice(["time", "vx", "yaw_rate", "ay"])
    if not case.honest:
        table = table.set_column(table.column_names.index(name), name, wrong[case.visit % len(wrong)])
    pq.write_table(table, case.place / "lap.parquet")
    return _reads(case, "lap.parquet")


def _rows_of_zeros(file: Path, groups: int) -> None:
    """Zeros that take next to nothing on the disk and 8 bytes each in memory."""
    block = pa.table({name: np.zeros(100_000) for name in ("time", "vx", "yaw_rate", "ay", "ax")})
    with pq.ParquetWriter(file, block.schema, compression="zstd") as writer:
        for _ in range(groups):
            writer.write_table(block)


@generator()
def bombs(case: Case) -> Command:
    file = case.place / "lap.parquet"
    if case.honest:
        pq.write_table(_table(), file)
    else:
        _rows_of_zeros(file, int(case.idea(400, 3000, 40)))  # type: ignore[call-overload]
    return _reads(case, "lap.parquet", *case.rng.choice([(), ("dataset.time=null", "dataset.rate_hz=100")]))


def _stored(case: Case, file: Path) -> dict[str, Any]:
    """An honest recording as vehest stores it; returns its description."""
    write_recording(planar_drive(40.0, 20.0, seed=case.visit, noise=0.02), file)
    return dict(json.loads(pq.read_schema(file).metadata[KEY]))


@generator("drives", weight=4)
def description_of_a_recording(case: Case) -> Command:
    file = case.place / "drive.parquet"
    described = _stored(case, file)
    if not case.honest:
        if case.rng.random() < 0.5:
            values = [*NAMES[:12], 0, -1, 1e-300, 1e300, math.nan, math.inf, None, [], {}, "20", True, 10**400, CALL]
            text = json.dumps(described | {case.rng.choice(list(described)): case.rng.choice(values)}, default=str).encode()
        else:
            text = spoil_json(described, case.rng)
        pq.write_table(pq.read_table(file).replace_schema_metadata({KEY: text}), file)
    return _reads(case, "drive.parquet")
