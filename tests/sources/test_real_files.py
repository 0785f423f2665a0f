"""What the publishers' files say of their own sensors; their readings are recorded in tests/golden."""

import numpy as np
import pandas as pd
import pytest

from real_drives import source_of
from vehest.alignment.checks import checks_of_recording


@pytest.mark.parametrize("dataset", ["ferrari_250lm_unlabelled", "av21"])
def test_drives_without_a_reference_or_without_lateral_acceleration_are_read(data_root, dataset):
    recordings = list(source_of(data_root, dataset).recordings())
    assert not [f for recording in recordings for f in checks_of_recording(recording) if f.level == "error"]
    for recording in recordings:
        moving, angle = recording["vx"] > 8.0, "handwheel" if "handwheel" in recording else "steer"
        assert np.corrcoef(recording[angle][moving], recording["yaw_rate"][moving])[0, 1] > 0.5
        assert ("vy_ref" in recording) == ("ay" not in recording) == (dataset == "av21")
        if dataset == "av21":  # measured by wheels, within half a per cent and their latency
            assert np.std((recording["vx"] - recording["vx_ref"])[moving]) < 0.25
            assert np.median((recording["vx"] / recording["vx_ref"])[moving]) == pytest.approx(1.0, abs=0.006)


def test_roboracer_runs_restart_and_are_scored_by_their_poses(data_root):
    recordings = {recording.id: recording for recording in source_of(data_root, "roboracer").recordings()}
    table = pd.read_csv(data_root / "roboracer" / "ftg_stanley_total_training.csv").iloc[1639:2082]
    run = recordings["ftg_stanley_total_training_run_2"]
    np.testing.assert_allclose(run["yaw_rate"], np.radians(table["yaw_rate"]), rtol=1e-12)
    np.testing.assert_allclose(run["ay"], 9.80665 * table["accy"], rtol=1e-12)
    moving = run["vx_ref"] > 0.5
    assert np.std((run["vx"] - run["vx_ref"])[moving]) < 0.1
    excess = table["velocity_vehicle_y"].to_numpy()[2:] - run["vy_ref"][1:-1]  # a row later, of the 40 ms
    turning = (run["vx_ref"] * run["yaw_rate_ref"])[1:-1]
    chosen = moving[1:-1]
    assert np.polyfit(turning[chosen], excess[chosen], 1)[0] == pytest.approx(0.025, abs=0.003)
    assert not [f for recording in recordings.values() for f in checks_of_recording(recording) if f.level == "error"]


def test_dart_sensors_agree_with_its_poses_once_held_values_and_latency_are_taken_off(data_root):
    source = source_of(data_root, "dart")
    recording = source.read("car_1_Datarecording_09_16_2024_10_02_28")
    assert recording.provenance["held"]["rate_hz"] == pytest.approx(10.0, abs=0.05)
    moving = recording["vx_ref"] > 0.3
    gyro, reference = recording["yaw_rate"][moving], recording["yaw_rate_ref"][moving]
    assert np.std(gyro - 1.028 * reference) < 0.12
    assert np.std((recording["vx"] - recording["vx_ref"])[moving]) < 0.06
    table = pd.read_csv(next((data_root / "dart").glob("*/*16_2024_10_02_28.csv")))
    raw = table["W (IMU)"].to_numpy()[-len(recording) - 5 : -5]
    assert np.std(raw[moving] - 1.028 * reference) > 3 * np.std(gyro - 1.028 * reference)
    drift = source.read("car_1_Datarecording_09_09_2024_18_13_59drifting_clockwise")
    fast = drift["vx_ref"] > 0.5
    assert 50.0 < np.degrees(np.abs(drift["sideslip_ref"][fast])).max() < 65.0
    assert not [f for one in (recording, drift) for f in checks_of_recording(one) if f.level == "error"]
