"""What makes simulated cars differ as real ones do: tyres that lag and wear, payloads,
installations, drivers who correct, traffic.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from cars import inputs_of, plant_of, rolling
from scipy.integrate import solve_ivp
from scipy.signal import welch
from test_simulation_sensors import motion_of, only

from vehest.configuration.composition import compose_config
from vehest.constants import GRAVITY
from vehest.data.errors import ConfigurationError
from vehest.simulation.drive import drive
from vehest.simulation.driving.driver import HIGHEST_CORRECTION, LOWEST_CORRECTION, Hands
from vehest.simulation.driving.laps import Laps
from vehest.simulation.fleet import SensorVariation, variations_from_config
from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import loaded
from vehest.simulation.plant.wear import Stint
from vehest.simulation.sensors.levels import SensorLevel, SensorLevels, Tilt
from vehest.simulation.sensors.recording import measure
from vehest.sources.base import open_source

LENGTHS = (0.4, 0.9)  # m, front and rear


def _lagging(lengths=LENGTHS):
    return MultiBodyPlant(replace(plant_of("ferrari_250_lm").vehicle, relaxation=lengths))


def test_lateral_forces_follow_the_slip_over_the_relaxation_length():
    """Against scipy's integration of dq/dt = u/length (asked - q), the force over load, with what a
    plant without lag asks for there.
    """
    plant = _lagging()
    plain = _lagging((0.0, 0.0))
    states = [rolling(plant, 25.0)]
    for k in range(1500):  # of a swerve
        steering = 0.25 * math.cos(2.0 * math.pi * 1.5 * k / 1000.0)
        states.append(plant.advance(states[-1], inputs_of(steering), 1))
    inputs = np.zeros((len(states), 5))
    _, forces = plain.evaluate(states, inputs)
    steer = np.array([state.steer for state in states])
    demanded = (
        forces[:, 1] * np.cos(steer[:, None] * np.array([1, 1, 0, 0]))
        - forces[:, 0] * np.sin(steer[:, None] * np.array([1, 1, 0, 0]))
    ) / forces[:, 2]
    demanded = demanded[:, [1, 0, 3, 2]]  # motion.WHEELS in the library's order
    times = np.arange(len(states)) / 1000.0
    speed = np.array([state.vx for state in states])
    for wheel in (0, 3):
        length = LENGTHS[wheel // 2]

        def rate(t, q, wheel=wheel, length=length):
            return (
                np.interp(t, times, speed) / length * (np.interp(t, times, demanded[:, wheel]) - q)
            )

        relaxed = solve_ivp(
            rate, (0.0, times[-1]), [0.0], t_eval=times, max_step=2e-3, rtol=1e-8, atol=1e-10
        ).y[0]
        ours = np.array([state.lateral_ratio[wheel] for state in states])
        assert np.abs(relaxed).max() > 0.2
        np.testing.assert_allclose(ours, relaxed, atol=0.01 * np.abs(relaxed).max())


def test_short_relaxation_lengths_converge_to_none_and_negative_ones_are_refused():
    def off(step):
        ends = []
        for length in (1e-4, 0.0):
            plant = MultiBodyPlant(
                replace(plant_of("ferrari_250_lm").vehicle, relaxation=(length, length)), step
            )
            state = rolling(plant, 25.0)
            per_ms = round(1e-3 / step)
            for k in range(800):
                steering = 0.25 * math.cos(2.0 * math.pi * 1.5 * k / 1000.0)
                state = plant.advance(state, inputs_of(steering), per_ms)
            ends.append(state.vy)
        return abs(ends[0] / ends[1] - 1.0)

    assert off(1e-3) < 5e-3
    assert off(2.5e-4) < 0.4 * off(1e-3)  # first order in the step
    with pytest.raises(
        ConfigurationError, match=r"relaxation rear must be zero or positive, not -0\.1 m"
    ):
        _lagging((0.1, -0.1))


def test_a_payload_moves_the_static_loads_as_levers_say_and_stays_on_the_axles():
    empty = plant_of("corvette_grand_sport")
    full = MultiBodyPlant(loaded(empty.vehicle, 80.0, forward=-0.6, up=0.1))
    loads = []
    for plant in (empty, full):
        state = rolling(plant, 0.0)
        loads.append(plant.evaluate([state], np.zeros((1, 5)))[1][0, 2])
    more = loads[1] - loads[0]
    a = empty.parameters.a
    b = empty.parameters.b
    assert more.sum() == pytest.approx(80.0 * GRAVITY, rel=2e-3)
    assert more[:2].sum() == pytest.approx(80.0 * GRAVITY * (b - 0.6) / (a + b), rel=0.02)
    assert full.parameters.I_z - empty.parameters.I_z == pytest.approx(
        80.0 * 0.6**2 * empty.parameters.m / full.parameters.m
    )
    with pytest.raises(ConfigurationError, match="puts the centre of gravity off the axles"):
        loaded(plant_of("corvette_grand_sport").vehicle, 5000.0, forward=-3.0, up=0.0)


def test_tyres_warm_up_and_wear_which_the_plant_feels_and_the_driver_does_not_know():
    stint = Stint(cold=0.1, warm_time=100.0, wear=0.04, wear_time=1000.0)
    assert stint.friction_at(-2.0) == stint.friction_at(0.0) == pytest.approx(0.9)
    assert stint.friction_at(100.0) == pytest.approx((1.0 - 0.1 / math.e) * (1.0 - 0.004))
    assert stint.friction_at(5000.0) == pytest.approx(0.96, abs=1e-9)
    laps = Laps(course="palm_beach_like", duration=5.0, severity=0.8)
    plant = plant_of("ferrari_250_lm")
    plain = drive(plant, laps, 3)
    cold = drive(plant, laps, 3, stint=Stint(cold=0.1))
    np.testing.assert_allclose(cold.motion.friction[0] / plain.motion.friction[0], 0.9, rtol=1e-9)
    assert cold.drawn == plain.drawn


def test_corrections_have_their_size_and_their_band():
    hands = Hands(0.8, np.random.default_rng(0))
    times = np.arange(0.0, 400.0, 0.01)
    corrections = np.array([hands.at(time, 1.0) for time in times])
    assert np.sqrt(np.mean(corrections**2)) == pytest.approx(0.8, rel=0.05)
    frequency, density = welch(corrections, 100.0, nperseg=4000)
    inside = (frequency > 0.9 * LOWEST_CORRECTION) & (frequency < 1.1 * HIGHEST_CORRECTION)
    assert density[inside].sum() > 0.98 * density.sum()
    assert hands.at(1.0, 0.0) == pytest.approx(hands.at(1.0, 1.0) / 3.0)


def test_installations_have_a_gain_a_bias_and_a_speed_of_wheels():
    motion = motion_of(50, ay=3.0)
    levels = only(ay=SensorLevel(gain=0.02, bias=-0.1))
    for seed in (1, 2):
        np.testing.assert_allclose(measure(motion, levels, seed)["ay"], 3.0 * 1.02 - 0.1)
    steer = np.concatenate([np.zeros(80), np.full(20, 0.1)])
    wheels = np.full((100, 4), 30.0 / 0.32)
    wheels[90:] *= 0.8  # locking
    channels = measure(
        motion_of(100, vx=30.0, steer=steer, wheel_speed=wheels), only(speed_of_wheels=True), 0
    )["vx"]
    np.testing.assert_allclose(channels[:80], 30.0)
    np.testing.assert_allclose(channels[90:], 24.0)


@pytest.mark.parametrize("share", [1.0, 0.4, -0.5])
def test_roll_leaks_by_its_share_and_sign(share):
    motion = motion_of(10, roll=0.03)
    ay = measure(motion, only(tilt=Tilt(roll_share=share)), 0)["ay"]
    np.testing.assert_allclose(ay, GRAVITY * math.sin(0.03 * share), rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"payload": {"weight": 3.0}}, "payload.mass is missing"),
        ({"tyres": {"cold": 0.9}}, "tyres.cold: input should be less than or equal to 0.5"),
        ({"sensors": "racing"}, "sensors 'racing' is not one of"),
    ],
)
def test_settings_of_a_drive_are_checked_before_the_simulation(change, message):
    dataset = compose_config("ingest", ["dataset=sim_race_cars"])["dataset"]
    dataset["drives"] = [{**dict(dataset["drives"][0]), **change}]
    with pytest.raises(ConfigurationError, match=message):
        open_source(dataset)


def test_variations_of_parameters_and_sensors_are_drawn_over_their_ranges():
    variation = variations_from_config([{"parameters": ["m"], "factor": [0.5, 2.0], "log": True}])[
        0
    ]
    drawn = [variation.drawn(np.random.default_rng(seed)) for seed in range(2000)]
    assert np.mean(np.array(drawn) < 1.0) == pytest.approx(0.5, abs=0.04)
    assert 0.5 <= min(drawn) < 0.52
    assert 1.95 < max(drawn) <= 2.0
    variation = SensorVariation.from_config({"roll_share": [-0.5, 1.5]})
    shares = [variation.applied(SensorLevels(), seed).tilt.roll_share for seed in range(200)]
    assert min(shares) < -0.3
    assert max(shares) > 1.3
    with pytest.raises(ConfigurationError, match="or roll_share to ranges"):
        SensorVariation.from_config({"pitch_share": [0, 1]})
