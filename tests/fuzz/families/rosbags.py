"""ROS 2 bags: damaged databases, messages that lie about their lengths, metadata.yaml, layouts of messages; zip archives of bags."""

from __future__ import annotations

import os
import sqlite3
import stat
import struct
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from fuzz.case import CANARY, Case, Command, generator, template
from fuzz.mutations import NAMES, spoil_bytes, spoil_tree, spoil_yaml


@template
def bags(folder: Path) -> None:
    """A bag on sqlite, one on mcap, and the data set that reads them."""
    from test_sources_rosbag import configuration, drive, write_bag

    (folder / "raw").mkdir()
    write_bag(folder / "files", drive(2.0), "sqlite3", name="lap")
    write_bag(folder / "files" / "mcap", drive(2.0), "mcap", name="lap")
    (folder / "conf" / "dataset").mkdir(parents=True)
    declared = configuration(Path("x")) | {"path": "${root}", "licence": "none", "citation": "none", "kind": "real", "accept": []}
    (folder / "conf" / "dataset" / "mine.yaml").write_text(yaml.safe_dump(declared, allow_unicode=True), encoding="utf-8")


def _bag(case: Case, storage: str = "sqlite3") -> Path:
    case.copy("bags/conf", "conf")
    case.copy("bags/files/lap" if storage == "sqlite3" else "bags/files/mcap/lap", "raw/lap")
    return case.place / "raw" / "lap"


def _reads(case: Case, *overrides: str) -> Command:
    return Command(
        ("data", str(case.idea("check", "show")), "mine", *overrides) if case.rng.random() < 0.6 else ("ingest", "mine", *overrides)
    )


@generator("bags", weight=3)
def bytes_of_a_database(case: Case) -> Command:
    file = _bag(case) / "lap.db3"
    if not case.honest:
        content = file.read_bytes()
        at = case.rng.choice([100, 4096, len(content)])
        file.write_bytes(spoil_bytes(content[:at], case.rng) + content[at:])
    return _reads(case)


@generator("bags", weight=2)
def bytes_of_mcap(case: Case) -> Command:
    file = _bag(case, "mcap") / "lap.mcap"
    if not case.honest:
        content = file.read_bytes()
        at = case.rng.choice([500, 5000, len(content)])
        file.write_bytes(spoil_bytes(content[:at], case.rng) + content[at:])
    return _reads(case)


STATEMENTS = (
    "DROP TABLE messages",
    "DROP TABLE topics",
    "DELETE FROM messages",
    "DELETE FROM topics",
    "UPDATE topics SET type = '../../../evil'",
    "UPDATE topics SET type = 'os/msg/system'",
    "UPDATE topics SET type = NULL",
    "UPDATE topics SET name = char(27) || '[2J' || name",
    "UPDATE topics SET name = 'x'",
    "UPDATE topics SET serialization_format = 'pickle'",
    "UPDATE topics SET offered_qos_profiles = '[[[[[[[['",
    "UPDATE topics SET id = 1",
    "UPDATE topics SET id = 'a'",
    "UPDATE messages SET topic_id = 77",
    "UPDATE messages SET timestamp = 0",
    "UPDATE messages SET timestamp = -timestamp",
    "UPDATE messages SET timestamp = 'now'",
    "UPDATE messages SET timestamp = 9223372036854775807",
    "UPDATE messages SET timestamp = timestamp + 1000000000000000000 WHERE id % 97 = 0",
    "UPDATE messages SET data = NULL",
    "UPDATE messages SET data = 'text'",
    "UPDATE messages SET data = zeroblob(3)",
    "UPDATE messages SET data = zeroblob(100000000) WHERE id = 5",
    "UPDATE messages SET data = 7",
    "ALTER TABLE messages RENAME COLUMN data TO date",
    "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) "
    "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(100) AS data FROM c",
    "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END",
    "INSERT INTO messages SELECT id + 1000000, topic_id, timestamp, data FROM messages",
    "PRAGMA user_version = 99",
)


@generator("bags", weight=3)
def statements(case: Case) -> Command:
    """The database is sound and holds something else than messages."""
    bag = _bag(case)
    if not case.honest:
        connection = sqlite3.connect(bag / "lap.db3")
        with suppress(sqlite3.IntegrityError):
            connection.executescript(STATEMENTS[case.visit % len(STATEMENTS)])
        connection.commit()
        connection.close()
    return _reads(case)


