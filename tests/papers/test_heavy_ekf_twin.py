"""The twin of the heavy vehicle: plant, tyres, driver, the filter with a state of crossfall, oracle tyres, and how cells are compared."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from readable_filters import NonlinearModel, extended_filter, rational_model
from scipy import integrate

from vehest.constants import GRAVITY
from vehest.filters.gaussian import Gaussian
from vehest.vehicle.rational_tyres import rational_axle
from vehest_papers.heavy_ekf import crossfall_filter, factorial, paper, vehicle
from vehest_papers.heavy_ekf.candidates import (
    BOX,
    FIRST_TUNING_SEED,
    ORACLE,
    TUNED_MISMATCHES,
    TUNED_SLIPS,
    Levels,
    estimator_of,
    mistaken,
    oracle,
    states_of,
    tuning_drives,
)
from vehest_papers.heavy_ekf.twin import (
    CURVES,
    FINER,
    RATE,
    TRUCK,
    Conditions,
    Plant,
    course,
    drive,
    driven,
)

LEVELS = Levels(ay=0.1, steer=0.005, tyres=0.003)
SECONDS = 30.0


@pytest.fixture(scope="module")
def dry():
    return [drive(Conditions(5.0), seed, SECONDS) for seed in range(6)]


@pytest.mark.parametrize(
    "conditions",
    [Conditions(3.0), Conditions(8.0, payload=True, wet_patches=True, crossfall=True)],
    ids=str,
)
def test_the_plant_is_what_another_integrator_makes_of_equations_1_to_6(conditions):
    """Steered as it was: SciPy's Dormand and Prince at 1e-10, with slips and forces written out here."""
    plant = Plant.of(payload=conditions.payload)
    own = course(conditions, np.random.default_rng(3), 12.0)
    states, steer, lateral = driven(plant, own)
    car = plant.car
    step = 1.0 / (RATE * FINER)
    front_load = plant.load_front
    rear_load = plant.load_rear

    def slope(time, state, k):
        beta, r = state
        u = own.speed[k]
        mu = own.friction[k]
        slips = steer[k] - beta - car.cg_to_front_axle * r / u, -beta + car.cg_to_rear_axle * r / u
        front, rear = (
            c2 * mu * load * slip * c1 * (mu + 1.0) / (slip**2 + c1 * (mu + 1.0))
            for slip, c1, c2, load in zip(
                slips, CURVES[::2], CURVES[1::2], (front_load, rear_load), strict=True
            )
        )
        turning = (car.cg_to_front_axle * front - car.cg_to_rear_axle * rear) / car.yaw_inertia
        return [(front + rear) / (car.mass * u) - r + own.road[k] / u, turning]

    state = np.zeros(2)
    for k in range(len(steer) - 1):
        if k % 20 == 0:
            np.testing.assert_allclose(states[k], state, rtol=0.0, atol=2e-7)
            beta_rate = slope(0.0, states[k], k)[0]
            assert lateral[k] == pytest.approx(
                own.speed[k] * (beta_rate + states[k, 1]) - own.road[k], abs=1e-9
            )
        found = integrate.solve_ivp(
            slope, (0.0, step), state, method="DOP853", rtol=1e-10, atol=1e-13, args=(k,)
        )
        state = found.y[:, -1]


def test_axles_loads_and_curves_of_the_truck_are_the_papers():
    """F_max = c₂ √(2c₁)/2: 39.0 kN front and 38.6 kN rear, the weight of about 8 t."""
    slip = np.linspace(0.0, 0.5, 50001)
    largest = [rational_axle(slip, c1, c2, 1.0).force.max() for c1, c2 in CURVES.reshape(2, 2)]
    np.testing.assert_allclose(largest, [39.03e3, 38.59e3], rtol=2e-4)
    assert sum(largest) / GRAVITY == pytest.approx(TRUCK.mass, rel=2e-3)
    plant = Plant.of(payload=True)
    empty = np.array([TRUCK.cg_to_rear_axle, TRUCK.cg_to_front_axle]) / 3.5 * TRUCK.mass
    loads = np.array([plant.load_front, plant.load_rear]) * empty
    assert loads.sum() == pytest.approx(plant.car.mass)
    assert loads[0] * plant.car.cg_to_front_axle == pytest.approx(
        loads[1] * plant.car.cg_to_rear_axle
    )
    plant = Plant.of(payload=False)
    slip = np.linspace(-0.2, 0.2, 41)
    c1, c2 = plant.curves(0.6)[:2]
    np.testing.assert_allclose(
        rational_axle(slip, c1, c2, 1.0).force,
        rational_axle(slip, CURVES[0], CURVES[1], 0.6).force,
        rtol=1e-12,
    )


