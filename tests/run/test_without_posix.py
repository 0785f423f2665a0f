"""From a log to C where no module of POSIX can be imported and nothing can fork, as on Windows, in
a folder with spaces in its name.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from conftest import planar_drive
from place import write_yaml

pytestmark = pytest.mark.apart

SOURCE = Path(__file__).resolve().parents[2] / "src"
CHILD = """
import os, sys
for name in ("fcntl", "resource", "prctl", "pwd", "grp", "termios"):
    sys.modules[name] = None
for name in ("fork", "forkpty", "geteuid", "getuid", "killpg", "setsid"):
    delattr(os, name)
from matplotlib.figure import Figure
from vehest.cli import main
save = Figure.savefig
# nothing is drawn, for the sake of time
Figure.savefig = lambda _, *arguments, **options: save(Figure(), *arguments, **options)
for words in WORDS:
    sys.argv = ["vehest", *words]
    try:
        main()
    except SystemExit as left:
        if left.code:
            raise
print(sorted(name for name in ("fcntl", "resource") if sys.modules[name] is not None))
"""


def test_new_run_estimate_and_export_need_nothing_of_posix(tmp_path, monkeypatch):
    folder = tmp_path / "my logs"
    folder.mkdir()
    monkeypatch.chdir(folder)
    drive = planar_drive(120.0, 50.0, seed=5, noise=0.02)
    columns = {
        "Time": drive.time,
        "Speed [km/h]": 3.6 * drive["vx"],
        "GyroZ [deg/s]": np.degrees(drive["yaw_rate"]),
    }
    columns |= {
        "AccX [m/s2]": drive["ax"],
        "AccY [m/s2]": drive["ay"],
        "VelLat [m/s]": drive["vy_ref"],
    }
    pd.DataFrame(columns).to_csv(folder / "first lap.csv", index=False)
    sweeps = [
        ["estimator=zero"],
        ["estimator=ksnn", "estimator.n_local=1", "estimator.n_hidden=0", "training.max_epochs=2"],
    ]
    parts = {
        "all": {"title": "All", "split": "my_car", "sweeps": sweeps}
    }  # fewer than the pipeline that is made
    write_yaml(
        folder / "pipelines" / "short.yaml",
        {"study": "short", "title": "Short", "report": "own_car", "parts": parts},
    )
    words = (
        ("new", "my_car", "first lap.csv", "--yes"),
        ("run", "short", "--jobs", "1", "tracking=none"),
        ("estimate", "ksnn", "first lap.csv", "dataset=my_car", "-o", "my beta.csv"),
        ("export", "ksnn", "-o", "on the car", "--vectors", "first lap.csv", "dataset=my_car"),
    )
    environment = {
        key: value
        for key, value in os.environ.items()
        if key not in ("VEHEST_DATA", "VEHEST_OUTPUT")
    }
    child = [sys.executable, "-c", CHILD.replace("WORDS", repr(words))]
    ran = subprocess.run(
        child,
        capture_output=True,
        text=True,
        env={**environment, "PYTHONPATH": str(SOURCE)},
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == "[]"
    assert np.isfinite(pd.read_csv(folder / "my beta.csv")["vy"]).any()
    assert (folder / "on the car" / "main.c").is_file()
