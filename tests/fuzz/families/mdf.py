"""MDF files of versions 3 and 4: conversions, formulas that hold code, packed blocks, links that go round, flipped bytes."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mdf_log import ONE, write_mdf

from fuzz.case import CANARY, Case, Command, generator, template
from fuzz.mutations import NAMES, spoil_bytes

TIME = np.arange(0, 301) / 50.0
FORMULA = "X1*1+000000000000000000000000000000000000000000000000000000000000000000"
CHANNELS = {
    **ONE,
    "yaw_rate": {"column": "r", "unit": "rad/s"},
    "ay": {"column": "a", "unit": "m/s²"},
}
DECLARED = {
    "name": "measured",
    "kind": "real",
    "vehicle": "car",
    "licence": "none",
    "citation": "none",
    "source": "mdf",
    "path": "${root}",
    "files": "*.m*",
    "rate_hz": 50,
    "raster": None,
    "channels": CHANNELS,
    "gappy": [],
    "file_units": "check",
    "accept": [],
}


def signals(conversion: Any = None, **more: Any) -> list[Any]:
    import asammdf

    return [
        asammdf.Signal(20.0 + np.sin(TIME), TIME, name="v", unit="m/s", conversion=conversion, **more),
        asammdf.Signal(0.1 * np.sin(TIME + 0.2), TIME, name="r", unit="rad/s"),
        asammdf.Signal(2.0 * np.sin(TIME + 0.3), TIME, name="a", unit="m/s^2"),
    ]


@template
def mdf(folder: Path) -> None:
    """Measurements of versions 3 and 4, plain, packed, with every kind of conversion."""
    (folder / "raw").mkdir()
    (folder / "conf" / "dataset").mkdir(parents=True)
    (folder / "conf" / "dataset" / "measured.yaml").write_text(yaml.safe_dump(DECLARED, allow_unicode=True), encoding="utf-8")
    (folder / "files").mkdir()
    for name, version, options in (
        ("v4", "4.10", {}),
        ("v4dz", "4.10", {"compression": 2}),
        ("v42", "4.20", {"compression": 1}),
        ("v3", "3.30", {}),
    ):
        write_mdf(folder / "files" / name, {"Only": signals()}, version, **options)
    linear, pairs = {"a": 0.5, "b": 1.0}, {"raw_0": 0, "phys_0": 5.0, "raw_1": 50, "phys_1": 90.0, "interpolation": True}
    rational = {"P1": 0.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 0.0, "P6": 1.0}
    for version, name in (("4.10", "v4"), ("3.30", "v3")):
        for kind, conversion in (("linear", linear), ("table", pairs), ("rational", rational)):
            write_mdf(folder / "files" / f"{name}_{kind}", {"Only": signals(conversion)}, version)
        write_mdf(folder / "files" / f"{name}_formula", {"Only": signals({"formula": FORMULA})}, version)


def _place(case: Case, name: str) -> Path:
    case.copy("mdf/conf", "conf")
    (case.place / "raw").mkdir()
    file = case.place / "raw" / ("drive.mf4" if name.startswith("v4") else "drive.mdf")
    file.write_bytes((case.templates / "mdf" / "files" / name).read_bytes())
    return file


def _reads(case: Case) -> Command:
    return Command(("data", str(case.idea("check", "show")), "measured") if case.rng.random() < 0.6 else ("ingest", "measured"))


KINDS = ("v4", "v4dz", "v42", "v3", "v4_linear", "v4_table", "v4_rational", "v3_table")


@generator("mdf", weight=6)
def bytes_of_mdf(case: Case) -> Command:
    file = _place(case, case.rng.choice(KINDS))
    if not case.honest:
        content = file.read_bytes()
        at = case.rng.choice([0, 0, 64, len(content) // 2])
        file.write_bytes(content[:at] + spoil_bytes(content[at:], case.rng))
    return _reads(case)


PAYLOADS = (
    f"__import__('os').system('touch {CANARY}')",
    f"open('{CANARY}','w')",
    "().__class__.__base__.__subclasses__()",
    "9**9**9**9",
    "X1+__import__('sly').x",
    "[x for x in range(10**9)]",
    "factorial(10**6)",
    "(" * 30 + "X1" + ")" * 30,
    "'a'*10**9",
    "X1;import os",
    "\x1b[2J",
    "",
)


@generator("mdf", weight=3)
def formulas(case: Case) -> Command:
    """The text of a formula is overwritten in its place."""
    name = "v4" if case.visit % 2 else "v3"
    if case.honest:
        _place(case, f"{name}_linear")
        return _reads(case)
    file = _place(case, f"{name}_formula")
    text = PAYLOADS[case.visit // 2 % len(PAYLOADS)].encode()
    file.write_bytes(
        file.read_bytes().replace(FORMULA.encode(), text[: len(FORMULA)].ljust(len(FORMULA), b" " if case.rng.random() < 0.5 else b"\0"))
    )
    return _reads(case)


def _blocks(content: bytes) -> list[tuple[int, bytes, int, int]]:
    """Offset, kind, length and number of links of every block of an MDF 4 file."""
    found, at = [], content.find(b"##")
    while at >= 0:
        length, links = struct.unpack("<QQ", content[at + 8 : at + 24]) if at + 24 <= len(content) else (0, 0)
        if at % 8 == 0 and 24 <= length <= len(content) and links < 1000:
            found.append((at, content[at : at + 4], length, links))
        at = content.find(b"##", at + 2)
    return found


@generator("mdf", weight=6)
def fields_of_blocks(case: Case) -> Command:
    """A number in a block becomes another: links, lengths, counts, types, flags, offsets of bits."""
    file = _place(case, case.rng.choice(KINDS))
    if not case.honest:
        content = bytearray(file.read_bytes())
        blocks, value = _blocks(content), case.rng.choice([0, 1, 255, 2**15, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1, len(content)])
        if blocks:
            at, _kind, length, count = case.rng.choice(blocks)
            body = case.rng.choice(
                [at + 8, at + 16, at + 24 + 8 * case.rng.randrange(count + 1), at + case.rng.randrange(24, max(25, length))]
            )
            value = case.rng.choice([value, case.rng.choice(blocks)[0], at])
        else:
            body = case.rng.randrange(64, min(2000, len(content)))
        width = case.rng.choice([1, 2, 4, 8])
        content[body : body + width] = (value % 2 ** (8 * width)).to_bytes(width, "little")
        file.write_bytes(content)
    return _reads(case)


@generator("mdf", weight=2)
def contents_of_mdf(case: Case) -> Command:
    """Sound files of the library's own writer whose contents make no sense."""
    import asammdf

    file = _place(case, "v4")
    if case.honest:
        return _reads(case)
    n = len(TIME)
    stamps = [np.where(np.arange(n) == 99, 1e9, TIME), TIME[::-1], np.zeros(n), np.full(n, np.nan), TIME * 1e12, TIME + 1e17]
    name = case.rng.choice(NAMES).replace("\ud8ff", "").replace("\0", "") or "x"
    rest = signals()[1:]
    ideas: list[Any] = [
        *(lambda t=t: [asammdf.Signal(np.ones(n), t, name=name) for name in "vra"] for t in stamps),
        lambda: [asammdf.Signal(np.array([b"text"] * n), TIME, name="v", encoding="utf-8"), *rest],
        lambda: [asammdf.Signal(np.zeros(n, dtype=[("v", "(3,)<f8")]), TIME, name="v"), *rest],
        lambda: [asammdf.Signal(np.full(n, np.nan), TIME, name="v"), *rest],
        lambda: [asammdf.Signal(np.ones(n), TIME, name="v", unit=name), asammdf.Signal(np.ones(n), TIME, name=name), *rest],
        lambda: signals({"a": 1e308, "b": 1e308}),
        lambda: signals({"val_0": 0, "text_0": b"N", "val_1": 1, "text_1": b"\x1b[31m", "default": b"?"}),
        lambda: signals() + signals(),
    ]
    write_mdf(file, {"Only": ideas[case.visit % len(ideas)]()})
    return _reads(case)
