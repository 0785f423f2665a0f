"""The planar plant, its car and its driver: closed forms, energy, standstill and spins, and what
the simulated tyre sets hold.
"""

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from vehest.configuration.composition import compose_config
from vehest.constants import GRAVITY
from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.freestyle import Freestyle
from vehest.simulation.driving.manoeuvres import manoeuvre_from_config
from vehest.simulation.errors import SimulationError
from vehest.simulation.planar_drive import (
    CHANNELS,
    PLANAR_MANOEUVRES,
    drive_freely,
    simulate_planar_drive,
)
from vehest.simulation.plant.planar import (
    FIRST_WHEEL,
    LOAD_AX,
    LOAD_AY,
    STEER,
    VX,
    VY,
    YAW_RATE,
    Inputs,
    PlanarPlant,
)
from vehest.simulation.plant.planar_car import PARAMETERS, planar_car_from_configuration
from vehest.simulation.road.surface import SURFACES
from vehest.simulation.sensors.levels import PRESETS
from vehest.sources.base import open_source

CONF = Path(__file__).parents[2] / "conf"
CONFIGURATION = yaml.safe_load((CONF / "vehicle" / "f1tenth.yaml").read_text(encoding="utf-8"))
CAR = planar_car_from_configuration(CONFIGURATION)
EVEN = replace(
    CAR, stiffness_factor_rear=CAR.stiffness_factor_front, load_sensitivity=0.0
)  # all tyres alike


def coasted(car, seconds, speed=0.0, **inputs):
    """The state after some time with constant inputs."""
    plant = PlanarPlant(car)
    return plant.advance(plant.initial_state(speed), Inputs(**inputs), round(1000 * seconds))


@cache
def freestyle(rate_hz=1000.0):
    return drive_freely(PlanarPlant(CAR), Freestyle(duration=15.0), 1, rate_hz=rate_hz).motion


def test_slow_motors_and_locked_wheels_have_the_forces_of_the_closed_form():
    car = replace(CAR, air_drag=1.0)
    current = 1.15 * CAR.coulomb_torque / CAR.torque_constant
    state = coasted(car, 30.0, speed=1.0, current=current)
    speed = state[VX]
    wheels = state[FIRST_WHEEL : FIRST_WHEEL + 4].mean()
    torque = car.torque_constant * current - car.coulomb_torque - car.viscous_torque * wheels
    assert torque == pytest.approx(car.wheel_radius * car.air_drag * speed**2, rel=2e-3)
    assert 0.5 < speed < 2.0
    plant = PlanarPlant(EVEN)
    state = plant.advance(plant.initial_state(4.0), Inputs(current=-70.0), 200)
    state[FIRST_WHEEL : FIRST_WHEEL + 4] = 0.0
    for _ in range(50):  # as long as the motor holds them
        state = plant.advance(state, Inputs(current=0.0), 1)
        state[FIRST_WHEEL : FIRST_WHEEL + 4] = 0.0
    rate, _ = plant.derivative(state, Inputs())
    sliding = (
        EVEN.friction
        * GRAVITY
        * math.sin(EVEN.shape_factor * math.atan(EVEN.stiffness_factor_front))
    )
    assert state[VX] > 1.0
    assert -rate[VX] == pytest.approx(
        sliding + EVEN.air_drag / EVEN.mass * state[VX] ** 2, rel=2e-3
    )


@pytest.mark.parametrize("steer", [0.05, -0.3])
def test_slow_circle_is_that_of_the_axles_geometry(steer):
    rolls_freely = replace(
        CAR, coulomb_torque=0.0, viscous_torque=0.0, axle_lock=0.0, centre_lock=0.0
    )
    state = coasted(rolls_freely, 1.0, speed=0.6, steer=steer)
    assert 0.4 < state[VX] < 0.6
    expected = state[VX] * math.tan(steer) / CAR.wheelbase
    assert state[YAW_RATE] == pytest.approx(
        expected, rel=0.05
    )  # tyres scrub: both wheels steer by one angle


