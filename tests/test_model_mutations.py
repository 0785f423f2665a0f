"""A model folder with mutated numbers: one error line, or estimates that are bounded or invalid."""

import random
import shutil
import time

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file, save_file

from every_estimator import drive_for, fitted
from vehest.data.errors import DataError, VehestError
from vehest.data.recording import Recording
from vehest.estimators.model_files import DESCRIPTION, WEIGHTS, load_model, save_model
from vehest.trust.contract import GuardedRun, limits_for
from vehest.trust.health import INVALID

NUMBERS = (0.0, -0.0, -1.0, 1e-300, 1e-30, 1e12, 1e38, 1e300, -1e38, float("nan"), float("inf"))
PLAIN = (None, True, "x", "1e400", -1, 0, 10**9, 10**400, 1e-300, 1e38, [], {}, [1, 2], {"a": 1})
MUTATIONS = 40
MAX_SECONDS = 5.0  # of a mutation; without any, milliseconds


def _leaves(content, above=()):
    for key, value in content.items():
        yield (*above, key)
        if isinstance(value, dict):
            yield from _leaves(value, (*above, key))


def _mutate_description(folder, draw):
    path = folder / DESCRIPTION
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    *above, key = draw.choice(list(_leaves(content)))
    inner = content
    for name in above:
        inner = inner[name]
    inner[key] = draw.choice(PLAIN)
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return f"{'.'.join((*above, key))} = {str(inner[key])[:20]}"


def _mutate_weights(folder, draw):
    path = folder / WEIGHTS
    tensors = load_file(path)
    name = draw.choice(sorted(tensors))
    number = draw.choice(NUMBERS)
    values = tensors[name].copy().reshape(-1)
    with np.errstate(over="ignore"):
        if draw.random() < 0.5:
            values[:] = number
        else:
            values[draw.randrange(values.size)] = number
    save_file({**tensors, name: values.reshape(tensors[name].shape)}, path)
    return f"{name} = {number}"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", ["kalman", "ksnn", "ensemble_ukf", "self_calibrating"])
def test_a_mutated_model_is_refused_or_its_estimate_is_bounded(tmp_path, name):
    model = fitted(name)
    drive = drive_for(model)
    original = tmp_path / "model"
    original.mkdir()
    save_model(model, original, {"trained_on": ["a drive"], "seed": 1})
    draw = random.Random(0)
    for number in range(MUTATIONS):
        folder = tmp_path / str(number)
        shutil.copytree(original, folder)
        mutation = (_mutate_weights if number % 2 else _mutate_description)(folder, draw)
        started = time.monotonic()
        try:
            _require_bounded(load_model(folder), drive, mutation)
        except VehestError as error:
            if "\n" in str(error):
                pytest.fail(f"{mutation}: {error}")
        assert time.monotonic() - started < MAX_SECONDS, mutation
        shutil.rmtree(folder)


def _require_bounded(model, drive, mutation):
    if model.rate_hz != drive.rate_hz:
        drive = Recording(drive.id, drive.vehicle, model.rate_hz, 0.0, drive.channels)
    estimate = GuardedRun(model)({name: drive[name] for name in model.channels}, drive)
    is_valid = estimate["health"] != INVALID
    is_valid[: model.warm_up_steps + model.horizon_steps + 1] = False
    limits = limits_for(model, None)
    bound = limits.largest_tan_sideslip * limits.top_speed
    assert (np.abs(estimate["vy"][is_valid]) <= bound).all(), mutation


def test_a_level_of_noise_beyond_its_setting_is_refused(tmp_path):
    save_model(fitted("kalman"), tmp_path)
    tensors = load_file(tmp_path / WEIGHTS)
    for number in (1e38, -0.1):
        save_file({**tensors, "steer": np.array([number])}, tmp_path / WEIGHTS)
        with pytest.raises(VehestError, match=r"safetensors': 'steer' must be"):
            load_model(tmp_path)


