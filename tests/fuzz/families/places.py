"""Names of files, special files, links, and where outcomes are written to."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from fuzz.case import Case, Command, generator
from fuzz.honest import KSNN

NAMES: tuple[bytes, ...] = (
    b"\xff\xfe.csv",
    b"lap\xe4.csv",
    b"a\nb.csv",
    b"\x1b[2J.csv",
    b" .csv",
    b"a b.csv",
    b"-x.csv",
    b"--out.csv",
    b"a=b.csv",
    b"~a.csv",
    b"a'b.csv",
    b'a"b.csv',
    b"[a].csv",
    b"*.csv",
    b"\xe2\x80\xaeevil.csv",
    b"x" * 200 + b".csv",
    b".csv",
    b".hidden.csv",
    b"LAP.CSV",
    b"lap.csv.csv",
    b"lap.",
    b"lap",
    b"lap.csv ",
    b"$(touch EXECUTED).csv",
    b"a;touch EXECUTED.csv",
    b"<b>.csv",
    b"[red]a[blue].csv",
    b"null.csv",
    b"${root}.csv",
)


def _reads(case: Case, name: bytes) -> tuple[bytes | str, ...]:
    how = case.rng.randrange(5)
    if how <= 2:
        return ("estimate", name, "-o", "out.csv")
    return ("data", "check" if how == 3 else "show", name)


@generator("drives", weight=3)
def names_of_files(case: Case) -> Command:
    case.copy("drives")
    if case.honest:
        return Command(_reads(case, b"lap.csv"), targets=("out.csv",))
    name = NAMES[case.visit % len(NAMES)]
    os.rename(case.place / "lap.csv", os.fsencode(case.place) + b"/" + name)
    return Command(_reads(case, b"./" + name if case.rng.random() < 0.3 else name), targets=("out.csv",))


@generator("drives", weight=2)
def names_in_a_data_set(case: Case) -> Command:
    """Files whose names become recordings' ids and names of files in the store."""
    case.copy("drives")
    if not case.honest:
        os.rename(case.place / "raw" / "three.csv", os.fsencode(case.place / "raw") + b"/" + NAMES[case.visit % len(NAMES)])
    return Command(case.rng.choice([("ingest", "mine"), ("data", "check", "mine"), ("downsample", "mine", "rate_hz=20")]))


def _special(folder: Path, how: int) -> Path:
    """Something that is no file, or none that ends."""
    path = folder / "special.csv"
    if how == 0:
        os.mkfifo(path)
    elif how == 1:
        path.symlink_to("/dev/zero")
    elif how == 2:
        path.symlink_to("/dev/null")
    elif how == 3:
        path.symlink_to(path.name)
    elif how == 4:
        path.symlink_to("gone.csv")
    elif how == 5:
        path.mkdir()
    elif how == 6:
        made, here = socket.socket(socket.AF_UNIX), os.getcwd()
        os.chdir(folder)  # a socket's path must be short
        made.bind(path.name)
        os.chdir(here)
        made.close()
    elif how == 7:
        path.symlink_to("/dev/full")
    elif how == 8:
        path.symlink_to("/proc/self/mem")
    elif how == 9:
        path.symlink_to("/dev/stdin")
    elif how == 10:
        path.symlink_to("/proc/self/environ")
    elif how == 11:
        with open(path, "wb") as stream:
            stream.truncate(3 * 2**40)
    elif how == 12:
        with open(path, "wb") as stream:
            stream.truncate(2**31)
    else:
        path.symlink_to("/dev/urandom")
    return path


@generator("drives", weight=4)
def special_files(case: Case) -> Command:
    case.copy("drives")
    if case.honest:
        os.link(case.place / "lap.csv", case.place / "special.csv")
        return Command(_reads(case, b"special.csv"), targets=("out.csv",))
    how = case.visit % 14
    path = _special(case.place, how)
    if case.rng.random() < 0.4:
        path = path.rename(path.with_suffix(".parquet"))
    return Command(_reads(case, os.fsencode(path.name)), targets=("out.csv",))


