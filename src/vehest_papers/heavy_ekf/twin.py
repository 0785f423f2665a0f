"""The paper's own single track with rational tyres as the plant: drives whose rear slip, load,
friction and road are chosen.

Every filter of the paper runs on its own model here, so that what it gains or loses comes from slip
and from tyres it does not know.

    β' = (F_F + F_R)/(M u) - r + g sin φ/u                    (Eq. 1; φ the crossfall)
    r' = (a_F F_F - a_R F_R)/J                                (Eq. 2)
    F = c₂ μ F_z/F_z0 α c₁(μ + 1)/(α² + c₁(μ + 1))            (Eq. 4)
    α_F = δ - β - a_F r/u,  α_R = -β + a_R r/u                (Eqs. 5, 6)
    a_y = (F_F + F_R)/M = u (β' + r) - g sin φ

The driver holds a wanted slip of the rear axle α* by two loops, one inside the other: the yaw rate
that turns the rear axle's slip towards α*, r* = (F_R l/(M a_F) + g sin φ)/u + α*' + k (α* - α_R),
is exact where J = M a_F a_R, and the front force that turns the car towards it, F_F = (J k_r (r* -
r) + a_R F_R)/a_F. So a car beyond its rear axle's peak is held by countersteering, as a driver
does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.data.recording import Recording
from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.rational_tyres import rational_axle
from vehest_papers.heavy_ekf import paper

RATE = 20.0  # Hz, as in the paper
SUBSTEPS = 20  # steps of the plant a sample: 400 Hz
SECONDS = 120.0
TRUCK = SingleTrackParameters(
    7912.0, 24230.0, 1.7401, 1.7599, 1.0, 1.0
)  # as in conf/vehicle/heavy_truck.yaml
CURVES = np.array([paper.CURVES[name] for name in ("c1_front", "c2_front", "c1_rear", "c2_rear")])
PAYLOAD = 1978.0  # kg, a quarter of the mass; assumed
PAYLOAD_BEHIND = 1.0  # m behind the centre of gravity; assumed
CROSSFALL = math.radians(1.0)
DRY = 1.0
WET = 0.6
NOISE = {
    "yaw_rate": math.radians(0.1),
    "ay": 0.1,
    "steer": math.radians(0.05),
    "vx": 0.05,
}  # a sample, white; assumed
SLIP_GAIN = 4.0
TURN_GAIN = 10.0  # 1/s
MAX_STEER = 0.7  # rad
MAX_STEER_RATE = 1.0  # rad/s
FRONT_SHARE = 0.98  # of the front axle's largest force, which the driver does not ask more of
SPEEDS = (12.5, 26.0)  # m/s, mean of a drive: from the laps at 45 km/h to the fast one
BEND_SECONDS = (4.0, 9.0)
REST_SECONDS = (1.0, 3.0)
WET_SECONDS = (12.0, 25.0)
RAMP_SECONDS = 1.5
MIN_BEND_SHARE = 0.4  # of the largest rear slip of a drive


@dataclass(frozen=True)
class Conditions:
    """What a drive of the plant is like."""

    slip: float  # largest rear slip angle that the driver holds [deg]
    # whether a quarter of the mass is loaded behind the centre of gravity, which no filter knows
    payload: bool = False
    wet_patches: bool = False  # whether the friction steps from 1 to 0.6 and back along the road
    # whether the road falls by 1° to the left all along, as on one side of a crown
    crossfall: bool = False


@dataclass(frozen=True)
class Plant:
    """Mass, inertia and places of the axles as they are, and what loads the axles carry over those
    at rest without payload.
    """

    car: SingleTrackParameters
    load_front: float
    load_rear: float

    @classmethod
    def of(cls, *, payload: bool) -> Plant:
        """The truck, with or without its payload."""
        if not payload:
            return cls(TRUCK, 1.0, 1.0)
        mass = TRUCK.mass + PAYLOAD
        behind = PAYLOAD * PAYLOAD_BEHIND / mass
        inertia = (
            TRUCK.yaw_inertia + TRUCK.mass * behind**2 + PAYLOAD * (PAYLOAD_BEHIND - behind) ** 2
        )
        front = TRUCK.cg_to_front_axle + behind
        rear = TRUCK.cg_to_rear_axle - behind
        at_front = mass * rear / (TRUCK.mass * TRUCK.cg_to_rear_axle)
        at_rear = mass * front / (TRUCK.mass * TRUCK.cg_to_front_axle)
        car = replace(
            TRUCK, mass=mass, yaw_inertia=inertia, cg_to_front_axle=front, cg_to_rear_axle=rear
        )
        return cls(car, float(at_front), float(at_rear))


@dataclass(frozen=True, eq=False)
class Course:
    """What is asked of the driver and what the road is like at the plant's steps, (K,) each."""

    speed: FloatArray  # u [m/s]
    slip: FloatArray  # wanted rear slip angle [rad]
    slip_rate: FloatArray  # its slope [rad/s]
    friction: FloatArray  # μ
    road: FloatArray  # g sin φ, positive where it pulls to the left [m/s²]


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive at the filters' rate."""

    samples: FloatArray  # yaw_rate, vx, ay and steer with the sensors' noise, (T, 4)
    sideslip: FloatArray  # β as it is [rad], (T,)
    yaw_rate: FloatArray  # r as it is [rad/s], (T,)
    rear_slip: FloatArray  # α_R as it is [rad], (T,)

    @cached_property
    def recording(self) -> Recording:
        """The same as a recording with its reference, named by its conditions."""
        names = ("yaw_rate", "vx", "ay", "steer")
        channels = dict(zip(names, self.samples.T, strict=True)) | {"sideslip_ref": self.sideslip}
        channels["vy_ref"] = channels["vx"] * np.tan(self.sideslip)
        return Recording("twin", "twin", RATE, 0.0, channels, "simulated")


