"""Stability control: when it acts, how much, and that it helps."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import vehicle_from_configuration
from vehest.simulation.plant.stability import StabilityControl, StabilityState, stability_control

CONFIGURATIONS = Path(__file__).parents[2] / "conf" / "vehicle"
OURS = ("corvette_grand_sport", "ferrari_250_lm", "bmw_545i", "heavy_truck")
CONTROL = StabilityControl(wheelbase=2.5, understeer_gradient=0.002, yaw_inertia=2000.0, grip=9.0, largest_moment=3000.0)


def plant_of(name):
    configuration = yaml.safe_load((CONFIGURATIONS / f"{name}.yaml").read_text(encoding="utf-8"))
    return MultiBodyPlant(vehicle_from_configuration(configuration))


def sine_with_dwell(plant, amplitude, control, friction):
    """Largest sideslip [rad] of the manoeuvre of FMVSS 126 at 80 km/h, and the moments [N m] that the control asked for."""
    state, doing = plant.initial_state(0.0, 0.0, 0.0, 80.0 / 3.6), StabilityState()
    largest, moments = 0.0, []
    for k in range(400):
        time = 0.01 * k
        phase = min(time, max(time - 0.5, 0.75 / 0.7)) * 0.7
        target = amplitude * math.sin(2.0 * math.pi * phase) if phase < 1.0 else 0.0
        if control is not None:
            doing = control.step(doing, 0.01, steer=state.steer, vx=state.vx, yaw_rate=state.yaw_rate, friction=friction)
        moments.append(doing.moment)
        state = plant.advance(state, np.array([30.0 * (target - state.steer), 0.0, doing.moment, 0.0, 0.0]), 10, friction)
        largest = max(largest, abs(math.atan2(state.vy, state.vx)))
    return largest, np.array(moments)


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("friction", [1.0, 0.5])
def test_sideslip_stays_lower_with_control_than_without(name, friction):
    plant = plant_of(name)
    control, amplitude = stability_control(plant), 0.16 if friction == 1.0 else 0.09
    without, _ = sine_with_dwell(plant, amplitude, None, friction)
    with_control, moments = sine_with_dwell(plant, amplitude, control, friction)
    assert with_control < 0.7 * without
    assert 0.0 < np.abs(moments).max() <= friction * control.largest_moment


@pytest.mark.parametrize("name", OURS)
def test_largest_moment_is_within_what_the_plant_can_brake_on_either_side(name):
    plant = plant_of(name)
    rolling = plant.initial_state(0.0, 0.0, 0.0, 20.0)
    forces = plant.motion([rolling] * 2, np.array([[0.0, 0.0, moment, 0.0, 0.0] for moment in (1e9, -1e9)]), 100.0).tyre_fx
    arm = 0.25 * (plant.parameters.T_f + plant.parameters.T_r)
    most = min(-forces[0, [0, 2]].sum(), -forces[1, [1, 3]].sum()) * arm  # to turn left, the left wheels are braked
    assert 0.85 * most < stability_control(plant).largest_moment <= 1.01 * most  # 15 %: front and rear tyres differ


@pytest.mark.parametrize("name", OURS)
def test_control_leaves_calm_driving_alone(name):
    plant = plant_of(name)
    _, moments = sine_with_dwell(plant, 0.03, stability_control(plant), 1.0)
    assert not moments.any()


def test_moment_turns_the_car_towards_the_reference():
    turns_too_much = CONTROL.step(StabilityState(reference=0.2), 0.01, steer=0.025, vx=20.0, yaw_rate=0.5)
    turns_too_little = CONTROL.step(StabilityState(reference=0.2), 0.01, steer=0.025, vx=20.0, yaw_rate=0.0)
    assert turns_too_much.moment < 0.0 < turns_too_little.moment
    mirrored = CONTROL.step(StabilityState(reference=-0.2), 0.01, steer=-0.025, vx=20.0, yaw_rate=-0.5)
    assert mirrored.moment == -turns_too_much.moment


def test_reference_is_the_linear_single_track_within_friction():
    state = StabilityState()
    for _ in range(200):
        state = CONTROL.step(state, 0.01, steer=0.02, vx=20.0, yaw_rate=0.0)
    assert state.reference == pytest.approx(20.0 * 0.02 / (2.5 + 0.002 * 400.0))
    for friction in (1.0, 0.5):
        for _ in range(200):
            state = CONTROL.step(state, 0.01, steer=0.3, vx=20.0, yaw_rate=0.0, friction=friction)
        assert state.reference == pytest.approx(friction * 9.0 / 20.0)


def test_control_has_hysteresis_and_a_largest_moment():
    between = StabilityState(reference=0.05, active=False)
    assert not CONTROL.step(between, 1e-6, steer=0.0, vx=20.0, yaw_rate=0.0).active
    assert CONTROL.step(StabilityState(reference=0.05, active=True), 1e-6, steer=0.0, vx=20.0, yaw_rate=0.0).active
    assert not CONTROL.step(StabilityState(reference=0.02, active=True), 1e-6, steer=0.0, vx=20.0, yaw_rate=0.0).active
    assert CONTROL.step(StabilityState(reference=0.0), 0.01, steer=0.0, vx=20.0, yaw_rate=2.0).moment == -3000.0
    assert CONTROL.step(StabilityState(reference=0.0), 0.01, steer=0.0, vx=20.0, yaw_rate=2.0, friction=0.5).moment == -1500.0
    assert CONTROL.step(StabilityState(reference=0.0, active=True), 0.01, steer=0.3, vx=3.0, yaw_rate=0.0).moment == 0.0
