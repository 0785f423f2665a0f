"""The page docs/from_a_log.md taken at its word, on the log that it names."""

import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "from_a_log.md").read_text(encoding="utf-8")
LOG = ROOT / "docs" / "examples" / "lap.csv"


@pytest.fixture
def logged(place):
    """The folder of the page with the files that it shows, and the log in it."""
    folder = place.folder / "raw" / "my_log"
    folder.mkdir()
    shutil.copy(LOG, folder)
    for name, content in re.findall(
        r"```yaml\n# ((?:conf|pipelines)/\S+)\n(.*?)```", PAGE, re.DOTALL
    ):
        (place.folder / name).write_text(content, encoding="utf-8")
    return place


def correct(folder):
    """The sign and the transforms of the page, in the data set."""
    (transforms,) = re.findall(r"```yaml\n(transforms:.*?)```", PAGE, re.DOTALL)
    (corrected,) = re.findall(r"`ay: (\{column: AccY.*?\})`", PAGE)
    file = folder / "conf" / "dataset" / "my_log.yaml"
    declared = file.read_text(encoding="utf-8")
    assert "{column: AccY, unit: m/s²}" in declared
    file.write_text(
        declared.replace("{column: AccY, unit: m/s²}", corrected) + transforms, encoding="utf-8"
    )


def test_a_log_declared_by_hand_gets_the_leaderboard_of_the_page(logged):
    code, out, err = logged("data", "check", "my_log")
    assert (code, err) == (0, "")
    (warning,) = re.findall(r"\$ vehest data check my_log\n(warning .*)\n", PAGE)
    assert warning in out.splitlines()
    out, _ = logged.done("data", "usable", "my_log")
    for line in (
        "ax: transforms: [{name: acceleration_from_speed}] of vx",
        "vy_ref: transforms: [{name: velocity_from_sideslip}] of sideslip_ref and vx",
        "columns without a channel: AccX; if one of them is a missing channel, declare it in "
        "conf/dataset",
    ):
        assert line in PAGE
        assert line in out.splitlines()
    correct(logged.folder)
    out, _ = logged.done("data", "check", "my_log")
    assert "sign reversed" not in out
    out, err = logged.done("run", "my_log", "tracking=none")
    assert "luenberger runs at 20 Hz instead of its 100 Hz" in err
    (best,) = re.findall(r"^(Best: .*?), \d.*$", PAGE, re.MULTILINE)
    assert any(line.startswith(f"{best}, ") for line in out.splitlines())


def test_twenty_seconds_of_a_log_get_no_winner(logged):
    lap = pd.read_csv(LOG)
    lap[lap["Timestamp"] < 20.0].to_csv(logged.folder / "raw" / "my_log" / "lap.csv", index=False)
    correct(logged.folder)
    out, _ = logged.done("run", "my_log", "training.max_epochs=5", "tracking=none")
    (line,) = re.findall(r"`(test set 'test' is too short.*?)`", PAGE)
    assert line in out.splitlines()
    report = next((logged.folder / "outputs" / "report").glob("my_log-*")) / "report.md"
    assert "**These recordings cannot rank estimators**" in report.read_text(encoding="utf-8")
