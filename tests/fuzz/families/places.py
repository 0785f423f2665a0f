"""Names of files that are read, and a pipe, a folder or a link in their place."""

import os

from fuzz.case import Command, generator

NAMES = (
    b"\xff\xfe.csv", b"lap\xe4.csv", b"a\nb.csv", b"\x1b[2J.csv", b" .csv", b"a b.csv", b"-x.csv",
    b"--out.csv", b"a=b.csv", b"~a.csv", b"a'b.csv", b'a"b.csv', b"[a].csv", b"*.csv",
    b"\xe2\x80\xaeevil.csv", b"x" * 200 + b".csv", b".csv", b".hidden.csv", b"LAP.CSV",
    b"lap.csv.csv", b"lap.", b"lap", b"lap.csv ", b"$(touch EXECUTED).csv", b"a;touch EXECUTED.csv",
    b"<b>.csv", b"[red]a[blue].csv", b"null.csv", b"${root}.csv",
)  # fmt: skip


@generator("drives", weight=8)
def files(case):
    """Names of files that are read, alone or in a data set, where they become recordings' ids."""
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
        special = file.with_name("special.csv")
        makers = [
            lambda: os.mkfifo(special),
            special.mkdir,
            lambda: special.symlink_to("/dev/zero"),
            lambda: special.symlink_to("gone"),
        ]
        makers[case.visit // 2 % len(makers)]()
    name = b"./" + name if case.rng.random() < 0.2 else name
    lone = [("estimate", name, "-o", "out.csv"), ("data", "check", name), ("data", "show", name)]
    of_a_set = [("ingest", "mine"), ("data", "check", "mine"), ("data", "show", "mine")]
    return Command(case.rng.choice(lone if alone else of_a_set))
