"""Filters with a gate: a spike does no harm, a jump is followed, online is batch.

A step that raises leaves any stepper as it was.
"""

import math
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from refusals import refusal

from dugoff_drive import TYRES, dugoff_drive
from every_estimator import fitted
from rational_drive import CURVES, rational_drive
from single_track_drive import NOISE, linear_drive
from small_car_drive import small_car_drive
from vehest.data.errors import ConfigurationError, DataError
from vehest.estimators.registry import estimator_class, estimator_names

SPIKE = 6.0
JUMP = 8.0  # s
DUGOFF = {
    "inputs": "imu",
    "tyres": TYRES,
    "noise": {"ay": 0.06, "yaw_rate": 0.002, "process_vy": 0.002, "process_yaw_rate": 0.002},
}
CONFIGS = {
    "kalman": {"noise": {**NOISE, "steer_factor": 1.0}},
    "factor_graph": {"window": 0.2, "noise": {"measured_ay": 0.5}},
    "rational_ekf": {
        "tyres": "rational",
        "curves": CURVES,
        "noise": {"yaw_rate": 0.005, "ay": 0.15, "steer": 0.003},
    },
    "dugoff_ukf": DUGOFF,
    "cnn_ukf": {**DUGOFF, "hidden": [8, 4]},
    "learned_ukf": {"dynamics": "pacejka", "noise": "constant"},
}
DRIVES = {
    "kalman": lambda seed: linear_drive(JUMP, seed=seed)[0],
    "factor_graph": lambda seed: linear_drive(JUMP, seed=seed)[0],
    "rational_ekf": lambda seed: rational_drive(JUMP, seed=seed),
    "dugoff_ukf": lambda seed: dugoff_drive(JUMP, seed),
    "cnn_ukf": lambda seed: dugoff_drive(JUMP, seed),
    "learned_ukf": lambda seed: small_car_drive(JUMP, seed),
}
EVERY_FILTER = pytest.mark.parametrize("name", CONFIGS)


def estimator(name, gate=None):
    """As it starts to learn, which is enough for filtering.

    Weights are the same with a gate and without.
    """
    gated = estimator_class(name).from_config({**CONFIGS[name], "gate": gate})
    gated.seed(0)
    if name in ("ensemble_ukf", "cnn_ukf"):
        network = gated.network
        network.double().reset([torch.Generator().manual_seed(0)])
        with torch.no_grad():
            network.get_parameter("bias_3")[0, 1:] = torch.tensor([0.0, -6.0, -6.0])
    if name.startswith("learned_ukf"):
        gated.filter.double().reset(torch.Generator().manual_seed(0))
    return gated


@cache
def drive(name):
    """Two drives one after the other, as if the car had jumped from one motion to another."""
    first, second = (DRIVES[name](seed).without_references() for seed in (1, 4))
    joined = {
        channel: np.concatenate([values, second[channel]])
        for channel, values in first.channels.items()
    }
    return replace(first, channels=joined)


def spoilt(name, value):
    """The drive with one wild sample of ay."""
    recording = drive(name)
    ay = recording["ay"].copy()
    ay[round(SPIKE * recording.rate_hz)] = value
    return recording.with_channels({"ay": ay})


def vy(gated, recording):
    return gated.estimate([recording])[0]["vy"]


@pytest.mark.parametrize(
    "name", [name for name in CONFIGS if name != "cnn_ukf"]
)  # whose network sees the spike, too
def test_a_spike_is_as_good_as_a_sample_that_is_missing(name):
    gated = estimator(name, 6.0)
    free = estimator(name)
    at = round(SPIKE * drive(name).rate_hz)
    clean = vy(gated, drive(name))
    spoilt_drive = spoilt(name, -1e3)
    spike = vy(gated, spoilt_drive)
    harm = np.abs(spike - clean)[at : at + 20].max()
    assert harm < 0.2
    believed = np.abs(vy(free, spoilt_drive) - vy(free, drive(name)))[at : at + 20]
    assert not (believed <= 5.0 * harm).all(), "a free filter believes it"


