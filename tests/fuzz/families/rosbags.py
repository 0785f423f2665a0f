"""ROS 2 bags: damaged databases, messages that lie about their lengths, metadata.yaml, layouts of messages; zip archives of bags."""

import shutil
import sqlite3
import stat
import zipfile
from contextlib import suppress
from pathlib import Path

import yaml

from fuzz.case import Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import CALL, NAMES, spoil_bytes, spoil_yaml, yaml_of

STATEMENTS = (
    *("DROP TABLE messages", "DELETE FROM messages"),
    "UPDATE topics SET type = '../../../evil'",
    "UPDATE topics SET name = char(27) || '[2J' || name",
    "UPDATE topics SET serialization_format = 'pickle'",
    *("UPDATE topics SET id = 1", "UPDATE messages SET timestamp = -timestamp"),
    "UPDATE messages SET timestamp = 9223372036854775807",
    "UPDATE messages SET timestamp = timestamp + 1000000000000000000 WHERE id % 97 = 0",
    "UPDATE messages SET data = zeroblob(100000000) WHERE id = 5",
    "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE c(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM c) "
    "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(100) AS data FROM c",
    "INSERT INTO messages SELECT id + 1000000, topic_id, timestamp, data FROM messages",
)
LAYOUTS = (
    "float64[1000000000] a",
    "MotorStamped again",
    f"float64 {CALL}",
    "float64 __class__\n",
    "evil[" * 1000,
    "float64 a); import os; os.system('touch EXECUTED'); (",
    f'string a "\\n{CALL}"',
)
TYPES = (*NAMES, "os/msg/system", "a", "a/b", "a/msg/b\nfloat64 x", "std_msgs/msg/Header")


@template
def bags(folder):
    """A bag on sqlite, one on mcap, and the data set that reads them."""
    from test_sources_rosbag import configuration, drive, write_bag

    for storage in ("sqlite3", "mcap"):
        write_bag(folder / storage, drive(2.0), storage, name="lap")
    declared = configuration(Path("x")) | {"path": "${root}", "licence": "none", "citation": "none", "kind": "real", "accept": []}
    write_yaml(folder / "conf" / "dataset" / "mine.yaml", declared)


def _state(database, case):
    """The database is sound and holds something else than messages."""
    connection = sqlite3.connect(database)
    with suppress(sqlite3.IntegrityError):
        connection.executescript(case.rng.choice(STATEMENTS))
    connection.commit()
    connection.close()


def _spoil_layout(content, case):
    """Definitions of messages, which the library turns into Python code."""
    tree = yaml.safe_load(content)
    tree["messages"][case.rng.choice([*tree["messages"], case.rng.choice(TYPES)])] = case.rng.choice(LAYOUTS)
    return yaml_of(tree).encode("utf-8", "replace")


def _archive(case, bag, how):
    """Pack the bag's folder: damaged bytes, names that climb out, links, bombs, entries twice."""
    file = case.place / "raw" / "lap.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in sorted(bag.iterdir()):
            archive.write(one, f"lap/{one.name}")
        if how == 1:
            for name in ("../../../evil", "/tmp/vehest-evil", "..\\..\\evil", "C:\\evil", "lap/../../evil"):
                archive.writestr(name, "evil")
        elif how in (2, 3):
            entry = zipfile.ZipInfo("lap/link")
            entry.external_attr = ((stat.S_IFLNK if how == 2 else stat.S_IFIFO) | 0o777) << 16
            archive.writestr(entry, str(case.folder / "elsewhere"))
        elif how == 4:
            with archive.open("lap/zeros.db3", "w", force_zip64=True) as stream:
                for _ in range(case.rng.choice([100, 700, 1500])):
                    stream.write(bytes(2**20))
        elif how == 5:
            for k in range(12_000):
                archive.writestr(f"lap/{k}", b"")
        elif how == 6:
            archive.writestr("lap/lap.db3", "twice")
    shutil.rmtree(bag)
    if how == 0:
        case.spoil(file, spoil_bytes)


@generator("bags", weight=8)
def bag(case):
    how, storage = case.idea(6), case.rng.choice(["sqlite3", "mcap"])
    storage = "sqlite3" if how == 0 else storage
    case.copy("bags/conf", "conf")
    folder = case.copy(f"bags/{storage}/lap", "raw/lap")
    if how == 0:
        _state(folder / "lap.db3", case)
    elif how == 1:
        case.spoil(case.place / "conf/dataset/mine.yaml", lambda content, rng: _spoil_layout(content, case))
    elif how == 2:
        case.spoil(folder / "metadata.yaml", lambda content, rng: spoil_yaml(yaml.safe_load(content), rng))
    elif how == 3 or (case.honest and case.rng.random() < 0.5):
        _archive(case, folder, -1 if case.honest else case.visit // 6 % 7)
    else:
        case.spoil(folder / ("lap.mcap" if storage == "mcap" else "lap.db3"), spoil_bytes)
    return Command(case.rng.choice([("data", "check", "mine"), ("data", "show", "mine"), ("ingest", "mine")]))
