"""The planar car with Pacejka's tyres against scipy's integrator, statics, symmetry and the linear
single track.
"""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from vehest.constants import GRAVITY
from vehest.vehicle.dynamics import rk4
from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.planar import F1TENTH, LEARNT, PlanarCar
from vehest.vehicle.single_track import lateral_model
from vehest.vehicle.tyres import PacejkaTyres, PositiveParameters, TyreForces, magic_formula

TYRES = {"friction": 0.8916, "B_x": 2.8, "C_x": 1.2, "D_x": 1.0}
TYRES |= {
    f"{name}_{axle}": value
    for axle in ("front", "rear")
    for name, value in (("B", 5.948), ("C", 2.2754), ("D", 0.8095))
}


@pytest.fixture
def car():
    return PlanarCar().double().requires_grad_(False), PacejkaTyres(TYRES).double().requires_grad_(
        False
    )


def motion_of(car, state, inputs):
    """Rates and accelerations of the chassis on the forces of its tyres."""
    chassis, tyres = car
    return chassis.motion(state, inputs, tyres(chassis.slips(state, inputs), chassis.loads()))


def rates(car, state, inputs):
    return motion_of(car, state, inputs).rates


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_runge_kutta_is_an_independent_integrator(car):
    """Over 10 ms from a drifting state; and its error falls with the fourth power of the step."""
    state = tensor(3.0, -0.6, 2.5, 3.4)
    inputs = tensor(0.2, 8.0)
    solution = solve_ivp(
        lambda _, x: rates(car, torch.from_numpy(x), inputs).numpy(),
        (0.0, 0.01),
        state.numpy(),
        rtol=1e-12,
        atol=1e-13,
    )
    errors = []
    for steps in (1, 2):
        stepped = state
        for _ in range(steps):
            stepped = rk4(lambda x, u: rates(car, x, u), stepped, inputs, 0.01 / steps)
        errors.append(float((stepped - torch.from_numpy(solution.y[:, -1])).abs().max()))
    assert errors[0] < 1e-6
    assert 10.0 < errors[0] / errors[1] < 24.0


def test_rates_and_accelerations_of_a_rolling_car_match_the_equations(car):
    state = tensor(4.0, 0.0, 0.0, 4.0)
    inputs = tensor(0.0, 0.0)
    car_rates = rates(car, state, inputs)
    drag = 0.1 + 0.01 * 4.0 + 0.1 * 16.0
    assert float(car_rates[0]) == pytest.approx(-drag / F1TENTH["mass"])
    assert car_rates[1:3].abs().max() < 1e-12
    assert float(car_rates[3]) == pytest.approx(-0.05 / 0.2 * (0.304115174 * 4.0 + 0.50421894))
    # ax = dvx/dt - r vy and ay = dvy/dt + r vx (Węgrzynowski et al. 2024, Section III-B.1).
    car_rates = motion_of(car, tensor(3.0, -0.6, 2.5, 3.4), tensor(0.2, 8.0))
    assert float(car_rates.ax) == pytest.approx(float(car_rates.rates[0] - 2.5 * -0.6))
    assert float(car_rates.ay) == pytest.approx(float(car_rates.rates[1] + 2.5 * 3.0))
    chassis = PlanarCar().double().requires_grad_(False)
    none = TyreForces(*(tensor(0.0)[0],) * 4)
    car_rates = chassis.motion(tensor(3.0, 1.0, 2.0, 0.0), tensor(0.1, 0.0), none)
    drag = 0.1 + 0.01 * 3.0 + 0.1 * 9.0
    assert car_rates.rates[:3].tolist() == pytest.approx([2.0 - drag / 5.1, -6.0, 0.0])


def test_loads_carry_the_weight_and_curvature_parameters_are_optional(car):
    state = tensor(3.0, -0.6, 2.5, 3.4)
    inputs = tensor(0.2, 8.0)
    mirror = tensor(1.0, -1.0, -1.0, 1.0)
    assert torch.allclose(
        rates(car, mirror * state, tensor(-0.2, 8.0)),
        mirror * rates(car, state, inputs),
        atol=1e-12,
    )
    front, rear = car[0].loads()
    assert float(front + rear) == pytest.approx(F1TENTH["mass"] * GRAVITY)
    assert float(front * (F1TENTH["wheelbase"] - 0.115)) == pytest.approx(float(rear * 0.115))
    plain = PacejkaTyres(TYRES)
    curved = PacejkaTyres(TYRES, with_curvature=True)
    assert (
        sum(p.numel() for p in curved.parameters()) - sum(p.numel() for p in plain.parameters())
        == 3
    )
    chassis = PlanarCar()
    slips = chassis.slips(torch.tensor([3.0, 0.5, 1.0, 3.5]), torch.tensor([0.1, 0.0]))
    for first, second in zip(
        plain(slips, chassis.loads()), curved(slips, chassis.loads()), strict=True
    ):
        assert first.item() == pytest.approx(second.item(), rel=1e-5)
    inertia_parameter = PositiveParameters({"inertia": 0.46})
    with torch.no_grad():
        inertia_parameter.get_parameter("log_inertia").sub_(20.0)
    assert 0.0 < inertia_parameter["inertia"].item() < 1e-8


