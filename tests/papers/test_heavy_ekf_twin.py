"""The twin of the heavy vehicle: plant, tyres, driver, the filter with a crossfall state, and how
cells are compared.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from readable_filters import NonlinearModel, extended_filter, rational_model
from scipy import integrate

from vehest.constants import GRAVITY
from vehest.data.recording import Recording
from vehest.filters.gaussian import Gaussian
from vehest.vehicle.rational_tyres import rational_axle
from vehest_papers.heavy_ekf import crossfall_filter, factorial, paper, region_map, wheels
from vehest_papers.heavy_ekf.candidates import (
    BOX,
    FIRST_TUNING_SEED,
    TUNED_MISMATCHES,
    TUNED_SLIPS,
    Levels,
    estimator_of,
    mistaken,
    tuning_drives,
)
from vehest_papers.heavy_ekf.twin import (
    CURVES,
    RATE,
    SUBSTEPS,
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
def test_the_plant_agrees_with_another_integrator_of_equations_1_to_6(conditions):
    """Steered as it was: SciPy's Dormand and Prince at 1e-10, with slips and forces written out
    here.
    """
    plant = Plant.of(payload=conditions.payload)
    planned = course(conditions, np.random.default_rng(3), 12.0)
    states, steer, lateral = driven(plant, planned)
    car = plant.car
    step = 1.0 / (RATE * SUBSTEPS)
    front_load = plant.load_front
    rear_load = plant.load_rear

    def slope(time, state, k):
        beta, r = state
        u = planned.speed[k]
        mu = planned.friction[k]
        slips = steer[k] - beta - car.cg_to_front_axle * r / u, -beta + car.cg_to_rear_axle * r / u
        front, rear = (
            c2 * mu * load * slip * c1 * (mu + 1.0) / (slip**2 + c1 * (mu + 1.0))
            for slip, c1, c2, load in zip(
                slips, CURVES[::2], CURVES[1::2], (front_load, rear_load), strict=True
            )
        )
        turning = (car.cg_to_front_axle * front - car.cg_to_rear_axle * rear) / car.yaw_inertia
        return [(front + rear) / (car.mass * u) - r + planned.road[k] / u, turning]

    state = np.zeros(2)
    for k in range(len(steer) - 1):
        if k % 20 == 0:
            np.testing.assert_allclose(states[k], state, rtol=0.0, atol=2e-7)
            beta_rate = slope(0.0, states[k], k)[0]
            assert lateral[k] == pytest.approx(
                planned.speed[k] * (beta_rate + states[k, 1]) - planned.road[k], abs=1e-9
            )
        solution = integrate.solve_ivp(
            slope, (0.0, step), state, method="DOP853", rtol=1e-10, atol=1e-13, args=(k,)
        )
        state = solution.y[:, -1]


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


@pytest.mark.parametrize("slip", factorial.SLIPS)
def test_the_driver_reaches_the_slip_and_does_not_spin(slip):
    for seed in range(3):
        steered_drive = drive(Conditions(slip), seed)
        assert np.degrees(np.abs(steered_drive.rear_slip)).max() == pytest.approx(slip, rel=0.05)
        assert np.degrees(np.abs(steered_drive.sideslip)).max() < 15.0


def test_seeds_decide_course_and_sensors_and_tuning_shares_no_seed_or_cell():
    level_drive = drive(Conditions(4.0), 5, SECONDS)
    crossfall_drive = drive(Conditions(4.0, crossfall=True), 5, SECONDS)
    np.testing.assert_array_equal(level_drive.samples[:, 1], crossfall_drive.samples[:, 1])
    noise = [
        noisy_drive.samples[:, 0] - noisy_drive.yaw_rate
        for noisy_drive in (level_drive, crossfall_drive)
    ]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)
    assert not set(TUNED_SLIPS) & set(factorial.SLIPS)
    assert not set(TUNED_MISMATCHES) & set(factorial.MISMATCHES)
    assert factorial.SEEDS <= FIRST_TUNING_SEED
    starts = {
        round(float(tuning_drive.curves[1] / CURVES[1]) - 1.0, 9)
        for tuning_drive in tuning_drives()
    }
    assert starts == set(TUNED_MISMATCHES)
    assert all(high - low >= 8.0 for low, high in BOX.values())


@pytest.mark.parametrize("name", [paper.LINT, paper.RATT, paper.RATTE])
def test_a_crossfall_fixed_at_zero_leaves_the_papers_filter(name, dry):
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
def test_crossfall_filter_agrees_with_the_readable_filter_with_automatic_jacobians(name):
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


def cell(squared):
    return factorial.Cell(factorial.LEVEL, factorial.ALL_ROADS, 4.0, 0.0, squared, 4.0)


PAIR = (paper.RATTE, paper.LINT)


def cell_with_ratio(generator, ratio):
    """Seeds whose errors differ a hundredfold; RATTE's RMSE is ``ratio`` times LINT's on each."""
    hard = 10.0 ** generator.uniform(-2.0, 0.0, factorial.SEEDS)
    noise = 1.0 + 0.02 * generator.standard_normal((2, factorial.SEEDS))
    return cell({paper.RATTE: ratio**2 * hard * noise[0], paper.LINT: hard * noise[1]})


def test_cells_of_the_map_are_better_not_different_or_worse():
    generator = np.random.default_rng(0)
    cells = [cell_with_ratio(generator, ratio) for ratio in (0.8, 1.0, 1.25)]
    of_cells = factorial.changes(cells, [PAIR])
    outcomes = [of_cells[position, PAIR].outcome for position in range(3)]
    assert outcomes == [factorial.BETTER, factorial.NOT_DIFFERENT, factorial.WORSE]
    assert region_map.counts(of_cells, PAIR) == dict.fromkeys(outcomes, 1)
    ratios = [of_cells[position, PAIR].ratio for position in range(3)]
    assert ratios == pytest.approx([0.8, 1.0, 1.25], rel=0.02)
    assert of_cells[1, PAIR].power > 0.99, "seeds are paired, so that 65 % would be found"


def test_intervals_and_power_of_a_cell_allow_for_the_cells_of_its_map():
    generator = np.random.default_rng(1)
    spread = np.exp(0.7 * generator.standard_normal((2, factorial.SEEDS)))
    noisy = cell({paper.RATTE: spread[0], paper.LINT: spread[1]})
    alone = factorial.changes([noisy], [PAIR])[0, PAIR]
    among = factorial.changes([noisy] * 40, [PAIR])[0, PAIR]
    assert among.low < alone.low < alone.high < among.high
    assert among.power < alone.power


def test_tracks_are_identified_from_rolling_wheels():
    time = np.arange(2000) / 20.0
    turn = 0.3 * np.sin(0.3 * time)
    u = np.full(2000, 20.0)
    speeds = {
        f"wheel_speed_{name}": (u - side * turn) / wheels.RADIUS
        for name, side in {"fl": 0.8, "fr": -0.8, "rl": 0.75, "rr": -0.75}.items()
    }
    channels = {"vx_ref": u, "yaw_rate": turn, "steer": np.zeros(2000), **speeds}
    assert wheels.tracks_of(
        Recording("rolls", "race car", 20.0, 0.0, channels, "simulated")
    ) == pytest.approx((1.6, 1.5))