def test_small_slips_have_the_stiffness_of_the_linear_single_track():
    plant = PlanarPlant(EVEN)
    car = EVEN
    state = plant.initial_state(3.0)
    state[VY] = 0.003
    state[STEER] = 0.001
    steady, _ = plant.derivative(state, Inputs(steer=0.001))
    for _ in range(400):  # the carcass comes to rest while the car is held
        rate, forces = plant.derivative(state, Inputs(steer=0.001))
        state[10:18] += 1e-3 * rate[10:18]
    stiffness = (
        car.friction
        * car.mass
        * GRAVITY
        * car.stiffness_factor_front
        * car.shape_factor
        / car.wheelbase
    )
    front = stiffness * car.cg_to_rear_axle * (0.001 - 0.003 / 3.0)
    rear = stiffness * car.cg_to_front_axle * (-0.003 / 3.0)
    assert np.isfinite(steady).all()
    assert forces[:2, 1].sum() == pytest.approx(front, abs=1e-4 * stiffness * car.wheelbase)
    assert forces[2:, 1].sum() == pytest.approx(rear, rel=1e-3)


def test_a_drive_is_consistent_in_forces_kinematics_and_friction():
    motion = freestyle()
    drag = CAR.air_drag * np.hypot(motion.vx, motion.vy)
    np.testing.assert_allclose(
        CAR.mass * motion.ax, motion.tyre_fx.sum(axis=1) - drag * motion.vx, atol=1e-9
    )
    np.testing.assert_allclose(
        CAR.mass * motion.ay, motion.tyre_fy.sum(axis=1) - drag * motion.vy, atol=1e-9
    )
    x = np.array([CAR.cg_to_front_axle] * 2 + [-CAR.cg_to_rear_axle] * 2)
    y = 0.5 * CAR.track * np.array([1.0, -1.0, 1.0, -1.0])
    moment = (x * motion.tyre_fy - y * motion.tyre_fx).sum(axis=1)
    turning = np.gradient(motion.yaw_rate) * motion.rate_hz
    assert (
        np.quantile(np.abs(CAR.yaw_inertia * turning - moment)[1:-1], 0.99)
        < 0.02 * np.abs(moment).max()
    )
    rate = 1000.0
    for channel, expected in (
        (np.gradient(motion.vx) * rate - motion.vy * motion.yaw_rate, motion.ax),
        (np.gradient(motion.vy) * rate + motion.vx * motion.yaw_rate, motion.ay),
        (np.gradient(motion.yaw) * rate, motion.yaw_rate),
        (
            np.gradient(motion.x) * rate,
            motion.vx * np.cos(motion.yaw) - motion.vy * np.sin(motion.yaw),
        ),
        (
            np.gradient(motion.y) * rate,
            motion.vx * np.sin(motion.yaw) + motion.vy * np.cos(motion.yaw),
        ),
    ):
        assert np.quantile(np.abs(channel - expected)[1:-1], 0.999) < 0.02 * np.abs(expected).max()
    force = np.hypot(motion.tyre_fx, motion.tyre_fy)
    relative = motion.tyre_fz / (0.25 * CAR.mass * GRAVITY) - 1.0
    assert (
        force <= CAR.friction * (1.0 - CAR.load_sensitivity * relative) * motion.tyre_fz + 1e-12
    ).all()
    assert (motion.tyre_fz > 0.0).all()  # and no wheel lifts


def test_wheel_loads_carry_the_weight_and_a_fixed_step_agrees_with_solve_ivp():
    plant = PlanarPlant(CAR)
    state = plant.initial_state(2.0)
    state[LOAD_AX] = 2.0
    state[LOAD_AY] = -3.0
    load = plant.derivative(state, Inputs())[1][:, 2]
    assert load.sum() == pytest.approx(CAR.mass * GRAVITY)
    assert 0.5 * CAR.track * (load[1] + load[3] - load[0] - load[2]) == pytest.approx(
        CAR.mass * CAR.cg_height * -3.0
    )
    axles = CAR.cg_to_front_axle * load[:2].sum() - CAR.cg_to_rear_axle * load[2:].sum()
    assert -axles == pytest.approx(CAR.mass * CAR.cg_height * 2.0)
    inputs = Inputs(steer=0.45, current=45.0)
    start = plant.initial_state(2.0)
    reference = solve_ivp(
        lambda _, state: plant.derivative(state, inputs)[0],
        (0.0, 0.5),
        start,
        rtol=1e-9,
        atol=1e-10,
        max_step=0.005,
    )
    np.testing.assert_allclose(
        plant.advance(start, inputs, 500), reference.y[:, -1], rtol=1e-3, atol=2e-4
    )
    plant = PlanarPlant(CAR, step=0.1)
    with pytest.raises(SimulationError, match=r"smaller step than 0\.1 s"):
        plant.advance(plant.initial_state(3.0), Inputs(0.4, 60.0), 10_000)


