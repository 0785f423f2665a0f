"""The proving ground: what its courses, surfaces, lines, driver and drives claim."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from cars import shipped
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from vehest.data.errors import ConfigurationError
from vehest.simulation.drive import drive as drive_plant
from vehest.simulation.drive import simulate_drive
from vehest.simulation.driving.car import car_of
from vehest.simulation.driving.driver import Driver, draw_style, speed_profile
from vehest.simulation.driving.manoeuvres import manoeuvre_from_config
from vehest.simulation.errors import SimulationError
from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import Vehicle
from vehest.simulation.road.course import build_course, course_by_name
from vehest.simulation.road.lines import least_within
from vehest.simulation.road.segments import Compound, Corner, Straight
from vehest.simulation.road.surface import surface_from_config
from vehest.simulation.road.tracks import LAYOUTS, Layout
from vehest.simulation.sensors.levels import PRESETS

LOWERED = shipped("bmw_320i_low")
HANDLING = course_by_name("handling")
LAP_SEEDS = (0, 2)  # the fastest styles among seeds 0 to 4


def gap(course):
    return math.hypot(course.x[-1] - course.x[0], course.y[-1] - course.y[0])


def drive(seed, duration=12.0, **options):
    manoeuvre = manoeuvre_from_config({"name": "laps", "course": "handling", "duration": duration})
    return simulate_drive(
        id=f"drive{seed}", vehicle=LOWERED, manoeuvre=manoeuvre, seed=seed, **options
    )


def trip(seed, course="handling", surface="dry", step=0.001, **options):
    manoeuvre = manoeuvre_from_config({"name": "laps", "course": course, **options})
    return drive_plant(
        MultiBodyPlant(LOWERED, step),
        manoeuvre,
        seed,
        surface=surface_from_config(surface),
        rate_hz=100.0,
    )


def places_on(course, x, y):
    """Nearest arc lengths, and distances from the centre line [m]."""
    fine = np.linspace(0.0, course.length, 40_000)
    centre = np.stack(
        [np.interp(fine, course.arc_length, values) for values in (course.x, course.y)], axis=1
    )
    distance, nearest = cKDTree(centre).query(np.stack([x, y], axis=1))
    return fine[nearest], distance


@pytest.fixture(scope="module")
def laps():
    return [trip(seed, laps=1) for seed in LAP_SEEDS]


@pytest.fixture(scope="module")
def circuit():
    return trip(
        1, course="palm_beach_like", duration=80.0
    )  # 2 km of 3.3 km, until the banked corner's end


@pytest.mark.parametrize(
    ("name", "shortest", "longest"),
    [
        ("handling", 2380, 2420),
        ("vairano_like", 2480, 2520),
        ("palm_beach_like", 3250, 3300),
        ("fast_circuit", 3780, 3820),
        ("hill_circuit", 3660, 3700),
    ],
)
def test_courses_are_closed_and_as_long_as_stated(name, shortest, longest):
    course = course_by_name(name)
    assert gap(course) < 1e-6
    assert abs(course.turning) == pytest.approx(2.0 * math.pi, abs=1e-9)
    assert shortest < course.length < longest
    for values in (course.bank, course.grade, course.friction):
        assert values.shape == course.arc_length.shape
        assert values[-1] == pytest.approx(values[0], abs=1e-3)  # no step at the line


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_courses_do_not_come_near_themselves(name):
    course = course_by_name(name)
    places = np.stack([course.x, course.y], axis=1)[:-1]
    pairs = cKDTree(places).query_pairs(14.0, output_type="ndarray")
    spacing = np.abs(pairs[:, 0] - pairs[:, 1])
    assert (
        np.minimum(spacing, len(places) - spacing).max() < 60
    )  # samples, a metre each: neighbours along the road only


def test_palm_beach_like_has_eleven_corners_and_a_straight_of_six_tenths_of_a_mile():
    course = course_by_name("palm_beach_like")
    # A turn is a stretch to one side; the two compound corners count as two turns, the opening kink
    # after a corner as none.
    straight = np.abs(course.curvature) < 1e-9
    changes = np.flatnonzero(np.diff(straight.astype(int)))
    runs = np.diff(np.concatenate([changes, [changes[0] + len(straight) - 1]]))
    assert runs.max() * course.arc_length[1] == pytest.approx(0.6 * 1609.0, rel=0.05)
    bends = [
        segment
        for segment in LAYOUTS["palm_beach_like"].segments
        if not isinstance(segment, Straight)
    ]
    radii = [
        1.0 / abs(corner.curvature)
        for bend in bends
        for corner in (bend.parts if isinstance(bend, Compound) else (bend,))
    ]
    assert len([radius for radius in radii if radius < 240.0]) == 11
    assert math.degrees(np.abs(course.bank).max()) == pytest.approx(6.0)


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_course_positions_follow_from_their_curvature(name):
    course = course_by_name(name)
    chord = np.hypot(np.diff(course.x), np.diff(course.y))
    np.testing.assert_allclose(chord, course.arc_length[1], rtol=1e-3)
    directions = np.unwrap(np.arctan2(np.diff(course.y), np.diff(course.x)))
    np.testing.assert_allclose(
        directions, 0.5 * (course.heading[1:] + course.heading[:-1]), atol=1e-3
    )
    slope = 0.5 * (course.curvature[1:] + course.curvature[:-1])
    np.testing.assert_allclose(np.diff(course.heading), slope * course.arc_length[1], atol=5e-4)


def test_square_courses_have_the_length_turning_bank_and_heights_of_their_parts():
    corner = Corner(radius=50.0, angle=math.pi / 2.0, transition=10.0)
    square = build_course("square", Layout((Straight(101.0), corner, Straight(100.0), corner) * 2))
    assert gap(square) < 1e-9
    assert square.length == pytest.approx(402.0 + 4.0 * (50.0 * math.pi / 2.0 + 10.0))
    corner = Compound((Corner(40.0, math.pi / 3.0, 12.0), Corner(80.0, math.pi / 6.0, 12.0)))
    square = build_course("square", Layout((Straight(100.0), corner) * 4))
    assert square.turning == pytest.approx(2.0 * math.pi)
    assert np.unique(np.round(1.0 / square.curvature[square.curvature > 1e-3])).tolist()[0] == 40.0
    with pytest.raises(ValueError, match="one side"):
        Compound((Corner(40.0, 1.0, 12.0), Corner(80.0, -1.0, 12.0)))
    banked = Corner(radius=50.0, angle=math.pi / 2.0, transition=10.0, banking=0.05)
    layout = Layout(
        (Straight(100.0), banked) * 4,
        crossfall=0.01,
        heights=((0.0, 0.0), (0.5, 4.0)),
        friction=((0.25, 0.5, 0.6),),
    )
    course = build_course("banked", layout)
    assert course.bank[course.curvature > 0.0199].mean() == pytest.approx(
        0.01 - 0.05, abs=1e-3
    )  # left turns: the right side is higher
    assert course.bank[0] == pytest.approx(0.01)
    first_half = course.arc_length <= 0.5 * course.length
    climbed = -np.trapezoid(np.tan(course.grade[first_half]), course.arc_length[first_half])
    assert climbed == pytest.approx(4.0, abs=0.05)
    assert (course.friction == 0.6).mean() == pytest.approx(0.25, abs=0.01)


def test_courses_styles_and_steps_that_make_no_sense_are_refused():
    with pytest.raises(ConfigurationError, match="90°"):
        build_course("open", Layout((Straight(100.0), Corner(50.0, math.pi / 2.0, 10.0))))
    with pytest.raises(ConfigurationError, match="handling"):
        course_by_name("nordschleife")
    with pytest.raises(ConfigurationError, match="grip fraction"):
        draw_style(0, (1.1, 1.1), 0.05, 0.5)
    with pytest.raises(ConfigurationError, match=r"step of 0\.003 s"):
        trip(0, step=3e-3, duration=1.0)


def test_patches_depend_on_the_seed_and_repeat_every_lap():
    patchy = surface_from_config("patchy")
    places = np.arange(0.0, 5000.0)
    scale = patchy.along(places, 3, 2500.0)
    np.testing.assert_array_equal(scale[:2500], scale[2500:])
    np.testing.assert_array_equal(scale, patchy.along(places, 3, 2500.0))
    assert np.abs(scale - patchy.along(places, 4, 2500.0)).max() > 0.2
    assert 0.5 <= scale.min() < 0.65
    assert 0.85 < scale.max() <= 1.0
    edges = np.flatnonzero(np.diff(scale) != 0.0)
    assert np.diff(edges)[np.diff(edges) > 3].min() >= 15  # patches of 20 m, less their two edges
    surface = surface_from_config({"friction": 0.9, "patches": 0.3, "seed": 7})
    places = np.arange(1000.0)
    np.testing.assert_array_equal(surface.along(places, 1), surface.along(places, 2))


def test_surfaces_and_drives_that_make_no_sense_are_refused():
    patches = {
        "patches": {"patches": 0.9, "friction": 0.5},
        "5 m": {"patches": 0.5, "patch_length": [1.0, 2.0]},
    }
    for complaint, configuration in {
        "icy": "icy",
        "0.05": {"friction": 0.0},
        "mu": {"mu": 0.5},
        **patches,
    }.items():
        with pytest.raises(ConfigurationError, match=complaint):
            surface_from_config(configuration)
    for options in ({"rate_hz": 30.0}, {"rate_hz": 0.0}, {"duration": 0.0}):
        with pytest.raises(ConfigurationError):
            drive(**{"seed": 0, "duration": 1.0, **options})


def test_smoothest_line_agrees_with_a_general_solver():
    generator = np.random.default_rng(0)
    rows = np.diff(np.eye(46)[:, 3:-3], 3, axis=0)
    lower = np.full(40, -np.inf)
    upper = np.full(40, np.inf)
    for place in (5, 12, 20, 31):
        lower[place], upper[place] = np.sort(generator.uniform(-2.0, 2.0, 2))
    reference = lsq_linear(rows, np.zeros(len(rows)), (lower, upper), tol=1e-12).x
    solution = least_within(rows.T @ rows, lower, upper)
    np.testing.assert_allclose(solution, reference, atol=5e-3)  # of bounds two metres wide
    assert np.clip(solution, lower, upper) == pytest.approx(solution, abs=2e-4)


def test_driver_laps_fast_near_the_centre_line_and_without_spin(laps):
    car = car_of(MultiBodyPlant(LOWERED))
    for lap in laps:
        place, distance = places_on(HANDLING, lap.motion.x, lap.motion.y)
        assert distance.max() < 1.5
        assert len(np.unique(place // 6.0)) >= math.floor(
            HANDLING.length / 6.0
        )  # it really goes all the way around
        assert lap.motion.x[0] == pytest.approx(0.0, abs=1.0)
        assert lap.motion.x[-1] == pytest.approx(0.0, abs=1.0)
        assert lap.motion.vx[0] == pytest.approx(lap.motion.vx[-1], abs=3.0)  # a flying start
        motion = lap.motion
        assert 12.0 < motion.vx.min() < 20.0
        assert 40.0 < motion.vx.max() <= car.top_speed + 0.5
        assert 0.75 * car.grip < motion.ay.max() < 1.08 * car.grip
        assert -1.08 * car.grip < motion.ay.min() < -0.75 * car.grip
        assert 1.0 < math.degrees(np.abs(motion.sideslip).max()) < 8.0
        assert lap.flags.completed
        assert not any((lap.flags.spun, lap.flags.left_road, lap.flags.stood))


def test_speed_profile_stays_within_friction_and_power():
    driver = Driver()
    car = car_of(MultiBodyPlant(LOWERED))
    max_grip = np.full_like(HANDLING.curvature, 8.0)
    speed = speed_profile(HANDLING.curvature, max_grip, HANDLING.arc_length[1], car, driver)
    lateral = speed**2 * HANDLING.curvature
    longitudinal = np.diff(speed**2) / (2.0 * HANDLING.arc_length[1])
    # Braking is planned with the air's help at the speed after it.
    air = car.drag * speed[1:] ** 2
    assert np.abs(lateral).max() <= 8.0 + 1e-9
    assert (longitudinal + air).min() >= -driver.braking_share * 8.0 - 1e-9
    assert (longitudinal * speed[:-1]).max() <= car.power_per_mass + 1e-9
    assert speed.max() <= car.top_speed
    assert np.isclose(np.abs(lateral), 8.0).sum() > 5  # and uses all of it in the corners
    curvature = np.full(200, 0.02)
    max_grip = np.full(200, 8.0)
    speed = speed_profile(curvature, max_grip, 1.0, car, driver)[100]
    helped = speed_profile(curvature, max_grip, 1.0, car, driver, bank=np.full(200, -0.1))[
        100
    ]  # a left turn, its inner side lower
    slippery = speed_profile(curvature, 0.5 * max_grip, 1.0, car, driver)[100]
    # A little of the grip goes into keeping the speed against the air.
    assert speed**2 * 0.02 == pytest.approx(8.0, rel=3e-3)
    assert helped**2 * 0.02 == pytest.approx(8.0 + 9.81 * math.sin(0.1), rel=3e-3)
    assert slippery**2 * 0.02 == pytest.approx(4.0, rel=3e-3)


def test_driver_values_of_a_vehicle_are_used_and_a_rollover_names_its_drive():
    vehicle = replace(LOWERED, driver={"grip": 7.0, "top_speed": 30.0, "power_per_mass": 20.0})
    car = car_of(MultiBodyPlant(vehicle))
    assert (car.grip, car.top_speed, car.power_per_mass) == (7.0, 30.0, 20.0)
    for wrong, complaint in (
        ({"grip": -1.0}, "grip"),
        ({"top_speed": 0.0}, "top_speed"),
        ({"gripp": 8.0}, "gripp"),
    ):
        with pytest.raises(ConfigurationError, match=complaint):
            car_of(MultiBodyPlant(replace(LOWERED, driver=wrong)))
    tall = Vehicle("tall", 2, {**LOWERED.overrides, "h_s": 1.4}, driver={"grip": 9.0})
    manoeuvre = manoeuvre_from_config({"name": "j_turn", "speed": 30.0, "severity": 1.5})
    with pytest.raises(
        SimulationError,
        match=r"drive 'high' with seed 0: manoeuvre 'j_turn', \d+\.\d\d s after the first sample: ",
    ) as raised:
        simulate_drive(id="high", vehicle=tall, manoeuvre=manoeuvre, seed=0)
    assert raised.value.exit_code == 3


def test_circuit_lap_keeps_the_bank_and_grade_of_its_place(circuit):
    course = course_by_name("palm_beach_like")
    motion = circuit.motion
    place, _ = places_on(course, motion.x, motion.y)
    # The car is turned against the road by its sideslip and by the line's angle, a few degrees.
    np.testing.assert_allclose(
        motion.bank, np.interp(place, course.arc_length, course.bank), atol=2.5e-3
    )
    np.testing.assert_allclose(
        motion.grade, np.interp(place, course.arc_length, course.grade), atol=1.2e-2
    )
    assert motion.bank.min() < -0.09  # the left turn with six degrees
    assert motion.bank.max() > 0.03  # right turns lean the other way


def test_tyre_forces_gravity_and_air_make_the_acceleration(circuit):
    motion = circuit.motion
    plant = MultiBodyPlant(LOWERED)
    mass = plant.parameters.m
    drag = car_of(plant).drag
    speed = np.hypot(motion.vx, motion.vy)
    along = (
        motion.tyre_fx.sum(axis=1) / mass + 9.81 * np.sin(motion.grade) - drag * speed * motion.vx
    )
    np.testing.assert_allclose(along, motion.ax, atol=1e-6)
    across = (
        motion.tyre_fy.sum(axis=1) / mass - 9.81 * np.sin(motion.bank) - drag * speed * motion.vy
    )
    # Sideways the body moves against its axles, whose forces the tyres give.
    banked = np.abs(motion.bank) > 0.03
    assert banked.sum() > 300
    assert np.abs(across - motion.ay)[banked].mean() < 0.1
    assert (
        np.abs(across + 9.81 * np.sin(motion.bank) - motion.ay)[banked].mean() > 0.25
    )  # and does not without gravity


def test_flat_omits_bank_and_grade_and_drives_do_not_depend_on_the_sampling_rate():
    motion = trip(1, course="palm_beach_like", duration=2.0, flat=True).motion
    assert not motion.bank.any()
    assert not motion.grade.any()
    coarse, fine = (
        drive(seed=0, duration=8.0, rate_hz=rate, sensors=PRESETS["ideal"])
        for rate in (20.0, 100.0)
    )
    for name in coarse.channels:
        np.testing.assert_array_equal(coarse[name], fine[name][::5])


def test_wet_road_lowers_the_accelerations_and_patches_are_in_the_motion():
    dry, wet, patchy = (trip(3, surface=name, duration=40.0) for name in ("dry", "wet", "patchy"))
    assert np.abs(wet.motion.ay).max() < 0.8 * np.abs(dry.motion.ay).max()
    assert wet.motion.friction.min() == wet.motion.friction.max() == 0.7
    assert not any((wet.flags.spun, wet.flags.left_road, patchy.flags.spun, patchy.flags.left_road))
    place, _ = places_on(HANDLING, patchy.motion.x, patchy.motion.y)
    expected = surface_from_config("patchy").along(HANDLING.arc_length, 3, HANDLING.length)
    difference = np.abs(patchy.motion.friction - np.interp(place, HANDLING.arc_length, expected))
    assert np.quantile(difference, 0.9) < 1e-9  # but at the edges of a patch
    assert np.ptp(patchy.motion.friction) > 0.3


def test_recording_says_where_it_comes_from():
    recording = drive(seed=1)
    assert recording.kind == "simulated"
    assert recording.vehicle == "bmw_320i_low"
    assert (len(recording), recording.rate_hz) == (1200, 100.0)
    provenance = json.loads(json.dumps(recording.provenance))
    assert provenance == recording.provenance
    assert provenance["manoeuvre"]["name"] == "laps"
    assert manoeuvre_from_config(provenance["manoeuvre"]) == manoeuvre_from_config(
        {"name": "laps", "course": "handling", "duration": 12.0}
    )
    assert provenance["seed"] == 1
    assert provenance["surface"]["name"] == "dry"
    assert provenance["stability_control"] is False
    assert provenance["overrides"]["h_s"] == 0.45
    assert provenance["library"].startswith("commonroad-vehicle-models ")
    flags = provenance["flags"]
    assert (flags["spun"], flags["left_road"], flags["completed"]) == (False, False, True)
    assert 0.0 < flags["largest_lateral_error"] < 1.5
    assert 0.0 < flags["largest_sideslip"] < 0.2
