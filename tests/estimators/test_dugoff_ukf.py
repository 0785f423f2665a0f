"""The filter on Dugoff's tyres finds the tyres it was driven on, and follows the car with tyre
forces and without.
"""

import sys

import numpy as np
import pytest
from refusals import refusal

from conftest import stop_after
from dugoff_drive import NOISE, TYRES, dugoff_drive
from every_estimator import online_rows
from single_track_drive import with_gaps
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.estimators.base import FitData
from vehest.estimators.cnn_ukf import CnnUkf, EndToEndSettings
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.filtering.track_filter import groups_of, in_nonlinear_range
from vehest.training.context import FitContext
from vehest.training.noise_tuning import IdentificationSettings
from vehest.training.search import optuna_search

LEVELS = {"ay": 0.06, "yaw_rate": 0.002, "process_vy": 1e-3, "process_yaw_rate": 1e-3}
FORCES = {"force_factor": 1.5, "fy_front": 100.0, "fy_rear": 100.0}
QUICK = IdentificationSettings(method="data", tyres_from="*", restarts=2, generations=40)


def estimator_with(inputs="full", **settings):
    """A filter that knows the car it is on."""
    noise = LEVELS | (FORCES if inputs == "full" else {})
    return DugoffUkf.from_config({"inputs": inputs, "tyres": TYRES, "noise": noise, **settings})


def test_the_fit_finds_tyres_and_noise_with_measured_forces_and_without():
    drives = [dugoff_drive(30.0, seed, straight=5.0) for seed in (1, 2)]
    estimator = DugoffUkf.from_config({})
    record = estimator.fit(FitData(drives, [dugoff_drive(10.0, 3)]), QUICK)
    for name in (
        "cornering_stiffness_front",
        "friction_front",
        "cornering_stiffness_rear",
        "friction_rear",
    ):
        assert record.metrics[name] == pytest.approx(TYRES[name], rel=0.05), name
        assert record.metrics[f"{name}_spread"] < 0.02 * TYRES[name]
    assert record.metrics["noise_ay"] == pytest.approx(NOISE["ay"], rel=0.2)
    assert record.metrics["noise_fy_front"] == pytest.approx(NOISE["fy"] * np.sqrt(2.0), rel=0.2)
    assert record.metrics["best_validation_loss"] < np.radians(0.3) ** 2
    assert estimator.n_parameters == 6 + 7
    drives = [dugoff_drive(25.0, seed) for seed in (1, 2)]
    estimator = DugoffUkf.from_config({"inputs": "imu"})
    estimator.fit(
        FitData(
            [
                drive.select([n for n in drive.channels if not n.startswith("fy")])
                for drive in drives
            ],
            [],
        ),
        QUICK,
    )
    assert estimator.axle_tyres[0] == pytest.approx(TYRES["cornering_stiffness_front"], rel=0.1)
    assert estimator.channels == ("yaw_rate", "vx", "ay", "steer", "ax")


@pytest.mark.parametrize("inputs", ["full", "imu"])
def test_the_filter_follows_the_car_and_knows_how_well(inputs):
    drive = dugoff_drive(20.0, 5)
    estimate = estimator_with(inputs).estimate([drive.without_references()])[0]
    assert np.sqrt(np.mean((estimate["sideslip"] - drive["sideslip_ref"])[100:] ** 2)) < np.radians(
        0.2
    ), "after a second"
    assert estimate.covariance_of == ("vy", "yaw_rate")
    error = (estimate["vy"] - drive["vy_ref"])[100:] / np.sqrt(estimate.covariance[100:, 0, 0])
    assert 0.2 < np.sqrt(np.mean(error**2)) < 2.0
    assert set(estimate["nis_dof"]) == ({4.0} if inputs == "full" else {2.0})


