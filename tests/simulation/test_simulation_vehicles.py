"""The shipped vehicles: steady handling, load transfer, springs, stability control, and that they
are the cars of their sources.
"""

import math
import re
from functools import cache

import numpy as np
import pytest
from cars import ALL, FOLDER, OURS, inputs_of, plant_of, rolling

from vehest.constants import GRAVITY
from vehest.data.errors import ConfigurationError
from vehest.simulation.plant.handling import ramp_steer
from vehest.simulation.plant.multi_body import MultiBodyPlant, PlantState
from vehest.simulation.plant.parameters import (
    Vehicle,
    library_parameters,
    rear_tyre,
    vehicle_from_configuration,
)
from vehest.simulation.plant.regimes import HEAVE, PITCH, ROLL, ROLL_RATE, Regime
from vehest.simulation.plant.stability import StabilityControl, StabilityState, stability_control
from vehest_papers.proving_ground.handling import understeer_angle

each_vehicle = pytest.mark.parametrize("name", ALL)


@cache
def ramp_of(name):
    return ramp_steer(plant_of(name), 20.0 if name == "heavy_truck" else 25.0)


def steady_turn(plant, speed, steer):
    """The last moment of a turn at constant speed and steering angle, as a motion of one sample."""
    state = rolling(plant, speed)
    integral = 0.0
    for _ in range(800):
        error = speed - state.vx
        integral += 0.01 * error
        inputs = inputs_of(
            np.clip(10.0 * (steer - state.steer), -0.02, 0.02), 3.0 * error + 2.0 * integral
        )
        state = plant.advance(state, inputs, 10)
    return plant.motion([state], inputs[None], 100.0)


def cornering_stiffnesses(plant):
    """Of the axles [N/rad], from the tyres' stiffness per load and the static loads."""
    p = plant.parameters
    weight = p.m * GRAVITY / (p.a + p.b)
    return -p.tire.p_ky1 * weight * p.b, -p.tire_rear.p_ky1 * weight * p.a


@each_vehicle
@pytest.mark.parametrize("speed", [10.0, 30.0])
def test_steady_cornering_at_low_lateral_acceleration_is_the_linear_single_tracks(name, speed):
    plant = plant_of(name)
    p = plant.parameters
    (front, rear) = cornering_stiffnesses(plant)
    length = p.a + p.b
    ay = 0.7
    understeer = p.m / length * (p.b / front - p.a / rear)
    turn = steady_turn(plant, speed, ay * (length + understeer * speed**2) / speed**2)
    assert turn.ay[0] == pytest.approx(ay, rel=0.03)
    assert turn.yaw_rate[0] == pytest.approx(ay / speed, rel=0.03)
    if name in OURS:  # the published tyre pulls to one side besides
        rear_slip = p.b * turn.yaw_rate[0] / speed - turn.sideslip[0]
        assert rear_slip == pytest.approx(
            p.m * p.a / length / rear * ay, rel=0.05
        )  # camber, left out, takes 2 to 3 %


@each_vehicle
def test_understeer_rises_with_lateral_acceleration_up_to_the_limit(name):
    ramp = ramp_of(name)
    plant = plant_of(name)
    angle = understeer_angle(ramp, plant.wheelbase)
    limit = int(np.argmax(ramp.ay))
    share = (
        0.95 if name == "jaguar_e_type" else 0.99
    )  # its rear bends as early as its front: at the limit it turns neutral
    ay_grid = np.arange(0.5, share * ramp.ay[limit], 0.25)
    angle_on_grid = np.interp(ay_grid, np.maximum.accumulate(ramp.ay[:limit]), angle[:limit])
    assert angle_on_grid[0] > 0.0
    assert (np.diff(angle_on_grid) > 0.0).all()
    assert (np.diff(angle_on_grid, 2)[4:] > -1e-6).all()  # and rises ever faster


@each_vehicle
def test_grip_is_the_steady_state_limit(name):
    plant = plant_of(name)
    assert ramp_of(name).ay.max() == pytest.approx(plant.grip, rel=0.055)
    assert ramp_steer(plant, 15.0).ay.max() == pytest.approx(plant.grip, rel=0.055)


