"""MDF files of versions 3 and 4, plain and packed: bytes, and formulas that hold code."""

import numpy as np
from mdf_log import ONE, write_mdf

from fuzz.case import CANARY, Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import CALL, spoil_bytes

TIME = np.arange(0, 301) / 50.0
FORMULA = "X1*1+" + "0" * 66
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
}
DECLARED |= {
    "path": "${root}",
    "files": "*.m*",
    "rate_hz": 50,
    "raster": None,
    "channels": CHANNELS,
    "gappy": [],
}
DECLARED |= {"file_units": "check", "accept": []}
PAIRS = {"raw_0": 0, "phys_0": 5.0, "raw_1": 50, "phys_1": 90.0, "interpolation": True}
RATIONAL = {"P1": 0.0, "P2": 2.0, "P3": 1.0, "P4": 0.0, "P5": 0.0, "P6": 1.0}
CONVERSIONS = (None, {"a": 0.5, "b": 1.0}, PAIRS, RATIONAL, {"formula": FORMULA})
VERSIONS = {"v4": ("4.10", 0), "v4dz": ("4.10", 2), "v42": ("4.20", 1), "v3": ("3.30", 0)}
PAYLOADS = (
    CALL, f"open('{CANARY}','w')", "().__class__.__base__.__subclasses__()", "9**9**9**9",
    "X1+__import__('sly').x", "[x for x in range(10**9)]", "factorial(10**6)",
    "(" * 30 + "X1" + ")" * 30, "'a'*10**9", "X1;import os", "\x1b[2J", "",
)  # fmt: skip


def signals(conversion=None):
    """Signals of a measurement, the first with a conversion."""
    import asammdf

    return [
        asammdf.Signal(20.0 + np.sin(TIME), TIME, name="v", unit="m/s", conversion=conversion),
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
            write_mdf(
                folder / "files" / f"{name}_{number}",
                {"Only": signals(conversion)},
                version,
                **options,
            )


def _overwrite_formula(content, rng):
    """Replace the formula of a conversion by hostile text of the same length."""
    text = rng.choice(PAYLOADS).encode()[: len(FORMULA)]
    return content.replace(FORMULA.encode(), text.ljust(len(FORMULA), rng.choice([b" ", b"\0"])))


@generator("mdf", weight=12)
def measurement(case):
    """A damaged measurement."""
    case.copy("mdf/conf", "conf")
    kind = case.idea(2)
    name = f"{case.rng.choice(list(VERSIONS))}_{4 if kind == 0 else case.rng.randrange(4)}"
    file = case.write(
        f"raw/drive.{'mdf' if name.startswith('v3') else 'mf4'}",
        (case.templates / "mdf" / "files" / name).read_bytes(),
    )
    case.spoil(file, (_overwrite_formula, spoil_bytes)[kind])
    return Command(
        case.rng.choice(
            [("data", "check", "measured"), ("data", "show", "measured"), ("ingest", "measured")]
        )
    )
