"""The Revs database: official CSV files, a folder of text files, tables of vehicle parameters."""

import numpy as np

from fuzz.case import Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import spoil_bytes
from revs_files import smooth_drive, write_csv, write_vehicle_parameters

NAME = "20140222_01_01_03_250lm"
TEXT = {
    "vx": "m/s",
    "yaw_rate": "rad/s",
    "ax": "m/s²",
    "ay": "m/s²",
    "steer": "rad",
    "vy_ref": "m/s",
}


@template
def revs(folder):
    """A recording in the official layout, its car's parameters, and a recording as text files."""
    files = folder / "raw" / "revs"
    (files / "lap").mkdir(parents=True)
    drive, truth = smooth_drive(3.0, start_time=12.5, decimals=6)
    write_csv(files / f"{NAME}.csv", drive)
    write_vehicle_parameters(files / "250lm.csv")
    time = 12.5 + np.arange(len(truth["vx"]) // 10) / 100
    for name, samples in {"t": time, **{name: truth[name][::10] for name in TEXT}}.items():
        np.savetxt(files / "lap" / f"{name}.txt", samples, fmt="%.6f")
    declared = {
        "name": "text",
        "kind": "real",
        "vehicle": "car",
        "licence": "none",
        "citation": "none",
        "source": "revs",
        "layout": "text",
    }
    declared |= {
        "path": "${root}/revs",
        "recordings": ["lap"],
        "time": {"column": "t", "unit": "s"},
        "gappy": [],
        "clock": "strict",
    }
    channels = {name: {"column": name, "unit": unit} for name, unit in TEXT.items()}
    write_yaml(folder / "conf" / "dataset" / "text.yaml", declared | {"channels": channels})


@generator("revs", weight=10)
def official_files(case):
    """The CSV, the table of vehicle parameters, and text files."""
    folder = case.copy("revs") / "raw" / "revs"
    files = {f"{NAME}.csv": "csv", "250lm.csv": "csv", "lap/vx.txt": "text", "lap/t.txt": "text"}
    file, layout = case.rng.choice(list(files.items()))
    case.spoil(folder / file, spoil_bytes)
    words = ("text",) if layout == "text" else ("revs_targa_2014", f"dataset.recordings=[{NAME}]")
    return Command((*case.rng.choice([("data", "check"), ("ingest",)]), *words))