def test_cars_reach_the_lateral_accelerations_of_the_papers():
    # Table I of Da Lio et al. 2023: 99 % quantiles of the laps; Fig. 4 of Bertipaglia et al. 2024:
    # spread over ±10 m/s², in transients too, which reach a little more than a steady turn.
    for name, published, at_most in (
        ("corvette_grand_sport", 11.6, 12.5),
        ("ferrari_250_lm", 10.78, 11.7),
        ("bmw_545i", 9.4, 10.5),
    ):
        for speed in (25.0, 40.0):
            ramp = ramp_steer(plant_of(name), speed)
            assert published < ramp.ay.max() < at_most, name
            assert ramp.tyre_fz[: np.argmax(ramp.ay)].min() > 100.0, name  # no wheel lifts
            assert 2.0 < -math.degrees(ramp.sideslip[np.argmax(ramp.ay)]) < 6.0, name


@each_vehicle
def test_lateral_load_transfer_balances_the_moments_of_inertia_and_lean(name):
    # Moments about the ground below the middle of the track, from forces and angles that sensors
    # could see: mass times acceleration times height, the weight of the leaning body and of axles
    # on tyres of unlike deflection, and the tyres' sideways give. Heights are less than the
    # drawing's by the tyres' deflection.
    plant = plant_of(name)
    p = plant.parameters
    turn = steady_turn(plant, 20.0, 0.02)
    load = turn.tyre_fz[0]
    ay = turn.ay[0]
    transfer = 0.5 * p.T_f * (load[1] - load[0]) + 0.5 * p.T_r * (load[3] - load[2])
    deflection = load.mean() / p.K_zt
    unsprung = p.m_uf + p.m_ur
    axle_height = p.R_w - deflection
    height = (p.m_s * (p.h_s - deflection) + unsprung * axle_height) / p.m
    axle_lean = 0.5 * (
        (load[1] - load[0]) / (p.K_zt * p.T_f) + (load[3] - load[2]) / (p.K_zt * p.T_r)
    )
    lean = GRAVITY * (p.m_s * turn.roll[0] * (p.h_s - p.R_w) + p.m * axle_lean * p.R_w)
    give = p.K_lt * np.sum(load * turn.tyre_fy[0])
    assert ay > 1.0
    assert transfer == pytest.approx(
        p.m * ay * height + lean + give, rel=3e-3
    )  # angles are taken as small
    lean_and_give = 0.09 if name in OURS else 0.15  # the published tyre gives 16 mm/kN
    assert transfer == pytest.approx(p.m * ay * height, rel=lean_and_give)


@each_vehicle
def test_car_at_rest_has_its_weight_on_its_axles_and_settles_there(name):
    plant = plant_of(name)
    p = plant.parameters
    at_rest = rolling(plant, 0.0)
    assert p.m_s + p.m_uf + p.m_ur == pytest.approx(p.m, rel=1e-4)
    disturbed = at_rest.values.copy()
    disturbed[[HEAVE, PITCH, ROLL, ROLL_RATE]] += 0.02, 0.01, 0.02, 0.1
    settled = plant.advance(PlantState(disturbed, Regime.SLOW), np.zeros(5), 6000)
    np.testing.assert_allclose(settled.values, at_rest.values, atol=1e-4)
    loads = plant.motion([settled], np.zeros((1, 5)), 100.0).tyre_fz[0]
    if name in OURS:
        expected = p.m * GRAVITY / plant.wheelbase * np.array([p.b, p.b, p.a, p.a]) / 2.0
        np.testing.assert_allclose(loads, expected, rtol=2e-3)
        height = (p.m_s * p.h_s + (p.m_uf + p.m_ur) * p.R_w) / p.m
        assert height == pytest.approx(p.h_cg, abs=2e-3)
    np.testing.assert_allclose(loads.sum(), p.m * GRAVITY, rtol=1e-4)