@pytest.mark.parametrize("slip", factorial.SLIPS)
def test_the_driver_reaches_the_slip_and_does_not_spin(slip):
    for seed in range(3):
        own = drive(Conditions(slip), seed)
        assert np.degrees(np.abs(own.rear_slip)).max() == pytest.approx(slip, rel=0.05)
        assert np.degrees(np.abs(own.sideslip)).max() < 15.0


def test_seeds_decide_course_and_sensors_and_tuning_has_seeds_and_cells_of_its_own():
    one = drive(Conditions(4.0), 5, SECONDS)
    other = drive(Conditions(4.0, crossfall=True), 5, SECONDS)
    np.testing.assert_array_equal(one.samples[:, 1], other.samples[:, 1])
    noise = [own.samples[:, 0] - own.yaw_rate for own in (one, other)]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
    assert not set(TUNED_SLIPS) & set(factorial.SLIPS)
    assert not set(TUNED_MISMATCHES) & set(factorial.MISMATCHES)
    assert factorial.SEEDS <= FIRST_TUNING_SEED
    tuned_on = {factorial.plant_of(own.conditions) for _, own in tuning_drives()}
    assert tuned_on == set(factorial.PLANTS)
    assert all(high - low >= 8.0 for low, high in BOX.values())


@pytest.mark.parametrize("name", [paper.LINT, paper.RATT, paper.RATTE])
def test_a_crossfall_that_is_known_to_be_nothing_leaves_the_paper_s_filter(name, dry):
    """Also where it restarts: a limit of 1.5° on a drive that goes beyond."""
    estimator = estimator_of(name, LEVELS, mistaken(-0.2))
    for limit in (estimator.largest_sideslip, math.radians(1.5)):
        estimator.settings = replace(estimator.settings, largest_sideslip=limit)
        ours = crossfall_filter.filtered(estimator, dry[0].samples, deviation=0.0, wander=0.0)
        np.testing.assert_allclose(
            ours[:, :-1], estimator.filter_samples(dry[0].samples).mean, atol=1e-9
        )
        assert (ours[:, -1] == 0.0).all()
    assert np.abs(dry[0].sideslip).max() > limit


@pytest.mark.parametrize("name", [paper.LINT, paper.RATT, paper.RATTE])
def test_filter_with_a_crossfall_state_is_the_readable_one_with_automatic_jacobians(name):
    estimator = estimator_of(name, LEVELS, mistaken(-0.2))
    samples = drive(Conditions(5.0, crossfall=True), 1, 6.0).samples
    plain = rational_model(estimator)
    extra = torch.zeros(1).double()
    step = 1.0 / RATE

    def transition(states, inputs):
        pull = torch.nn.functional.pad(
            states[..., -1:] / inputs[..., :1], (2, states.shape[-1] - 3)
        )
        return torch.cat([plain.transition(states[..., :-1], inputs), states[..., -1:]], -1) + pull

    model = NonlinearModel(
        transition,
        lambda states, inputs: (
            plain.observation(states[..., :-1], inputs)
            - states[..., -1:] * torch.tensor([0.0, 1.0])
        ),
        lambda states, inputs: torch.block_diag(
            plain.process_noise(states[:-1], inputs),
            step * (extra + crossfall_filter.WANDER).square()[None],
        ),
        plain.observation_noise,
    )
    mean, covariance = map(torch.as_tensor, estimator.first_gaussian(samples[0], {}))
    first = Gaussian(
        torch.cat([mean, extra]),
        torch.block_diag(covariance, (extra + crossfall_filter.DEVIATION).square()[None]),
    )
    y = torch.as_tensor(samples[:, [0, 2]])
    u = torch.as_tensor(samples[:, [1, 3]])
    theirs = extended_filter(model, y, u, first).filtered.mean.numpy()
    np.testing.assert_allclose(crossfall_filter.filtered(estimator, samples), theirs, atol=1e-9)


