"""Whatever stands in a file, reading it executes nothing: an audit hook watches while hostile files
of each format are read.

Each format runs in a process of its own, since a hook cannot be taken off again. The process reads
an honest file first, so that what vehest imports and compiles for a format is there, then watches.
A further format is a further entry of `CASES`: how honest and hostile files are made, which returns
what reads them; the package without which they cannot be written; and those that must be refused.
"""

import contextlib
import csv
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.apart

WATCHED = {
    "exec",
    "compile",
    "import",
    "code.__new__",
    "marshal.loads",
    "pickle.find_class",
    "ctypes.dlopen",
}
WATCHED |= {
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "os.forkpty",
    "subprocess.Popen",
    "pty.spawn",
}
WATCHED |= {
    "socket.connect",
    "urllib.Request",
    "sqlite3.enable_load_extension",
    "sqlite3.load_extension",
}
MARK = "MARK"  # what every hostile file would leave behind if it were run
PAYLOAD = f"__import__('os').system('touch {MARK}')"
PICKLE = b"cos\nsystem\n(S'touch MARK'\ntR."
FAST = np.arange(500) / 100.0


def by_source(**dataset):
    """Read a file or folder as the one recording of a data set."""

    def read(file):
        from vehest.sources.base import open_source

        (recording,) = open_source(
            {
                "name": "mine",
                "path": str(file.parent),
                "files": file.name,
                "vehicle": "car",
                **dataset,
            }
        ).recordings()
        return recording

    return read


def mdf(honest, hostile):
    import asammdf
    from mdf_log import ONE, write_mdf

    def write(file, version, conversion):
        raw = np.arange(len(FAST)) % 40
        write_mdf(
            file,
            {"Only": [asammdf.Signal(raw, FAST, name="v", unit="m/s", conversion=conversion)]},
            version,
        )

    for version in ("4.10", "3.30"):
        write(honest / f"a{version}.mf4", version, {"a": 2.0, "b": 1.0})
        write(hostile / f"formula_{version}.mf4", version, {"formula": PAYLOAD})
    write(hostile / "power.mf4", "4.10", {"formula": "9**9**9**X1"})
    inner = asammdf.blocks.conversion_utils.from_dict({"formula": PAYLOAD})
    write(hostile / "nested.mf4", "4.10", {"val_0": 1.0, "text_0": b"one", "default_addr": inner})
    bomb = b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><AUTOSAR>&b;</AUTOSAR>'
    with asammdf.MDF(version="4.10") as measurement:
        measurement.append([asammdf.Signal(FAST, FAST, name="v", unit="m/s")], comment="Only")
        measurement.attach(data=bomb, file_name=f"../../{MARK}.arxml", embedded=True)
        Path(measurement.save(hostile / "attached.mf4", overwrite=True)).rename(
            hostile / "attached.mf4"
        )
    return by_source(source="mdf", rate_hz=100, channels=ONE)


