"""The learned filter as an estimator: candidates, starts, dropouts, members, and refusals."""

from functools import cache

import numpy as np
import pytest
import torch
from refusals import refusal

from every_estimator import fitted
from single_track_drive import with_gaps
from small_car_drive import small_car_drive
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.estimators.base import FitData
from vehest.estimators.learned_ukf import SHORT, LearnedUkf
from vehest.estimators.registry import estimator_class
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseSettings
from vehest.training.through_filter import ThroughFilterSettings

REFERENCES = {"vx": "vx_ref", "vy": "vy_ref", "yaw_rate": "yaw_rate_ref"}


def quick(epochs=1, single_step=40, **changes):
    phases = {
        "one_step": PhaseSettings(
            learning_rate=1e-2,
            max_epochs=single_step,
            validate_every=single_step,
            schedule="cosine",
        ),
        "through": PhaseSettings(learning_rate=1e-3, max_epochs=epochs),
        "noise": PhaseSettings(learning_rate=1e-3, max_epochs=epochs),
    }
    sizes = {
        "one_step_batch": 128,
        "steps": 100,
        "validation_steps": 150,
        "validation_drop_steps": 30,
        "dtype": "float64",
    }
    return ThroughFilterSettings(**phases, **sizes | changes)


def data():
    return FitData([small_car_drive(4.0, 0), small_car_drive(4.0, 1)], [small_car_drive(4.0, 2)])


def estimator(family=LearnedUkf, **config):
    created = family.from_config({"width": 16} | config)
    created.seed(0)
    return created


@cache
def trained():
    """NNTF_UH, trained for a moment; tests leave it as it is."""
    ukf = estimator()
    drives = FitData(
        [small_car_drive(8.0, seed) for seed in (10, 11, 12)], [small_car_drive(4.0, 2)]
    )
    ukf.fit(drives, quick(1, 200, one_step_batch=256))
    return ukf


def drive(seed=3, seconds=6.0):
    return small_car_drive(seconds, seed).without_references()


def test_variants_are_called_and_parameters_counted_as_in_the_paper():
    cases = {
        "pc": {"dynamics": "pacejka", "noise": "constant", "through_filter": False},
        "pcr": {"dynamics": "residual", "noise": "constant", "through_filter": False},
        "nn_u": {"dynamics": "neural", "noise": "constant"},
        "nnt_uh": {"dynamics": "tyre_network"},
        "nntf_uh": {},
        "nntf_uh_mu0.4": {"start_friction": 0.4},
        "nntf_uh_unrepaired": {"repair": False},
        "nntf_uh_si": {"scaled": False},
    }
    assert {name: LearnedUkf.from_config(config).variant for name, config in cases.items()} == {
        name: name for name in cases
    }
    # A network of 9, 64, 64, 4 for the tyres, nine numbers of the car, factors of the noise and of
    # its dependence on the state.
    ukf = estimator_class("learned_ukf").from_config({})
    assert ukf.settings == LearnedUkf.settings_type()
    network = 9 * 64 + 64 + 64 * 64 + 64 + 64 * 4 + 4
    assert ukf.n_parameters == network + 9 + (15 + 15 * 6) + (10 + 10 * 6) + 15
    assert torch.get_default_dtype() == torch.float32


@pytest.mark.parametrize("dynamics", SHORT)
def test_every_candidate_learns_and_estimates_with_a_covariance(dynamics):
    ukf = estimator(
        dynamics=dynamics,
        noise="constant" if dynamics == "pacejka" else "state_dependent",
        through_filter=dynamics != "residual",
    )
    short = FitData([small_car_drive(1.2, 0)], [small_car_drive(1.2, 2)])
    record = ukf.fit(
        short, quick(single_step=2, steps=40, validation_steps=60, validation_drop_steps=10)
    )
    assert record.metrics["epochs"] == 3
    assert record.history["epoch"] == [1, 2, 3], (
        "whole numbers, over all phases, as a tracker wants them"
    )
    assert record.history["phase"] == [0, 0, 1]
    assert record.metrics["skipped_steps"] == 0
    assert record.metrics["best_validation_loss"] <= record.metrics["start_validation_loss"] < 10.0
    estimate = ukf.estimate([small_car_drive(1.0, 3).without_references()])[0]
    assert estimate.covariance_of == ("vx", "vy", "yaw_rate", "rim_speed", "friction")
    assert (np.linalg.eigvalsh(estimate.covariance) > 0).all()
    assert all(
        np.isfinite(estimate[name]).all()
        for name in ("vx", "vy", "yaw_rate", "rim_speed", "friction", "sideslip", "nis")
    )


