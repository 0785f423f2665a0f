"""The linear single track against Newton's laws, its characteristic polynomial and the steady-state yaw gain."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters
from vehest.vehicle.single_track import forward_euler, lateral_acceleration, lateral_dynamics

CAR = FERRARI_250LM
SPEEDS = torch.tensor([8.0, 20.0, 45.0], dtype=torch.float64)


def test_derivatives_and_acceleration_are_those_of_forces_and_moments():
    """Slip angles and axle forces written out, then Newton and Euler."""
    sideslip, yaw_rate, steer = 0.03, 0.4, -0.02
    state = torch.tensor([sideslip, yaw_rate], dtype=torch.float64)
    A, B = lateral_dynamics(CAR, SPEEDS)
    C, D = lateral_acceleration(CAR, SPEEDS)
    for k, u in enumerate(SPEEDS.tolist()):
        front = CAR.cornering_stiffness_front * (steer - (sideslip + CAR.cg_to_front_axle * yaw_rate / u))
        rear = -CAR.cornering_stiffness_rear * (sideslip - CAR.cg_to_rear_axle * yaw_rate / u)
        acceleration = (front + rear) / CAR.mass
        moment = CAR.cg_to_front_axle * front - CAR.cg_to_rear_axle * rear
        derivative = A[k] @ state + B[k] * steer
        assert float(derivative[0]) == pytest.approx(acceleration / u - yaw_rate, rel=1e-12)
        assert float(derivative[1]) == pytest.approx(moment / CAR.yaw_inertia, rel=1e-12)
        assert float(C[k] @ state + D[k] * steer) == pytest.approx(acceleration, rel=1e-12)


def test_eigenvalues_are_the_roots_of_the_textbook_polynomial():
    """λ² + 2σλ + ω²: sum and product of the poles as vehicle dynamics books give them."""
    front, rear, lf, lr = CAR.cornering_stiffness_front, CAR.cornering_stiffness_rear, CAR.cg_to_front_axle, CAR.cg_to_rear_axle
    m, J, wheelbase = CAR.mass, CAR.yaw_inertia, CAR.cg_to_front_axle + CAR.cg_to_rear_axle
    for u, A in zip(SPEEDS.numpy(), lateral_dynamics(CAR, SPEEDS).A.numpy(), strict=True):
        damping = (front + rear) / (m * u) + (lf**2 * front + lr**2 * rear) / (J * u)
        stiffness = front * rear * wheelbase**2 / (m * J * u**2) + (lr * rear - lf * front) / J
        roots = np.sort_complex(np.roots([1.0, damping, stiffness]))
        assert np.allclose(np.sort_complex(np.linalg.eigvals(A)), roots, rtol=1e-10)
        assert (roots.real < 0).all(), "this car understeers: stable at any speed"


def test_steady_state_yaw_gain_is_u_over_wheelbase_plus_understeer():
    """r/δ = u / (L + K u²), K = m (lr Cr - lf Cf) / (L Cf Cr)."""
    A, B = lateral_dynamics(CAR, SPEEDS)
    steady = -torch.linalg.solve(A, B.unsqueeze(-1)).squeeze(-1)
    wheelbase = CAR.cg_to_front_axle + CAR.cg_to_rear_axle
    surplus = CAR.cg_to_rear_axle * CAR.cornering_stiffness_rear - CAR.cg_to_front_axle * CAR.cornering_stiffness_front
    understeer = CAR.mass * surplus / (wheelbase * CAR.cornering_stiffness_front * CAR.cornering_stiffness_rear)
    assert torch.allclose(steady[:, 1], SPEEDS / (wheelbase + understeer * SPEEDS**2), rtol=1e-12)
    C, D = lateral_acceleration(CAR, SPEEDS)
    assert torch.allclose((C * steady).sum(-1) + D, SPEEDS * steady[:, 1], rtol=1e-10), "in steady state ay = u r"


def test_forward_euler_is_first_order():
    """Against the exact solution over 0.1 s: half the step, half the error."""
    dynamics = lateral_dynamics(CAR, SPEEDS[1])
    exact = torch.linalg.matrix_exp(0.1 * dynamics.A)
    errors = [float((torch.linalg.matrix_power(forward_euler(dynamics, 0.1 / n).A, n) - exact).abs().max()) for n in (100, 200)]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.02)
    assert torch.equal(forward_euler(dynamics, 0.01).B, 0.01 * dynamics.B)


def test_arrays_are_taken_as_they_are():
    from_array, from_tensor = lateral_dynamics(CAR, SPEEDS.numpy()), lateral_dynamics(CAR, SPEEDS)
    assert from_array.A.shape == (3, 2, 2)
    assert torch.equal(from_array.A, from_tensor.A)
    assert lateral_acceleration(CAR, SPEEDS.reshape(1, 3)).D.shape == (1, 3)


def test_gradients_reach_every_parameter_and_the_speed():
    values = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (9.0, 16.0, 1.3, 1.1, 7.0, 12.0)]
    speed = SPEEDS.clone().requires_grad_()

    def outcome(vx, *parameters):
        car = SingleTrackParameters(*parameters)
        return (*forward_euler(lateral_dynamics(car, vx), 0.01), *lateral_acceleration(car, vx))

    assert torch.autograd.gradcheck(outcome, (speed, *values))


def test_parameters_that_make_no_car_are_refused():
    with pytest.raises(ValueError, match="mass must be positive, not -1"):
        SingleTrackParameters(-1.0, 1.0, 1.0, 1.0, 1.0, 1.0)


def test_ferrari_is_the_published_one():
    assert pytest.approx(982 / 12 * (1.7**2 + 4.09**2), rel=1e-7) == CAR.yaw_inertia
    assert CAR.cg_to_front_axle + CAR.cg_to_rear_axle == pytest.approx(2.40)
