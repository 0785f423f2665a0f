"""Filters whose tyres adapt: the compiled one against automatic differentiation, tyres found again,
bad input survived.
"""

import importlib.util

import numpy as np
import pytest
import torch
from readable_filters import extended_filter, rational_model
from refusals import refusal

from rational_drive import CURVES, NOISE, changed, rational_drive
from single_track_drive import with_gaps
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import FitData
from vehest.estimators.filtering.rational_fit import BOXES
from vehest.estimators.filtering.rational_model import KINDS, LEVELS
from vehest.estimators.model_files import load_model, save_model
from vehest.estimators.registry import estimator_class
from vehest.filters.gaussian import Gaussian
from vehest.training.context import FitContext
from vehest.training.noise_tuning import NoiseTuningSettings
from vehest.training.search import optuna_search
from vehest.vehicle.rational_tyres import AxleForce, rational_axle

LEVEL = {"yaw_rate": 0.005, "ay": 0.15, "steer": 0.003, "tyres": 0.01}
QUICK = NoiseTuningSettings(grid=1, max_evaluations=25)


def rational(tyres="rational_adaptive", **config):
    """A filter with everything given."""
    curves = {
        name: value for name, value in CURVES.items() if tyres != "linear" or name.startswith("c2")
    }
    return unfitted(**{"tyres": tyres, "noise": LEVEL, "curves": curves, **config})


def unfitted(**config):
    """A filter whose curves or levels are not given."""
    return estimator_class("rational_ekf").from_config(config)


@pytest.fixture(scope="module")
def drive():
    return rational_drive(40.0, seed=1)


def readable(estimator, samples):
    """The extended filter of the same model, with Jacobians from automatic differentiation, step by
    step.
    """
    first = Gaussian(*map(torch.as_tensor, estimator.first_gaussian(samples[0], {})))
    return extended_filter(
        rational_model(estimator),
        torch.as_tensor(samples[:, [0, 2]]),
        torch.as_tensor(samples[:, [1, 3]]),
        first,
    )


def test_rational_tyre_slopes_and_peak_match_differentiation_and_closed_form():
    values = torch.tensor([0.06, np.log(0.008), np.log(7e4), np.log(0.7)], dtype=torch.float64)
    axle_force = rational_axle(values[0], values[1].exp(), values[2].exp(), values[3].exp())
    slopes = torch.func.jacrev(
        lambda v: rational_axle(v[0], v[1].exp(), v[2].exp(), v[3].exp()).force
    )(values)
    assert torch.allclose(torch.stack(axle_force[1:]), slopes, rtol=1e-12)
    assert AxleForce._fields[1:] == ("per_slip", "per_log_c1", "per_log_c2", "per_log_friction")
    slip = np.linspace(0.0, 0.4, 100001)
    force = rational_axle(slip, 0.008, 7e4, 1.0).force
    assert slip[force.argmax()] == pytest.approx(np.sqrt(2 * 0.008), abs=1e-5)
    assert force.max() == pytest.approx(7e4 * np.sqrt(2 * 0.008) / 2)
    assert np.array_equal(rational_axle(slip, np.inf, 7e4, 1.0).force, 7e4 * slip)


