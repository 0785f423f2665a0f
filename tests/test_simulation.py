"""The proving ground: what its plant, course, driver and sensors claim."""

from __future__ import annotations

import json
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.simulation.course import Corner, Straight, build_course, course_by_name
from vehest.simulation.drive import Trip, drive_course, simulate_drive
from vehest.simulation.driver import Driver, DrivingStyle, draw_style, speed_profile
from vehest.simulation.errors import SimulationError
from vehest.simulation.motion import Motion
from vehest.simulation.parameters import Vehicle, library_parameters, vehicle_from_configuration
from vehest.simulation.plant import VX, VY, YAW_RATE, MultiBodyPlant
from vehest.simulation.sensors import SensorLevel, SensorLevels, ideal_sensors, measure, specific_force

CONFIGURATION = Path(__file__).parents[1] / "conf" / "vehicle" / "bmw_320i_low.yaml"
LOWERED = vehicle_from_configuration(yaml.safe_load(CONFIGURATION.read_text(encoding="utf-8")))
AS_PUBLISHED = Vehicle("bmw_320i", parameter_set=2)
HANDLING = course_by_name("handling")
LAP_SEEDS = (0, 2, 4)  # the fastest styles among seeds 0 to 9


def drive(seed: int, duration: float = 12.0, **options: object) -> Recording:
    return simulate_drive(id=f"drive{seed}", vehicle=LOWERED, course=HANDLING, duration=duration, seed=seed, **options)


def trip(seed: int, duration: float, rate_hz: float = 100.0, step: float = 1e-3) -> Trip:
    plant = MultiBodyPlant(LOWERED, step)
    return drive_course(plant=plant, course=HANDLING, driver=Driver(), style=draw_style(seed), duration=duration, rate_hz=rate_hz)


def turn_left(speed: float, steer: float, seconds: float, vehicle: Vehicle = LOWERED) -> Motion:
    """A car at constant speed and steering angle for a while, as a motion of one sample."""
    plant = MultiBodyPlant(vehicle)
    state = plant.initial_state(0.0, 0.0, 0.0, speed)
    for _ in range(round(seconds * 100)):
        inputs = np.array([np.clip(10.0 * (steer - state[2]), -0.02, 0.02), 3.0 * (speed - state[VX]) + 0.8])
        state = plant.advance(state, inputs, 10)
    return plant.motion(state[None], plant.derivative(state, inputs)[None], 100.0)


def still(n_samples: int, **values: float) -> Motion:
    names = [name for name in Motion.__dataclass_fields__ if name != "rate_hz"]
    return Motion(100.0, **{name: np.full(n_samples, values.get(name, 0.0)) for name in names})


@pytest.fixture(scope="module")
def laps() -> list[Trip]:
    return [trip(seed, duration=100.0) for seed in LAP_SEEDS]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return drive(seed=1)


# --- plant


def test_compiled_equations_are_the_librarys_own() -> None:
    plant, generator = MultiBodyPlant(LOWERED), np.random.default_rng(0)
    for _ in range(20):
        state = plant.initial_state(1.0, 2.0, 0.3, 25.0)
        state += 0.02 * generator.standard_normal(29) * np.maximum(np.abs(state), 0.1)
        inputs = generator.uniform([-0.3, -8.0], [0.3, 4.0])
        expected = vehicle_dynamics_mb(state.tolist(), inputs.tolist(), library_parameters(LOWERED))
        np.testing.assert_allclose(plant.derivative(state, inputs), expected, rtol=1e-9, atol=1e-9)


def test_fixed_step_agrees_with_solve_ivp() -> None:
    plant, inputs, parameters = MultiBodyPlant(LOWERED), np.array([0.04, -2.0]), library_parameters(LOWERED)
    start = plant.initial_state(0.0, 0.0, 0.0, 30.0)

    def right_hand_side(_: float, state: np.ndarray) -> list[float]:
        return vehicle_dynamics_mb(state.tolist(), inputs.tolist(), parameters)

    reference = solve_ivp(right_hand_side, (0.0, 1.0), start, method="DOP853", rtol=1e-8, atol=1e-9).y[:, -1]
    state = plant.advance(start, inputs, 1000)
    np.testing.assert_allclose(state, reference, rtol=1e-4, atol=1e-4)
    assert abs(state[YAW_RATE] * state[VX]) > 6.0  # the manoeuvre is not a harmless one


def test_halving_the_step_changes_no_sample_that_matters() -> None:
    # Where a tyre's camber changes sign its force jumps, and the step decides when: hence largest and mean differences.
    whole, half = (trip(seed=2, duration=25.0, step=step).motion for step in (1e-3, 5e-4))
    for name, largest, mean in (("vx", 1e-4, 1e-5), ("vy", 3e-3, 4e-4), ("yaw_rate", 1e-3, 1e-4), ("ay", 0.3, 0.01)):
        difference = np.abs(getattr(whole, name) - getattr(half, name))
        assert difference.max() < largest, name
        assert difference.mean() < mean, name