def rosbag(honest, hostile):
    from test_sources_rosbag import Topic, write_bag

    values = {"/v": Topic("std_msgs/msg/Float64", FAST, {"data": np.sin(FAST)})}
    good, _ = (
        write_bag(honest, values, storage, {}, name=storage) for storage in ("sqlite3", "mcap")
    )
    view = "CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, {} AS data"
    endless = (
        "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, 1 AS "
        "topic_id, id AS timestamp, x'00' AS data FROM n"
    )
    layout = f"float64 data\n{PAYLOAD}\nfloat64 x={PAYLOAD}\n".replace("'", "''")
    for name, *statements in (
        ("view_load", "DROP TABLE messages", view.format(f"load_extension('./{MARK}.so')")),
        ("view_zeros", "DROP TABLE messages", view.format("zeroblob(1000000000)")),
        (
            "trigger",
            f"CREATE TRIGGER evil AFTER INSERT ON messages BEGIN SELECT "
            f"load_extension('./{MARK}.so'); END",
        ),
        ("endless", "DROP TABLE messages", f"CREATE VIEW messages AS {endless}"),
        ("layout", f"UPDATE message_definitions SET encoded_message_definition = '{layout}'"),
        (
            "quality",
            f"UPDATE topics SET offered_qos_profiles = '!!python/object/apply:os.system [touch "
            f"{MARK}]'",
        ),
    ):
        shutil.copytree(good, hostile / name)
        with (
            contextlib.closing(sqlite3.connect(hostile / name / "sqlite3.db3")) as database,
            database,
        ):
            for statement in statements:
                database.execute(statement)
    for name, tag in (
        ("object", "!!python/object/apply:os.system"),
        ("module", "!!python/module:antigravity"),
    ):
        shutil.copytree(good, hostile / f"yaml_{name}")
        (hostile / f"yaml_{name}" / "metadata.yaml").write_text(
            f"rosbag2_bagfile_information: {tag} [touch {MARK}]\n"
        )
    topics = {"v": {"topic": "/v", "type": "std_msgs/msg/Float64", "stamps": "received"}}
    return by_source(
        source="rosbag",
        rate_hz=50,
        topics=topics,
        channels={"vx": {"topic": "v", "field": "data", "unit": "m/s"}},
    )


def table(honest, hostile):
    def write(file, header, first):
        with open(file, "w", newline="", encoding="utf-8") as stream:
            csv.writer(stream).writerows(
                [
                    header,
                    *(
                        [f"{t:.2f}", first if k == 3 else f"{t / 2:.3f}"]
                        for k, t in enumerate(FAST)
                    ),
                ]
            )

    write(honest / "a.csv", ["time", "v"], "0.015")
    for number, cell in enumerate(
        [PAYLOAD, f'=cmd|" /C touch {MARK}"!A0', "1j", "nan(0x1)", "$(touch MARK)"]
    ):
        write(hostile / f"cell{number}.csv", ["time", "v"], cell)
        write(hostile / f"header{number}.csv", ["time", "v", cell], "0.015")
    (hostile / "pickle.csv").write_bytes(PICKLE)
    return by_source(
        source="tabular",
        time={"column": "time", "unit": "s"},
        channels={"vx": {"column": "v", "unit": "m/s"}},
    )


def vbo(honest, hostile):
    from vbo_log import dataset, write_log

    write_log(honest / "a.vbo")
    content = (honest / "a.vbo").read_text(encoding="latin-1")
    for number, text in enumerate([PAYLOAD, f'=cmd|" /C touch {MARK}"!A0', "$(touch MARK)"]):
        bare = text.replace(" ", "")
        spoilt = [
            ("[comments]", f"[comments]\n{text}"),
            ("+0.000000E+00", bare),
            (" SWA ", f" {bare} "),
            (" +2.000000E-02 ", f" {PAYLOAD} "),
        ]
        for name, (old, new) in zip(("comment", "cell", "column", "number"), spoilt, strict=True):
            (hostile / f"{name}{number}.vbo").write_text(
                content.replace(old, new, 1), encoding="latin-1"
            )
    (hostile / "pickle.vbo").write_bytes(b"[column names]\ntime\n[data]\n" + PICKLE)
    return by_source(
        **{key: value for key, value in dataset(honest).items() if key not in ("name", "path")}
    )