@generator("bags", weight=3)
def messages(case: Case) -> Command:
    """Serialised messages whose lengths, numbers or stamps lie."""
    bag = _bag(case)
    if not case.honest:
        connection, rng = sqlite3.connect(bag / "lap.db3"), case.rng
        topics = [row[0] for row in connection.execute("SELECT id FROM topics")]
        topic = rng.choice(topics)
        rows = connection.execute("SELECT id, data FROM messages WHERE topic_id = ?", (topic,)).fetchall()
        for number, data in rows if rng.random() < 0.3 else [rng.choice(rows)]:
            spoilt = bytearray(data)
            how = rng.randrange(6)
            if how == 0:
                at = rng.randrange(4, max(5, len(spoilt) - 4)) // 4 * 4
                struct.pack_into("<I", spoilt, min(at, len(spoilt) - 4), rng.choice([0, 2**31 - 1, 2**32 - 1, 2**30, 1_000_000]))
            elif how == 1:
                spoilt = bytearray(spoil_bytes(bytes(spoilt), rng))
            elif how == 2:
                spoilt[:4] = rng.choice([b"\0\0\0\0", b"\0\2\0\0", b"\xff\xff\xff\xff", b"\0\3\0\0"])
            elif how == 3:
                spoilt = spoilt[: rng.randrange(len(spoilt))]
            elif how == 4:
                at = max(4, len(spoilt) - 8)
                spoilt[at:] = struct.pack("<d", rng.choice([float("nan"), float("inf"), 1e308, -1e300]))
            else:
                spoilt += bytes(1_000_000)
            connection.execute("UPDATE messages SET data = ? WHERE id = ?", (bytes(spoilt), number))
        connection.commit()
        connection.close()
    return _reads(case)


@generator("bags", weight=3)
def metadata(case: Case) -> Command:
    bag = _bag(case, case.rng.choice(["sqlite3", "mcap"]))
    file = bag / "metadata.yaml"
    if not case.honest:
        file.write_bytes(spoil_yaml(yaml.safe_load(file.read_text()), case.rng))
    return _reads(case)


@generator("bags", weight=3)
def declarations(case: Case) -> Command:
    """The data set that says how the bag is read."""
    _bag(case)
    file = case.place / "conf" / "dataset" / "mine.yaml"
    if not case.honest:
        tree = yaml.safe_load(file.read_text())
        part = case.rng.choice(["topics", "channels", "pose", "messages", None])
        spoilt = spoil_tree(tree, case.rng) if part is None else tree | {part: spoil_tree(tree[part], case.rng)}
        file.write_text(yaml.safe_dump(spoilt, allow_unicode=True), encoding="utf-8", errors="replace")
    return _reads(case)


LAYOUTS = (
    "float64",
    "float64 a b c",
    "",
    "\x00",
    "float64[1000000000] a",
    "float64[] a\nstring b\n",
    "car_msgs/Motor again",
    "MotorStamped again",
    f"float64 __import__('os').system('touch {CANARY}')",
    f"float64 a = __import__('os').system('touch {CANARY}')",
    "float64 class\nfloat64 def\n",
    "float64 __class__\n",
    "float64 a\nfloat64 a\n",
    "evil[" * 1000,
    "int32 X=" + "9" * 10_000,
    "string<=5 a\nwstring b\n",
    "# " + "x" * 1_000_000,
    "float64 a\n" * 3000,
    "../../evil a",
    "float64 a); import os; os.system('touch EXECUTED'); (",
    "string a \"\\n__import__('os').system('touch EXECUTED')\"",
)


@generator("bags", weight=2)
def layouts(case: Case) -> Command:
    """Definitions of messages, which the library turns into Python code."""
    _bag(case)
    file = case.place / "conf" / "dataset" / "mine.yaml"
    if not case.honest:
        tree = yaml.safe_load(file.read_text())
        text = LAYOUTS[case.visit % len(LAYOUTS)]
        if case.rng.random() < 0.7:
            tree["messages"][case.rng.choice(list(tree["messages"]))] = text
        else:
            tree["messages"][case.rng.choice([*NAMES, "os/msg/system", "a", "a/b", "a/msg/b\nfloat64 x", "std_msgs/msg/Header"])] = text
        file.write_bytes(yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "replace"))
    return _reads(case)


