"""Logs of a VBOX: bytes, sections, columns, units, clocks, cells, and comments with offsets."""

from __future__ import annotations

import yaml
from vbo_log import UNITS, dataset, write_log

from fuzz.case import Case, Command, generator
from fuzz.families.tables import CELLS
from fuzz.mutations import NAMES, spoil_bytes

SWAPS = (
    (b"[data]", b""), (b"[data]", b"[data][data]"), (b"[column names]", b"[column names]\r\n"), (b"[channel units]", b"[comments]"),
    (b" time ", b" "), (b" time ", b" time time "), (b"YawRate", b"\xff\xfe"), (b"{", b"{" * 500), (b"+00.031", b"+" + b"9" * 400),
    (b"+1.790", b"1e999"), (b"[header]", b"[" * 5000), (b"\r\n", b"\r"), (b"\r\n", b"\n\n"), (b" ", b"\t"),
    (b"[comments]", b"[comments]\r\n\x1b[2J"),
)  # fmt: skip
CLOCKS = (0.0, 86_395.0, 86_399.99, 43_200.0)


def _read(case: Case, name: str = "lap.vbo") -> Command:
    described = dataset(case.place / "raw") | {"title": "Logs"}
    if not case.honest and case.rng.random() < 0.2:
        described["clock"] = "interpolate"
    case.write("conf/dataset/logs.yaml", yaml.safe_dump(described))
    how = case.rng.randrange(4)
    if how == 0:
        return Command(("estimate", f"raw/{name}", "dataset=logs", "-o", "out.csv"), targets=("out.csv",))
    if how == 1:
        return Command(("data", "check", f"raw/{name}", "dataset=logs"))
    return Command(("ingest", "logs")) if how == 2 else Command(("data", "show", f"raw/{name}", "dataset=logs", "--json"))


def _log(case: Case, **how: object) -> bytes:
    file = case.place / "raw" / "lap.vbo"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_log(file, case.rng.choice(CLOCKS), **how)  # type: ignore[arg-type]
    return file.read_bytes()


@generator(weight=2)
def logs(case: Case) -> Command:
    """Bytes anywhere in a log, and lines of its head."""
    content = _log(case)
    if not case.honest:
        if case.rng.random() < 0.5:
            content = spoil_bytes(content, case.rng)
        else:
            old, new = case.rng.choice(SWAPS)
            content = content.replace(old, new, case.rng.choice([1, 1, -1]))
        case.write("raw/lap.vbo", content)
    return _read(case)


@generator(weight=2)
def cells_of_a_log(case: Case) -> Command:
    """Values of the rows, clock times among them, and units."""
    units = UNITS if case.honest or case.rng.random() < 0.7 else tuple(case.rng.choice([*UNITS, *NAMES[:20]]) for _ in UNITS)
    lines = _log(case, units=tuple(" ".join(unit.split())[:200] for unit in units)).split(b"\r\n") if not case.honest else []
    if case.honest:
        _log(case)
        return _read(case)
    first = lines.index(b"[data]") + 1
    for _ in range(case.rng.choice([1, 1, 5, 200])):
        row = case.rng.randrange(first, len(lines))
        cells = lines[row].split(b" ")
        cells[case.rng.randrange(len(cells))] = case.rng.choice(CELLS).encode("latin-1", "replace")
        lines[row] = b" ".join(cells)
    if case.rng.random() < 0.2:
        case.rng.shuffle(lines)
    case.write("raw/lap.vbo", b"\r\n".join(lines))
    return _read(case)