def test_ferrari_and_truck_have_the_axles_and_eigenvalues_that_were_published():
    plant = plant_of("ferrari_250_lm")
    p = plant.parameters
    (front, rear) = cornering_stiffnesses(plant)
    assert (p.m, p.a, p.b) == (982.0, 1.33, 1.07)
    assert p.I_z == pytest.approx(982.0 / 12.0 * (1.7**2 + 4.09**2), rel=1e-4)
    assert front == pytest.approx(0.7e5, rel=0.01)
    assert rear == pytest.approx(1.2e5, rel=0.01)
    # Di Biase et al. 2020, Table 1 and the remark below Eq. 27, with the rational tyre at friction
    # 1.
    plant = plant_of("heavy_truck")
    p = plant.parameters
    for load_arm, tyre, c1, c2 in (
        (p.b, p.tire, 0.01286, 486735.0),
        (p.a, p.tire_rear, 0.00769, 622319.0),
    ):
        load = p.m * GRAVITY * load_arm / (p.a + p.b)
        assert -tyre.p_ky1 * load == pytest.approx(c2, rel=0.01)
        assert load == pytest.approx(c2 * math.sqrt(2.0 * c1) / 2.0, rel=0.01)
    front = 486735.0
    rear = 622319.0
    for speed, ratio in ((2.0, 1.27), (6.5, 1.0), (15.0, 1.0)):
        coupling = front * p.a - rear * p.b
        matrix = [
            [-(front + rear) / (p.m * speed), -coupling / (p.m * speed**2) - 1.0],
            [-coupling / p.I_z, -(front * p.a**2 + rear * p.b**2) / (p.I_z * speed)],
        ]
        sizes = np.abs(np.linalg.eigvals(matrix))
        assert sizes.max() / sizes.min() == pytest.approx(ratio, abs=0.02)


SOURCE = re.compile(
    r"assumed|Neither ply steer nor conicity"  # an assumption
    # a source that the file's head names, or the published set that it starts from
    r"|\[\d\]|as BMW 320i"
    r"|likewise|see \w+|follows from|m - m_uf - m_ur|m a b"  # from other values of the file
)


@each_vehicle
def test_every_value_says_where_it_comes_from_or_that_it_is_assumed(name):
    overrides = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8").partition("overrides:\n")[2]
    block = ""  # comment above a group of values that have none of their own
    for line in overrides.splitlines():
        value, _, comment = line.strip().partition("#")
        if not value:
            block = comment
        elif value.endswith(":"):
            block = ""
        else:
            assert SOURCE.search(comment or block), line
    assert "parameter_set: 2  # BMW 320i (Althoff and Würsching" in (
        FOLDER / f"{name}.yaml"
    ).read_text(encoding="utf-8")


def test_overrides_reach_the_plant_and_cars_pull_to_neither_side():
    for name in OURS:
        plant = plant_of(name)
        after = plant.advance(rolling(plant, 30.0), inputs_of(acceleration=-3.0), 2000)
        assert abs(after.y) < 1e-12
        assert abs(after.yaw) < 1e-12
    slippery = Vehicle(
        "slippery", 2, {"h_s": 0.45, "tire": {"p_dy1": 0.5}, "tire_rear": {"p_dx1": 0.6}}
    )
    assert library_parameters(slippery).tire.p_dy1 == 0.5
    assert library_parameters(slippery).h_s == 0.45
    assert library_parameters(Vehicle("bmw", 2)).h_s == pytest.approx(0.61373004)
    assert (rear_tyre(slippery).p_dy1, rear_tyre(slippery).p_dx1) == (
        0.5,
        0.6,
    )  # the front tyre, but for what is replaced
    compiled = MultiBodyPlant(slippery).parameters
    assert (compiled.tire.p_dx1, compiled.tire_rear.p_dx1, compiled.tire_rear.p_dy1) == (
        pytest.approx(1.1739),
        0.6,
        0.5,
    )


@pytest.mark.parametrize(
    ("configuration", "complaint"),
    [
        ({"name": "a", "parameter_set": 9}, "parameter set 9"),
        ({"name": "a", "parameter_set": 2, "overrides": {"height": 0.4}}, "'height'"),
        (
            {"name": "a", "parameter_set": 2, "overrides": {"tire": {"p_dy1": float("nan")}}},
            "'tire.p_dy1'",
        ),
        (
            {"name": "a", "parameter_set": 2, "overrides": {"tire_rear": {"grip": 1.0}}},
            r"'tire_rear\.grip'",
        ),
    ],
)
def test_vehicle_that_makes_no_sense_names_the_value(configuration, complaint):
    with pytest.raises(ConfigurationError, match=complaint):
        vehicle_from_configuration(configuration)


CONTROL = StabilityControl(
    wheelbase=2.5, understeer_gradient=0.002, yaw_inertia=2000.0, grip=9.0, largest_moment=3000.0
)