def test_drives_of_any_length_are_independent_and_force_trust_has_hysteresis():
    drives = [
        dugoff_drive(seconds, seed).without_references()
        for seconds, seed in ((3.0, 1), (5.0, 2), (3.0, 3))
    ]
    estimator = estimator_with()
    for together, drive in zip(estimator.estimate(drives), drives, strict=True):
        np.testing.assert_array_equal(together["vy"], estimator.estimate([drive])[0]["vy"])
    assert list(groups_of([3, 5, 3], 10)) == [[1, 0], [2]]
    assert list(groups_of([30, 5], 10)) == [[0], [1]]
    ay = np.array([0.0, 3.9, -4.1, 3.5, np.nan, -3.1, 2.9, 3.9, 4.0])
    expected = [False, False, True, True, True, True, False, False, True]
    assert in_nonlinear_range(ay, 4.0, 3.0).tolist() == expected
    nonlinear = in_nonlinear_range(ay, 4.0, 3.0)
    assert all(
        in_nonlinear_range(ay[k : k + 1], 4.0, 3.0, bool(nonlinear[k - 1]))[0] == nonlinear[k]
        for k in range(1, len(ay))
    )
    assert in_nonlinear_range(ay[3:4], 4.0, 3.0, before=True)[0]


def test_online_agrees_with_batch_through_gaps_and_standstill():
    drive = dugoff_drive(6.0, 7)
    slow = drive["vx"].copy()
    slow[300:380] = np.linspace(20.0, -1.0, 80)
    slow[380:420] = np.linspace(-1.0, 15.0, 40)
    gaps = {"ay": slice(150, 220), "fy_fl": slice(None, None, 7)}
    drive = with_gaps(drive.with_channels({"vx": slow}), gaps)
    estimator = estimator_with()
    batch = estimator.estimate([drive.without_references()])[0]
    online = online_rows(estimator, drive)
    for name in ("vy", "yaw_rate"):
        np.testing.assert_allclose([row[name] for row in online], batch[name], rtol=0.0, atol=1e-9)
    assert np.isfinite(batch["sideslip"]).all()
    assert batch["nis_dof"][160] == 3.0
    rolling = np.flatnonzero(drive["vx"] < 3.0)
    assert (batch["nis_dof"][rolling] == 0.0).all()
    np.testing.assert_allclose(
        batch["yaw_rate"][rolling[1:]],
        (drive["vx"] * drive["steer"])[rolling[1:] - 1] / 2.88,
        rtol=1e-12,
    )


def test_correlated_errors_count_as_fewer_measurements_and_states_are_restored():
    drive = dugoff_drive(2.0, 7).without_references()
    first = estimator_with().estimate([drive], {"vy": -1.0, "yaw_rate": 0.2})[0]
    assert first["vy"][0] == pytest.approx(-1.0, abs=1e-6)
    white, correlated = (estimator_with(correlated_samples=candidate) for candidate in (1.0, 10.0))
    (process, once), (correlated_process, tenfold) = (
        candidate.noise_covariances(candidate.levels) for candidate in (white, correlated)
    )
    np.testing.assert_array_equal(process, correlated_process)
    np.testing.assert_allclose(tenfold, 10.0 * once)


def test_process_noise_is_tuned_by_the_house_search_below_its_limit():
    estimator = DugoffUkf.from_config({"tyres": TYRES, "noise": FORCES})
    drives = [dugoff_drive(4.0, seed) for seed in (1, 2)]
    record = estimator.fit(
        FitData(drives, drives),
        IdentificationSettings(method="nelder_mead", grid=1, max_evaluations=12),
    )
    untuned = DugoffUkf.from_config({"tyres": TYRES, "noise": FORCES})
    before = untuned.fit(FitData(drives, drives), IdentificationSettings(method="data"))
    assert record.metrics["best_validation_loss"] < before.metrics["best_validation_loss"]
    assert record.metrics["evaluations"] == 12
    estimator = DugoffUkf.from_config(
        {"tyres": TYRES, "noise": FORCES | {"ay": 0.06, "yaw_rate": 0.002}}
    )
    data = FitData([dugoff_drive(6.0)], [dugoff_drive(4.0, seed=2)])
    estimator.fit(
        data, IdentificationSettings(trials=6, most_process_yaw_rate=2e-5, error="recordings")
    )
    assert 1e-5 <= estimator.levels["process_yaw_rate"] <= 2e-5