@generator("drives", weight=2)
def special_files_in_a_data_set(case: Case) -> Command:
    case.copy("drives")
    if not case.honest:
        (case.place / "raw" / "three.csv").unlink()
        path = _special(case.place / "raw", case.visit % 14)
        path.rename(path.with_name("three.csv")) if case.rng.random() < 0.7 else None
    return Command(case.rng.choice([("ingest", "mine"), ("data", "check", "mine"), ("data", "show", "mine")]))


TARGETS = (
    "/dev/full", "/dev/null", "/dev/stdout", "out", "out.txt", "out.csv/", "raw", "raw/one.csv/x.csv", "", ".", "..", "/",
    "x" * 300 + ".csv", "loop.csv", "pipe.csv", "zero.csv", "full.csv", "full.parquet", "lap.csv", "./lap.csv", "link.csv",
    "a\nb.csv", "deep/er/out.csv", "/proc/x.csv", "-.csv",
)  # fmt: skip


@generator("study", weight=3)
def targets(case: Case) -> Command:
    """Where an estimate is written to."""
    case.copy("study")
    place = case.place
    out = "out.csv" if case.honest else str(case.idea(*TARGETS))
    (place / "loop.csv").symlink_to("loop.csv")
    os.mkfifo(place / "pipe.csv")
    (place / "zero.csv").symlink_to("/dev/zero")
    (place / "full.csv").symlink_to("/dev/full")
    (place / "full.parquet").symlink_to("/dev/full")
    (place / "link.csv").symlink_to("lap.csv")
    model = () if case.rng.random() < 0.5 else ("ksnn",)
    return Command(
        ("estimate", *model, "lap.csv", "--out", out),
        targets=("out.csv", "deep", "a\nb.csv", "-.csv", "loop.csv", "pipe.csv", "zero.csv", "full.csv", "full.parquet", "link.csv"),
    )


@generator("study", weight=2)
def streams(case: Case) -> Command:
    """Standard output that takes nothing."""
    case.copy("study")
    commands = [
        ("data", "channels"),
        ("config", "train"),
        ("data", "show", "lap.csv"),
        ("data", "show", "lap.csv", "--json"),
    ]
    commands += [
        ("--help",),
        ("train", "--help"),
        ("--version",),
        ("estimate", "lap.csv", "-o", "out.csv"),
        ("data", "align", "lap.csv", "-e", "offsets"),
    ]
    command = case.rng.choice(commands)
    return Command(command, targets=("out.csv",), stdout=None if case.honest else "/dev/full")


@generator("study", weight=2)
def environments(case: Case) -> Command:
    """Variables that vehest reads, with values that make no sense."""
    case.copy("study")
    variable = case.rng.choice(
        ["VEHEST_DATA", "VEHEST_OUTPUT", "MLFLOW_TRACKING_URI", "HOME", "COLUMNS", "TMPDIR", "VEHEST_DEBUG_X", "LANG", "TERM"]
    )
    value = case.rng.choice(
        [
            "",
            "/dev/null",
            "/nothing",
            "raw/one.csv",
            "\udcff\udcfe",
            "${root}",
            "a\nb",
            "x" * 5000,
            "-1",
            "null",
            "[1]",
            "{",
            "http://[",
            "file:///evil",
            "sqlite:////dev/full",
        ]
    )
    command = case.rng.choice([("ingest", "mine"), ("data", "show", "mine"), ("train", *KSNN, "--dry-run"), ("data", "channels")])
    if variable == "MLFLOW_TRACKING_URI":
        command = ("config", "train")
    if variable == "VEHEST_OUTPUT" and value == "/nothing":  # told to write there, it would, and nobody could call that wrong
        value = "nothing"
    return Command(
        command,
        environment={} if case.honest else {variable: value},
        targets=() if case.honest or variable != "VEHEST_OUTPUT" else ("file:" if value.startswith("file:") else value.strip("/") or ".",),
    )
