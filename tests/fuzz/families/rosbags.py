"""ROS 2 bags: damaged databases, messages that lie about their lengths, metadata.yaml, layouts of messages; zip archives of bags."""

from __future__ import annotations

import os
import sqlite3
import stat
import zipfile
from contextlib import suppress
from pathlib import Path

import yaml

from fuzz.case import CANARY, Case, Command, generator, template
from fuzz.mutations import NAMES, spoil_bytes, spoil_yaml


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


@generator("bags", weight=5)
def files_of_a_bag(case: Case) -> Command:
    """Bytes of the database, of an mcap file, and what metadata.yaml says."""
    name = case.rng.choice(["lap.db3", "lap.mcap", "metadata.yaml"])
    file = _bag(case, "mcap" if name == "lap.mcap" else "sqlite3") / name
    if not case.honest:
        content = file.read_bytes()
        at = case.rng.choice([500, 5000, len(content)])
        spoilt = (
            spoil_yaml(yaml.safe_load(content), case.rng) if name == "metadata.yaml" else spoil_bytes(content[:at], case.rng) + content[at:]
        )
        file.write_bytes(spoilt)
    return _reads(case)


STATEMENTS = (
    "DROP TABLE messages",
    "DELETE FROM messages",
    "UPDATE topics SET type = '../../../evil'",
    "UPDATE topics SET name = char(27) || '[2J' || name",
    "UPDATE topics SET serialization_format = 'pickle'",
    "UPDATE topics SET id = 1",
    "UPDATE messages SET timestamp = -timestamp",
    "UPDATE messages SET timestamp = 9223372036854775807",
    "UPDATE messages SET timestamp = timestamp + 1000000000000000000 WHERE id % 97 = 0",
    "UPDATE messages SET data = zeroblob(100000000) WHERE id = 5",
    "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) "
    "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(100) AS data FROM c",
    "INSERT INTO messages SELECT id + 1000000, topic_id, timestamp, data FROM messages",
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


LAYOUTS = (
    "float64[1000000000] a",
    "MotorStamped again",
    f"float64 __import__('os').system('touch {CANARY}')",
    "float64 __class__\n",
    "evil[" * 1000,
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


@generator("bags", weight=3)
def archives(case: Case) -> Command:
    """Zip archives of bags: damaged bytes, names that climb out, links, entries twice, bombs."""
    bag = _bag(case)
    file, rng, how = case.place / "raw" / "lap.zip", case.rng, case.visit % 7
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in sorted(bag.iterdir()):
            archive.write(one, f"lap/{one.name}")
        if case.honest or how == 0:
            pass
        elif how == 1:
            for name in ("../../../evil", "/tmp/vehest-evil", "..\\..\\evil", "C:\\evil", "lap/../../evil"):
                archive.writestr(name, "evil")
        elif how in (2, 3):
            entry = zipfile.ZipInfo("lap/link")
            entry.external_attr = ((stat.S_IFLNK if how == 2 else stat.S_IFIFO) | 0o777) << 16
            archive.writestr(entry, str(case.folder / "elsewhere"))
        elif how == 4:
            with archive.open("lap/zeros.db3", "w", force_zip64=True) as stream:
                for _ in range(rng.choice([100, 700, 1500])):
                    stream.write(bytes(2**20))
        elif how == 5:
            for k in range(12_000):
                archive.writestr(f"lap/{k}", b"")
        else:
            archive.writestr("lap/lap.db3", "twice")
    os.rename(bag, case.folder / "bag")
    if not case.honest and how == 0:
        file.write_bytes(spoil_bytes(file.read_bytes(), rng))
    return _reads(case)