def test_a_network_without_a_yaw_rate_is_refused(tmp_path):
    save_model(fitted("ksnn"), tmp_path)
    tensors = load_file(tmp_path / WEIGHTS)
    save_file({**tensors, "yaw_rate_max": np.array(0.0)}, tmp_path / WEIGHTS)
    with pytest.raises(VehestError, match=r"safetensors': 'yaw_rate_max' must be positive, not 0"):
        load_model(tmp_path)


DAMAGES = {  # family, array -> (place, value, what is said of it)
    ("rational_ekf", "levels"): [
        (1, 0.0, "'ay' in 'levels' must be positive"),
        (0, -0.01, "'yaw_rate' in 'levels' must be positive"),
        (3, 1e13, "'tyres' in 'levels' must be a number of at most 1e+12"),
    ],
    ("rational_ekf", "curves"): [(1, 0.0, "'c2_front' in 'curves' must be positive")],
    ("rational_ekf", "curve_covariance"): [
        ((0, 1), 1.0, "it is not symmetric"),
        ((0, 0), -1.0, "it has the eigenvalue -1"),
        ((0, 0), 1e13, "must hold numbers of at most 1e+12"),
    ],
    ("dugoff_ukf", "levels"): [(0, 0.0, "'process_vy' in 'levels' must be positive")],
    ("dugoff_ukf", "tyres"): [
        (1, -1.0, "'friction_front' in 'tyres' must be positive"),
        (2, -1e-3, "'reduction_front' in 'tyres' must be at least 0"),
    ],
    ("ensemble_ukf", "filter.levels"): [(2, -0.5, "'ay' in 'levels' must be positive")],
    ("ensemble_ukf", "scaling"): [(1, 1e12, "'p2' in 'scaling' must lie between 0.2 and 2")],
    ("ensemble_ukf", "network.unit"): [((), 0.0, "'unit' must be positive, not 0")],
    ("cnn_ukf", "filter.tyres"): [(0, 0.0, "'cornering_stiffness_front' in 'tyres' must be")],
    ("cnn_ukf", "network.input_span"): [(0, -1.0, "'input_span' must be positive, not -1")],
    ("sideslip_ffnn", "input_span"): [(2, 0.0, "'input_span' must be positive, not 0")],
    ("gru", "input_scale"): [(0, 0.0, "'input_scale' must be positive, not 0")],
    ("velocity_lstm", "output_scale"): [(1, -2.0, "'output_scale' must be positive, not -2")],
    ("learned_ukf", "dynamics.network.input_scale"): [
        (4, 0.0, "'dynamics.network.input_scale' must be positive, not 0")
    ],
}


@pytest.mark.parametrize(("name", "array"), DAMAGES)
def test_an_impossible_weight_is_refused_in_a_line_that_names_the_file(tmp_path, name, array):
    save_model(fitted(name), tmp_path)
    load_model(tmp_path)
    tensors = load_file(tmp_path / WEIGHTS)
    for place, value, says in DAMAGES[name, array]:
        damaged = tensors[array].copy()
        damaged[place] = value
        save_file({**tensors, array: damaged}, tmp_path / WEIGHTS)
        with pytest.raises(DataError) as refused:
            load_model(tmp_path)
        assert str(refused.value).startswith(f"'{tmp_path / WEIGHTS}': ")
        assert says in str(refused.value)
        assert "\n" not in str(refused.value)


def test_settings_that_no_estimator_accepts_are_refused_in_a_line(tmp_path, monkeypatch):
    save_model(fitted("gru"), tmp_path)
    kind = type(fitted("gru"))

    def damaged(self):
        raise TypeError("a defect")

    monkeypatch.setattr(kind, "min_weights", damaged)
    with pytest.raises(DataError, match=r"model\.yaml': no estimator can be built .*a defect"):
        load_model(tmp_path)