def course(
    conditions: Conditions, generator: np.random.Generator, seconds: float = SECONDS
) -> Course:
    """A course of bends to either side, of which one at least asks for the whole slip, at a speed
    that wavers.
    """
    step = 1.0 / (RATE * SUBSTEPS)
    time = np.arange(round(seconds / step)) * step
    slip = np.zeros(len(time))
    at = 2.0
    largest = math.radians(conditions.slip)
    n_bends = 0
    while at < seconds - BEND_SECONDS[0]:
        length = float(generator.uniform(*BEND_SECONDS))
        share = 1.0 if n_bends % 4 == 0 else float(generator.uniform(MIN_BEND_SHARE, 1.0))
        rise = (
            np.clip((time - at) / RAMP_SECONDS, 0.0, 1.0),
            np.clip((at + length - time) / RAMP_SECONDS, 0.0, 1.0),
        )
        shape = np.minimum(*rise)
        slip += (
            float(generator.choice([-1.0, 1.0]))
            * share
            * largest
            * 0.5
            * (1.0 - np.cos(math.pi * shape))
        )
        at += length + float(generator.uniform(*REST_SECONDS))
        n_bends += 1
    phase = generator.uniform(0.0, 2.0 * math.pi, 2)
    mean = float(generator.uniform(*SPEEDS))
    speed = mean + 1.2 * np.sin(0.21 * time + phase[0]) + 0.8 * np.sin(0.53 * time + phase[1])
    friction = np.full(len(time), DRY)
    at = float(generator.uniform(*WET_SECONDS))
    wet = True
    while conditions.wet_patches and at < seconds:
        until = at + float(generator.uniform(*WET_SECONDS))
        friction[(time >= at) & (time < until)] = WET if wet else DRY
        at = until
        wet = not wet
    road = np.full(len(time), GRAVITY * math.sin(CROSSFALL) if conditions.crossfall else 0.0)
    return Course(speed, slip, np.gradient(slip, step), friction, road)


def drive(conditions: Conditions, seed: int, seconds: float = SECONDS) -> Drive:
    """A drive of a course, and sensors, that the seed alone decides: the same for all plants of
    equal slip.

    Parameters
    ----------
    conditions
        Rear slip, load, friction and road.
    seed
        Of the course and, in a stream of its own, of the sensors' noise.
    seconds
        Length of the drive [s].
    """
    generator = np.random.default_rng([seed, 22])
    plant = Plant.of(payload=conditions.payload)
    planned = course(conditions, np.random.default_rng([seed, 4]), seconds)
    states, steer, lateral = driven(plant, planned)
    sampled = slice(None, None, SUBSTEPS)
    sideslip, yaw_rate = states[sampled].T
    speed = planned.speed[sampled]
    clean = np.stack([yaw_rate, speed, lateral[sampled], steer[sampled]], axis=1)
    noise = np.array([NOISE[name] for name in ("yaw_rate", "vx", "ay", "steer")])
    samples = clean + noise * generator.standard_normal(clean.shape)
    rear_slip = -sideslip + float(plant.car.cg_to_rear_axle) * yaw_rate / speed
    return Drive(samples, sideslip.copy(), yaw_rate.copy(), rear_slip)