def test_levels_come_from_moving_samples_and_are_tuned_on_the_scored_reference():
    drive = dugoff_drive(12.0, straight=4.0)
    is_standing = np.arange(1200) >= 700
    quiet = {
        "ay": np.where(is_standing, 0.0, drive["ay"]),
        "vx": np.where(is_standing, 0.0, drive["vx"]),
        "steer": np.where(is_standing, 0.0, drive["steer"]),
    }
    record = DugoffUkf.from_config({"inputs": "imu", "tyres": TYRES}).fit(
        FitData([drive.with_channels(quiet)], []), QUICK
    )
    assert record.metrics["noise_ay"] > 0.8 * NOISE["ay"]
    gap = with_gaps(drive, {"ax": is_standing})
    assert "recording 'drive': channel 'ax' has gaps" in refusal(
        lambda: DugoffUkf.from_config({}).fit(FitData([gap], []), QUICK)
    )
    drive = dugoff_drive(3.0)
    data = IdentificationSettings(method="data")
    with_sideslip_error = drive.with_channels({"sideslip_ref": drive["sideslip_ref"] + 0.1})
    losses = [
        estimator_with().fit(FitData([], [recording]), data).metrics["best_validation_loss"]
        for recording in (drive, with_sideslip_error)
    ]
    assert losses[0] == losses[1]
    blind = drive.select([name for name in drive.channels if name != "vy_ref"])
    with pytest.raises(DataError, match="recording 'drive' has no vy_ref"):
        DugoffUkf.from_config({"tyres": TYRES}).fit(
            FitData([blind], []), IdentificationSettings(method="nelder_mead")
        )


def test_a_network_is_not_trained_behind_an_identification_that_was_stopped():
    """Going on identifies again; a network trained behind half a search would then meet another
    filter.
    """
    drives = [dugoff_drive(3.0)]
    estimator = CnnUkf.from_config({"inputs": "imu", "tyres": TYRES, "hidden": [4, 3]})
    before = {
        name: values.copy()
        for name, values in estimator.weights().items()
        if name.startswith("network.")
    }
    identification = IdentificationSettings(method="nelder_mead", grid=2, max_evaluations=3)
    context = FitContext(should_stop=stop_after(1))
    record = estimator.fit(
        FitData(drives, drives), EndToEndSettings(identification=identification), context
    )
    assert record.interrupted
    assert record.metrics == {"best_epoch": 0}
    assert all(
        np.array_equal(values, estimator.weights()[name], equal_nan=True)
        for name, values in before.items()
    )


def test_stages_search_wide_bounds_and_then_close_to_the_best():
    pytest.importorskip("optuna", reason="needs optuna: pip install 'vehest[tuning]'")
    search = optuna_search(
        lambda x: float(np.sum((x - 0.7) ** 2)),
        [(-5.0, 1.0)] * 2,
        30,
        0,
        FitContext(),
        stages=2,
        shrink=0.2,
    )
    assert search.evaluations == len(search.starts) == 30
    assert np.ptp(search.starts[:15, 0]) > 2.0
    assert np.ptp(search.starts[15:, 0]) <= 1.2
    assert search.starts[:, :2].max() <= 1.0
    assert search.cost == search.starts[:, -1].min()


def test_invalid_settings_and_missing_packages_are_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    drives = [dugoff_drive(2.0)]
    with pytest.raises(MissingError, match="set method=nelder_mead in its settings"):
        DugoffUkf.from_config({"tyres": TYRES}).fit(
            FitData(drives, drives), IdentificationSettings()
        )
    assert "has no tyres yet" in refusal(
        lambda: DugoffUkf.from_config({}).online(), ConfigurationError
    )
    with pytest.raises(DataError, match=r"no training recording is called '\*skidpad\*'"):
        DugoffUkf.from_config({}).fit(
            FitData([dugoff_drive(2.0)], []), IdentificationSettings(method="data")
        )
