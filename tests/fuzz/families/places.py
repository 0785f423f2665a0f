"""Names of files that are read, and special files and links in their place."""

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
