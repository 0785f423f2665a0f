"""MDF files of versions 3 and 4: conversions, formulas that hold code, packed blocks, links that go round, flipped bytes."""

import struct

import numpy as np
from mdf_log import ONE, write_mdf

from fuzz.case import CANARY, Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import CALL, WRITABLE_NAMES, spoil_bytes

TIME = np.arange(0, 301) / 50.0
FORMULA = "X1*1+" + "0" * 66
CHANNELS = {**ONE, "yaw_rate": {"column": "r", "unit": "rad/s"}, "ay": {"column": "a", "unit": "m/s²"}}
DECLARED = {"name": "measured", "kind": "real", "vehicle": "car", "licence": "none", "citation": "none", "source": "mdf"}
DECLARED |= {"path": "${root}", "files": "*.m*", "rate_hz": 50, "raster": None, "channels": CHANNELS, "gappy": []}
DECLARED |= {"file_units": "check", "accept": []}
PAIRS = {"raw_0": 0, "phys_0": 5.0, "raw_1": 50, "phys_1": 90.0, "interpolation": True}
RATIONAL = {"P1": 0.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 0.0, "P6": 1.0}
CONVERSIONS = (None, {"a": 0.5, "b": 1.0}, PAIRS, RATIONAL, {"formula": FORMULA})
VERSIONS = {"v4": ("4.10", 0), "v4dz": ("4.10", 2), "v42": ("4.20", 1), "v3": ("3.30", 0)}
PAYLOADS = (
    CALL, f"open('{CANARY}','w')", "().__class__.__base__.__subclasses__()", "9**9**9**9", "X1+__import__('sly').x",
    "[x for x in range(10**9)]", "factorial(10**6)", "(" * 30 + "X1" + ")" * 30, "'a'*10**9", "X1;import os", "\x1b[2J", "",
)  # fmt: skip


def signals(conversion=None, **more):
    import asammdf

    return [
        asammdf.Signal(20.0 + np.sin(TIME), TIME, name="v", unit="m/s", conversion=conversion, **more),
        asammdf.Signal(0.1 * np.sin(TIME + 0.2), TIME, name="r", unit="rad/s"),
        asammdf.Signal(2.0 * np.sin(TIME + 0.3), TIME, name="a", unit="m/s^2"),
    ]


@template
def mdf(folder):
    """Measurements of versions 3 and 4, plain, packed, with every kind of conversion."""
    write_yaml(folder / "conf" / "dataset" / "measured.yaml", DECLARED)
    (folder / "files").mkdir()
    for name, (version, packed) in VERSIONS.items():
        options = {} if version == "3.30" else {"compression": packed}
        for number, conversion in enumerate(CONVERSIONS):
            write_mdf(folder / "files" / f"{name}_{number}", {"Only": signals(conversion)}, version, **options)


def _overwrite_formula(content, rng):
    text = rng.choice(PAYLOADS).encode()[: len(FORMULA)]
    return content.replace(FORMULA.encode(), text.ljust(len(FORMULA), rng.choice([b" ", b"\0"])))


def _overwrite_field(content, rng):
    """A number in a block of MDF 4, or near the head of MDF 3, becomes another: links, lengths, counts, types, flags, offsets of bits."""
    blocks, at = [], content.find(b"##")
    while at >= 0:
        length, links = struct.unpack("<QQ", content[at + 8 : at + 24]) if at + 24 <= len(content) else (0, 0)
        if at % 8 == 0 and 24 <= length <= len(content) and links < 1000:
            blocks.append((at, length, links))
        at = content.find(b"##", at + 2)
    value = rng.choice([0, 1, 255, 2**15, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1, len(content)])
    field = rng.randrange(64, min(2000, len(content)))
    if blocks:
        at, length, links = rng.choice(blocks)
        field = rng.choice([at + 8, at + 16, at + 24 + 8 * rng.randrange(links + 1), at + rng.randrange(24, max(25, length))])
        value = rng.choice([value, rng.choice(blocks)[0], at])
    width = rng.choice([1, 2, 4, 8])
    return content[:field] + (value % 2 ** (8 * width)).to_bytes(width, "little") + content[field + width :]


def _senseless(case):
    """Signals for a sound file of the library's own writer whose contents make no sense."""
    import asammdf

    n, rest, name = len(TIME), signals()[1:], case.rng.choice(WRITABLE_NAMES) or "x"
    stamps = [np.where(np.arange(n) == 99, 1e9, TIME), TIME[::-1], np.zeros(n), np.full(n, np.nan), TIME * 1e12, TIME + 1e17]
    ideas = [
        *([asammdf.Signal(np.ones(n), clock, name=name) for name in "vra"] for clock in stamps),
        [asammdf.Signal(np.array([b"text"] * n), TIME, name="v", encoding="utf-8"), *rest],
        [asammdf.Signal(np.zeros(n, dtype=[("v", "(3,)<f8")]), TIME, name="v"), *rest],
        [asammdf.Signal(np.full(n, np.nan), TIME, name="v"), *rest],
        [asammdf.Signal(np.ones(n), TIME, name="v", unit=name), asammdf.Signal(np.ones(n), TIME, name=name), *rest],
        signals({"a": 1e308, "b": 1e308}),
        signals({"val_0": 0, "text_0": b"N", "val_1": 1, "text_1": b"\x1b[31m", "default": b"?"}),
        signals() + signals(),
    ]
    return ideas[case.visit // 5 % len(ideas)]


@generator("mdf", weight=12)
def measurement(case):
    case.copy("mdf/conf", "conf")
    how = case.idea(5)
    name = f"{case.rng.choice(list(VERSIONS))}_{4 if how == 0 else case.rng.randrange(4)}"
    file = case.write(f"raw/drive.{'mdf' if name.startswith('v3') else 'mf4'}", (case.templates / "mdf" / "files" / name).read_bytes())
    if how == 1:
        write_mdf(file, {"Only": _senseless(case)}, "3.30" if name.startswith("v3") else "4.10")
    else:
        case.spoil(file, (_overwrite_formula, spoil_bytes, _overwrite_field, _overwrite_field, spoil_bytes)[how])
    return Command(case.rng.choice([("data", "check", "measured"), ("data", "show", "measured"), ("ingest", "measured")]))