def sine_with_dwell(plant, amplitude, control, friction):
    """Largest sideslip [rad] of the manoeuvre of FMVSS 126 at 80 km/h, and the moments [N m] that
    the control asked for.
    """
    state = rolling(plant, 80.0 / 3.6)
    doing = StabilityState()
    largest = 0.0
    moments = []
    for k in range(400):
        time = 0.01 * k
        phase = min(time, max(time - 0.5, 0.75 / 0.7)) * 0.7
        target = amplitude * math.sin(2.0 * math.pi * phase) if phase < 1.0 else 0.0
        if control is not None:
            doing = control.step(
                doing,
                0.01,
                steer=state.steer,
                vx=state.vx,
                yaw_rate=state.yaw_rate,
                friction=friction,
            )
        moments.append(doing.moment)
        state = plant.advance(
            state,
            inputs_of(30.0 * (target - state.steer), moment=doing.moment),
            10,
            friction,
        )
        largest = max(largest, abs(math.atan2(state.vy, state.vx)))
    return largest, np.array(moments)


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("friction", [1.0, 0.5])
def test_sideslip_stays_lower_with_control_than_without(name, friction):
    plant = plant_of(name)
    control = stability_control(plant)
    amplitude = 0.16 if friction == 1.0 else 0.09
    without, _ = sine_with_dwell(plant, amplitude, None, friction)
    with_control, moments = sine_with_dwell(plant, amplitude, control, friction)
    assert with_control < 0.7 * without
    assert 0.0 < np.abs(moments).max() <= friction * control.largest_moment


@pytest.mark.parametrize("name", OURS)
def test_largest_moment_is_within_the_braking_limit_of_both_sides(name):
    plant = plant_of(name)
    state = rolling(plant, 20.0)
    forces = plant.motion(
        [state] * 2, np.array([inputs_of(moment=moment) for moment in (1e9, -1e9)]), 100.0
    ).tyre_fx
    arm = 0.25 * (plant.parameters.T_f + plant.parameters.T_r)
    max_moment = (
        min(-forces[0, [0, 2]].sum(), -forces[1, [1, 3]].sum()) * arm
    )  # to turn left, the left wheels are braked
    assert (
        0.85 * max_moment < stability_control(plant).largest_moment <= 1.01 * max_moment
    )  # 15 %: front and rear tyres differ


@pytest.mark.parametrize("name", OURS)
def test_control_leaves_calm_driving_alone(name):
    plant = plant_of(name)
    _, moments = sine_with_dwell(plant, 0.03, stability_control(plant), 1.0)
    assert not moments.any()


def controlled(reference, active=False, step=0.01, steer=0.0, vx=20.0, yaw_rate=0.0, **options):
    """State of the control a step after one with this reference."""
    state = StabilityState(reference=reference, active=active)
    return CONTROL.step(state, step, steer=steer, vx=vx, yaw_rate=yaw_rate, **options)


def test_moment_turns_the_car_towards_the_reference_with_hysteresis_and_a_limit():
    turns_too_much = controlled(0.2, steer=0.025, yaw_rate=0.5).moment
    assert turns_too_much < 0.0 < controlled(0.2, steer=0.025).moment
    assert controlled(-0.2, steer=-0.025, yaw_rate=-0.5).moment == -turns_too_much
    assert not controlled(0.05, step=1e-6).active
    assert controlled(0.05, active=True, step=1e-6).active
    assert not controlled(0.02, active=True, step=1e-6).active
    assert controlled(0.0, yaw_rate=2.0).moment == -3000.0
    assert controlled(0.0, yaw_rate=2.0, friction=0.5).moment == -1500.0
    assert controlled(0.0, active=True, steer=0.3, vx=3.0).moment == 0.0


def test_reference_is_the_linear_single_track_within_friction():
    state = StabilityState()
    for _ in range(200):
        state = CONTROL.step(state, 0.01, steer=0.02, vx=20.0, yaw_rate=0.0)
    assert state.reference == pytest.approx(20.0 * 0.02 / (2.5 + 0.002 * 400.0))
    for friction in (1.0, 0.5):
        for _ in range(200):
            state = CONTROL.step(state, 0.01, steer=0.3, vx=20.0, yaw_rate=0.0, friction=friction)
        assert state.reference == pytest.approx(friction * 9.0 / 20.0)