@pytest.mark.parametrize("tyres", KINDS)
def test_compiled_jacobians_are_those_of_automatic_differentiation(tyres):
    """One prediction of a covariance without noise is A P Aᵀ, that of a known state Δt σ² B Bᵀ."""
    estimator = rational(tyres)
    track = estimator.track()
    n = 4 + len(estimator.adapted)
    generator = np.random.default_rng(0)
    for sample in (np.array([np.nan, 22.0, np.nan, 0.11]), np.array([np.nan, 9.0, np.nan, -0.3])):
        root = 0.01 * generator.standard_normal((n, n))
        mean = 0.1 * generator.standard_normal(n)
        state = torch.as_tensor(mean)
        inputs = torch.as_tensor(sample[[1, 3]])
        slope = torch.func.jacrev(track.transition)(state, inputs).numpy()
        steering = torch.func.jacrev(track.transition, 1)(state, inputs)[:, 1].numpy()
        wander = np.diag([0.0] * 4 + [0.05**2] * (n - 4))
        rows = np.stack([sample, sample])
        silent = estimator.filter_samples(
            rows, Gaussian(mean, root @ root.T), levels=dict.fromkeys(LEVELS, 0.0)
        ).last
        noisy = estimator.filter_samples(
            rows,
            Gaussian(mean, np.zeros((n, n))),
            levels=dict(zip(LEVELS, (0.1, 0.1, 0.2, 0.05), strict=True)),
        ).last
        assert np.allclose(silent.mean, track.transition(state, inputs), rtol=1e-12)
        assert np.allclose(
            silent.covariance, slope @ root @ root.T @ slope.T, rtol=1e-9, atol=1e-15
        )
        assert np.allclose(
            noisy.covariance,
            track.step * (0.04 * np.outer(steering, steering) + wander),
            rtol=1e-9,
            atol=1e-15,
        )


def filtered_as_readable(estimator, samples):
    """The compiled filter's result, whose means and last covariance are the readable filter's."""
    ours = estimator.filter_samples(samples)
    theirs = readable(estimator, samples).filtered
    assert np.abs(ours.mean - theirs.mean.numpy()).max() < 1e-9
    assert np.abs(ours.last.covariance - theirs.covariance[-1].numpy()).max() < 1e-9
    return ours


@pytest.mark.parametrize("unstable", [False, True])
def test_both_forms_begin_anew_where_an_unstable_car_was_lost(unstable):
    """A bend of 15 s without measurements: with too soft a rear axle the model spins, of which no
    filter may be sure.
    """
    curves = {**CURVES, "c2_rear": (0.5 if unstable else 1.0) * CURVES["c2_rear"]}
    estimator = rational("rational", curves=curves)
    count = round(15.0 * estimator.settings.rate_hz)
    samples = np.full((count, 4), np.nan)
    samples[:, 1] = 25.0
    samples[:, 3] = 0.02
    unscented = rational("rational", curves=curves, filter="unscented").filter_samples(samples)
    for filtered in (filtered_as_readable(estimator, samples[:80]), unscented):
        begun_anew = np.isclose(filtered.deviation[1:, 0], 0.05) & (filtered.mean[1:, 2] == 0.0)
        assert begun_anew.any() == unstable
        assert np.abs(filtered.mean[:, 0]).max() < 1.5


@pytest.mark.parametrize("tyres", KINDS)
def test_sideslip_beyond_its_limit_restarts_motion_and_tyres_in_both_forms(tyres, drive):
    """A limit of 1.5° on a drive that goes beyond: there the car rolls again, and tyres are what
    they were.
    """
    estimator = rational(tyres, largest_sideslip=np.radians(1.5))
    samples = drive.cut(0.0, 4.0).stack(estimator.channels)
    ours = filtered_as_readable(estimator, samples)
    free = rational(tyres).filter_samples(samples).mean
    assert np.abs(free[:, 0]).max() > np.radians(1.5)
    assert np.mean(np.abs(ours.mean[:, 0]) > np.radians(1.5)) < np.mean(
        np.abs(free[:, 0]) > np.radians(1.5)
    )


@pytest.mark.parametrize(
    "config",
    [{"tyres": "rational_friction"}, {"filter": "unscented", "adapt_above": 2.0}],
)
def test_online_is_batch_through_gaps_and_a_stop_and_from_its_file(config, drive, tmp_path):
    gappy = with_gaps(drive, {"yaw_rate": slice(100, 120), "ay": slice(110, 150)}).cut(0.0, 12.0)
    gappy = changed(gappy, {"vx": np.where(np.abs(gappy.time - 9.0) < 1.0, 1.0, gappy["vx"])})
    estimator = rational(**config)
    estimate = estimator.estimate([gappy.without_references()])[0]
    save_model(estimator, tmp_path)
    stepper = load_model(tmp_path).online()
    steps = [
        stepper.step({name: gappy[name][k] for name in estimator.channels})
        for k in range(len(gappy))
    ]
    for name in set(steps[0]) - {"vy_variance"}:
        assert np.allclose([step[name] for step in steps], estimate[name], rtol=1e-9, atol=1e-9)