def test_steady_cornering_at_45_m_per_s_reaches_the_known_figure() -> None:
    turn = turn_left(speed=45.0, steer=0.0275, seconds=15.0)
    assert turn.ay[0] == pytest.approx(9.3, abs=0.1)
    assert math.degrees(turn.sideslip[0]) == pytest.approx(-3.4, abs=0.15)


def test_left_turn_has_the_signs_of_iso_8855() -> None:
    turn = turn_left(speed=20.0, steer=0.04, seconds=5.0)
    for name in ("steer", "yaw_rate", "ay", "yaw", "y"):
        assert getattr(turn, name)[0] > 0, name
    assert turn.roll[0] > 0.01  # leans outwards, the left side up
    assert turn.wheel_speed_fr[0] > turn.wheel_speed_fl[0] + 1.0  # the outer wheels run further
    assert turn.wheel_speed_rr[0] > turn.wheel_speed_rl[0] + 0.5


def test_braking_lowers_the_nose() -> None:
    plant, inputs = MultiBodyPlant(LOWERED), np.array([0.0, -5.0])
    state = plant.advance(plant.initial_state(0.0, 0.0, 0.0, 30.0), inputs, 1000)
    motion = plant.motion(state[None], plant.derivative(state, inputs)[None], 100.0)
    assert motion.pitch[0] > 0.005
    assert motion.ax[0] == pytest.approx(-5.0, abs=0.5)
    assert specific_force(motion)[0][0] < motion.ax[0]  # gravity adds to the braking that the sensor shows


def test_published_bmw_rolls_over_where_the_lowered_one_corners() -> None:
    with pytest.raises(SimulationError, match="rolled over"):
        turn_left(speed=45.0, steer=0.0275, seconds=15.0, vehicle=AS_PUBLISHED)


def test_drive_that_fails_says_which_and_when() -> None:
    with pytest.raises(SimulationError, match=r"drive 'high' with seed 0: course 'handling', \d+\.\d\d s after the start: ") as raised:
        simulate_drive(id="high", vehicle=AS_PUBLISHED, course=HANDLING, duration=60.0, seed=0)
    assert raised.value.exit_code == 3


def test_state_that_is_not_finite_is_an_error() -> None:
    plant = MultiBodyPlant(LOWERED)
    state = plant.initial_state(0.0, 0.0, 0.0, 20.0)
    state[VY] = np.nan
    with pytest.raises(SimulationError):
        plant.advance(state, np.zeros(2), 1)


def test_too_slow_a_car_is_an_error_not_an_unstable_integration() -> None:
    plant = MultiBodyPlant(LOWERED)
    state = plant.initial_state(0.0, 0.0, 0.0, 2.1)
    state = plant.advance(state, np.array([0.0, -5.0]), 10)
    with pytest.raises(SimulationError, match="smaller step"):
        plant.advance(state, np.array([0.0, -5.0]), 100)


@pytest.mark.parametrize(
    ("configuration", "complaint"),
    [
        ({"name": "a", "parameter_set": 9}, "parameter set 9"),
        ({"name": "a", "parameter_set": 2, "overrides": {"height": 0.4}}, "'height'"),
        ({"name": "a", "parameter_set": 2, "overrides": {"tire": {"p_dy1": float("nan")}}}, "'tire.p_dy1'"),
        ({"name": "a", "parameter_set": 2, "overrides": {"tire": 1.0}}, "must be a mapping"),
        ({"name": "a"}, "parameter_set"),
    ],
)
def test_vehicle_that_makes_no_sense_names_the_value(configuration: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigurationError, match=complaint):
        vehicle_from_configuration(configuration)


def test_overrides_reach_the_plant() -> None:
    slippery = Vehicle("slippery", 2, {**LOWERED.overrides, "tire": {"p_dy1": 0.5}})
    assert library_parameters(slippery).tire.p_dy1 == 0.5
    assert library_parameters(slippery).h_s == 0.45
    assert library_parameters(AS_PUBLISHED).h_s == pytest.approx(0.61373004)


# --- course


def test_handling_course_is_closed() -> None:
    assert HANDLING.gap < 1e-6
    assert HANDLING.turning == pytest.approx(2.0 * math.pi, abs=1e-9)
    assert 1500.0 < HANDLING.length < 2500.0


def test_handling_course_turns_both_ways_at_several_radii() -> None:
    for side in (1.0, -1.0):
        curvature = side * HANDLING.curvature
        tops = curvature[1:-1][(curvature[1:-1] > 1e-6) & (curvature[1:-1] >= curvature[:-2]) & (curvature[1:-1] >= curvature[2:])]
        assert len(np.unique(np.round(1.0 / tops))) >= 3