def driven(plant: Plant, planned: Course) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motion of the plant along a course, by Runge and Kutta's fourth order.

    Returns
    -------
    states : array, shape (K, 2)
        β [rad] and r [rad/s] at the plant's steps.
    steer, lateral : array, shape (K,)
        Road-wheel angle [rad] and lateral acceleration [m/s²].
    """
    states = np.zeros((len(planned.speed), 2))
    steer = np.zeros(len(planned.speed))
    lateral = np.zeros(len(planned.speed))
    car = np.array(
        [
            plant.car.mass,
            plant.car.yaw_inertia,
            plant.car.cg_to_front_axle,
            plant.car.cg_to_rear_axle,
        ],
        dtype=np.float64,
    )
    tyres = np.array(
        [CURVES[0], CURVES[1] * plant.load_front, CURVES[2], CURVES[3] * plant.load_rear]
    )
    _drive(
        car,
        tyres,
        planned.speed,
        planned.slip,
        planned.slip_rate,
        planned.friction,
        planned.road,
        1.0 / (RATE * SUBSTEPS),
        states,
        steer,
        lateral,
    )
    return states, steer, lateral


_axle = numba.njit(rational_axle)


@numba.njit(cache=True, error_model="numpy")
def _drive(  # type: ignore[no-untyped-def]
    car, tyres, speed, slip, slip_rate, friction, road, step, states, steer, lateral
):
    """Driver and plant over K steps; fills ``states`` (K, 2), ``steer`` and ``lateral`` (K,) in
    place.

    At each step the driver moves the steering angle towards the wanted one (`_steering`), within
    its rate and range, and holds it while the plant moves.
    """
    angle = 0.0
    for k in range(len(speed)):
        u = speed[k]
        mu = friction[k]
        pull = road[k]
        target = _steering(
            car, tyres, u, mu, pull, slip[k], slip_rate[k], states[k, 0], states[k, 1]
        )
        moved = min(max(target - angle, -MAX_STEER_RATE * step), MAX_STEER_RATE * step)
        angle = min(max(angle + moved, -MAX_STEER), MAX_STEER)
        steer[k] = angle
        b0, r0, lateral[k] = rates(car, tyres, u, mu, pull, angle, states[k, 0], states[k, 1])
        if k + 1 == len(speed):
            break
        half = 0.5 * step
        b1, r1, _ = rates(
            car, tyres, u, mu, pull, angle, states[k, 0] + half * b0, states[k, 1] + half * r0
        )
        b2, r2, _ = rates(
            car, tyres, u, mu, pull, angle, states[k, 0] + half * b1, states[k, 1] + half * r1
        )
        b3, r3, _ = rates(
            car, tyres, u, mu, pull, angle, states[k, 0] + step * b2, states[k, 1] + step * r2
        )
        states[k + 1, 0] = states[k, 0] + step / 6.0 * (b0 + 2.0 * b1 + 2.0 * b2 + b3)
        states[k + 1, 1] = states[k, 1] + step / 6.0 * (r0 + 2.0 * r1 + 2.0 * r2 + r3)


@numba.njit(cache=True, error_model="numpy")
def rates(car, tyres, u, mu, pull, angle, sideslip, yaw_rate):  # type: ignore[no-untyped-def]
    """β', r' and a_y of the plant; `pull` is g sin φ."""
    mass, inertia, front_arm, rear_arm = car
    turn = yaw_rate / u
    front = _axle(angle - sideslip - front_arm * turn, tyres[0], tyres[1], mu).force
    rear = _axle(rear_arm * turn - sideslip, tyres[2], tyres[3], mu).force
    acceleration = (front + rear) / mass
    return (
        (acceleration + pull) / u - yaw_rate,
        (front_arm * front - rear_arm * rear) / inertia,
        acceleration,
    )


@numba.njit(cache=True, error_model="numpy")
def _steering(  # type: ignore[no-untyped-def]
    car, tyres, u, mu, pull, slip, slip_rate, sideslip, yaw_rate
):
    """Road-wheel angle by which the driver turns the rear axle's slip towards the wanted one.

    The wanted yaw rate and front force are those of the module's docstring. The force is limited to
    `FRONT_SHARE` of the largest, and the slip angle that gives it is the smaller solution of Eq. 4.
    """
    mass, inertia, front_arm, rear_arm = car
    rear_slip = rear_arm * yaw_rate / u - sideslip
    rear = _axle(rear_slip, tyres[2], tyres[3], mu).force
    turn = (
        (rear * (front_arm + rear_arm) / (mass * front_arm) + pull) / u
        + slip_rate
        + SLIP_GAIN * (slip - rear_slip)
    )
    bend = tyres[0] * (mu + 1.0)
    largest = FRONT_SHARE * tyres[1] * mu * math.sqrt(bend) / 2.0
    front = (inertia * TURN_GAIN * (turn - yaw_rate) + rear_arm * rear) / front_arm
    front = min(max(front, -largest), largest)
    stiffness = tyres[1] * mu  # front = stiffness α/(1 + α²/bend), the smaller of the two solutions
    angle = (
        2.0 * front / (stiffness + math.sqrt(stiffness * stiffness - 4.0 * front * front / bend))
    )
    return angle + sideslip + front_arm * yaw_rate / u