def test_a_wild_angle_of_a_network_is_refused(monkeypatch):
    gated = estimator("cnn_ukf", 6.0)
    pseudo_of = gated.pseudo_of
    at = round(SPIKE * 100.0)

    def sure(inputs):
        return replace(pseudo_of(inputs), variance=np.full(len(inputs), 1e-4))

    monkeypatch.setattr(gated, "pseudo_of", sure)
    clean = vy(gated, drive("cnn_ukf"))

    def wild(inputs):
        pseudo = sure(inputs)
        angle = pseudo.sideslip.copy()
        angle[at] += 1.0
        return replace(pseudo, sideslip=angle)

    monkeypatch.setattr(gated, "pseudo_of", wild)
    assert np.abs(vy(gated, drive("cnn_ukf")) - clean).max() < 0.1
    gated.settings = replace(gated.settings, gate=None)
    assert np.abs(vy(gated, drive("cnn_ukf")) - clean).max() > 0.5


@EVERY_FILTER
def test_gated_estimates_recover_after_a_jump_of_the_truth(name):
    gated = vy(estimator(name, 6.0), drive(name))
    free = vy(estimator(name), drive(name))
    back = round((JUMP + 3.0) * drive(name).rate_hz)
    size = np.sqrt(np.mean(free[back:] ** 2))
    assert np.sqrt(np.mean((gated - free)[back:] ** 2)) < 0.02 * max(size, 1.0)


@EVERY_FILTER
def test_gate_that_refuses_nothing_changes_only_the_name_of_the_variant(
    name,
):
    assert np.array_equal(vy(estimator(name), drive(name)), vy(estimator(name, 1e9), drive(name)))
    assert (
        estimator(name, 5.0).variant.replace("_gate5", "")
        == estimator(name).variant
        != estimator(name, 5.0).variant
    )
    assert "gated at 5 sigma" in estimator(name, 5.0).full_title
    assert "estimator.gate must be positive" in refusal(
        lambda: estimator(name, 0.0), ConfigurationError
    )


@EVERY_FILTER
def test_online_with_a_gate_is_batch_with_a_gate(name):
    recording = spoilt(name, 1e4)
    gated = estimator(name, 4.0)
    batch = vy(gated, recording)
    stepper = gated.online()
    online = [
        stepper.step({channel: recording[channel][k] for channel in recording.channels})["vy"]
        for k in range(len(recording))
    ]
    assert np.abs(np.array(online) - batch).max() < (
        1e-6 if name.startswith("learned_ukf") else 1e-9
    )
    if name != "factor_graph":
        n_accepted = gated.estimate([recording])[0]["nis_dof"]
        assert n_accepted[round(SPIKE * recording.rate_hz)] < n_accepted.max()


def test_gates_share_trainings_of_learned_filters_and_need_none_otherwise():
    with pytest.raises(
        ConfigurationError, match=r"estimator\.gate is there for estimator\.filter=extended only"
    ):
        estimator_class("rational_ekf").from_config(
            {**CONFIGS["rational_ekf"], "filter": "unscented", "gate": 5.0}
        )
    assert estimator("learned_ukf", 5.0).batch_key == estimator("learned_ukf").batch_key


FILTERS = (
    "kalman",
    "factor_graph",
    "rational_ekf",
    "dugoff_ukf",
    "cnn_ukf",
    "learned_ukf",
)
UNGATED = [
    name for name in estimator_names() if name not in (*FILTERS, "ensemble_ukf")
]  # whose stepper is that of cnn_ukf
fitted_once = cache(fitted)


def ready(name):
    """Filters as they start to learn, the others fitted."""
    if name not in FILTERS:
        return fitted_once(name)
    gated = estimator(name, 5.0)
    gated.seed(0)
    return gated


def rows(name):
    recording = small_car_drive(2.0) if name.startswith("learned_ukf") else linear_drive(2.0)[0]
    return [
        {channel: float(recording[channel][k]) for channel in recording.channels} for k in range(60)
    ]


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
    [
        *product((*FILTERS, *UNGATED), (missing, none)),
        *product(FILTERS, (infinite,)),
    ],  # others take an infinite value
)
def test_steps_after_a_refused_step_are_unaffected_by_it(name, wrong):
    stepper = ready(name)
    samples = rows(name)
    calm = stepper.online()
    disturbed = stepper.online()
    expected = motion([calm.step(row) for row in samples])
    estimates = []
    for k, row in enumerate(samples):
        if k in (0, 1, 20, 21, 40):
            with pytest.raises((DataError, TypeError)):
                disturbed.step(wrong(row))
        estimates.append(disturbed.step(row))
    assert np.array_equal(motion(estimates), expected, equal_nan=True)
