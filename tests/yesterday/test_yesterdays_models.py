"""Models that were saved before a refactoring give the estimates that they gave then, with their
bands and their health.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from make_models import drive_name

from place import run_vehest
from vehest.data.store import read_estimate, read_recording
from vehest.estimators.model_files import RENAMED, load_model
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.inference.estimation import estimate_recording
from vehest.inference.models import open_model
from vehest.trust.health import INVALID, TOO_WIDE
from vehest.trust.health_kernel import JUMP
from vehest.trust.verdict import WIDEST

FOLDER = Path(__file__).parent
MODELS = sorted(folder.name for folder in (FOLDER / "models").iterdir())
TOLERANCE = 1e-6


@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_yesterday_estimates_as_it_did(name):
    folder, model, trust = open_model(str(FOLDER / "models" / name), FOLDER, print)
    drive = read_recording(FOLDER / "drives" / drive_name(model))
    then = read_estimate(folder / "estimate.parquet")
    now = estimate_recording(model, drive, trust)
    assert set(now.channels) == set(then.channels)
    expected = dict(then.channels)
    wide = np.nan_to_num(then["band_sideslip"]) > WIDEST  # then valid or degraded, now invalid
    unexplained = wide & (then["health_reason"] == 0.0)
    expected["health"] = np.where(wide, INVALID, then["health"])
    expected["health_reason"] = np.where(unexplained, TOO_WIDE * 10_000.0, then["health_reason"])
    jumps = (then["health_reason"] // 10_000 == JUMP) & (
        now["health_reason"] // 10_000 == JUMP
    )  # now of the largest likelihood ratio
    expected["health_reason"] = np.where(jumps, now["health_reason"], expected["health_reason"])
    for channel, values in expected.items():
        np.testing.assert_allclose(
            now[channel],
            values,
            rtol=0.0,
            atol=TOLERANCE,
            equal_nan=True,
            err_msg=f"{name}: {channel}",
        )


def test_the_command_gives_the_same(tmp_path, monkeypatch, capsys):
    folder = FOLDER / "models" / "ksnn"
    model = load_model(folder)
    drive = read_recording(FOLDER / "drives" / drive_name(model))
    monkeypatch.chdir(tmp_path)
    drive.to_pandas().to_csv("lap.csv")
    code, out, err = run_vehest(
        capsys, "estimate", str(folder), "lap.csv", "-o", "out.parquet", "--json"
    )
    assert code == 0, err
    assert "of the drive" in json.loads(out)["verdict"]
    table = pd.read_parquet("out.parquet")
    then = read_estimate(folder / "estimate.parquet")
    for channel in ("vy", "sideslip", "band_sideslip"):
        np.testing.assert_allclose(
            table[channel], then[channel], rtol=0.0, atol=TOLERANCE, equal_nan=True
        )


def test_every_family_has_a_model_of_yesterday():
    assert sorted(
        name for name in estimator_names() if estimator_class(name).__module__.startswith("vehest.")
    ) == [name for name in MODELS if name not in RENAMED]
