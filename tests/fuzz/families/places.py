"""Names of files, special files, links, rights, streams, variables, and where outcomes are written to."""

import os
import socket

from fuzz.case import Command, generator

NAMES = (
    b"\xff\xfe.csv", b"lap\xe4.csv", b"a\nb.csv", b"\x1b[2J.csv", b" .csv", b"a b.csv", b"-x.csv", b"--out.csv", b"a=b.csv", b"~a.csv",
    b"a'b.csv", b'a"b.csv', b"[a].csv", b"*.csv", b"\xe2\x80\xaeevil.csv", b"x" * 200 + b".csv", b".csv", b".hidden.csv", b"LAP.CSV",
    b"lap.csv.csv", b"lap.", b"lap", b"lap.csv ", b"$(touch EXECUTED).csv", b"a;touch EXECUTED.csv", b"<b>.csv", b"[red]a[blue].csv",
    b"null.csv", b"${root}.csv",
)  # fmt: skip
LINKS = (*(f"/dev/{name}" for name in ("zero", "null", "full", "stdin", "urandom")), "/proc/self/mem", "/proc/self/environ")
LINKS += ("gone.csv", "special.csv")
TARGETS = (
    "/dev/full", "/dev/null", "/dev/stdout", "out", "out.txt", "out.csv/", "raw", "raw/one.csv/x.csv", "", ".", "..", "/",
    "x" * 300 + ".csv", "loop.csv", "pipe.csv", "zero.csv", "full.csv", "full.parquet", "lap.csv", "./lap.csv", "link.csv",
    "a\nb.csv", "deep/er/out.csv", "/proc/x.csv", "-.csv",
)  # fmt: skip
ROOTS = ("/dev/null", "/dev/full/x", "outputs/" + "x" * 300, "''", "null", "[1]", "outputs/\x01", "3", "/proc/x", "/dev/stdin")


def _bind(path):
    made, here = socket.socket(socket.AF_UNIX), os.getcwd()
    os.chdir(path.parent)  # a socket's path must be short
    made.bind(path.name)
    os.chdir(here)
    made.close()


def _special(case, folder):
    """Something that is no file, or none that ends."""
    path = folder / "special.csv"
    makers = [
        lambda: os.mkfifo(path),
        path.mkdir,
        lambda: _bind(path),
        lambda: (path.touch(), os.truncate(path, case.rng.choice([2**31, 3 * 2**40]))),
        *(lambda link=link: path.symlink_to(link) for link in LINKS),
    ]
    makers[case.visit // 2 % len(makers)]()
    return path


@generator("drives", weight=8)
def files(case):
    """Names of files that are read, alone or in a data set, where they become recordings' ids; special files in their place."""
    case.copy("drives")
    alone = case.visit // 8 % 2 == 0
    file = case.place / "lap.csv" if alone else case.place / "raw" / "three.csv"
    name = b"special.csv"
    if case.honest:
        file.rename(file.with_name("special.csv"))
    elif case.visit % 2:
        name = case.rng.choice(NAMES)
        os.rename(file, os.fsencode(file.parent) + b"/" + name)
    else:
        file.unlink()
        special = _special(case, file.parent)
        name = os.fsencode(special.rename(special.with_suffix(case.rng.choice([".csv", ".parquet"]))).name)
    name = b"./" + name if case.rng.random() < 0.2 else name
    lone = [("estimate", name, "-o", "out.csv"), ("data", "check", name), ("data", "show", name)]
    of_a_set = [("ingest", "mine"), ("data", "check", "mine"), ("data", "show", "mine")]
    return Command(case.rng.choice(lone if alone else of_a_set))


@generator("study", weight=4)
def targets(case):
    """Where an estimate is written to, the output root, and standard output that takes nothing."""
    case.copy("study")
    place = case.place
    how = case.idea(4)
    if how == 0:
        return Command(("ingest", "mine", f"output={case.rng.choice(ROOTS)}"))
    if how == 1:
        commands = [("data", "channels"), ("config", "train"), ("data", "show", "lap.csv", "--json"), ("--help",), ("train", "--help")]
        commands += [("--version",), ("estimate", "lap.csv", "-o", "out.csv"), ("data", "align", "lap.csv", "-e", "offsets")]
        return Command(case.rng.choice(commands), stdout="/dev/full")
    links = {"loop.csv": "loop.csv", "zero.csv": "/dev/zero", "full.csv": "/dev/full", "full.parquet": "/dev/full", "link.csv": "lap.csv"}
    for name, target in links.items():
        (place / name).symlink_to(target)
    os.mkfifo(place / "pipe.csv")
    out = "out.csv" if case.honest else case.rng.choice(TARGETS)
    named = ("out.csv", "deep", "a\nb.csv", "-.csv", "pipe.csv", *links)
    return Command(("estimate", *case.rng.choice([(), ("ksnn",)]), "lap.csv", "--out", out), targets=named)


@generator("drives")
def rights(case):
    """Folders and files that may not be read or written."""
    case.copy("drives")
    (case.place / "outputs").mkdir()
    if not case.honest:
        what = case.rng.choice(["outputs", "raw/one.csv", "raw", "conf", "conf/dataset/mine.yaml", "conf/dataset", "pipelines"])
        os.chmod(case.place / what, case.rng.choice([0o000, 0o000, 0o444]))
    commands = [("ingest", "mine"), ("data", "check", "mine"), ("data", "show", "mine"), ("run", "small", "--dry-run", "tracking=none")]
    return Command(case.rng.choice(commands), unprivileged=True)