def test_it_estimates_an_unseen_drive_from_any_start_after_a_moment_of_training():
    """A sliding car's lateral velocity to less than half of its deviation, which a filter that
    calls it zero does not reach.
    """
    recording = small_car_drive(6.0, 3)
    start = {name: float(recording[reference][0]) for name, reference in REFERENCES.items()}
    estimate = trained().estimate([recording.without_references()], start)[0]
    for name, reference in REFERENCES.items():
        error = (estimate[name] - recording[reference])[100:]
        assert np.sqrt(np.mean(error**2)) < (
            0.5 * recording["vy_ref"].std() if name == "vy" else 0.3
        ), name
    recording = drive()
    free, started = (
        trained().estimate([recording], state)[0]
        for state in (None, {"vx": 2.5, "vy": 0.4, "yaw_rate": 0.5})
    )
    assert abs(started["vy"][0] - 0.4) < 0.1 < abs(free["vy"][0] - 0.4)
    assert started.covariance[0, 1, 1] < free.covariance[0, 1, 1]
    assert abs(started["vy"][-1] - free["vy"][-1]) < 0.02


def test_members_that_differ_in_the_start_of_friction_share_their_training():
    first_ukf = estimator()
    second_ukf = estimator(start_friction=0.4)
    third = estimator(repair=False)
    assert (
        first_ukf.batch_key
        == second_ukf.batch_key
        == third.batch_key
        != estimator(noise="constant").batch_key
    )
    messages = []
    short = FitData([small_car_drive(1.2, 0)], [small_car_drive(1.2, 2)])
    LearnedUkf.fit_members(
        [first_ukf, second_ukf, third],
        short,
        quick(single_step=2, steps=40, validation_steps=60),
        FitContext(on_progress=messages.append),
    )
    assert len(messages) == 3, "the epochs of one training"
    for name, values in first_ukf.weights().items():
        assert np.array_equal(values, second_ukf.weights()[name]), name
    first = [
        ukf.estimate([drive(seconds=1.0)])[0]["friction"][0] for ukf in (first_ukf, second_ukf)
    ]
    assert first == pytest.approx([0.6, 0.4], abs=0.03)
    assert (first_ukf.filter.repair, third.filter.repair) == (True, False)


@pytest.mark.parametrize("sensor", ["ay", "steer", "motor_speed"])
def test_half_a_second_without_a_sensor_stays_finite_and_is_forgotten(sensor):
    complete = drive()
    estimate, undisturbed = (
        trained().estimate([recording])[0]
        for recording in (with_gaps(complete, {sensor: slice(200, 250)}), complete)
    )
    for name in ("vx", "vy", "yaw_rate", "rim_speed", "friction", "sideslip"):
        assert np.isfinite(estimate[name]).all(), name
    assert np.array_equal(estimate["vy"][:200], undisturbed["vy"][:200])
    assert not np.array_equal(estimate["vy"][200:250], undisturbed["vy"][200:250])
    assert np.abs(estimate["vy"][-100:] - undisturbed["vy"][-100:]).max() < 0.05
    if sensor != "steer":
        assert np.array_equal(estimate["nis_dof"][[199, 200, 249, 250]], [4, 3, 3, 4])


