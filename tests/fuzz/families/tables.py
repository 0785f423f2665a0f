"""Tables and recordings, CSV and Parquet: bytes, cells, descriptions, a bomb."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat

from conftest import planar_drive
from fuzz.case import Command, generator
from fuzz.honest import lap
from fuzz.mutations import spoil_bytes, spoil_json
from parquet_bomb import bomb
from vehest.data.store import write_recording

CELLS = (
    "", "nan", "inf", "1e400", "-1e400", "1e308", "1e-400", "0x10", "1_000", "1;5", "१२", "1e",
    "--1", "None", "true", '"', '""', "\x00", "\x1b[31m", "=1+1", "9" * 23, "1" * 5000, " ", "\t1",
    "1 2", "N/A", "😀", "\ufeff1",
)  # fmt: skip


def _reads(case, file):
    """One of the commands that read a table."""
    words = [
        ("estimate", file, "-o", "out.csv"),
        ("data", "check", file),
        ("data", "show", file, "--json"),
    ]
    return Command(case.rng.choice([*words, ("data", "align", file, "-e", "offsets")]))


@generator(weight=8)
def csv(case):
    """A damaged table."""
    file = case.write("lap.csv", lap(case.visit, 20.0).to_csv(index=False))
    kind = case.idea(3)
    if kind == 2:
        rows = [line.split(",") for line in file.read_text().splitlines()]
        row = case.rng.choice([*rows[1:], rows[-1]])
        row[0] = repr(float(row[0]) + case.rng.choice([1e7, 1e9, 1e10, 1e18]))
        case.write("lap.csv", "\n".join(map(",".join, rows)) + "\n")
    elif kind == 0:
        rows = [line.split(",") for line in file.read_text().splitlines()]
        for row in case.rng.sample(rows, case.rng.choice([1, 1, 3, 50])):
            row[case.rng.randrange(len(row))] = case.rng.choice(CELLS)
        case.write("lap.csv", "\n".join(map(",".join, rows)) + "\n")
    else:
        case.spoil(file, spoil_bytes)
    return _reads(case, "lap.csv")


@generator(weight=8)
def parquet(case):
    """Bytes, most of all of the footer, which says how to read the rest.

    Zeros that pack to next to nothing; pages larger than said.
    """
    file = case.place / "lap.parquet"
    idea = case.idea(4)
    if idea == 1:
        bomb(file, case.rng.choice([10**6, 10**8, 2**31 - 1024]), ("time", "vx", "yaw_rate", "ay"))
    elif idea == 0:
        block = pa.table(
            {name: np.zeros(100_000) for name in ("time", "vx", "yaw_rate", "ay", "ax")}
        )
        with pq.ParquetWriter(file, block.schema, compression="zstd") as writer:
            for _ in range(case.rng.choice([40, 400, 3000])):
                writer.write_table(block)
    else:
        table = pa.Table.from_pandas(lap(9, 20.0), preserve_index=False)
        pq.write_table(
            table,
            file,
            compression=case.rng.choice(["snappy", "zstd", "gzip", "none", "brotli", "lz4"]),
        )
        case.spoil(file, spoil_bytes)
    return _reads(case, "lap.parquet")


@generator(weight=4)
def matlab(case):
    """Bytes of a MAT-file, and zeros that pack to next to nothing."""
    file = case.place / "lap.mat"
    if case.idea(4) == 0:
        zeros = np.zeros(case.rng.choice([10**6, 10**7]))
        savemat(file, dict.fromkeys(("time", "vx", "yaw_rate"), zeros), do_compression=True)
    else:
        table = lap(9, 20.0)
        columns = {name: table[name].to_numpy() for name in table}
        content = case.rng.choice([columns, {"lap": columns}])
        savemat(file, content, do_compression=case.rng.random() < 0.5)
        case.spoil(file, spoil_bytes)
    return _reads(case, "lap.mat")


@generator(weight=4)
def recording(case):
    """What a recording, as vehest stores it, says of itself in its metadata."""
    file = case.place / "drive.parquet"
    write_recording(planar_drive(40.0, 20.0, seed=case.visit, noise=0.02), file)
    if not case.honest:
        described = spoil_json(pq.read_schema(file).metadata[b"vehest"], case.rng)
        pq.write_table(pq.read_table(file).replace_schema_metadata({b"vehest": described}), file)
    return _reads(case, "drive.parquet")
