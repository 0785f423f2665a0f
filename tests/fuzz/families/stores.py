"""What vehest keeps beside its artefacts: the record of checksums of downloads, the local MLflow store."""

from __future__ import annotations

import hashlib
import os
import sqlite3
from contextlib import suppress
from pathlib import Path

from fuzz.case import Case, Command, generator, template
from fuzz.honest import KSNN, drives, run, write_yaml
from fuzz.mutations import NAMES, spoil_bytes, spoil_text, spoil_tree
from place import DATASET

TRACKED = tuple(word for word in KSNN if not word.startswith("tracking"))


@generator("drives", weight=2)
def downloads(case: Case) -> Command:
    """All files are there already; what is declared about them, and the record of their checksums, is spoilt. Nothing is fetched."""
    case.copy("drives")
    raw = case.place / "raw"
    sums = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(raw.iterdir())}
    declared = {"url": "https://example.org/folder", "files": list(sums), "sha256": dict(sums)}
    record = "".join(f"{name} {digest}\n" for name, digest in sums.items())
    if not case.honest:
        how = case.rng.randrange(5)
        if how == 0:
            record = spoil_text(record, case.rng).decode("utf-8", "surrogateescape")
        elif how == 1:
            declared["files"] = [case.rng.choice(NAMES).replace("\ud8ff", "")]
        elif how == 2:
            declared["url"] = case.rng.choice(["file:///etc", "ftp://x", "", "http://", "https://[", "x" * 9999, "https://\x1b[2J"])
        elif how == 3:
            spoilt = spoil_tree(declared, case.rng)
            declared = (
                spoilt if isinstance(spoilt, dict) and "files" in spoilt and str(spoilt.get("files")) == str(declared["files"]) else {}
            )
        else:
            record += f"{case.rng.choice(NAMES)} {case.rng.choice(['0' * 64, 'x', '', '0' * 64 + ' 1'])}\n"
    (raw / "checksums.txt").write_bytes(record.encode("utf-8", "surrogateescape") if "\ud8ff" not in record else b"\xed\xa0\x80 x\n")
    with suppress(UnicodeEncodeError):
        write_yaml(case.place / "conf" / "dataset" / "mine.yaml", DATASET | {"download": declared})
    return Command(("ingest", "mine", "--download"), targets=("raw/checksums.txt", "raw/.download"))


@template
def tracked(folder: Path) -> None:
    """A training and its evaluation, logged in a local store."""
    drives(folder)
    run("train", *TRACKED, "--quiet")
    run("eval", *TRACKED, "--quiet")


STATEMENTS = (
    "DELETE FROM experiments",
    "DROP TABLE runs",
    "UPDATE alembic_version SET version_num = 'x'",
    "DROP TABLE alembic_version",
)


@generator("tracked", weight=2)
def tracking_stores(case: Case) -> Command:
    """The store is damaged, or something else stands in its place: work goes on without it and says so."""
    case.copy("tracked")
    store, how = case.place / "outputs" / "mlflow.db", case.visit % 10
    if not case.honest:
        if how <= 2:
            content = store.read_bytes()
            store.write_bytes(spoil_bytes(content[: case.rng.choice([100, 5000, len(content)])], case.rng))
        elif how == 3:
            store.write_bytes(b"")
        elif how == 4:
            store.write_text("no database")
        elif how == 5:
            store.unlink()
            store.mkdir()
        elif how == 6:
            store.unlink()
            os.mkfifo(store)
        elif how == 7:
            store.unlink()
            store.symlink_to("/dev/zero")
        else:
            connection = sqlite3.connect(store)
            connection.executescript(case.rng.choice(STATEMENTS))
            connection.close()
    return Command(("eval", *TRACKED, "--force"))