def test_course_positions_follow_from_their_curvature() -> None:
    heading = HANDLING.heading
    chord = np.hypot(np.diff(HANDLING.x), np.diff(HANDLING.y))
    np.testing.assert_allclose(chord, HANDLING.arc_length[1], rtol=1e-3)
    directions = np.unwrap(np.arctan2(np.diff(HANDLING.y), np.diff(HANDLING.x)))
    np.testing.assert_allclose(directions, 0.5 * (heading[1:] + heading[:-1]), atol=1e-3)
    slope = 0.5 * (HANDLING.curvature[1:] + HANDLING.curvature[:-1])
    np.testing.assert_allclose(np.diff(heading), slope * HANDLING.arc_length[1], atol=5e-4)


def test_circle_of_four_corners_has_the_length_of_its_parts() -> None:
    corner = Corner(radius=50.0, angle=math.pi / 2.0, transition=10.0)
    square = build_course("square", [Straight(101.0), corner, Straight(100.0), corner] * 2)
    assert square.gap < 1e-9
    assert square.length == pytest.approx(402.0 + 4.0 * (50.0 * math.pi / 2.0 + 10.0))


def test_course_that_does_not_close_is_an_error() -> None:
    with pytest.raises(ConfigurationError, match="90°"):
        build_course("open", [Straight(100.0), Corner(50.0, math.pi / 2.0, 10.0)])
    with pytest.raises(ConfigurationError, match="handling"):
        course_by_name("nordschleife")


# --- driver