@pytest.mark.parametrize("yaw_rate", [0.0, 6.0, -12.0])
def test_a_car_that_coasts_loses_energy_until_it_stands(yaw_rate):
    plant = PlanarPlant(CAR)
    state = plant.initial_state(4.0)
    state[VY] = 1.5
    state[YAW_RATE] = yaw_rate
    energies = []
    for _ in range(500):
        wheels = state[FIRST_WHEEL : FIRST_WHEEL + 4]
        moving = (
            CAR.mass * (state[VX] ** 2 + state[VY] ** 2) + CAR.yaw_inertia * state[YAW_RATE] ** 2
        )
        energies.append(
            0.5
            * (
                moving
                + CAR.wheel_inertia * (wheels**2).sum()
                + CAR.motor_inertia * wheels.mean() ** 2
            )
        )
        state = plant.advance(state, Inputs(steer=0.2), 10)
    assert (
        np.diff(energies) < 5e-4 * energies[0]
    ).all()  # tyres give back what their carcasses hold, which is little
    assert energies[-1] < 1e-4 * energies[0]


def test_car_at_rest_stays_there_and_slippery_floors_lower_accelerations():
    state = coasted(CAR, 2.0, steer=0.4)
    assert state[STEER] == pytest.approx(0.4)
    np.testing.assert_array_equal(state[:STEER], 0.0)
    assert coasted(CAR, 2.0, current=0.5 * CAR.coulomb_torque / CAR.torque_constant)[VX] < 0.06
    assert coasted(CAR, 2.0, current=30.0)[VX] > 2.0
    dry, wet = (
        drive_freely(PlanarPlant(CAR), Freestyle(duration=15.0), 1, surface=SURFACES[name]).motion
        for name in ("dry", "wet")
    )
    dry, wet = (np.quantile(np.hypot(motion.ax, motion.ay), 0.95) for motion in (dry, wet))
    assert wet / dry == pytest.approx(0.7, rel=0.05)


def test_states_stay_finite_under_random_inputs():
    plant = PlanarPlant(CAR)
    generator = np.random.default_rng(5)
    state = plant.initial_state()
    fastest = 0.0
    backwards = 0.0
    turned = 0.0
    for _ in range(80):
        inputs = Inputs(
            float(generator.choice([-1.0, 0.0, 1.0])),
            float(generator.uniform(-80.0, 80.0)),
            float(generator.uniform(0.3, 1.2)),
        )
        state = plant.advance(state, inputs, 500)
        fastest = max(fastest, state[VX])
        backwards = min(backwards, state[VX])
        turned = max(turned, abs(state[YAW_RATE]))
    assert np.isfinite(state).all()
    assert 2.0 < fastest < 20.0
    assert backwards < -1.0
    assert 3.0 < turned < 40.0


def test_vx_is_the_motors_speed_at_the_rim_and_errs_where_wheels_slip():
    recording = simulate_planar_drive(
        id="a", car=CAR, manoeuvre=Freestyle(duration=15.0), seed=1, sensors=PRESETS["ideal"]
    )
    motion = freestyle(rate_hz=100.0)
    assert set(recording.channels) == set(CHANNELS)
    np.testing.assert_array_equal(
        recording["vx"], CAR.wheel_radius * motion.wheel_speed.mean(axis=1)
    )
    np.testing.assert_array_equal(recording["vx_ref"], motion.vx)
    np.testing.assert_array_equal(recording["motor_current"], motion.motor_current)
    assert np.abs(recording["vx"] - recording["vx_ref"]).max() > 0.5
    assert recording.kind == "simulated"
    assert recording.provenance["parameters"]["friction"] == CAR.friction


@cache
def tyre_sets():
    source = open_source(compose_config("ingest", ["dataset=sim_tyre_sets"])["dataset"])
    return {name: dict(source.read(name).channels) for name in source.ids()}


def of(pattern, channel):
    return np.concatenate(
        [drive[channel] for name, drive in tyre_sets().items() if name.startswith(pattern)]
    )