def model(honest, hostile):
    import vehest.pretrained
    from vehest.estimators.registry import estimator_names

    estimator_names()  # imports vehest's own, as the message on an unknown name does
    good = next(path.parent for path in Path(vehest.pretrained.__path__[0]).rglob("model.yaml"))
    shutil.copytree(good, honest / "model")
    described = (good / "model.yaml").read_text(encoding="utf-8")
    lines = [line for line in described.splitlines() if not line.startswith("estimator:")]
    tags = (
        "!!python/object/apply:os.system",
        "!!python/object/new:os.system",
        "!!python/module:antigravity",
    )
    names = ("os.system", "antigravity", "../../evil", "vehest.cli", PAYLOAD)
    texts = [f"{described}\nmore: {tag} [touch {MARK}]\n" for tag in tags]
    texts += ["\n".join([f"estimator: {json.dumps(name)}", *lines]) for name in names]
    for number, text in enumerate([*texts, described]):
        shutil.copytree(good, hostile / f"model{number}")
        (hostile / f"model{number}" / "model.yaml").write_text(text, encoding="utf-8")
    (hostile / f"model{len(texts)}" / "model.safetensors").write_bytes(PICKLE)

    def read(folder):
        from vehest.estimators.model_files import load_model

        return load_model(folder)

    return read


CASES = {
    "mdf": (mdf, "asammdf", {"formula_4.10.mf4", "formula_3.30.mf4", "power.mf4", "nested.mf4"}),
    "rosbag": (rosbag, "rosbags", {"view_load", "view_zeros", "endless"}),
    "vbo": (vbo, "", {"number0.vbo", "pickle.vbo"}),
    "table": (table, "", {"cell0.csv", "pickle.csv"}),
    "model": (model, "", {f"model{number}" for number in range(9)}),
}


@pytest.mark.parametrize("name", CASES)
def test_hostile_files_execute_nothing(tmp_path, name):
    _, needs, refused = CASES[name]
    if needs:
        pytest.importorskip(needs, reason="the files of this test cannot be written")
    (tmp_path / "temporary").mkdir()
    environment = os.environ | {
        "PYTHONDONTWRITEBYTECODE": "1",
        "TMPDIR": str(tmp_path / "temporary"),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    command = [sys.executable, __file__, name, str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stderr
    outcome = json.loads(done.stdout.splitlines()[-1])
    assert len(outcome) >= 5
    assert {file: events for file, (_, events) in outcome.items() if events} == {}
    assert {
        file: ended for file, (ended, _) in outcome.items() if ended not in ("read", "refused")
    } == {}
    assert {file for file in refused if outcome[file][0] != "refused"} == set()
    assert list(tmp_path.rglob(f"*{MARK}*")) == []


def watch(name, folder):
    """Read honest files of a format, then watch while hostile ones are read: file -> how it ended,
    and what was seen.
    """
    import processes
    from vehest.data.errors import VehestError
    from vehest.sources import limited

    limited.subprocess = processes.READING
    honest = folder / "honest"
    hostile = folder / "hostile"
    honest.mkdir()
    hostile.mkdir()
    read = CASES[name][0](honest, hostile)
    for file in sorted(honest.iterdir()):
        read(file)
    with contextlib.suppress(VehestError):  # what the way to an error imports
        read(folder / "nowhere" / min(hostile.iterdir()).name)
    outcome = {}
    events = []
    armed = [False]
    temporary = tempfile.gettempdir()

    def hook(event, arguments):
        if not armed[0]:
            return
        if event == "os.fork":
            return  # the reading process, in which the fuzz watches
        if event == "open" and _writes(*arguments) and not str(arguments[0]).startswith(temporary):
            events.append(f"open {str(arguments[0])[:80]} {arguments[1]}")
        elif event in WATCHED:
            events.append(f"{event} {str(arguments)[:160]}")

    sys.addaudithook(hook)
    for file in sorted(hostile.iterdir()):
        events.clear()
        armed[0] = True
        try:
            read(file)
            ended = "read"
        except VehestError:
            ended = "refused"
        except BaseException as error:
            ended = f"{type(error).__name__}: {error}"[:200]
        armed[0] = False
        outcome[file.name] = ended, list(events)
    return outcome


def _writes(path, mode, flags):
    by_flags = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    return not isinstance(path, int) and bool(
        (isinstance(mode, str) and set(mode) & set("wax+")) or by_flags
    )


if __name__ == "__main__":
    print(json.dumps(watch(sys.argv[1], Path(sys.argv[2]))))