def test_driver_stays_within_a_metre_and_a_half_of_the_centre_line(laps: list[Trip]) -> None:
    fine = np.linspace(0.0, HANDLING.length, 40_000)
    centre = np.stack([np.interp(fine, HANDLING.arc_length, values) for values in (HANDLING.x, HANDLING.y)], axis=1)
    tree = cKDTree(centre)
    for lap in laps:
        distance, nearest = tree.query(np.stack([lap.motion.x, lap.motion.y], axis=1))
        assert distance.max() < 1.5
        assert len(np.unique(nearest // 100)) == 400  # it really goes all the way around


def test_laps_are_fast_and_without_spin(laps: list[Trip]) -> None:
    for lap in laps:
        motion = lap.motion
        assert 12.0 < motion.vx.min() < 20.0
        assert 40.0 < motion.vx.max() < 46.0
        assert 7.0 < motion.ay.max() < 9.5
        assert -9.5 < motion.ay.min() < -7.0
        assert 1.5 < math.degrees(np.abs(motion.sideslip).max()) < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_no_seed_spins_or_rolls_over(seed: int) -> None:
    lap = trip(seed, duration=240.0)
    assert np.abs(lap.lateral_error).max() < 1.0
    assert math.degrees(np.abs(lap.motion.sideslip).max()) < 5.0


def test_speed_profile_stays_within_friction_circle_and_power() -> None:
    driver, limit = Driver(), np.full_like(HANDLING.curvature, 8.0)
    speed = speed_profile(HANDLING.curvature, limit, HANDLING.arc_length[1], driver)
    lateral = speed**2 * HANDLING.curvature
    longitudinal = np.diff(speed**2) / (2.0 * HANDLING.arc_length[1])
    assert np.abs(lateral).max() <= 8.0 + 1e-9
    assert longitudinal.min() >= -driver.braking_share * 8.0 - 1e-9
    assert (longitudinal * speed[:-1]).max() <= driver.drive_power + 1e-9
    assert np.isclose(np.abs(lateral), 8.0).sum() > 5  # and uses all of it in the corners


def test_style_beyond_the_grip_is_an_error() -> None:
    with pytest.raises(ConfigurationError, match="grip fraction"):
        DrivingStyle(grip_fraction=1.1)


# --- sensors


def test_ideal_sensors_are_kinematically_consistent() -> None:
    shown = drive(seed=0, duration=20.0, rate_hz=1000.0, sensors=ideal_sensors())
    vx, vy, yaw_rate = shown["vx"], shown["vy_ref"], shown["yaw_rate"]
    for velocity, rate in ((vy, shown["ay"] - vx * yaw_rate), (vx, shown["ax"] + vy * yaw_rate)):
        change = velocity[2:] - velocity[:-2]
        integral = 1e-3 / 3.0 * (rate[:-2] + 4.0 * rate[1:-1] + rate[2:])  # Simpson's rule
        error = np.abs(change - integral)
        assert error.max() < 1e-4  # in the few steps in which a tyre's force jumps
        assert np.median(error) < 1e-7
        assert np.abs(change).max() > 1e-3


def test_ideal_sensors_show_the_motion_itself() -> None:
    motion = trip(seed=3, duration=5.0).motion
    shown = drive(seed=3, duration=5.0, sensors=ideal_sensors())
    for name in ("vx", "yaw_rate", "ax", "ay", "steer", "wheel_speed_fl", "wheel_speed_rr"):
        np.testing.assert_array_equal(shown[name], getattr(motion, name))
    np.testing.assert_array_equal(shown["sideslip_ref"], np.arctan2(shown["vy_ref"], shown["vx_ref"]))


def test_gravity_leaks_into_the_accelerometers_of_a_tilted_car_at_rest() -> None:
    silent = replace(ideal_sensors(), gravity_leak=True)
    tilted = measure(still(1, roll=0.05, pitch=-0.02), silent, seed=0)
    assert tilted["ay"][0] == pytest.approx(9.81 * math.sin(0.05) * math.cos(0.02))  # left side up
    assert tilted["ax"][0] == pytest.approx(9.81 * math.sin(0.02))  # nose up
    level = measure(still(1, roll=0.05, pitch=-0.02), ideal_sensors(), seed=0)
    assert level["ay"][0] == level["ax"][0] == 0.0


def test_noise_and_offset_have_their_levels() -> None:
    levels, motion = SensorLevels(), still(20_000, vx=20.0)
    shown = measure(motion, levels, seed=5)
    for name in ("yaw_rate", "ax", "ay", "vx", "steer", "vx_ref", "vy_ref"):
        noise = getattr(levels, name).noise
        assert np.std(shown[name]) == pytest.approx(noise, rel=0.03), name
        lagged = np.corrcoef(shown[name][1:], shown[name][:-1])[0, 1]
        assert abs(lagged) < 0.03, name  # white
    offsets = [measure(still(1), SensorLevels(ay=SensorLevel(offset=0.03)), seed)["ay"][0] for seed in range(400)]
    assert np.std(offsets) == pytest.approx(0.03, rel=0.15)
    assert abs(np.mean(offsets)) < 0.006


def test_switching_one_sensor_off_leaves_the_others_alone() -> None:
    motion = still(100, vx=20.0)
    all_on = measure(motion, SensorLevels(), seed=7)
    one_off = measure(motion, SensorLevels(ay=SensorLevel()), seed=7)
    assert not one_off["ay"].any()
    for name in all_on:
        if name != "ay":
            np.testing.assert_array_equal(all_on[name], one_off[name])


def test_negative_sensor_level_is_an_error() -> None:
    with pytest.raises(ConfigurationError, match="zero or positive"):
        SensorLevel(noise=-0.1)


# --- drives


def test_same_seed_gives_the_same_samples_here_and_in_two_processes_at_once(recording: Recording) -> None:
    with ProcessPoolExecutor(max_workers=2, mp_context=get_context("spawn")) as pool:
        others = list(pool.map(drive, [1, 1]))
    for other in (drive(seed=1), *others):
        for name in recording.channels:
            np.testing.assert_array_equal(recording[name], other[name])


def test_other_seeds_give_other_drives(recording: Recording) -> None:
    other = drive(seed=2)
    assert np.abs(recording["vx"] - other["vx"]).max() > 0.5
    assert np.abs(draw_style(1).grip_fraction - draw_style(2).grip_fraction) > 0.01


def test_sampling_rate_does_not_change_the_drive() -> None:
    coarse, fine = (drive(seed=0, duration=8.0, rate_hz=rate, sensors=ideal_sensors()) for rate in (20.0, 100.0))
    for name in coarse.channels:
        np.testing.assert_array_equal(coarse[name], fine[name][::5])


def test_recording_says_where_it_comes_from(recording: Recording) -> None:
    assert recording.kind == "simulated"
    assert recording.vehicle == "bmw_320i_low"
    assert (len(recording), recording.rate_hz) == (1200, 100.0)
    wheels = {f"wheel_speed_{corner}" for corner in ("fl", "fr", "rl", "rr")}
    assert set(recording.channels) == {"vx", "yaw_rate", "ax", "ay", "steer", "vx_ref", "vy_ref", "sideslip_ref"} | wheels
    provenance = json.loads(json.dumps(recording.provenance))
    assert provenance == recording.provenance
    assert provenance["course"] == "handling"
    assert provenance["seed"] == 1
    assert provenance["overrides"]["h_s"] == 0.45
    assert provenance["sensors"]["gravity_leak"] is True
    assert provenance["library"].startswith("commonroad-vehicle-models ")


@pytest.mark.parametrize("options", [{"rate_hz": 30.0}, {"rate_hz": 0.0}, {"duration": 0.0}, {"seed": -1}, {"step": 0.0}, {"step": 3e-3}])
def test_drive_that_makes_no_sense_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError):
        drive(**{"seed": 0, "duration": 1.0, **options})