def test_unscented_filter_agrees_where_the_model_is_nearly_linear_in_its_uncertainty(drive):
    short = drive.cut(0.0, 15.0)
    extended, unscented = (
        rational(filter=kind).estimate([short])[0] for kind in ("extended", "unscented")
    )
    assert np.degrees(np.abs(extended["sideslip"] - unscented["sideslip"])[40:].max()) < 0.1
    assert (extended["nis_dof"] == 2).all()


def test_changed_tyres_and_friction_are_identified_and_reduce_the_error():
    """Tyres 15 % softer than those fitted: c₂ of both axles within 5 % of the truth after 90 s, and
    half the error of fixed tyres.
    """
    worn = rational_drive(120.0, seed=2, stiffness=0.85)
    adaptive = rational().estimate([worn])[0]
    fixed = rational("rational").estimate([worn])[0]
    for axle in ("front", "rear"):
        late = adaptive[f"cornering_stiffness_{axle}"][-600:]
        assert late.mean() == pytest.approx(0.85 * CURVES[f"c2_{axle}"], rel=0.05)
    late = worn.cut(60.0, 120.0)
    errors = [
        np.sqrt(np.mean((estimate["sideslip"][1200:] - late["sideslip_ref"]) ** 2))
        for estimate in (adaptive, fixed)
    ]
    assert errors[0] < 0.5 * errors[1]
    estimate = rational("rational_friction").estimate([rational_drive(60.0, seed=3, friction=0.7)])[
        0
    ]
    assert estimate["friction"][-200:].mean() == pytest.approx(0.7, abs=0.03)
    assert np.allclose(
        estimate["cornering_stiffness_front"], CURVES["c2_front"] * estimate["friction"]
    )


def test_tyre_states_are_constant_straight_ahead_and_adapt_in_bends(drive):
    """Where |u r| is below the limit the parameters stay, and an offset of ay on a straight no
    longer moves them.
    """
    estimator = rational(adapt_above=2.0)
    filtered = estimator.filter_samples(drive.stack(estimator.channels))
    before = filtered.mean[:-1, 4:]
    after = filtered.mean[1:, 4:]
    is_constant = (before == after).all(axis=1)
    bend = np.abs(drive["vx"] * filtered.mean[:, 1])[1:]
    assert is_constant[bend < 1.5].all()
    assert not is_constant[bend > 2.5].any()
    assert 0.1 < is_constant.mean() < 0.9
    straight = changed(
        drive, {"steer": np.zeros(800), "yaw_rate": np.zeros(800), "ay": np.full(800, 0.3)}
    )
    straight_states, moved = (
        rational(adapt_above=limit).filter_samples(straight.stack(estimator.channels)).last.mean[4:]
        for limit in (2.0, 0.0)
    )
    assert (straight_states == 0.0).all()
    assert np.abs(moved).max() > 0.1
    assert (rational(adapt_above=2.0).variant, rational("rational", adapt_above=2.0).variant) == (
        "ratte_held",
        "ratt",
    )


