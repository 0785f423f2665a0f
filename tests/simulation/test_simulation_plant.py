"""The plant: library's equations, what was added to them, and that it holds from standstill to a
spin.
"""

import fcntl
import math
from dataclasses import fields
from functools import cache
from threading import Event, Thread
from types import FunctionType

import numpy as np
import pytest
from cars import ALL, inputs_of, rolling, shipped
from numba.core.dispatcher import Dispatcher
from scipy.integrate import solve_ivp
from vehiclemodels.init_mb import init_mb
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

from vehest.constants import GRAVITY
from vehest.simulation.errors import SimulationError
from vehest.simulation.plant import compiled
from vehest.simulation.plant.equations import SMALLEST_WHEEL_VELOCITY, multi_body
from vehest.simulation.plant.handling import ramp_steer
from vehest.simulation.plant.motion import Motion
from vehest.simulation.plant.multi_body import MultiBodyPlant, PlantState, road_gravity
from vehest.simulation.plant.parameters import (
    PUBLISHED_SETS,
    Vehicle,
    compiled_parameters,
    library_parameters,
    rear_tyre,
)
from vehest.simulation.plant.regimes import FIRST_WHEEL, ROLL, VX, VY, YAW_RATE, Regime

AS_PUBLISHED = Vehicle("bmw_320i", parameter_set=2)
LOWERED = shipped("bmw_320i_low")
FERRARI = shipped("ferrari_250_lm")
CORVETTE = shipped("corvette_grand_sport")
TRUCK = shipped("heavy_truck")

# CommonRoad's own test of the multi-body equations (vehiclemodels/unit_tests/test_derivatives.py):
# BMW 320i, state, derivatives.
PUBLISHED_INPUTS = (0.15, 0.63 * GRAVITY)
PUBLISHED_STATE = [
    *(
        10.8808433066274794,
        0.5371850187869442,
        0.0980442671005920,
        18.0711398687457745,
        0.1649995631003776,
        0.6158755000936103,
    ),
    *(
        -0.1198403612262477,
        -0.2762672756169581,
        0.0131909920269115,
        -0.0718483683742141,
        -0.3428324595054725,
        0.0103233373083297,
    ),
    *(
        -0.0399590564140291,
        -0.0246468320579360,
        -0.0551575051990853,
        0.5798277643297529,
        0.0172059354801703,
        0.0067890113155477,
    ),
    *(
        -0.0184269459410162,
        -0.0408207136116175,
        -1.0064484829203018,
        0.0166808347900582,
        -0.0049188492004049,
        53.6551710641082451,
    ),
    *(
        50.7045242506744316,
        56.7917911784219598,
        200.7079633169796296,
        -0.0939969123691911,
        -0.0881514621614376,
    ),
]
PUBLISHED_DERIVATIVES = [
    *(
        17.8820162482414098,
        2.6300428035858809,
        0.1500000000000000,
        2.7009396644636450,
        0.6158755000936103,
        1.3132879472301846,
    ),
    *(
        -0.2762672756169581,
        -0.1360581472638375,
        -0.0718483683742141,
        0.4909514227532223,
        -2.6454134031927374,
        -0.0399590564140291,
    ),
    *(
        0.0486778649724968,
        -0.0551575051990853,
        0.0354501802049087,
        -1.1130397141873534,
        0.0067890113155477,
        -0.0886810139593130,
    ),
    *(
        -0.0408207136116175,
        0.0427680029698811,
        -4.3436374104751501,
        -0.0049188492004049,
        0.1142109377736169,
        10.0527321757776047,
    ),
    *(
        0.0436512393438736,
        -154.12795711273924,
        422.12780928288305,
        -0.2105876149500405,
        -0.2126005780977984,
    ),
]