def test_for_small_slips_it_is_the_linear_single_track(car):
    front, rear = (float(load) * 0.8916 * 0.8095 * 5.948 * 2.2754 for load in car[0].loads())
    linear = SingleTrackParameters(
        F1TENTH["mass"], 0.46, F1TENTH["wheelbase"] - 0.115, 0.115, front, rear
    )
    speed = 4.0
    sideslip = 2e-4
    yaw_rate = 3e-3
    steer = 1e-3
    state = tensor(speed, speed * math.tan(sideslip), yaw_rate, speed)
    inputs = tensor(steer, 0.0)
    planar_motion = motion_of(car, state, inputs)
    A, B, C, D = lateral_model(linear, np.array(speed))
    x = np.array([sideslip, yaw_rate])
    expected = A @ x + B * steer
    assert float(planar_motion.rates[2]) == pytest.approx(expected[1], rel=1e-3)
    assert float(planar_motion.ay) == pytest.approx(float(C @ x + D * steer), rel=1e-3)
    assert float(planar_motion.rates[1]) / speed == pytest.approx(expected[0], rel=1e-3)


def test_the_magic_formula_has_its_slope_its_peak_and_its_curvature():
    stiffness = tensor(5.948)
    shape = tensor(2.2754)
    slip = torch.linspace(-0.6, 0.6, 2001, dtype=torch.float64)
    curve = magic_formula(slip, stiffness, shape)
    assert float(magic_formula(tensor(1e-6), stiffness, shape)) == pytest.approx(
        1e-6 * 5.948 * 2.2754, rel=1e-6
    )
    peak = math.tan(math.pi / (2.0 * 2.2754)) / 5.948
    assert float(magic_formula(tensor(peak), stiffness, shape)) == pytest.approx(1.0, abs=1e-12)
    assert float(curve.max()) <= 1.0
    assert torch.allclose(curve, -curve.flip(0), atol=1e-15)
    flatter = magic_formula(slip, stiffness, shape, -2.0)
    by_hand = np.sin(2.2754 * np.arctan(5.948 * 0.3 + 2.0 * (5.948 * 0.3 - np.arctan(5.948 * 0.3))))
    assert float(flatter[1500]) == pytest.approx(by_hand)


def test_forces_oppose_sliding_and_scale_with_friction_and_load(car):
    chassis, tyres = car
    slips = chassis.slips(tensor(3.0, 0.5, 0.0, 3.5), tensor(0.0, 0.0))
    forces = tyres(slips, chassis.loads())
    assert float(forces.front_y) < 0.0
    assert float(forces.rear_y) < 0.0
    assert float(forces.front_x) > 0.0, "wheels that turn faster than the car rolls push it"
    slippery = PacejkaTyres(TYRES | {"friction": 2.0 * 0.8916}).double().requires_grad_(False)
    half = slippery(slips, tuple(0.5 * load for load in chassis.loads()))
    for force, halved in zip(forces, half, strict=True):
        assert float(halved) == pytest.approx(float(force))


def test_gradients_reach_every_parameter_and_batches_work(car):
    chassis, tyres = (module.requires_grad_() for module in car)
    state = tensor(3.0, -0.6, 2.5, 3.4).repeat(2, 3, 1)
    inputs = tensor(0.2, 8.0).repeat(2, 3, 1)
    outcome = rk4(lambda x, u: rates(car, x, u), state, inputs, 0.01)
    assert outcome.shape == (2, 3, 4)
    outcome.square().sum().backward()
    for parameter in (*chassis.parameters(), *tyres.parameters()):
        assert torch.isfinite(parameter.grad).all()
    assert all(chassis.learnt.get_parameter(f"log_{name}").grad.abs() > 0 for name in LEARNT)
