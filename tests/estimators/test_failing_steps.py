"""A step that raises leaves its stepper as it was: whoever goes on gets what he would have got without it."""

import math
from functools import cache
from itertools import product

import numpy as np
import pytest
from test_gated_filters import estimator as filter_of

from every_estimator import fitted
from single_track_drive import linear_drive
from small_car_drive import small_car_drive
from vehest.data.errors import DataError
from vehest.estimators.registry import estimator_class, estimator_names

SETTINGS = {
    "data_sheet": {"wheelbase": 2.7},
    "ksnn": {"window": 5},
    "gru": {"window": 5},
    "lstm": {"window": 5},
    "velocity_gru": {"inputs": ["vx", "yaw_rate", "ay", "ax"], "outputs": ["vx", "vy"], "n_states": 4},
    "velocity_lstm": {"inputs": ["vx", "yaw_rate", "ay", "ax"], "outputs": ["vx", "vy"], "n_states": 4},
    "sideslip_ffnn": {"inputs": "imu", "hidden": [8, 4]},
}
FILTERS = ("kalman", "factor_graph", "rational_ekf", "dugoff_ukf", "cnn_ukf", "learned_ukf", "learned_ukf_variant")
FITTED = ("kinematic", "static_map", "luenberger")  # in a moment
OTHERS = [name for name in estimator_names() if name not in (*FILTERS, "ensemble_ukf")]  # whose stepper is that of cnn_ukf


known = cache(fitted)


def ready(name):
    """As it starts to learn, where that runs already."""
    if name in FITTED:
        return known(name)
    made = filter_of(name, 5.0) if name in FILTERS else estimator_class(name).from_config(SETTINGS.get(name, {}))
    made.seed(0)
    return made


def rows(name):
    recording = small_car_drive(2.0) if name.startswith("learned_ukf") else linear_drive(2.0)[0]
    return [{channel: float(recording[channel][k]) for channel in recording.channels} for k in range(60)]


def missing(row):
    """Without what every method reads, or fails without."""
    return {name: value for name, value in row.items() if name not in ("ay", "vx", "steer")}


def infinite(row):
    return {**row, "ay": math.inf}


def none(row):
    return {**row, "yaw_rate": None, "vx": None}


def motion(steps):
    return np.array([step["vy"] for step in steps])


@pytest.mark.parametrize(
    ("name", "wrong"),
    [*product((*FILTERS, *OTHERS), (missing, none)), *product(FILTERS, (infinite,))],  # others take an infinite value
)
def test_who_goes_on_after_a_step_that_raised_gets_what_he_would_have_got(name, wrong):
    made, samples = ready(name), rows(name)
    calm, disturbed = made.online(), made.online()
    expected = motion([calm.step(row) for row in samples])
    found = []
    for k, row in enumerate(samples):
        if k in (0, 1, 20, 21, 40):
            with pytest.raises((DataError, TypeError)):
                disturbed.step(wrong(row))
        found.append(disturbed.step(row))
    assert np.array_equal(motion(found), expected, equal_nan=True)
