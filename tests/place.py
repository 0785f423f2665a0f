"""A small data set with a configuration and a pipeline of its own, and the command line run
on it.
"""

import json
import shutil
import sys
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import yaml
from matplotlib.figure import Figure

from conftest import planar_drive
from single_track_drive import linear_drive
from vehest.cli import main
from vehest.data.files import ASIDE_PREFIX

PIPELINE = {
    "study": "small",
    "title": "A small study",
    "report": "drive",
    "split": "mine",
    "sweeps": [
        ["estimator=luenberger", "training.grid=1", "training.max_evaluations=20"],
        ["estimator=ksnn", "estimator.n_hidden=0", "seed=0,1", "training.max_epochs=2"],
        ["estimator=gru", "estimator.n_states=2", "training.max_epochs=2"],
    ],
}


def write_csv(path, seed, seconds=30.0):
    """A drive at 100 Hz as a table with columns of its own names and units."""
    table, text = _table(seed, seconds)
    path.write_text(text)
    return table.copy()


@cache
def _table(seed, seconds):
    """Table of a drive, in the units of its data set."""
    drive = planar_drive(seconds, 100.0, seed=seed, noise=0.02)
    table = pd.DataFrame(
        {
            "Time": drive.time,
            "Speed": drive["vx"] * 3.6,
            "Yaw": np.degrees(drive["yaw_rate"]),
            "LatAcc": -drive["ay"],
            "LongAcc": drive["ax"],
            "Vy": drive["vy_ref"],
        }
    )
    return table, table.to_csv(index=False)


DATASET = {
    "name": "mine",
    "title": "My car",
    "kind": "simulated",
    "vehicle": "my car",
    "licence": "none",
    "citation": "none",
    "source": "tabular",
    "path": "${root}",
    "files": "*.csv",
    "time": {"column": "Time", "unit": "s"},
    "channels": {
        "vx": {"column": "Speed", "unit": "km/h"},
        "yaw_rate": {"column": "Yaw", "unit": "deg/s"},
        "ay": {"column": "LatAcc", "unit": "m/s²", "sign": -1},
        "ax": {"column": "LongAcc", "unit": "m/s²"},
        "vy_ref": {"column": "Vy", "unit": "m/s"},
    },
}


def undrawn(patch):
    """Save figures without their content: laying out those of a small study takes longer than all
    the rest of it.
    """
    save = Figure.savefig
    patch.setattr(
        Figure,
        "savefig",
        lambda _, *arguments, **options: save(Figure((6, 4)), *arguments, **options),
    )


STEERED = {"vx": "m/s", "yaw_rate": "rad/s", "ay": "m/s²", "steer": "rad"}
STEERED |= {"vx_ref": "m/s", "vy_ref": "m/s", "yaw_rate_ref": "rad/s"}
SPLIT = {
    "name": "mine",
    "dataset": "mine",
    "train": [{"recording": "one"}],
    "validation": [{"recording": "two"}],
}
SPLIT |= {"tests": {"test": [{"recording": "three"}]}}


