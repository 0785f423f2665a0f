"""The Revs database: official CSV and MAT files, a folder of text files, tables of vehicle parameters."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np

from fuzz.case import Case, Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import spoil_bytes
from revs_files import smooth_drive, write_csv, write_mat, write_vehicle_parameters

NAME = "20140222_01_01_03_250lm"
SECONDS = 3.0
DATASET = f"dataset.recordings=[{NAME}]"


@template
def revs(folder: Path) -> None:
    """A recording in both official layouts, its car's parameters, and a recording as text files."""
    (folder / "raw" / "revs" / "lap").mkdir(parents=True)
    drive, truth = smooth_drive(SECONDS, start_time=12.5, decimals=6)
    write_csv(folder / "raw" / "revs" / f"{NAME}.csv", drive)
    write_mat(folder / "raw" / "revs" / f"{NAME}.mat", drive)
    write_mat(folder / "raw" / "revs" / "plain.mat", drive, compressed=False)
    write_vehicle_parameters(folder / "raw" / "revs" / "250lm.csv")
    time = 12.5 + np.arange(len(truth["vx"]) // 10) / 100
    for name, samples in {"t": time, **{name: truth[name][::10] for name in ("vx", "yaw_rate", "ax", "ay", "steer", "vy_ref")}}.items():
        np.savetxt(folder / "raw" / "revs" / "lap" / f"{name}.txt", samples, fmt="%.6f")
    declared = {"name": "text", "kind": "real", "vehicle": "car", "licence": "none", "citation": "none", "source": "revs", "layout": "text"}
    declared |= {"path": "${root}/revs", "recordings": ["lap"], "time": {"column": "t", "unit": "s"}, "gappy": [], "clock": "strict"}
    channels = {name: {"column": name, "unit": unit} for name, unit in TEXT.items()}
    write_yaml(folder / "conf" / "dataset" / "text.yaml", declared | {"channels": channels})


TEXT = {"vx": "m/s", "yaw_rate": "rad/s", "ax": "m/s²", "ay": "m/s²", "steer": "rad", "vy_ref": "m/s"}


def _ingest(case: Case, *overrides: str) -> Command:
    words = ("revs_targa_2014", DATASET, *overrides)
    return Command(("data", "check", *words) if case.rng.random() < 0.5 else ("ingest", *words))


def _csv(case: Case) -> Path:
    case.copy("revs")
    return case.place / "raw" / "revs" / f"{NAME}.csv"


@generator("revs", weight=6)
def bytes_of_files(case: Case) -> Command:
    """Bytes of the official CSV, of the MAT file, plain or packed, and of the vehicle's parameters."""
    file, layout = case.rng.choice([(_csv(case), "csv"), (_mat(case), "mat"), (_csv(case).with_name("250lm.csv"), "csv")])
    if not case.honest:
        content = file.read_bytes()
        at = case.rng.choice([len(content), 300, 2000])
        file.write_bytes(spoil_bytes(content[:at], case.rng) + content[at:])
    return _ingest(case, f"dataset.layout={layout}")


def _mat(case: Case) -> Path:
    case.copy("revs")
    file = case.place / "raw" / "revs" / f"{NAME}.mat"
    if case.rng.random() < 0.5:
        (case.place / "raw" / "revs" / "plain.mat").replace(file)
    return file


def _element(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


@generator("revs", weight=2)
def made_up_mat(case: Case) -> Command:
    """Files written by hand: bombs, dimensions that multiply to more than there is, thousands of elements."""
    file = _mat(case)
    if case.honest:
        return _ingest(case, "dataset.layout=mat")
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    flags = _element(6, struct.pack("<II", 6, 0))

    def matrix(rows: int, columns: int, data: bytes, name: bytes = b"x") -> bytes:
        return _element(14, flags + _element(5, struct.pack("<ii", rows, columns)) + _element(1, name) + _element(9, data))

    def bomb(megabytes: int) -> bytes:
        packer = zlib.compressobj(9)
        size = megabytes * 2**20
        head = struct.pack("<II", 14, size + 56) + flags + _element(5, struct.pack("<ii", size // 8, 1)) + _element(1, b"x")
        begun = packer.compress(head + struct.pack("<II", 9, size))
        short = begun + b"".join(packer.compress(bytes(2**20)) for _ in range(megabytes)) + packer.flush()
        return struct.pack("<II", 15, len(short)) + short

    ideas = [
        lambda: bomb(int(case.rng.choice([100, 600, 1500]))),
        lambda: matrix(2**31 - 1, 2**31 - 1, bytes(8)),
        lambda: struct.pack("<II", 14, 0) * 500_000,
        lambda: b"".join(matrix(1, 1, bytes(8), b"x%d" % k) for k in range(30_000)),
    ]
    file.write_bytes(head + ideas[case.visit % len(ideas)]())
    return _ingest(case, "dataset.layout=mat")


@generator("revs", weight=2)
def text_files(case: Case) -> Command:
    case.copy("revs")
    folder = case.place / "raw" / "revs" / "lap"
    file = folder / f"{case.rng.choice(['t', 'vx', 'ay', 'vy_ref'])}.txt"
    if not case.honest:
        lines, rng = file.read_text().splitlines(), case.rng
        ideas = [
            lambda: file.write_bytes(spoil_bytes(file.read_bytes(), rng)),
            lambda: file.write_text("\n".join([*lines, rng.choice(["nan", "1e400", "a", "1 2", "\x1b[2J", "9" * 5000])])),
            lambda: (file.unlink(), os.mkfifo(file)),
            lambda: (file.unlink(), file.symlink_to("/dev/zero")),
            lambda: file.write_text("\n".join([lines[0], str(float(lines[1]) + 1e9), *lines[2:]])),
            lambda: file.write_text("0\n" * 3_000_000),
        ]
        ideas[case.visit % len(ideas)]()
    return Command(("data", "check", "text") if case.rng.random() < 0.5 else ("ingest", "text"))