def test_tyre_parameters_stay_inside_bounds_wider_than_the_initial_uncertainty(drive):
    absurd = changed(drive, {"ay": -3.0 * drive["ay"], "yaw_rate": 2.0 * drive["yaw_rate"]})
    for tyres in ("linear", "rational_adaptive", "rational_friction"):
        estimator = rational(tyres, bound=1.5, noise={**LEVEL, "tyres": 0.5})
        states = estimator.filter_samples(absurd.stack(estimator.channels)).mean[:, 4:]
        assert np.abs(states).max() == pytest.approx(np.log(1.5)), "the bound is reached"
        assert (np.abs(states) <= np.log(1.5)).all()
    # With logarithms known to 0.5 the bound of a factor of 3 would cut their band at 2.2 standard
    # deviations.
    wide = rational(curves={**CURVES, "deviation": 0.5})
    narrow = rational()
    assert wide.model().bounds[4:] == pytest.approx([1.5] * 4)
    assert narrow.model().bounds[4:] == pytest.approx([np.log(3.0)] * 4)


@pytest.mark.parametrize("kind", ["extended", "unscented"])
def test_standing_and_reversing_cars_roll_without_slip_and_adapt_no_tyres(kind, drive):
    vx = np.interp(drive.time[:200], [0, 3, 5, 7, 10], [20.0, 0.0, 0.0, -2.0, 20.0])
    slow = changed(drive.cut(0.0, 10.0), {"vx": vx, "steer": np.full(200, 0.1)})
    estimator = rational(filter=kind)
    estimate = estimator.estimate([slow])[0]
    below = vx < estimator.settings.minimum_speed
    assert all(np.isfinite(values).all() for values in estimate.channels.values())
    assert np.isfinite(estimate.covariance).all()
    assert np.allclose(estimate["vy"][below], vx[below] * np.tan(0.1 * 1.07 / 2.40))
    assert len(set(estimate["cornering_stiffness_front"][below])) == 1
    assert (estimate["nis_dof"][below] == 0).all()


def test_fit_finds_curves_and_levels_and_innovations_become_as_large_as_expected():
    train = rational_drive(60.0, seed=4)
    validation_drive = rational_drive(40.0, seed=5)
    estimator = unfitted(tyres="rational")
    assert (estimator.learns, estimator.n_parameters, estimator.variant) == (True, 7, "ratt")
    assert "has no axle curves yet; fit or load it first" in refusal(
        lambda: estimator.online(), ConfigurationError
    )
    record = estimator.fit(FitData([train], [validation_drive]), QUICK)
    for name, value in CURVES.items():
        assert record.metrics[name] == pytest.approx(value, rel=0.15)
        assert 0.0 < record.metrics[f"{name}_interval"] < 0.3 * value
    filtered = estimator.filter_samples(train.stack(estimator.channels))
    nis, n_measured = filtered.nis()
    assert nis.sum() / n_measured.sum() == pytest.approx(1.0, rel=0.05)
    assert np.degrees(np.sqrt(record.metrics["best_validation_loss"])) < 0.15
    assert record.metrics["best_validation_loss"] == pytest.approx(
        np.mean(
            (
                estimator.estimate([validation_drive])[0]["sideslip"]
                - validation_drive["sideslip_ref"]
            )[30:]
            ** 2
        )
    )
    second_filter = unfitted(tyres="rational")
    second_filter.load_weights(estimator.weights())
    assert np.array_equal(
        second_filter.estimate([validation_drive])[0]["vy"],
        estimator.estimate([validation_drive])[0]["vy"],
    )


@pytest.mark.parametrize("fault", ["slip", "force"])
def test_stiffness_intervals_cover_the_truth_with_offset_sensors(fault):
    """A sideslip angle 0.15° off, and an accelerometer that shows 5 % too much: the fit's residuals
    show neither.
    """
    drive = rational_drive(60.0, seed=4)
    wrong = {
        "slip": {"sideslip_ref": drive["sideslip_ref"] + np.radians(0.15)},
        "force": {"ay": 1.05 * drive["ay"]},
    }[fault]
    estimator = unfitted()
    record = estimator.fit(FitData([changed(drive, wrong)], []), NoiseTuningSettings(method="data"))
    for name in ("c2_front", "c2_rear"):
        assert abs(record.metrics[name] - CURVES[name]) < record.metrics[f"{name}_interval"]