def test_oracles_know_the_curves_and_go_on_where_friction_steps(dry):
    np.testing.assert_allclose(
        oracle(LEVELS, dry[0]), states_of(ORACLE, LEVELS, dry[0], CURVES)[:, 0], atol=1e-12
    )
    # Steps between frictions that are nearly the same change nothing that is seen.
    own = drive(Conditions(4.0, wet_patches=True), 2, 60.0)
    assert len(set(own.friction.tolist())) == 2
    same = replace(own, friction=np.where(own.friction < 1.0, 1.0 - 1e-9, 1.0))
    np.testing.assert_allclose(
        oracle(LEVELS, same),
        oracle(LEVELS, replace(own, friction=np.ones(len(own.friction)))),
        atol=1e-7,
    )


def cell(name, squared):
    return factorial.Cell(name, Conditions(4.0), 0.0, squared, {}, (0.0, 0.0, 0.0))


def test_a_change_is_paired_over_seeds_and_corrected_for_the_tables_cells():
    """Seeds that differ a hundredfold, one filter 20 % below the other on each: told apart, and 20 %."""
    generator = np.random.default_rng(0)
    hard = 10.0 ** generator.uniform(-2.0, 0.0, factorial.SEEDS)
    noise = 1.0 + 0.02 * generator.standard_normal((2, factorial.SEEDS))
    cells = [
        cell("one", {"A": 0.64 * hard * noise[0], "B": hard * noise[1]}),
        cell("other", {"A": hard * noise[0], "B": hard * noise[1]}),
    ]
    found = factorial.changes(cells, [("A", "B")])
    assert found[0, ("A", "B")].percent == pytest.approx(-20.0, abs=1.0)
    assert found[0, ("A", "B")].told_apart
    assert not found[1, ("A", "B")].told_apart
    generator = np.random.default_rng(1)
    one = {
        "A": np.exp(0.5 * generator.standard_normal(factorial.SEEDS)),
        "B": np.exp(0.5 * generator.standard_normal(factorial.SEEDS)) + 0.9,
    }
    alone = factorial.changes([cell("one", one)], [("A", "B")])[0, ("A", "B")]
    among = factorial.changes([cell(str(at), one) for at in range(20)], [("A", "B")])[0, ("A", "B")]
    assert among.low < alone.low < alone.high < among.high


def test_eigenvalues_have_the_papers_ratios_and_tracks_are_found_from_rolling_wheels():
    """1 above 6 m/s and at most about 1.3 below, with Table 1's stiffnesses."""
    stiff = replace(TRUCK, cornering_stiffness_front=CURVES[1], cornering_stiffness_rear=CURVES[3])
    fast = vehicle.ratios(stiff, np.array([6.5, 10.0, 30.0]))
    slow = vehicle.ratios(stiff, np.array([0.5, 2.0, 4.0]))
    np.testing.assert_allclose(fast, 1.0, atol=1e-9)
    assert 1.0 < slow.max() < 1.35
    from vehest.data.recording import Recording

    time = np.arange(2000) / 20.0
    turn = 0.3 * np.sin(0.3 * time)
    u = np.full(2000, 20.0)
    wheels = {
        f"wheel_speed_{name}": (u - side * turn) / vehicle.RADIUS
        for name, side in {"fl": 0.8, "fr": -0.8, "rl": 0.75, "rr": -0.75}.items()
    }
    channels = {"vx_ref": u, "yaw_rate": turn, "steer": np.zeros(2000), **wheels}
    assert vehicle.tracks_of(
        Recording("rolls", "race car", 20.0, 0.0, channels, "simulated")
    ) == pytest.approx((1.6, 1.5))
