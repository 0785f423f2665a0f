"""Logs of a VBOX: bytes, sections, columns, units, clocks, and comments with offsets."""

from __future__ import annotations

import yaml
from vbo_log import UNITS, dataset, write_log

from fuzz.case import Case, Command, generator
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


@generator(weight=4)
def logs(case: Case) -> Command:
    """Bytes anywhere in a log, and lines of its head."""
    units = UNITS if case.honest or case.rng.random() < 0.8 else tuple(" ".join(case.rng.choice(NAMES[:20]).split())[:200] for _ in UNITS)
    file = case.place / "raw" / "lap.vbo"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_log(file, case.rng.choice(CLOCKS), units=units)
    if not case.honest:
        content, (old, new) = file.read_bytes(), case.rng.choice(SWAPS)
        swapped = content.replace(old, new, case.rng.choice([1, 1, -1]))
        file.write_bytes(case.rng.choice([spoil_bytes(content, case.rng), swapped]))
    return _read(case)
