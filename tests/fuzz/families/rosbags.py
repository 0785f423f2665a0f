"""ROS 2 bags, plain and zipped: bytes, databases that hold something else, metadata.yaml, layouts
of messages.
"""

import shutil
import sqlite3
from contextlib import suppress
from pathlib import Path

import yaml

from fuzz.case import Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import CALL, NAMES, spoil_bytes, spoil_yaml, yaml_of

STATEMENTS = (
    "UPDATE topics SET name = char(27) || '[2J' || name",
    "UPDATE topics SET serialization_format = 'pickle'",
    "UPDATE messages SET timestamp = timestamp + 1000000000000000000 WHERE id % 97 = 0",
    "UPDATE messages SET data = zeroblob(100000000) WHERE id = 5",
)
LAYOUTS = (
    "float64[1000000000] a",
    "MotorStamped again",
    f"float64 {CALL}",
    f'string a "\\n{CALL}"',
)
TYPES = (*NAMES, "os/msg/system", "a", "a/b", "a/msg/b\nfloat64 x", "std_msgs/msg/Header")


@template
def bags(folder):
    """A bag on sqlite, one on mcap, and the data set that reads them."""
    from test_sources_rosbag import configuration, drive, write_bag

    for storage in ("sqlite3", "mcap"):
        write_bag(folder / storage, drive(2.0), storage, name="lap")
    declared = configuration(Path("x")) | {
        "path": "${root}",
        "licence": "none",
        "citation": "none",
        "kind": "real",
        "accept": [],
    }
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
    tree["messages"][case.rng.choice([*tree["messages"], case.rng.choice(TYPES)])] = (
        case.rng.choice(LAYOUTS)
    )
    return yaml_of(tree).encode("utf-8", "replace")


@generator("bags", weight=8)
def bag(case):
    """A damaged ROS bag."""
    kind = case.idea(5)
    storage = case.rng.choice(["sqlite3", "mcap"])
    storage = "sqlite3" if kind == 0 else storage
    case.copy("bags/conf", "conf")
    folder = case.copy(f"bags/{storage}/lap", "raw/lap")
    if kind == 0:
        _state(folder / "lap.db3", case)
    elif kind == 1:
        case.spoil(
            case.place / "conf/dataset/mine.yaml", lambda content, rng: _spoil_layout(content, case)
        )
    elif kind == 2:
        case.spoil(
            folder / "metadata.yaml", lambda content, rng: spoil_yaml(yaml.safe_load(content), rng)
        )
    elif kind == 3 or (case.honest and case.rng.random() < 0.5):
        archive = Path(
            shutil.make_archive(str(case.place / "raw" / "lap"), "zip", case.place / "raw", "lap")
        )
        shutil.rmtree(folder)
        case.spoil(archive, spoil_bytes)
    else:
        case.spoil(folder / ("lap.mcap" if storage == "mcap" else "lap.db3"), spoil_bytes)
    return Command(
        case.rng.choice([("data", "check", "mine"), ("data", "show", "mine"), ("ingest", "mine")])
    )
