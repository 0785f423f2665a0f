"""``python -m fuzz``: try malformed inputs, write a row for each, and fail if any of them ends
badly.
"""

import os

os.environ |= {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "COLUMNS": "160",
    "MPLBACKEND": "agg",
}

import argparse
import sys
import tempfile
import time
from pathlib import Path

VERSION = "1"
"""Raised when the numbers of its tables move."""


def main():
    """Exit code 1 if any row is bad."""
    options = _options()
    from fuzz.runner import Fuzzer, described, summary, write_rows
    from vehest.run.table_records import record_tables

    with tempfile.TemporaryDirectory(prefix="vehest-fuzz-", ignore_cleanup_errors=True) as scratch:
        started = time.monotonic()
        folder = Path(options.folder) if options.folder else Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        fuzzer = Fuzzer(
            folder, options.seed, options.family, keep=bool(options.folder), seconds=options.seconds
        )
        fuzzer.prepare()
        indices = options.only or range(options.inputs)
        print(
            f"{len(indices)} inputs, {len(set(fuzzer.turns))} generators, ready after "
            f"{time.monotonic() - started:.0f} s",
            flush=True,
        )
        rows = []

        def report(row):
            rows.append(row)
            if options.out and len(rows) % 50 == 0:
                write_rows(rows, Path(options.out))
            if row.verdict != "ok" or options.only:
                print(described(row), flush=True)

        fuzzer.run(indices, options.jobs, report)
        if options.out:
            write_rows(rows, Path(options.out))
            record_tables([Path(options.out)], "make fuzz", ["script tests/fuzz/__main__.py"])
        if options.only and options.folder:
            print(f"files: {', '.join(str(folder / f'{index:06d}') for index in indices)}")
        bad = sum(row.verdict != "ok" for row in rows)
        print(
            f"\n{summary(rows)}\n\n{bad} of {len(rows)} inputs ended badly; "
            f"{time.monotonic() - started:.0f} s, seed {options.seed}"
        )
    return 1 if bad else 0


def _options():
    """Options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=3000, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="another seed makes other inputs")
    parser.add_argument("--only", type=int, nargs="+", help="indices of single inputs to try again")
    parser.add_argument("--jobs", type=int, default=2, help="children at a time")
    parser.add_argument("--seconds", type=float, default=20.0, help="that a command may take")
    parser.add_argument(
        "--family", nargs="+", default=[], help="families to use; indices then count other inputs"
    )
    parser.add_argument("--out", help="CSV file to write")
    parser.add_argument("--folder", help="work here and keep every input's files")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
