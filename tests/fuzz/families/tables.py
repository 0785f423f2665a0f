"""CSV tables: structure, numbers, clocks, encodings, sizes, and the declarations that go with them."""

from __future__ import annotations

import numpy as np
import pandas as pd

from fuzz.case import Case, Command, generator
from fuzz.honest import lap
from fuzz.mutations import spoil_bytes

CELLS = (
    "", "nan", "NaN", "inf", "-inf", "1e400", "-1e400", "1e308", "1e-400", "0x10", "1_000", "1,5", "1;5", "१२", "1e", "--1", "+-1",
    "None", "true", '"', '""', "'", "\x00", "\x1b[31m", "=1+1", "99999999999999999999999", "1" * 5000, " ", "\t1", "1 2", "N/A", "#REF!",
    "😀", "\ufeff1",
)  # fmt: skip


def _text(frame: pd.DataFrame, **options: object) -> str:
    return str(frame.to_csv(index=False, **options))


def _commands(case: Case, file: str, *overrides: str) -> Command:
    """One of the commands that read a table."""
    how = case.rng.randrange(5)
    if how <= 1:
        return Command(("estimate", file, *overrides, "-o", "out.parquet"), targets=("out.parquet",))
    if how == 2:
        return Command(("data", "check", file, *overrides))
    if how == 3:
        return Command(("data", "show", file, *overrides, "--json"))
    return Command(("data", "align", file, *overrides, "-e", "offsets"))


@generator(weight=3)
def bytes_of_a_table(case: Case) -> Command:
    content = _text(lap(case.visit, 20.0)).encode()
    case.write("lap.csv", content if case.honest else spoil_bytes(content, case.rng))
    return _commands(case, "lap.csv")


@generator(weight=3)
def cells(case: Case) -> Command:
    rows = [line.split(",") for line in _text(lap(case.visit, 20.0)).splitlines()]
    if not case.honest:
        for _ in range(case.rng.choice([1, 1, 3, 50])):
            row = case.rng.randrange(len(rows))
            rows[row][case.rng.randrange(len(rows[row]))] = case.rng.choice(CELLS)
    case.write("lap.csv", "\n".join(map(",".join, rows)) + "\n")
    return _commands(case, "lap.csv")


def clocks(time: np.ndarray, case: Case) -> np.ndarray:
    """A clock that no recording should have."""
    n, at, rng = len(time), case.rng.randrange(1, len(time) - 1), case.rng
    spoilt = [
        lambda: np.where(np.arange(n) == at, rng.choice([1e9, 1e12, 1e18, 1e300, -1e9]), time),
        lambda: np.append(time[:-1], rng.choice([1e6, 1e9, 1e15, 1e300])),
        lambda: np.where(np.arange(n) == at, np.nan, time),
        lambda: np.where(np.arange(n) == at, np.inf, time),
        lambda: np.zeros(n),
        lambda: time[::-1].copy(),
        lambda: time + case.numbers.normal(0, 0.01, n),
        lambda: np.sort(time + case.numbers.uniform(0, 0.02, n)),
        lambda: time * 1e12,
        lambda: time + 1e17,
        lambda: np.where(np.arange(n) > at, time + rng.choice([1.0, 3600.0, 1e7]), time),
        lambda: np.geomspace(1e-12, 1e12, n),
    ]
    return np.asarray(spoilt[case.visit % len(spoilt)](), dtype=float)


@generator(weight=2)
def time_stamps(case: Case) -> Command:
    frame = lap(case.visit, 20.0)
    if not case.honest:
        frame["time"] = clocks(frame["time"].to_numpy(), case)
    frame.to_csv(case.place / "lap.csv", index=False)
    clock = case.rng.choice(["strict", "interpolate", "interpolate"])
    return _commands(case, "lap.csv", f"dataset.clock={clock}")
