"""Whatever stands in a file, reading it executes nothing: an audit hook watches while hostile files of each format are read.

Each format runs in a process of its own, since a hook cannot be taken off again. The process reads an honest file first, so that what
vehest imports and compiles for a format is there, then watches. A further format is a further entry of `CASES`: how honest and hostile
files are made, and what reads them.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

WATCHED = {"exec", "compile", "import", "code.__new__", "marshal.loads", "pickle.find_class", "ctypes.dlopen"}
WATCHED |= {"os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "subprocess.Popen", "pty.spawn"}
WATCHED |= {"socket.connect", "urllib.Request", "sqlite3.enable_load_extension", "sqlite3.load_extension"}
MARK = "MARK"  # what every hostile file would leave behind if it were run
PAYLOAD = f"__import__('os').system('touch {MARK}')"
FAST = np.arange(500) / 100.0


@dataclass(frozen=True)
class Case:
    """A format.

    Args:
        make: writes honest files into one folder and hostile ones into another, and returns how each is read.
        needs: package without which its files cannot be written.
        refused: hostile files that must end in an error of vehest; the others may be read as plain data.
    """

    make: Callable[[Path, Path], Callable[[Path], Any]]
    needs: str = ""
    refused: frozenset[str] = field(default_factory=frozenset)


def by_source(**dataset):
    """Read a file or folder as the one recording of a data set."""

    def read(file):
        from vehest.sources.base import open_source

        (recording,) = open_source({"name": "mine", "path": str(file.parent), "files": file.name, "vehicle": "car", **dataset}).recordings()
        return recording

    return read


def mdf(honest, hostile):
    import asammdf

    def write(file, version, conversion, **attached):
        with asammdf.MDF(version=version) as measurement:
            raw = np.arange(len(FAST)) % 40
            measurement.append([asammdf.Signal(raw, FAST, name="v", unit="m/s", conversion=conversion)], comment="Only")
            if attached:
                measurement.attach(**attached)
            saved = Path(measurement.save(file, overwrite=True))
        saved.rename(file)

    for version, lines in (("4.10", [f"X1 + {PAYLOAD}", "9**9**9**X1"]), ("3.30", [PAYLOAD])):
        write(honest / f"a{version}.mf4", version, {"a": 2.0, "b": 1.0})
        for number, line in enumerate(lines):
            write(hostile / f"formula{number}_{version}.mf4", version, {"formula": line})
    nested = {"val_0": 1.0, "text_0": b"one", "default_addr": asammdf.blocks.conversion_utils.from_dict({"formula": PAYLOAD})}
    write(hostile / "nested.mf4", "4.10", nested)
    write(honest / "attached.mf4", "4.10", None, data=b"text", file_name="notes.txt", embedded=True)
    bomb = b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><AUTOSAR>&b;</AUTOSAR>'
    write(hostile / "attached.mf4", "4.10", None, data=bomb, file_name=f"../../{MARK}.arxml", embedded=True)
    return by_source(source="mdf", rate_hz=100, channels={"vx": {"column": "v", "unit": "m/s"}})


def mat(honest, hostile):
    from scipy.io import savemat

    values = {"value": np.sin(FAST)[:, None], "time": FAST[:, None]}
    for packed in (False, True):
        savemat(honest / f"a{packed:d}.mat", {"insData": {"vxCG": values}}, do_compression=packed)
        savemat(
            hostile / f"text{packed:d}.mat",
            {"insData": {"vxCG": {**values, "value": PAYLOAD}}, PAYLOAD[:5]: PAYLOAD},
            do_compression=packed,
        )
        savemat(hostile / f"object{packed:d}.mat", {"insData": {"vxCG": np.array([PAYLOAD, 1], dtype=object)}}, do_compression=packed)
    pickled = (honest / "a0.mat").read_bytes() + b"cos\nsystem\n(S'touch MARK'\ntR."
    (hostile / "pickle.mat").write_bytes(pickled)
    declared = {"channels": {"vx": {"column": "vxCG", "unit": "m/s"}}, "time": {"column": "time", "unit": "s"}}
    read = by_source(source="revs", layout="mat", rate_hz=100, **declared)
    return lambda file: read(file.with_suffix(""))


def rosbag(honest, hostile):
    import shutil
    import sqlite3

    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    number = types.types["std_msgs/msg/Float64"]
    for storage in ("SQLITE3", "MCAP"):
        with Writer(honest / storage, version=9, storage_plugin=StoragePlugin[storage]) as writer:
            connection = writer.add_connection("/v", "std_msgs/msg/Float64", typestore=types)
            for stamp, value in zip(FAST, np.sin(FAST), strict=True):
                writer.write(
                    connection, 10**18 + round(stamp * 1e9), bytes(types.serialize_cdr(number(data=value), "std_msgs/msg/Float64"))
                )
    good = honest / "SQLITE3"

    def changed(name, *statements):
        shutil.copytree(good, hostile / name)
        database = sqlite3.connect(hostile / name / "SQLITE3.db3")
        for statement in statements:
            database.execute(statement)
        database.commit()
        database.close()

    for function in (f"load_extension('./{MARK}.so')", "zeroblob(1000000000)"):
        name = function.split("(")[0]
        view = f"CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, {function} AS data"
        changed(f"view_{name}", "DROP TABLE messages", view)
    changed("trigger", f"CREATE TRIGGER evil AFTER INSERT ON messages BEGIN SELECT load_extension('./{MARK}.so'); END")
    endless = (
        "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
    )
    changed("endless", "DROP TABLE messages", f"CREATE VIEW messages AS {endless}")
    layout = f"float64 data\n{PAYLOAD}\nfloat64 x=__import__('os').system('touch {MARK}')\n"
    changed("layout", f"UPDATE message_definitions SET encoded_message_definition = '{layout.replace(chr(39), chr(39) * 2)}'")
    changed("quality", f"UPDATE topics SET offered_qos_profiles = '!!python/object/apply:os.system [touch {MARK}]'")
    for name, tag in (("object", "!!python/object/apply:os.system"), ("module", "!!python/module:antigravity")):
        shutil.copytree(good, hostile / f"yaml_{name}")
        (hostile / f"yaml_{name}" / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {tag} [touch {MARK}]\n")
    return by_source(
        source="rosbag",
        rate_hz=50,
        topics={"v": {"topic": "/v", "type": "std_msgs/msg/Float64", "stamps": "received"}},
        channels={"vx": {"topic": "v", "field": "data", "unit": "m/s"}},
    )


def table(honest, hostile):
    def write(file, header, first):
        with open(file, "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(header)
            writer.writerows([f"{t:.2f}", first if k == 3 else f"{t / 2:.3f}"] for k, t in enumerate(FAST))

    write(honest / "a.csv", ["time", "v"], "0.015")
    for number, cell in enumerate([PAYLOAD, f'=cmd|" /C touch {MARK}"!A0', "1j", "nan(0x1)", "$(touch MARK)"]):
        write(hostile / f"cell{number}.csv", ["time", "v"], cell)
        write(hostile / f"header{number}.csv", ["time", "v", cell], "0.015")
    (hostile / "pickle.csv").write_bytes(b"cos\nsystem\n(S'touch MARK'\ntR.")
    return by_source(source="tabular", time={"column": "time", "unit": "s"}, channels={"vx": {"column": "v", "unit": "m/s"}})


def vbo(honest, hostile):
    from vbo_log import dataset, write_log

    write_log(honest / "a.vbo")
    content = (honest / "a.vbo").read_text(encoding="latin-1")
    for number, text in enumerate([PAYLOAD, f'=cmd|" /C touch {MARK}"!A0', "$(touch MARK)"]):
        (hostile / f"comment{number}.vbo").write_text(content.replace("[comments]", f"[comments]\n{text}"), encoding="latin-1")
        (hostile / f"cell{number}.vbo").write_text(content.replace("+0.000000E+00", text.replace(" ", ""), 1), encoding="latin-1")
        (hostile / f"column{number}.vbo").write_text(content.replace(" SWA ", f" {text.replace(' ', '')} "), encoding="latin-1")
    (hostile / "cell3.vbo").write_text(content.replace(" +2.000000E-02 ", f" {PAYLOAD} ", 1), encoding="latin-1")
    (hostile / "pickle.vbo").write_bytes(b"[column names]\ntime\n[data]\ncos\nsystem\n(S'touch MARK'\ntR.")
    return by_source(**{key: value for key, value in dataset(honest).items() if key not in ("name", "path")})


def model_folder(honest, hostile):
    import shutil

    import vehest.pretrained
    from vehest.estimators.registry import estimator_names

    estimator_names()  # imports vehest's own, as the message on an unknown name does
    good = next(path.parent for path in Path(vehest.pretrained.__path__[0]).rglob("model.yaml"))
    shutil.copytree(good, honest / "model")
    described = (good / "model.yaml").read_text(encoding="utf-8")
    for number, tag in enumerate(["!!python/object/apply:os.system", "!!python/object/new:os.system", "!!python/module:antigravity"]):
        shutil.copytree(good, hostile / f"tag{number}")
        (hostile / f"tag{number}" / "model.yaml").write_text(f"{described}\nmore: {tag} [touch {MARK}]\n", encoding="utf-8")
    for number, name in enumerate(["os.system", "antigravity", "../../evil", "vehest.cli", PAYLOAD]):
        shutil.copytree(good, hostile / f"name{number}")
        lines = [f"estimator: {json.dumps(name)}" if line.startswith("estimator:") else line for line in described.splitlines()]
        (hostile / f"name{number}" / "model.yaml").write_text("\n".join(lines), encoding="utf-8")
    shutil.copytree(good, hostile / "pickle")
    (hostile / "pickle" / "model.safetensors").write_bytes(b"cos\nsystem\n(S'touch MARK'\ntR.")

    def read(folder):
        from vehest.estimators.model_files import load_model

        return load_model(folder)

    return read


CASES = {
    "mdf": Case(mdf, needs="asammdf", refused=frozenset({*(f"formula{k}_4.10.mf4" for k in range(2)), "formula0_3.30.mf4", "nested.mf4"})),
    "mat": Case(mat, refused=frozenset({"text0.mat", "object0.mat", "pickle.mat", "text1.mat", "object1.mat"})),
    "rosbag": Case(rosbag, needs="rosbags", refused=frozenset({"view_load_extension", "view_zeroblob", "endless"})),
    "vbo": Case(vbo, refused=frozenset({"cell3.vbo", "pickle.vbo"})),
    "table": Case(table, refused=frozenset({"cell0.csv", "pickle.csv"})),
    "model": Case(model_folder, refused=frozenset({"tag0", "tag1", "tag2", "name0", "name1", "name2", "name3", "name4", "pickle"})),
}


@pytest.mark.parametrize("name", CASES)
def test_hostile_files_execute_nothing(tmp_path, name):
    case = CASES[name]
    if case.needs:
        pytest.importorskip(case.needs, reason="the files of this test cannot be written")
    (tmp_path / "temporary").mkdir()
    environment = os.environ | {
        "PYTHONDONTWRITEBYTECODE": "1",
        "TMPDIR": str(tmp_path / "temporary"),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    command = [sys.executable, __file__, name, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    outcome = json.loads(done.stdout.splitlines()[-1])
    assert len(outcome) >= 5
    assert {file: one["events"] for file, one in outcome.items() if one["events"]} == {}
    assert {file: one["ended"] for file, one in outcome.items() if one["ended"] not in ("read", "refused")} == {}
    assert {file for file in case.refused if outcome[file]["ended"] != "refused"} == set()
    assert list(tmp_path.rglob(f"*{MARK}*")) == []


def watch(name, folder):
    """Read honest files of a format, then watch while hostile ones are read: file -> how it ended, and what was seen."""
    from vehest.data.errors import VehestError

    honest, hostile = folder / "honest", folder / "hostile"
    honest.mkdir()
    hostile.mkdir()
    read = CASES[name].make(honest, hostile)
    for file in sorted(honest.iterdir()):
        read(file)
    for file in sorted(hostile.iterdir())[:1]:  # what the way to an error imports
        with contextlib.suppress(VehestError):
            read(folder / "nowhere" / file.name)
    outcome = {}
    seen = []
    armed = [False]
    temporary = tempfile.gettempdir()

    def hook(event, arguments):
        if not armed[0]:
            return
        if (event == "subprocess.Popen" and "vehest.sources.limited" in arguments[1]) or (event == "open" and arguments[0] == os.devnull):
            return  # the reading process, in which the fuzz watches
        if event == "open" and _writes(arguments) and not str(arguments[0]).startswith(temporary):
            seen.append(f"open {str(arguments[0])[:80]} {arguments[1]}")
        elif event in WATCHED:
            seen.append(f"{event} {str(arguments)[:160]}")

    sys.addaudithook(hook)
    for file in sorted(hostile.iterdir()):
        seen.clear()
        armed[0] = True
        try:
            read(file)
            ended = "read"
        except VehestError:
            ended = "refused"
        except BaseException as error:
            ended = f"{type(error).__name__}: {error}"[:200]
        armed[0] = False
        outcome[file.name] = {"ended": ended, "events": list(seen)}
    return outcome


def _writes(arguments):
    path, mode, flags = arguments
    if isinstance(path, int):
        return False
    return bool(isinstance(mode, str) and set(mode) & set("wax+")) or bool(
        isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    )


if __name__ == "__main__":
    print(json.dumps(watch(sys.argv[1], Path(sys.argv[2]))))
