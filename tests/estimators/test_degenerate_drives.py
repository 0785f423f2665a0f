"""Trained on a drive that shows little, a family is refused in one line or becomes a finite model:
no NaN is stored.
"""

import numpy as np
import pytest

import every_estimator
from every_estimator import CONFIGS, fitted
from vehest.data.errors import DataError, VehestError
from vehest.estimators.base import FitData
from vehest.estimators.luenberger import Luenberger
from vehest.estimators.model_files import WEIGHTS, load_model, save_model
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.training.context import FitContext
from vehest.training.search import DirectSearchSettings, nelder_mead_over_grid, optuna_search

STRAIGHT = dict.fromkeys(("yaw_rate", "ay", "steer", "vy_ref", "sideslip_ref", "yaw_rate_ref"), 0.0)
AT_REST = STRAIGHT | dict.fromkeys(("vx", "ax", "vx_ref", "motor_speed", "motor_current"), 0.0)
NO_CURVES = {"rational_ekf": {}}
TRAINED_THROUGH_A_FILTER = ("cnn_ukf", "learned_ukf")  # eight trainings of them take 15 s


def _with(recording, channels):
    values = {
        name: np.full(len(recording), value)
        for name, value in channels.items()
        if name in recording.channels
    }
    return recording.with_channels(values)


DRIVES = {
    "straight": lambda drive: _with(drive, STRAIGHT),
    "standing": lambda drive: _with(drive, AT_REST),
    "constant": lambda drive: _with(
        drive, {name: samples[0] for name, samples in drive.channels.items()}
    ),
    "constant_yaw_rate": lambda drive: _with(drive, {"yaw_rate": 0.1}),
    "constant_ay": lambda drive: _with(drive, {"ay": 1.0}),
    "constant_reference": lambda drive: _with(drive, {"vy_ref": 0.0, "sideslip_ref": 0.0}),
    "two_samples": lambda drive: drive.part(slice(0, 2)),
    "forty_samples": lambda drive: drive.part(slice(0, 40)),
}


@pytest.fixture
def arguments_of(monkeypatch):
    """Recordings and training with which `fitted` fits a family."""

    def arguments(name):
        family = estimator_class(name)
        recorded = []
        fit = family.fit
        monkeypatch.setattr(every_estimator, "_FITTED", {})
        monkeypatch.setattr(
            family,
            "fit",
            lambda self, data, training, context=None: (
                recorded.append((data, training)),
                fit(self, data, training, context),
            )[1],
        )
        fitted(name)
        monkeypatch.undo()
        return recorded[0]

    return arguments


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.apart if name in TRAINED_THROUGH_A_FILTER else ())
        for name in sorted(estimator_names())
    ],
)
def test_a_drive_that_shows_little_is_refused_or_gives_a_finite_model(tmp_path, arguments_of, name):
    data, training = arguments_of(name)
    config = NO_CURVES.get(name, CONFIGS.get(name, {}))
    for drive, changed in DRIVES.items():
        estimator = estimator_class(name).from_config(config)
        estimator.seed(0)
        folder = tmp_path / drive
        folder.mkdir()
        try:
            estimator.fit(FitData(*([changed(r) for r in part] for part in _parts(data))), training)
            save_model(estimator, folder, {})
        except VehestError as error:
            if "\n" in str(error) or list(folder.iterdir()):
                pytest.fail(f"{drive}: {error}")
        else:
            load_model(folder)  # refuses what is not finite


def _parts(data):
    return data.train, data.validation


@pytest.mark.parametrize("name", ["ksnn", "luenberger"])
def test_drives_without_a_bend_are_named(arguments_of, name):
    data, training = arguments_of(name)
    straight = FitData(*([_with(r, STRAIGHT) for r in part] for part in _parts(data)))
    with pytest.raises(DataError, match=r"recordings 'drive': channel 'yaw_rate' is 0 throughout"):
        estimator_class(name).from_config({}).fit(straight, training)


def test_weights_that_are_not_finite_are_not_written(tmp_path):
    estimator = Luenberger.from_config({"gain": 3.0})
    with pytest.raises(DataError, match=r"1 of the 1 numbers of 'threshold' .* training on a lap"):
        save_model(estimator, tmp_path, {"trained_on": ["a lap"]})
    assert not (tmp_path / WEIGHTS).exists()


def test_a_search_avoids_costs_that_are_not_finite():
    def cost(numbers):
        return float("nan") if numbers[0] < 0.5 else (numbers[0] - 0.7) ** 2

    settings = DirectSearchSettings(grid=3)
    searches = (
        lambda of: nelder_mead_over_grid(of, [(0.0, 1.0)], [(0.0, 1.0)], settings, FitContext()),
        lambda of: optuna_search(of, [(0.0, 1.0)], 30, 0, FitContext()),
    )
    for search in searches:
        outcome = search(cost)
        assert outcome.best[0] == pytest.approx(0.7, abs=0.05)
        assert np.isfinite(outcome.starts).all()
        with pytest.raises(DataError, match="gives a finite estimate"):
            search(lambda numbers: float("nan"))