class TwoTyres:
    """Parameters of the library whose ``tire`` is the front one for two calls, then the rear one
    for two, and so on.
    """

    def __init__(self, vehicle):
        self.values = library_parameters(vehicle)
        self.evaluations = 0
        self.tyres = (self.values.tire, rear_tyre(vehicle))

    def __getattr__(self, name):
        if name == "tire":
            self.evaluations += 1
            return self.tyres[(self.evaluations - 1) % 4 // 2]
        return getattr(self.values, name)


def in_python(function):
    """A compiled function as plain Python, with all it calls: Python's sines are those of the
    library.
    """
    plain = function.py_func
    functions = {
        name: plain.__globals__[name]
        for name in plain.__code__.co_names
        if name in plain.__globals__
    }
    return FunctionType(
        plain.__code__,
        {
            name: in_python(value) if isinstance(value, Dispatcher) else value
            for name, value in functions.items()
        },
    )


@cache
def equations_in_python():
    return in_python(multi_body)


def derivatives_of(x, inputs, vehicle):
    derivatives = [math.nan] * 29
    contact = (int(Regime.ROLLING), np.zeros(5), 1.0, 1.0, False, np.zeros(8))
    equations_in_python()(list(x), *inputs, contact, compiled_parameters(vehicle), derivatives)
    return derivatives


def disturbed(plant, generator, speed=25.0):
    values = plant.initial_state(1.0, 2.0, 0.3, speed).values
    return values + 0.02 * generator.standard_normal(29) * np.maximum(np.abs(values), 0.1)


def drive(plant, state, command, seconds, rate_hz=100.0, friction=1.0):
    """What follows from inputs command(time, state), held between samples."""
    states = []
    inputs = []
    n_steps = round(1.0 / (rate_hz * plant.step))
    for k in range(round(seconds * rate_hz)):
        now = np.asarray(command(k / rate_hz, state), dtype=float)
        states.append(state)
        inputs.append(now)
        state = plant.advance(state, now, n_steps, friction)
    return plant.motion(states, np.array(inputs), rate_hz, friction=friction), states


def lane_change(time, state):
    target = 0.06 * math.sin(2.0 * math.pi * 0.5 * time) if time < 2.0 else 0.0
    return inputs_of(20.0 * (target - state.steer), 1.0 if time < 2.0 else -6.0)


def spins(time, state):
    """A sine with dwell in the steering, too large for the speed, then the brakes."""
    phase = min(time, max(time - 0.5, 0.75 / 0.7)) * 0.7
    target = 0.2 * math.sin(2.0 * math.pi * phase) if phase < 1.0 else 0.0
    return inputs_of(50.0 * (target - state.steer), -4.0 if time > 2.0 else 0.0)


@pytest.fixture(scope="module")
def spin():
    plant = MultiBodyPlant(CORVETTE)
    return drive(plant, rolling(plant, 40.0), spins, 12.0)


def test_published_derivatives_are_reproduced():
    computed = derivatives_of(PUBLISHED_STATE, list(PUBLISHED_INPUTS), AS_PUBLISHED)
    np.testing.assert_allclose(
        computed, PUBLISHED_DERIVATIVES, rtol=0.0, atol=5e-8
    )  # as the library's own test: seven places
    inputs = inputs_of(*PUBLISHED_INPUTS)
    state = PlantState(np.array(PUBLISHED_STATE), Regime.ROLLING)
    derivatives, _ = MultiBodyPlant(AS_PUBLISHED).evaluate([state], inputs[None])
    compared = np.setdiff1d(
        np.arange(29), [25, 26]
    )  # one driven wheel spins at 200 rad/s: the plant's engine has no such power
    np.testing.assert_allclose(
        derivatives[0, compared], np.array(PUBLISHED_DERIVATIVES)[compared], rtol=0.0, atol=5e-8
    )


@pytest.mark.parametrize("vehicle", [LOWERED, FERRARI, TRUCK], ids=lambda vehicle: vehicle.name)
def test_equations_are_the_librarys_bit_by_bit(vehicle):
    plant = MultiBodyPlant(vehicle)
    generator = np.random.default_rng(0)
    parameters = TwoTyres(vehicle)
    assert (
        rolling(plant, 0.0).values[[16, 21]].tolist()
        == np.array(init_mb([0.0] * 7, parameters))[[16, 21]].tolist()
    )
    for _ in range(200):
        state = disturbed(plant, generator, generator.uniform(0.7, 60.0))
        inputs = generator.uniform([-0.5, -15.0], [0.5, 15.0])
        state[FIRST_WHEEL] *= generator.uniform(-0.1, 1.0)
        expected = vehicle_dynamics_mb(state.tolist(), inputs.tolist(), parameters)
        assert derivatives_of(state.tolist(), inputs.tolist(), vehicle) == expected


@pytest.mark.parametrize("vehicle", [LOWERED, FERRARI, TRUCK], ids=lambda vehicle: vehicle.name)
def test_compiled_derivatives_are_the_librarys_to_1e_12(vehicle):
    plant = MultiBodyPlant(vehicle)
    generator = np.random.default_rng(1)
    parameters = TwoTyres(vehicle)
    for _ in range(20):
        state = disturbed(plant, generator)
        inputs = generator.uniform([-0.3, -8.0], [0.3, 0.5])
        expected = np.array(vehicle_dynamics_mb(state.tolist(), inputs.tolist(), parameters))
        derivatives, _ = plant.evaluate(
            [PlantState(state, Regime.ROLLING)], inputs_of(*inputs)[None]
        )
        np.testing.assert_allclose(
            derivatives[0], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max()
        )


def test_slip_is_the_librarys_down_to_the_smallest_wheel_velocity_and_finite_below():
    plant = MultiBodyPlant(LOWERED)
    for speed in (1.02 * SMALLEST_WHEEL_VELOCITY, 2.0 * SMALLEST_WHEEL_VELOCITY):
        state = rolling(plant, speed).values
        state[FIRST_WHEEL] *= 0.98
        expected = vehicle_dynamics_mb(state.tolist(), [0.0, 0.0], library_parameters(LOWERED))
        assert derivatives_of(state.tolist(), [0.0, 0.0], LOWERED) == expected
    at_limit = []
    for speed in (0.999999 * SMALLEST_WHEEL_VELOCITY, 1.000001 * SMALLEST_WHEEL_VELOCITY):
        state = rolling(plant, speed).values
        state[[FIRST_WHEEL, VY, YAW_RATE]] += 0.01, 0.02, 0.02
        at_limit.append(derivatives_of(state.tolist(), [0.0, 0.0], LOWERED))
    np.testing.assert_allclose(
        at_limit[0], at_limit[1], rtol=1e-3, atol=1e-3
    )  # no step at the limit
    creeping = rolling(plant, 1e-6).values
    assert np.isfinite(derivatives_of(creeping.tolist(), [0.0, 0.0], LOWERED)).all()


def test_fixed_step_agrees_with_solve_ivp():
    plant = MultiBodyPlant(LOWERED)
    inputs = inputs_of(0.04, -2.0)
    parameters = library_parameters(LOWERED)
    start = rolling(plant, 30.0)

    def right_hand_side(_, state):
        return vehicle_dynamics_mb(state.tolist(), inputs[:2].tolist(), parameters)

    reference = solve_ivp(
        right_hand_side, (0.0, 1.0), start.values, method="DOP853", rtol=1e-8, atol=1e-9
    ).y[:, -1]
    state = plant.advance(start, inputs, 1000)
    np.testing.assert_allclose(state.values, reference, rtol=1e-4, atol=1e-4)
    assert abs(state.yaw_rate * state.vx) > 6.0  # the manoeuvre is not a harmless one


def turn_left(speed, steer, seconds, vehicle=LOWERED):
    plant = MultiBodyPlant(vehicle)

    def hold(time, state):
        return inputs_of(
            np.clip(10.0 * (steer - state.steer), -0.02, 0.02), 3.0 * (speed - state.vx) + 0.8
        )

    return drive(plant, rolling(plant, speed), hold, seconds)[0]


def test_left_turn_and_braking_have_the_signs_of_iso_8855():
    turn = turn_left(speed=20.0, steer=0.04, seconds=5.0)
    for name in ("steer", "yaw_rate", "ay", "yaw", "y"):
        assert getattr(turn, name)[-1] > 0, name
    assert turn.roll[-1] > 0.01  # leans outwards, the left side up
    front_left, front_right, rear_left, rear_right = turn.wheel_speed[-1]
    assert front_right > front_left + 1.0  # the outer wheels run further
    assert rear_right > rear_left + 0.5
    assert (turn.tyre_fz[-1, [1, 3]] > turn.tyre_fz[-1, [0, 2]] + 500.0).all()  # and carry more
    assert (turn.tyre_fy[-1] > 0).all()
    plant = MultiBodyPlant(LOWERED)
    motion, _ = drive(
        plant,
        rolling(plant, 30.0),
        lambda time, state: inputs_of(acceleration=-5.0),
        1.0,
    )
    assert motion.pitch[-1] > 0.005
    assert motion.ax[-1] == pytest.approx(-5.0, abs=0.5)
    assert motion.pitch[0] == 0.0
    assert (motion.tyre_fx[-1] < -500.0).all()
    np.testing.assert_allclose(
        np.gradient(motion.pitch, 0.01)[5:-1], motion.pitch_rate[5:-1], atol=2e-3
    )


def velocities_and_rates(motion):
    """Both velocities with their derivatives by the kinematics of the plane."""
    return (
        (motion.vy, motion.ay - motion.vx * motion.yaw_rate),
        (motion.vx, motion.ax + motion.vy * motion.yaw_rate),
    )


def test_accelerations_are_consistent_with_velocities_in_every_regime(spin):
    plant = MultiBodyPlant(FERRARI)
    motion, states = drive(plant, rolling(plant, 14.0), lane_change, 5.5, rate_hz=1000.0)
    assert {state.regime for state in states} == {Regime.ROLLING, Regime.SLOW}
    assert motion.vx[-1] == 0.0
    for velocity, rate in velocities_and_rates(motion):
        error = np.abs((velocity[2:] - velocity[:-2]) / 2e-3 - rate[1:-1])
        assert np.median(error) < 1e-5
        # Inputs that jump (brakes at 2 s) and the stop itself leave a few samples with half a jump.
        assert np.sum(error > 0.05) <= 8
        assert np.sort(error)[-20] < 0.01
    motion, states = spin
    sliding = np.array([state.regime == Regime.SLIDING for state in states])
    inside = np.flatnonzero(sliding[:-2] & sliding[2:])
    for velocity, rate in velocities_and_rates(motion):
        error = np.abs((velocity[inside + 2] - velocity[inside]) / 0.02 - rate[inside + 1])
        assert np.median(error) < 0.02  # the sampling is ten times coarser here


@pytest.mark.parametrize("moment", [0.0, 900.0, -900.0])
def test_tyre_forces_account_for_all_accelerations(moment):
    # Masses times accelerations by differences of velocities of the body and of both axles, against
    # the sum of forces.
    plant = MultiBodyPlant(FERRARI)
    slope = road_gravity(bank=0.05, grade=0.03)
    p = plant.parameters
    rate_hz = 1000.0

    def command(time, state):
        return inputs_of(20.0 * (0.05 * math.sin(3.0 * time) - state.steer), -1.0, moment, *slope)

    motion, states = drive(plant, rolling(plant, 30.0), command, 2.0, rate_hz)
    values = np.array([state.values for state in states])
    change = ((values[2:] - values[:-2]) / (2.0 / rate_hz))[
        100:
    ]  # brakes and moment come on within the first 100 ms
    vx, vy, yaw_rate = (values[101:-1, place] for place in (VX, VY, YAW_RATE))
    forces = [force[101:-1] for force in (motion.tyre_fx, motion.tyre_fy)]
    ax = change[:, VX] - vy * yaw_rate - slope[0]
    np.testing.assert_allclose(
        forces[0].sum(axis=1), p.m * ax, atol=0.5
    )  # of 2,000 N: what differences over 2 ms leave
    lateral = sum(
        mass * (change[:, place] + vx * yaw_rate - slope[1])
        for mass, place in ((p.m_s, VY), (p.m_uf, 15), (p.m_ur, 20))
    )
    # N, of 10,000: joints lean with the body, by the cosine of the roll angle and its second order
    joint = 8.0
    np.testing.assert_allclose(forces[1].sum(axis=1), lateral, atol=joint)
    arm_x = np.array([p.a, p.a, -p.b, -p.b])
    arm_y = 0.5 * np.array([p.T_f, -p.T_f, p.T_r, -p.T_r])
    turning = (forces[1] * arm_x).sum(axis=1) - (forces[0] * arm_y).sum(axis=1)
    np.testing.assert_allclose(turning, p.I_z * change[:, YAW_RATE], atol=1.0)
    assert np.abs(motion.ay).max() > 8.0


def test_yaw_moment_turns_left_and_is_limited_by_the_brakes_of_a_side():
    plant = MultiBodyPlant(FERRARI)
    p = plant.parameters
    state = rolling(plant, 30.0)
    inputs = np.array([inputs_of(moment=moment) for moment in (0.0, 900.0, 1e6)])
    without, with_moment, too_much = plant.motion([state] * 3, inputs, 100.0).ax
    arm = 0.25 * (p.T_f + p.T_r)
    assert with_moment - without == pytest.approx(-900.0 / arm / p.m, rel=1e-9)
    assert too_much == pytest.approx(
        -0.5 * GRAVITY * 1.27, rel=0.03
    )  # half of the weight times the friction of 1.24 and 1.30
    after = plant.advance(state, inputs_of(moment=900.0), 10)
    assert after.yaw_rate == pytest.approx(
        900.0 / p.I_z * 0.01, rel=0.05
    )  # the tyres already resist


def test_bank_pulls_all_masses_equally_and_half_friction_halves_grip():
    # Hardly any friction: the car slips sideways as a whole, and its joints are not strained.
    plant = MultiBodyPlant(FERRARI)
    across = road_gravity(bank=0.1, grade=0.0)[1]
    assert across == pytest.approx(-GRAVITY * math.sin(0.1))  # the left side is higher
    motion, states = drive(
        plant,
        rolling(plant, 20.0),
        lambda t, s: inputs_of(across=across),
        1.0,
        friction=1e-3,
    )
    assert motion.vy[-1] == pytest.approx(across * 0.99, rel=0.02)
    assert (
        np.abs([state.values[27:29] for state in states]).max() < 1e-4
    )  # 1e-2 with the body pulled alone
    plant = MultiBodyPlant(CORVETTE)
    dry, wet = (ramp_steer(plant, 25.0, friction=friction).ay.max() for friction in (1.0, 0.5))
    assert wet / dry == pytest.approx(0.5, rel=0.08)  # above: smaller slip angles cost less drag


def test_cars_stand_in_equilibrium_and_on_a_slope_stop_and_drive_off():
    for vehicle in (FERRARI, TRUCK, LOWERED):
        plant = MultiBodyPlant(vehicle)
        for speed in (0.0, 0.5, 30.0):
            start = plant.initial_state(3.0, 4.0, 0.0, speed)
            after = plant.advance(start, inputs_of(), 2000)
            moved = after.values - start.values
            assert moved[0] == pytest.approx(2.0 * speed, abs=2e-3)
            if (
                vehicle is not LOWERED or speed == 0.0
            ):  # whose published tyres pull to one side when they roll
                assert np.abs(moved[1:]).max() < 1e-9
    plant = MultiBodyPlant(FERRARI)
    along = road_gravity(bank=0.0, grade=0.1)[0]
    assert along > 0.0  # downhill
    state = rolling(plant, 0.0)
    stopped = plant.advance(state, inputs_of(acceleration=-2.0, along=along), 1000)
    assert stopped.is_standing
    rolls = plant.advance(state, inputs_of(along=along), 1000)
    assert rolls.vx == pytest.approx(along, rel=0.1)
    motion = plant.motion(
        [stopped], inputs_of(acceleration=-2.0, along=along)[None], 100.0, grade=0.1
    )
    assert motion.tyre_fx[0].sum() == pytest.approx(-plant.parameters.m * along)
    assert motion.grade[0] == 0.1
    plant = MultiBodyPlant(TRUCK)
    motion, states = drive(
        plant,
        rolling(plant, 12.5),
        lambda time, state: inputs_of(acceleration=-2.54 if time < 7.0 else 1.5),
        12.0,
    )
    is_standing = np.array([state.is_standing for state in states])
    assert np.flatnonzero(is_standing)[0] == pytest.approx(500, abs=15)
    assert is_standing[520:700].all()
    assert not motion.ax[520:700].any()
    assert not motion.wheel_speed[600:700].any()
    assert np.abs(motion.pitch[600:700]).max() < 1e-3  # the last nod is over
    assert motion.vx[-1] == pytest.approx(
        1.5 * 5.0, rel=0.06
    )  # wheels take part of the force to turn faster
    assert not states[-1].spun


def test_regimes_join_without_jumps_that_matter():
    plant = MultiBodyPlant(CORVETTE)

    def stop_and_go(time, state):
        return inputs_of(10.0 * (0.15 * math.sin(time) - state.steer), -2.5 if time < 3.0 else 2.0)

    motion, states = drive(plant, rolling(plant, 5.0), stop_and_go, 6.0, rate_hz=1000.0)
    regimes = np.array([state.regime for state in states])
    joins = np.flatnonzero(np.diff(regimes)) + 1
    assert regimes[joins].tolist() == [Regime.SLOW, Regime.ROLLING]
    for k in joins:
        assert abs(motion.ax[k] - motion.ax[k - 1]) < 0.1
        assert abs(motion.ay[k] - motion.ay[k - 1]) < 0.02
        for name, largest in (
            ("vx", 3e-3),
            ("vy", 5e-4),
            ("yaw_rate", 5e-4),
            ("roll", 1e-4),
            ("pitch", 1e-4),
        ):  # a step's change
            assert abs(getattr(motion, name)[k] - getattr(motion, name)[k - 1]) < largest, name
        assert np.abs(motion.tyre_fz[k] - motion.tyre_fz[k - 1]).max() < 10.0
    slow = np.flatnonzero((regimes == Regime.SLOW) & (motion.vx > 0.3))
    path = motion.yaw_rate[slow] - motion.vx[slow] * np.tan(motion.steer[slow]) / plant.wheelbase
    assert np.abs(path).max() < 0.01  # follows its front wheels


def test_spin_is_survived_and_ends_at_standstill(spin):
    motion, states = spin
    assert states[-1].spun
    assert not states[0].spun
    assert states[-1].is_standing
    assert math.degrees(np.abs(motion.sideslip[motion.vx**2 + motion.vy**2 > 1.0]).max()) > 60.0
    for name in (
        field.name
        for field in fields(Motion)
        if field.name != "rate_hz" and not field.name.startswith("motor_")
    ):
        assert np.isfinite(getattr(motion, name)).all(), name
    p = MultiBodyPlant(CORVETTE).parameters
    energy = 0.5 * p.m * (motion.vx**2 + motion.vy**2) + 0.5 * p.I_z * motion.yaw_rate**2
    sliding = np.flatnonzero([state.regime == Regime.SLIDING for state in states])
    assert len(sliding) > 50
    assert (np.diff(energy[sliding]) < 0.0).all()
    slowing = np.hypot(motion.ax, motion.ay)[sliding[10:-10]]
    assert slowing.max() < 1.1 * 1.42 * GRAVITY  # the rear tyres' friction; loads vary
    assert slowing.mean() > 0.6 * GRAVITY
    end = states[-1]
    away = MultiBodyPlant(CORVETTE).advance(end, inputs_of(acceleration=2.0), 3000)
    assert away.vx > 4.0
    assert away.spun  # it has been in a spin, whatever it does now


def test_rollovers_and_non_finite_states_are_errors():
    with pytest.raises(SimulationError, match="rolled over") as raised:
        turn_left(speed=45.0, steer=0.0275, seconds=15.0, vehicle=AS_PUBLISHED)
    assert raised.value.exit_code == 3
    plant = MultiBodyPlant(LOWERED)
    state = rolling(plant, 20.0)
    state.values[VY] = np.nan
    with pytest.raises(SimulationError):
        plant.advance(state, inputs_of(), 1)


def test_lifted_wheel_carries_nothing_and_does_not_outrun_the_engine():
    plant = MultiBodyPlant(CORVETTE)
    p = plant.parameters
    motion, _ = drive(
        plant,
        rolling(plant, 20.0),
        lambda t, s: inputs_of(0.3 if t < 0.3 else 0.0, 7.0),
        3.0,
    )
    assert motion.tyre_fz.min() >= 1.0
    driven = motion.wheel_speed[:, 2:].mean(axis=1) * p.R_w
    assert driven.max() > 1.2 * motion.vx.max()  # they do spin
    assert driven.max() < 1.2 * p.longitudinal.v_max


ALL_VEHICLES = [*(shipped(name) for name in ALL), *(Vehicle(f"set {n}", n) for n in PUBLISHED_SETS)]


@pytest.mark.parametrize("vehicle", ALL_VEHICLES, ids=lambda vehicle: vehicle.name)
def test_no_state_becomes_infinite_between_standstill_and_70_m_per_s(vehicle):
    plant = MultiBodyPlant(vehicle)
    for speed in (0.0, 0.05, 0.9, 1.0, 1.1, 1.3, 2.0, 5.0, 15.0, 40.0, 70.0):
        for acceleration in (-20.0, 0.0, 5.0):
            for steering, friction in ((0.0, 1.0), (0.3, 0.3)):
                state = rolling(plant, speed)
                state = plant.advance(
                    state, inputs_of(steering, acceleration, 500.0), 600, friction
                )
                assert np.isfinite(state.values).all()
                assert abs(state.values[ROLL]) < (
                    0.3 if vehicle.name.startswith("set") else 0.2
                )  # the published springs are soft


def test_first_call_waits_for_another_process_that_compiles(monkeypatch):
    function = compiled.CachedFunction(compiled.advance.dispatcher.py_func)
    called = Event()
    assert function.lock is not None
    monkeypatch.setattr(function, "dispatcher", called.set)
    first = Thread(target=function)
    with function.lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        first.start()
        assert not called.wait(0.3)
    assert called.wait(10.0)
    first.join()
    with function.lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        function()  # later calls do not


def test_no_kind_of_array_is_compiled_for_twice():
    plant = MultiBodyPlant(FERRARI)
    state = rolling(MultiBodyPlant(FERRARI), 20.0)
    read_only = np.broadcast_to(inputs_of(), (3, 5))
    columns = np.zeros((3, 10), order="F")[:, ::2]
    for inputs in (read_only, columns, columns.tolist()):
        for friction in (1.0, [1, 1, 1], np.broadcast_to(1.0, 3)):
            plant.motion([state] * 3, inputs, 100.0, friction=friction)
        plant.advance(state, inputs[0], 1)
    assert [
        len(function.dispatcher.signatures) for function in (compiled.advance, compiled.evaluate)
    ] == [1, 1]