def test_tyre_sets_are_as_long_as_stated_and_slide_and_grip_as_the_recordings_do():
    assert all(
        np.isfinite(samples).all() for drive in tyre_sets().values() for samples in drive.values()
    )
    for pattern, minutes in (("learn_a", 3.0), ("test_a", 1.5), ("test_d", 3.0)):
        assert len(of(pattern, "vx")) / 6000.0 == pytest.approx(minutes, rel=0.1)
    # iros_hoons_1: 99 % of |β| below 23°, of the slip ratio below 0.95, half of the yaw rates above
    # 2.3 rad/s, speeds of 0.8 to 3.9 m/s.
    for pattern in ("learn_a", "test_a", "test_d"):
        vx = of(pattern, "vx_ref")
        vy = of(pattern, "vy_ref")
        fast = vx > 0.5
        assert fast.mean() > 0.97
        assert 20.0 < np.degrees(np.quantile(np.abs(np.arctan2(vy, vx))[fast], 0.99)) < 65.0
        assert 0.4 < np.quantile(((of(pattern, "vx") - vx) / vx)[fast], 0.99) < 1.5
        assert 0.5 < np.quantile(vx[fast], 0.01) < 1.2
        assert 3.0 < np.quantile(vx[fast], 0.99) < 6.0
        assert 1.4 < np.median(np.abs(of(pattern, "yaw_rate_ref"))) < 2.5
    grip = {}
    for tyre in ("test_a", "test_d"):
        vx = of(tyre, "vx_ref")
        yaw_rate = of(tyre, "yaw_rate_ref")
        grip[tyre] = np.quantile(np.abs(vx * yaw_rate), 0.9)
    assert grip["test_d"] / grip["test_a"] == pytest.approx(0.45 / 0.65, rel=0.1)


def test_every_value_says_where_it_comes_from_or_that_it_is_assumed():
    text = (CONF / "vehicle" / "f1tenth.yaml").read_text(encoding="utf-8")
    lines = text.partition("parameters:\n")[2].splitlines()
    assert len(lines) == len(PARAMETERS)
    assert all(re.search(r"#.*(assumed|\] \[\d\]|see \w+)", line) for line in lines)


def car_with(**changes):
    return planar_car_from_configuration(
        {**CONFIGURATION, "parameters": {**CONFIGURATION["parameters"], **changes}}
    )


def data_set(**changes):
    drive = {"id": "a", "manoeuvre": {"name": "freestyle", "duration": 1.0}}
    return open_source(
        {
            "name": "mine",
            "source": "simulated",
            "vehicle": CONFIGURATION,
            "drives": [drive],
            **changes,
        }
    )


OF_OTHERS = [{"parameters": ["tire.p_dy1"], "factor": [0.9, 1.1]}]


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: car_with(height=1.0), "unknown key 'height'"),
        (lambda: car_with(mass=-1.0), "mass: .* greater than 0, not -1"),
        (
            lambda: manoeuvre_from_config({"name": "slalom"}, PLANAR_MANOEUVRES),
            "there is no manoeuvre 'slalom'; there are freestyle",
        ),
        (
            lambda: manoeuvre_from_config({"name": "freestyle", "brakes": 2.0}, PLANAR_MANOEUVRES),
            "brakes must lie between 0 and 1",
        ),
        (
            lambda: manoeuvre_from_config(
                {"name": "freestyle", "brakes": 0.6, "kicks": 0.6}, PLANAR_MANOEUVRES
            ),
            "shares of one",
        ),
        (lambda: data_set(stability_control=True), "has no stability control"),
        (
            lambda: data_set(drives=[{"id": "a", "manoeuvre": {"name": "slalom"}}]),
            "there are freestyle",
        ),
        (
            lambda: data_set(vary=OF_OTHERS),
            r"'tire\.p_dy1' is no parameter of vehicle 'f1tenth_tyre_a'",
        ),
        (
            lambda: data_set(vehicle={"name": "a", "parameter_set": 2}),
            "there is no manoeuvre 'freestyle'",
        ),
    ],
)
def test_cars_manoeuvres_and_data_sets_that_make_no_sense_are_refused(make, complaint):
    with pytest.raises(ConfigurationError, match=complaint):
        make()


def test_cars_of_a_data_set_vary_from_drive_to_drive():
    drives = [{"id": "a", "count": 2, "manoeuvre": {"name": "freestyle", "duration": 1.0}}]
    source = data_set(
        drives=drives, vary=[{"parameters": ["friction", "mass"], "factor": [0.5, 0.9]}]
    )
    assert source.inputs() == {}  # the planar plant is vehest's own
    first, second = (source.read(name).provenance["parameters"] for name in source.ids())
    for drawn in (first, second):
        assert 0.5 <= drawn["friction"] / CAR.friction <= 0.9
        assert drawn["mass"] / CAR.mass == pytest.approx(drawn["friction"] / CAR.friction)
    assert first["mass"] != second["mass"]