def test_unscented_levels_are_searched_through_the_extended_filter_within_limits():
    train = rational_drive(30.0, seed=9)
    estimator = unfitted(tyres="rational")
    assert estimator.fit(FitData([train], []), QUICK).metrics["levels_at_limits"] == 0
    train = rational_drive(30.0, seed=8)
    fitted = [unfitted(filter=kind) for kind in ("extended", "unscented")]
    for estimator in fitted:
        estimator.fit(FitData([train], []), NoiseTuningSettings(grid=1, max_evaluations=5))
    assert fitted[0].values == fitted[1].values
    assert fitted[1].settings.filter == "unscented"


def test_curves_come_from_the_recordings_that_are_named_and_need_a_reference(drive):
    """Tyres 15 % softer in a second drive do not change the curves, only the levels."""
    train = rational_drive(60.0, seed=4)
    worn = rational_drive(60.0, seed=7, stiffness=0.85)
    alone, two_drives = (unfitted(curves={"deviation": spread}) for spread in (None, 0.2))
    alone.fit(FitData([train], []), NoiseTuningSettings(method="data"))
    two_drives.fit(FitData([train, worn], []), NoiseTuningSettings(method="data", curves_from="*4"))
    assert np.array_equal(alone.axle_curves, two_drives.axle_curves)
    np.testing.assert_allclose(
        two_drives.curve_covariance - alone.curve_covariance, 0.04 * np.eye(4), atol=1e-12
    )
    with pytest.raises(
        ConfigurationError,
        match=r"curves_from 'fit_\*' matches no training recording \(rational4\)",
    ):
        two_drives.fit(FitData([train], []), NoiseTuningSettings(curves_from="fit_*"))
    assert "sideslip_ref" in refusal(
        lambda: rational(noise={"tyres": 0.01}).fit(
            FitData([drive.without_references()], []), QUICK
        )
    )


def test_levels_of_the_data_need_no_search_and_full_settings_no_fit():
    train = rational_drive(30.0, seed=6)
    estimator = unfitted(noise={"tyres": 0.02})
    record = estimator.fit(FitData([train], []), NoiseTuningSettings(method="data"))
    assert record.metrics["noise_tyres"] == 0.02
    assert record.metrics["noise_yaw_rate"] == pytest.approx(NOISE["yaw_rate"], rel=0.2)
    assert estimator.n_parameters == 7
    assert "evaluations" not in record.metrics
    estimator = rational()
    assert (estimator.learns, estimator.n_parameters, estimator.variant) == (False, 0, "ratte")
    assert np.isfinite(
        estimator.online().step({"vx": 20.0, "yaw_rate": 0.1, "ay": 2.0, "steer": 0.01})["vy"]
    )


@pytest.mark.skipif(
    importlib.util.find_spec("optuna") is None, reason="needs optuna: pip install 'vehest[tuning]'"
)
def test_optuna_reaches_the_minimum_and_improves_levels_within_their_box():
    train = rational_drive(30.0, seed=9)
    few_trials, many_trials = (unfitted(tyres="rational") for _ in range(2))
    records = [
        search.fit(FitData([train], []), NoiseTuningSettings(method="optuna", trials=n))
        for search, n in ((few_trials, 3), (many_trials, 25))
    ]
    assert [record.metrics["evaluations"] for record in records] == [3, 25]
    assert records[1].metrics["best_train_loss"] <= records[0].metrics["best_train_loss"]
    low, high = BOXES["ay"]
    assert 10.0**low <= many_trials.values["ay"] / many_trials.values["yaw_rate"] <= 10.0**high
    records = [
        optuna_search(lambda p: float((p[0] - 0.3) ** 2), [(-1.0, 1.0)], 40, 7, FitContext())
        for _ in range(2)
    ]
    assert records[0].best[0] == pytest.approx(0.3, abs=0.1)
    assert np.array_equal(records[0].starts, records[1].starts)
