"""Rows of errors with the best lever arm in a study's metrics, where the reference's point is
unknown.
"""

import numpy as np
import pandas as pd
import pytest

from vehest.data.store import read_recording


def test_errors_at_an_unknown_point_are_listed_with_the_best_lever_arm(place):
    place.change("conf/dataset/mine.yaml", reference_point="unknown")
    place.change(
        "pipelines/levers.yaml",
        study="levers",
        report="drive",
        split="mine",
        sweeps=[["estimator=zero"]],
    )
    result = place.told("run", "levers", "tracking=none", "output=out")
    table = pd.read_csv(next((place.folder / "out" / "evaluate").glob("zero-*")) / "metrics.csv")
    tests = table[(table["test_set"] == "test") & (table["subset"] == "all")]
    levers, nominal = (
        tests[tests["condition"] == name].set_index("metric")["value"]
        for name in ("best_lever_arm", "nominal")
    )
    assert set(levers.index) == {"rmse_vy", "rmse_sideslip", "fvu", "lever_arm"}
    assert (
        levers["lever_arm"] == 0.5
    )  # v is about -2.2 m·r, so v = 0 lies as far ahead as is allowed
    recording = read_recording(
        next((place.folder / "out" / "downsample").glob("mine-20hz-*")) / "three.parquet"
    )
    late = recording.time >= recording.start_time + 1.5 - 1e-9
    residual = recording["vy_ref"][late] + 0.5 * recording["yaw_rate"][late]
    assert levers["rmse_vy"] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-9)
    assert [row["rmse_sideslip"] for row in result["leaderboard"]] == [
        pytest.approx(nominal["rmse_sideslip"])
    ]