def write_yaml(file, content):
    """Write a file of configuration and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(yaml.safe_dump(content, allow_unicode=True, sort_keys=False), encoding="utf-8")


def write_drives(folder, seconds=30.0):
    """The tables of `DATASET`."""
    (folder / "raw").mkdir(exist_ok=True)
    for seed, name in enumerate(("one", "two", "three"), start=1):
        write_csv(folder / "raw" / f"{name}.csv", seed, seconds)


def write_steered(folder, names):
    """A data set ``steered`` of a linear single track with a steering angle: drives of 30 s, name
    -> seed.
    """
    (folder / "raw" / "steered").mkdir(parents=True)
    for name, seed in names.items():
        drive = linear_drive(30.0, seed=seed)[0]
        table = pd.DataFrame({"t": drive.time, **{channel: drive[channel] for channel in STEERED}})
        table.to_csv(folder / "raw" / "steered" / f"{name}.csv", index=False)
    channels = {name: {"column": name, "unit": unit} for name, unit in STEERED.items()}
    entries = {
        "name": "steered",
        "path": "${root}/steered",
        "time": {"column": "t", "unit": "s"},
        "channels": channels,
    }
    write_yaml(folder / "conf" / "dataset" / "steered.yaml", DATASET | entries)


def run_vehest(capsys, *arguments):
    """Exit code, standard output and standard error of a command."""
    former = sys.argv
    code = 0
    sys.argv = ["vehest", *arguments]
    try:
        main()
    except SystemExit as leave:
        code = int(leave.code or 0)
    finally:
        sys.argv = former
    out, err = capsys.readouterr()
    return code, out, err


_DONE = {}
_COPIES = TemporaryDirectory()


class Place:
    """A working folder with data, configuration and a pipeline of its own."""

    def __init__(self, folder, capsys):
        self.folder = folder
        self._capsys = capsys
        write_drives(folder)
        self.change("conf/dataset/mine.yaml", **DATASET)
        self.change("conf/split/mine.yaml", **SPLIT)
        self.change("pipelines/small.yaml", **PIPELINE)

    def add_steered(self):
        """A data set ``steered``: drives of 30 s, ``first`` and ``second``, of a linear single
        track with a steering angle.
        """
        write_steered(self.folder, {"first": 1, "second": 2})

    def __call__(self, *arguments):
        """Exit code, standard output and standard error of a command."""
        return run_vehest(self._capsys, *arguments)

    def done(self, *arguments):
        """Standard output and error of a command that must succeed."""
        code, out, err = self(*arguments)
        assert code == 0, err
        return out, err

    def told(self, *arguments):
        """What a command that must succeed says in JSON."""
        return json.loads(self.done(*arguments, "--json")[0])

    def change(self, name, /, **changes):
        """Write a YAML file, or change keys of one that is there; what it holds then."""
        file = self.folder / name
        content = (
            yaml.safe_load(file.read_text(encoding="utf-8")) if file.is_file() else {}
        ) | changes
        write_yaml(file, content)
        return content

    def once(self, *arguments):
        """Output and errors of a command that must succeed: it runs once, later places like this
        one get a copy of what it made.
        """
        files = [
            file
            for file in sorted(self.folder.rglob("*"))
            if file.is_file() and not file.is_symlink()
        ]
        key = (
            *arguments,
            *(
                (file.relative_to(self.folder), sha256(file.read_bytes()).digest())
                for file in files
            ),
        )
        if key not in _DONE:
            output = self.done(*arguments)
            copy = Path(_COPIES.name) / str(len(_DONE))
            _DONE[key] = output, shutil.copytree(self.folder, copy)
        else:
            shutil.copytree(_DONE[key][1], self.folder, dirs_exist_ok=True)
        return _DONE[key][0]

    def refused(self, *arguments, code=None, says=()):
        """Exit code and error line of a command that must fail and leave nothing behind.

        ``code`` and ``says`` are what is expected of both.
        """
        before = self.files()
        exit_code, _, err = self(*arguments)
        assert exit_code != 0
        lines = [
            line for line in err.splitlines() if not line.startswith(("done", "reused", "once"))
        ]
        assert len(lines) == 1, err
        assert lines[0].startswith("error: ")
        assert {
            name
            for name in self.files() - before
            if "/ingest/" not in name and "/downsample/" not in name
        } == set()
        assert not any(ASIDE_PREFIX in name for name in self.files())
        assert code in (None, exit_code), lines[0]
        assert exit_code == 1 or "defect" not in lines[0]
        assert [
            words for words in ([says] if isinstance(says, str) else says) if words not in lines[0]
        ] == [], lines[0]
        return exit_code, lines[0]

    def files(self):
        """Every file in the output root but the locks, which stay where they are and are empty."""
        outputs = self.folder / "outputs"
        return {
            str(file)
            for file in outputs.rglob("*")
            if file.is_file() and outputs / "locks" not in file.parents
        }
