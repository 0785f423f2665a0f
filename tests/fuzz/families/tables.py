"""Tables and recordings, CSV and Parquet: bytes, cells, clocks, types, descriptions, bombs."""

import math
from datetime import datetime, timedelta

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from conftest import planar_drive
from fuzz.case import Command, generator
from fuzz.honest import lap
from fuzz.mutations import spoil_bytes, spoil_json
from vehest.data.store import write_recording

CELLS = (
    "", "nan", "inf", "1e400", "-1e400", "1e308", "1e-400", "0x10", "1_000", "1;5", "१२", "1e", "--1", "None", "true", '"', '""', "\x00",
    "\x1b[31m", "=1+1", "9" * 23, "1" * 5000, " ", "\t1", "1 2", "N/A", "😀", "\ufeff1",
)  # fmt: skip


def _reads(case, file, *overrides):
    """One of the commands that read a table."""
    words = [("estimate", file, "-o", "out.csv"), ("data", "check", file), ("data", "show", file, "--json")]
    return Command((*case.rng.choice([*words, ("data", "align", file, "-e", "offsets")]), *overrides))


def _clock(time, case):
    """A clock that no recording should have."""
    n, at, rng = len(time), case.rng.randrange(1, len(time) - 1), case.rng
    here = np.arange(n) == at
    spoilt = [
        np.where(here, rng.choice([1e9, 1e12, 1e18, 1e300, -1e9, np.nan, np.inf]), time),
        np.append(time[:-1], rng.choice([1e6, 1e9, 1e15, 1e300])),
        np.zeros(n),
        time[::-1],
        time + case.numbers.normal(0, 0.01, n),
        time * 1e12,
        time + 1e17,
        np.where(np.arange(n) > at, time + rng.choice([1.0, 3600.0, 1e7]), time),
        np.geomspace(1e-12, 1e12, n),
    ]
    return np.asarray(spoilt[case.visit // 3 % len(spoilt)], dtype=float)


@generator(weight=8)
def csv(case):
    frame, how = lap(case.visit, 20.0), case.idea(3)
    if how == 0:
        frame["time"] = _clock(frame["time"].to_numpy(), case)
    file = case.write("lap.csv", frame.to_csv(index=False))
    if how == 1:
        rows = [line.split(",") for line in file.read_text().splitlines()]
        for row in case.rng.sample(rows, case.rng.choice([1, 1, 3, 50])):
            row[case.rng.randrange(len(row))] = case.rng.choice(CELLS)
        case.write("lap.csv", "\n".join(map(",".join, rows)) + "\n")
    elif how == 2:
        case.spoil(file, spoil_bytes)
    return _reads(case, "lap.csv", *(case.rng.choice([(), ("dataset.clock=interpolate",)]) if how == 0 else ()))


def _wrong_types(n):
    instants = [datetime(2020, 1, 1) + timedelta(milliseconds=20 * k) for k in range(n)]
    values = [["a"] * n, instants, [timedelta(seconds=1)] * n, [[1.0]] * n, [{"a": 1.0}] * n, [math.nan] * n, [[0.0] * 1000] * n]
    return [*map(pa.array, values), pa.nulls(n, pa.float64()), pa.array(range(2**63 - n, 2**63)), pa.array(["a"] * n).dictionary_encode()]


@generator(weight=8)
def parquet(case):
    """Bytes, most of all of the footer, which says how to read the rest; columns of other types; zeros that pack to next to nothing."""
    file, how, overrides = case.place / "lap.parquet", case.idea(4), ()
    if how == 0:
        block = pa.table({name: np.zeros(100_000) for name in ("time", "vx", "yaw_rate", "ay", "ax")})
        with pq.ParquetWriter(file, block.schema, compression="zstd") as writer:
            for _ in range(case.rng.choice([40, 400, 3000])):
                writer.write_table(block)
        overrides = case.rng.choice([(), ("dataset.time=null", "dataset.rate_hz=100")])
    else:
        table = pa.Table.from_pandas(lap(9, 20.0), preserve_index=False)
        if how == 1:
            name, types = case.rng.choice(["time", "vx", "yaw_rate", "ay"]), _wrong_types(len(table))
            table = table.set_column(table.column_names.index(name), name, types[case.visit // 4 % len(types)])
        pq.write_table(table, file, compression=case.rng.choice(["snappy", "zstd", "gzip", "none", "brotli", "lz4"]))
        if how > 1:
            case.spoil(file, spoil_bytes)
    return _reads(case, "lap.parquet", *overrides)


@generator(weight=4)
def recording(case):
    """What a recording, as vehest stores it, says of itself in its metadata."""
    file = case.place / "drive.parquet"
    write_recording(planar_drive(40.0, 20.0, seed=case.visit, noise=0.02), file)
    if not case.honest:
        described = spoil_json(pq.read_schema(file).metadata[b"vehest"], case.rng)
        pq.write_table(pq.read_table(file).replace_schema_metadata({b"vehest": described}), file)
    return _reads(case, "drive.parquet")