@pytest.mark.parametrize(
    "dtype", ["float64", pytest.param("float32", marks=pytest.mark.apart)]
)  # compiles the filter's training for a minute
def test_estimates_from_pure_noise_stay_finite_and_bounded(dtype):
    """20 s of nothing but noise, with the deviations and worse of a wild drive."""
    generator = np.random.default_rng(0)
    scales = {
        "ax": 6.0,
        "ay": 6.0,
        "yaw_rate": 3.0,
        "motor_speed": 60.0,
        "steer": 0.3,
        "motor_current": 15.0,
    }
    channels = {name: scale * generator.standard_normal(2000) for name, scale in scales.items()} | {
        "vx": np.zeros(2000)
    }
    recording = Recording(
        "noise", "none", 100.0, 0.0, channels | {"vx": 0.05 * channels["motor_speed"]}, "simulated"
    )
    estimate = fitted("learned_ukf", dtype).estimate([recording])[0]
    for name in ("vx", "vy", "yaw_rate", "rim_speed", "friction"):
        assert np.isfinite(estimate[name]).all(), name
    assert np.isfinite(estimate.covariance).all()
    assert min(estimate["vx"].min(), estimate["friction"].min()) >= 0.05 - 1e-6


def test_weights_and_drives_that_do_not_fit_are_a_clear_error():
    assert "do not fit its settings: 'dynamics.network.0.bias'" in refusal(
        lambda: estimator(width=8).load_weights(trained().weights())
    )
    missing = small_car_drive(1.2, 0).without_references()
    with pytest.raises(
        DataError, match="has no channel 'vx_ref', on which estimator 'learned_ukf' is trained"
    ):
        estimator().fit(FitData([missing], [missing]), quick())
    gappy = with_gaps(small_car_drive(1.2, 0), {"steer": slice(3, 5)})
    assert "channel 'steer' has gaps" in refusal(
        lambda: estimator().fit(FitData([gappy], [gappy]), quick())
    )


@pytest.mark.parametrize("noise", ["constant", "state_dependent"])
def test_diagonal_noise_stays_diagonal_while_it_learns(noise):
    full = estimator(noise=noise)
    diagonal = estimator(noise=noise, correlated_noise=False)
    for ukf in (full, diagonal):
        ukf.fit(data(), quick(single_step=3))
    assert diagonal.variant == f"{full.variant}_diagonal"
    state = torch.tensor([[2.0, 0.3, 1.0, 2.1, 0.6]], dtype=torch.float64)
    inputs = torch.zeros(1, 2, dtype=torch.float64)
    for ukf, is_diagonal in ((diagonal, True), (full, False)):
        for part in (ukf.filter.process_noise, ukf.filter.observation_noise):
            with torch.no_grad():
                covariance = part(state, inputs)[0]
            assert bool((covariance == covariance.diagonal().diag()).all()) == is_diagonal
            assert (torch.linalg.eigvalsh(covariance) > 0).all()
    start = estimator(noise=noise, correlated_noise=False)
    start.filter.to(torch.float64).begin_noise(
        [diagonal.drive(ukf, torch.float64) for ukf in data().train], 0.2
    )
    with torch.no_grad():
        moved = diagonal.filter.process_noise(state, inputs) - start.filter.process_noise(
            state, inputs
        )
    assert (moved[0].diagonal().abs() > 0).all(), "the diagonal has learnt"
    n_outputs = (1 + 5 + 1) if noise == "state_dependent" else 1
    assert full.n_parameters - diagonal.n_parameters == n_outputs * (10 + 6), (
        "entries off the diagonals of 5 and 4 rows"
    )


def test_curvature_starts_at_pacejkas_curves_without_it_and_is_learnt():
    plain = {"dynamics": "pacejka", "noise": "constant", "through_filter": False}
    plain_ukf = estimator(**plain)
    curved_ukf = estimator(curvature=True, **plain)
    assert curved_ukf.n_parameters == plain_ukf.n_parameters + 3
    state = torch.tensor([[2.0, 0.3, 1.0, 2.1, 0.6]])
    inputs = torch.tensor([[0.1, 8.0]])
    with torch.no_grad():
        torch.testing.assert_close(
            curved_ukf.filter.moved(state, inputs),
            plain_ukf.filter.moved(state, inputs),
            rtol=0,
            atol=1e-6,
        )
    with pytest.raises(ConfigurationError, match="cannot be exported to C"):
        curved_ukf.c_values()
    curved_ukf.fit(
        FitData([small_car_drive(1.2, 0)], [small_car_drive(1.2, 2)]),
        quick(single_step=5, steps=40, validation_steps=60),
    )
    assert curved_ukf.variant == "pc_curved"
    assert (curved_ukf.filter.dynamics.tyres.curvature.detach().abs() > 0).all()
