"""The Revs database: official CSV and MAT files, a folder of text files, tables of vehicle parameters."""

import os
import struct
import zlib

import numpy as np

from fuzz.case import Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import spoil_bytes
from revs_files import smooth_drive, write_csv, write_mat, write_vehicle_parameters

NAME = "20140222_01_01_03_250lm"
TEXT = {"vx": "m/s", "yaw_rate": "rad/s", "ax": "m/s²", "ay": "m/s²", "steer": "rad", "vy_ref": "m/s"}
LINES = ("nan", "1e400", "a", "1 2", "\x1b[2J", "9" * 5000)


@template
def revs(folder):
    """A recording in both official layouts, its car's parameters, and a recording as text files."""
    files = folder / "raw" / "revs"
    (files / "lap").mkdir(parents=True)
    drive, truth = smooth_drive(3.0, start_time=12.5, decimals=6)
    write_csv(files / f"{NAME}.csv", drive)
    write_mat(files / f"{NAME}.mat", drive)
    write_mat(files / "plain.mat", drive, compressed=False)
    write_vehicle_parameters(files / "250lm.csv")
    time = 12.5 + np.arange(len(truth["vx"]) // 10) / 100
    for name, samples in {"t": time, **{name: truth[name][::10] for name in TEXT}}.items():
        np.savetxt(files / "lap" / f"{name}.txt", samples, fmt="%.6f")
    declared = {"name": "text", "kind": "real", "vehicle": "car", "licence": "none", "citation": "none", "source": "revs", "layout": "text"}
    declared |= {"path": "${root}/revs", "recordings": ["lap"], "time": {"column": "t", "unit": "s"}, "gappy": [], "clock": "strict"}
    channels = {name: {"column": name, "unit": unit} for name, unit in TEXT.items()}
    write_yaml(folder / "conf" / "dataset" / "text.yaml", declared | {"channels": channels})


def _element(kind, body):
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def _made_up_mat(_, rng):
    """Written by hand: a bomb, dimensions that multiply to more than there is, or thousands of elements."""
    flags, name = _element(6, struct.pack("<II", 6, 0)), _element(1, b"x")

    def matrix(rows, columns, data):
        return _element(14, flags + _element(5, struct.pack("<ii", rows, columns)) + name + _element(9, data))

    def bomb(megabytes):
        packer, size = zlib.compressobj(9), megabytes * 2**20
        begin = struct.pack("<II", 14, size + 56) + flags + _element(5, struct.pack("<ii", size // 8, 1)) + name
        begun = packer.compress(begin + struct.pack("<II", 9, size))
        return _element(15, begun + b"".join(packer.compress(bytes(2**20)) for _ in range(megabytes)) + packer.flush())

    ideas = [
        lambda: bomb(rng.choice([100, 600, 1500])),
        lambda: matrix(2**31 - 1, 2**31 - 1, bytes(8)),
        lambda: struct.pack("<II", 14, 0) * 500_000,
        lambda: matrix(1, 1, bytes(8)) * 30_000,
    ]
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + rng.choice(ideas)()


def _spoil_text_file(file, rng):
    lines = file.read_text().splitlines()
    ideas = [
        lambda: file.write_bytes(spoil_bytes(file.read_bytes(), rng)),
        lambda: file.write_text("\n".join([*lines, rng.choice(LINES)])),
        lambda: (file.unlink(), os.mkfifo(file)),
        lambda: (file.unlink(), file.symlink_to("/dev/zero")),
        lambda: file.write_text("\n".join([lines[0], str(float(lines[1]) + 1e9), *lines[2:]])),
        lambda: file.write_text("0\n" * 3_000_000),
    ]
    rng.choice(ideas)()


@generator("revs", weight=10)
def official_files(case):
    """The CSV, the MAT file, plain or packed, the table of vehicle parameters, and text files."""
    folder, (file, layout) = (
        case.copy("revs") / "raw" / "revs",
        case.rng.choice([("csv", "csv"), ("mat", "mat"), ("car", "csv"), ("", "text")]),
    )
    if case.rng.random() < 0.5:
        (folder / "plain.mat").replace(folder / f"{NAME}.mat")
    if layout == "text":
        if not case.honest:
            _spoil_text_file(folder / "lap" / f"{case.rng.choice(['t', 'vx', 'ay', 'vy_ref'])}.txt", case.rng)
    elif file == "mat" and case.rng.random() < 0.4:
        case.spoil(folder / f"{NAME}.mat", _made_up_mat)
    else:
        case.spoil(folder / ("250lm.csv" if file == "car" else f"{NAME}.{file}"), spoil_bytes)
    words = ("text",) if layout == "text" else ("revs_targa_2014", f"dataset.recordings=[{NAME}]", f"dataset.layout={layout}")
    return Command((*case.rng.choice([("data", "check"), ("ingest",)]), *words))
