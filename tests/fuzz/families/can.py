"""Logs of a bus and DBC files: bytes, lines, objects of no length, containers that unpack to much, messages of any size."""

from __future__ import annotations

from pathlib import Path

import yaml
from can_drive import DBC, SIGNALS, write_log

from conftest import planar_drive
from fuzz.case import Case, Command, generator, template
from fuzz.mutations import NAMES, spoil_bytes

CHANNELS = {name: SIGNALS[name] for name in ("vx", "yaw_rate", "ax", "ay")}
TOLD = "vx=Speed.VehSpd,yaw_rate=YawRate,ax=AccLong,ay=-AccLat"
SUFFIXES = (".asc", ".blf", ".log")


@template
def can(folder: Path) -> None:
    """A drive of ten seconds in every format."""
    for suffix in SUFFIXES:
        write_log(planar_drive(10.0, 100.0, seed=1), folder / suffix[1:], suffix, jitter=0.0005, lost=0.003)


def _place(case: Case) -> Path:
    suffix = str(case.idea(*SUFFIXES))
    case.copy(f"can/{suffix[1:]}", "raw")
    return case.place / "raw" / f"drive{suffix}"


def _reads(case: Case, log: Path) -> Command:
    described = {"name": "bus", "kind": "real", "vehicle": "car", "licence": "none", "citation": "none", "source": "can"}
    described |= {"path": "${root}", "files": "drive.*", "dbc": "${root}/car.dbc", "rate_hz": 100}
    case.write("conf/dataset/bus.yaml", yaml.safe_dump({**described, "channels": CHANNELS}, allow_unicode=True))
    how, file = case.rng.randrange(5), f"raw/{log.name}"
    if how < 2:
        words = ("replay", file, "--dbc", "raw/car.dbc", "--signals", TOLD, "--speed", "max", "--quiet", "--out", "out.csv")
        return Command(words, targets=("out.csv",))
    if how == 2:
        return Command(("estimate", "pretrained", file, "dataset=bus", "-o", "out.csv"), targets=("out.csv",))
    return Command(("ingest", "bus")) if how == 3 else Command(("data", "check", file, "dataset=bus"))


@generator("can", weight=3)
def bytes_of_a_log(case: Case) -> Command:
    """Bytes anywhere, lines of the text, its head, its end."""
    log = _place(case)
    if not case.honest:
        content = log.read_bytes()
        at = case.rng.choice([0, 0, 144, len(content) // 2])
        swaps = ((b"d 8", b"d 99"), (b"Rx", b"CANFD"), (b"120", b"zzz"), (b"#", b"##9"), (b".", b".e"), (b"\n", b"\r"), (b"0", b"9" * 400))
        if log.suffix != ".blf" and case.rng.random() < 0.5:
            content = content.replace(*case.rng.choice(swaps), case.rng.choice([1, 1, 5, -1]))
            log.write_bytes(content[: 4 * 2**20])
        else:
            log.write_bytes(content[:at] + spoil_bytes(content[at:], case.rng))
    return _reads(case, log)


LINES = (
    ("BO_ 288 IMU: 8", "BO_ 288 IMU: 4000000000"), ("BO_ 288 IMU: 8", "BO_ 288 IMU: 0"), ("BO_ 288", "BO_ 99999999999"),
    ("SG_ YawRate :", "SG_ YawRate m0 :"), ("SG_ YawRate :", "SG_ YawRate M :"), ("SG_ YawRate :", "SG_ " + "Y" * 500 + " :"),
)  # fmt: skip


@generator("can", weight=2)
def lines_of_a_dbc(case: Case) -> Command:
    """What a DBC says of messages, signals, multiplexers and numbers."""
    log = _place(case)
    if not case.honest:
        text = DBC
        if case.rng.random() < 0.6:
            text = text.replace(*LINES[case.visit % len(LINES)], case.rng.choice([1, -1]))
            content = text.encode("cp1252", errors="replace")
        elif case.rng.random() < 0.3:
            name = case.rng.choice(NAMES)
            content = text.replace("YawRate", name).encode("utf-8", "surrogatepass")
        else:
            content = spoil_bytes(text.encode("cp1252"), case.rng)
        case.write("raw/car.dbc", content)
    return _reads(case, log)