def _zip(bag: Path, file: Path) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in sorted(bag.iterdir()):
            archive.write(one, f"lap/{one.name}")


@generator("bags", weight=3)
def archives(case: Case) -> Command:
    """Zip archives of bags: names that climb out, links, entries twice, bombs."""
    bag = _bag(case)
    file = case.place / "raw" / "lap.zip"
    _zip(bag, file)
    os.rename(bag, case.folder / "bag")
    if not case.honest:
        _spoil_archive(case, file, case.folder / "bag")
    return _reads(case)


def _spoil_archive(case: Case, file: Path, bag: Path) -> None:
    rng, how = case.rng, case.visit % 12
    if how == 0:
        file.write_bytes(spoil_bytes(file.read_bytes(), rng))
        return
    whole = file.read_bytes()
    with zipfile.ZipFile(file, "w" if how in (1, 2) else "a", zipfile.ZIP_DEFLATED) as archive:
        if how == 1:
            archive.writestr("readme.txt", "nothing")
        elif how == 3:
            for name in ("../../../evil", "/tmp/vehest-evil", "..\\..\\evil", "C:\\evil", "lap/../../evil"):
                archive.writestr(name, "evil")
        elif how == 4:
            entry = zipfile.ZipInfo("lap/link")
            entry.external_attr = (stat.S_IFLNK | 0o777) << 16
            archive.writestr(entry, str(case.folder / "elsewhere"))
        elif how == 5:
            with archive.open("lap/zeros.db3", "w", force_zip64=True) as stream:
                for _ in range(rng.choice([100, 700, 1500])):
                    stream.write(bytes(2**20))
        elif how == 6:
            archive.writestr("lap/lap.db3", "twice")
        elif how == 7:
            for k in range(12_000):
                archive.writestr(f"lap/{k}", b"")
        elif how == 8:
            archive.writestr(rng.choice(NAMES).replace("\ud8ff", "").replace("\0", "") or "x", "name")
        elif how == 9:
            archive.writestr("lap/inner.zip", whole)
        elif how == 10:
            entry = zipfile.ZipInfo("lap/fifo")
            entry.external_attr = (stat.S_IFIFO | 0o666) << 16
            archive.writestr(entry, "")
        elif how == 11:
            archive.writestr("/".join(["d"] * 1500) + "/x", "deep")
    if how == 2 or (how == 11 and rng.random() < 0.5):  # the directory says other sizes than the entries have
        _zip(bag, file)
        content = bytearray(file.read_bytes())
        at = content.rfind(b"PK\x01\x02")
        struct.pack_into("<I", content, at + rng.choice([16, 20, 24, 42]), rng.choice([0, 1, 2**31, 2**32 - 1]))
        file.write_bytes(content)


@generator("bags", weight=2)
def what_stands_for_a_bag(case: Case) -> Command:
    bag = _bag(case)
    data, how = bag / "lap.db3", case.visit % 10
    if not case.honest:
        if how == 0:
            data.unlink()
            os.mkfifo(data)
        elif how == 1:
            data.unlink()
            data.symlink_to("/dev/zero")
        elif how == 2:
            (bag / "metadata.yaml").unlink()
            os.mkfifo(bag / "metadata.yaml")
        elif how == 3:
            (bag / "metadata.yaml").unlink()
            (bag / "metadata.yaml").symlink_to("/dev/zero")
        elif how == 4:
            (bag / "lap.db3-wal").write_bytes(os.urandom(0) + bytes(100))
            (bag / "lap.db3-journal").write_bytes(bytes(100))
        elif how == 5:
            data.unlink()
            data.mkdir()
        elif how == 6:
            os.rename(bag, bag.with_name("lap\x1b[2J"))
        elif how == 7:
            os.rename(bag, os.fsencode(bag.parent) + b"/lap\xff\xfe")
        elif how == 8:
            (bag / "lap.db3").symlink_to("lap.db3") if not data.exists() else data.rename(bag / "other.db3")
        else:
            (bag / "extra").symlink_to("..")
    options: list[Any] = [
        [],
        ["dataset.start=1e18"],
        ["dataset.rate_hz=1e9"],
        ["dataset.stop=-1"],
        ["dataset.start=nan"],
        ["+dataset.unpacked_limit=1e400"],
    ]
    return _reads(case, *([] if case.honest else case.rng.choice(options)))
