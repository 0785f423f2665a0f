"""Every numeric setting at its extremes: refused in one line, or the estimator runs to finite
numbers within the guard's bound.
"""

import math
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass

import numpy as np
import pytest

from every_estimator import drive_for, fitted
from vehest.data.errors import ConfigurationError, VehestError
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.trust.contract import GuardedRun, limits_for
from vehest.trust.health import INVALID

EXTREMES = (1e-300, 1e-12, 1e12, -0.0, -1, math.nan, math.inf, 10**9, 10**400)
SECONDS = 1.5


def _numeric_settings(group, above=()):
    """Path of each numeric setting, and its value."""
    for field in fields(group):
        value = getattr(group, field.name)
        path = (*above, field.name)
        if is_dataclass(value):
            yield from _numeric_settings(value, path)
        elif (
            value is None
            or _is_number(value)
            or (isinstance(value, tuple) and value and _is_number(value[0]))
        ):
            yield path, value


def _is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def _changed(config, path, value):
    name, *below = path
    return {**config, name: _changed(config[name], below, value) if below else value}


def _start_of(drive):
    steps = math.ceil(SECONDS * drive.rate_hz)
    return drive.part(slice(0, steps))


def _with_weights(estimator, weights):
    """The estimator with the weights of another one but for the numbers that its settings give."""
    numbers = getattr(estimator, "values", {})
    finite_numbers = {name: value for name, value in numbers.items() if not math.isnan(value)}
    estimator.load_weights(weights)
    if finite_numbers:
        estimator.values |= finite_numbers
    return estimator


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", estimator_names())
def test_an_extreme_setting_is_refused_or_its_estimate_is_bounded(name):
    model = fitted(name)
    weights = model.weights()
    drive = _start_of(drive_for(model))
    config = asdict(model.settings)
    settings = list(_numeric_settings(model.settings))
    n_runs = 0
    for index, (path, default) in enumerate(settings):
        for number, extreme in enumerate(EXTREMES):
            if path == ("rate_hz",):
                continue
            value = [extreme] * len(default) if isinstance(default, tuple) else extreme
            try:
                estimator = estimator_class(name).from_config(_changed(config, path, value))
            except ConfigurationError as error:
                if "\n" in str(error):
                    pytest.fail(f"{path} = {extreme}: {error}")
                continue
            if extreme != EXTREMES[0] and (index + number) % 3:
                continue  # a third of those that run, and all of them at the first extreme
            with suppress(VehestError):  # weights of another shape
                _require_bounded(_with_weights(estimator, weights), drive, f"{path} = {extreme}")
                n_runs += 1
    assert n_runs or len(settings) < 5


def _require_bounded(estimator, drive, description):
    samples = {channel: drive[channel] for channel in estimator.channels}
    estimate = GuardedRun(estimator)(samples, drive)
    is_valid = estimate["health"] != INVALID
    is_valid[: estimator.warm_up_steps + estimator.horizon_steps + 1] = False
    limits = limits_for(estimator, None)
    bound = limits.largest_tan_sideslip * limits.top_speed
    assert (np.abs(estimate["vy"][is_valid]) <= bound).all(), description


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("kalman", {"car": {"yaw_inertia": 1e-300}}, r"yaw_inertia must lie between 1e-07 and 1e"),
        ("kalman", {"noise": {"cutoff": 1e-12}}, r"noise\.cutoff must lie between 0\.001 and 0\.8"),
        ("gru", {"n_states": 2**31}, r"n_states must lie between 1 and 4096"),
        ("sideslip_ffnn", {"hidden": [2**31, 8]}, r"widths of two layers, at most 4096"),
    ],
)
def test_settings_beyond_any_car_or_memory_are_refused(name, config, message):
    values = asdict(fitted(name).settings)
    for key, value in config.items():
        values[key] = values[key] | value if isinstance(value, dict) else value
    with pytest.raises(ConfigurationError, match=message):
        estimator_class(name).from_config(values)
