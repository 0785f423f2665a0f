"""The page docs/from_a_log.md taken at its word, on 20 s of the real Ferrari made to look like
another car's log.
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd

PAGE = Path(__file__).parents[2] / "docs" / "from_a_log.md"
DRIVE = "revs/20140222_01_01_03_250lm"


def log_of(data_root):
    """300 to 320 s of the drive at 50 Hz: unix time, km/h, deg/s, lateral acceleration reversed,
    angles in degrees.
    """

    def column(name):
        return np.loadtxt(data_root / DRIVE / f"{name}.txt")

    time = column("t")
    rows = np.flatnonzero((time >= 300.0) & (time < 320.0))[::2]
    return pd.DataFrame(
        {
            "Timestamp": np.round(1393000000.0 + time[rows] - time[rows][0], 3),
            "Speed": np.round(3.6 * column("vx")[rows], 3),
            "GyroZ": np.round(np.degrees(column("yawRate")[rows]), 4),
            "AccY": np.round(-column("ayCG")[rows], 4),
            "SteerWheel": np.round(16.0 * np.degrees(column("delta")[rows]), 3),
            "SlipAngle": np.round(np.degrees(column("beta_true")[rows]), 4),
        }
    )


def test_a_log_of_twenty_seconds_gets_a_leaderboard_and_no_winner(place, data_root):
    logged = place
    page = PAGE.read_text(encoding="utf-8")
    folder = place.folder / "raw" / "my_log"
    folder.mkdir()
    log_of(data_root).to_csv(folder / "lap.csv", index=False)
    for name, content in re.findall(
        r"```yaml\n# ((?:conf|pipelines)/\S+)\n(.*?)```", page, re.DOTALL
    ):
        (place.folder / name).write_text(content, encoding="utf-8")
    code, out, err = logged("data", "check", "my_log")
    assert (code, err) == (0, "")
    (warning,) = re.findall(r"\$ vehest data check my_log\n(warning .*)\n", page)
    assert warning in out.splitlines()
    out, _ = logged.done("data", "usable", "my_log")
    for line in (
        "ax: transforms: [{name: acceleration_from_speed}] of vx",
        "vy_ref: transforms: [{name: velocity_from_sideslip}]",
    ):
        assert line in page
        assert line in out
    (transforms,) = re.findall(r"```yaml\n(transforms:.*?)```", page, re.DOTALL)
    file = logged.folder / "conf" / "dataset" / "my_log.yaml"
    file.write_text(
        file.read_text(encoding="utf-8").replace(
            "{column: AccY, unit: m/s²}", "{column: AccY, unit: m/s², sign: -1}"
        )
        + transforms
    )
    out, _ = logged.done("data", "check", "my_log")
    assert "sign reversed" not in out
    out, err = logged.done("run", "my_log", "tracking=none")
    assert "luenberger runs at 50 Hz instead of its 100 Hz" in err
    assert "test set 'test' is too short to compare estimators: no interval, no winner" in out
    report = next((logged.folder / "outputs" / "report").glob("my_log-*")) / "report.md"
    text = report.read_text(encoding="utf-8")
    (verdict,) = re.findall(r"```output\n(These recordings cannot.*?)\n```", page, re.DOTALL)
    assert " ".join(verdict.split()) in text.replace("**", "")
    assert "from 14 s after its start" in text
    assert "1.393e+09" not in text
