"""The linear single track against Newton's laws, its characteristic polynomial and the steady-state
yaw gain.
"""

import numpy as np
import pytest
from scipy import linalg

from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters
from vehest.vehicle.single_track import lateral_model

CAR = FERRARI_250LM
SPEEDS = np.array([8.0, 20.0, 45.0])


def test_derivatives_eigenvalues_and_steady_state_are_the_textbooks():
    """Slip angles and axle forces written out, then Newton and Euler."""
    sideslip = 0.03
    yaw_rate = 0.4
    steer = -0.02
    state = np.array([sideslip, yaw_rate])
    A, B, C, D = lateral_model(CAR, SPEEDS)
    for k, u in enumerate(SPEEDS.tolist()):
        front = CAR.cornering_stiffness_front * (
            steer - (sideslip + CAR.cg_to_front_axle * yaw_rate / u)
        )
        rear = -CAR.cornering_stiffness_rear * (sideslip - CAR.cg_to_rear_axle * yaw_rate / u)
        acceleration = (front + rear) / CAR.mass
        moment = CAR.cg_to_front_axle * front - CAR.cg_to_rear_axle * rear
        derivative = A[k] @ state + B[k] * steer
        assert float(derivative[0]) == pytest.approx(acceleration / u - yaw_rate, rel=1e-12)
        assert float(derivative[1]) == pytest.approx(moment / CAR.yaw_inertia, rel=1e-12)
        assert float(C[k] @ state + D[k] * steer) == pytest.approx(acceleration, rel=1e-12)
    # λ² + 2σλ + ω²: sum and product of the poles as vehicle dynamics books give them.
    front = CAR.cornering_stiffness_front
    rear = CAR.cornering_stiffness_rear
    lf = CAR.cg_to_front_axle
    lr = CAR.cg_to_rear_axle
    m = CAR.mass
    J = CAR.yaw_inertia
    wheelbase = CAR.cg_to_front_axle + CAR.cg_to_rear_axle
    for u, A in zip(SPEEDS, lateral_model(CAR, SPEEDS).A, strict=True):
        damping = (front + rear) / (m * u) + (lf**2 * front + lr**2 * rear) / (J * u)
        stiffness = front * rear * wheelbase**2 / (m * J * u**2) + (lr * rear - lf * front) / J
        roots = np.sort_complex(np.roots([1.0, damping, stiffness]))
        assert np.allclose(np.sort_complex(np.linalg.eigvals(A)), roots, rtol=1e-10)
        assert (roots.real < 0).all(), "this car understeers: stable at any speed"
    # r/δ = u / (L + K u²), K = m (lr Cr - lf Cf) / (L Cf Cr).
    A, B, C, D = lateral_model(CAR, SPEEDS)
    steady = -np.linalg.solve(A, B[..., None])[..., 0]
    wheelbase = CAR.cg_to_front_axle + CAR.cg_to_rear_axle
    surplus = (
        CAR.cg_to_rear_axle * CAR.cornering_stiffness_rear
        - CAR.cg_to_front_axle * CAR.cornering_stiffness_front
    )
    understeer = (
        CAR.mass
        * surplus
        / (wheelbase * CAR.cornering_stiffness_front * CAR.cornering_stiffness_rear)
    )
    assert np.allclose(steady[:, 1], SPEEDS / (wheelbase + understeer * SPEEDS**2), rtol=1e-12)
    assert np.allclose((C * steady).sum(-1) + D, SPEEDS * steady[:, 1], rtol=1e-10), (
        "in steady state ay = u r"
    )


def test_forward_euler_is_first_order():
    """Against the exact solution over 0.1 s: half the step, half the error."""
    model = lateral_model(CAR, SPEEDS[1])
    exact = linalg.expm(0.1 * model.A)
    errors = [
        np.abs(np.linalg.matrix_power(model.in_steps(0.1 / n).A, n) - exact).max()
        for n in (100, 200)
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.02)
    assert np.array_equal(model.in_steps(0.01).B, 0.01 * model.B)
    assert lateral_model(CAR, SPEEDS.reshape(1, 3)).D.shape == (1, 3)


def test_ferrari_has_published_parameters_and_negative_mass_is_refused():
    assert pytest.approx(982 / 12 * (1.7**2 + 4.09**2), rel=1e-7) == CAR.yaw_inertia
    assert CAR.cg_to_front_axle + CAR.cg_to_rear_axle == pytest.approx(2.40)
    with pytest.raises(ValueError, match="mass must be positive, not -1"):
        SingleTrackParameters(-1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
