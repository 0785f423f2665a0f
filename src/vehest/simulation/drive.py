"""One simulated drive: a driver takes a vehicle through a manoeuvre, sensors make a recording of
it.

Flow: manoeuvre and seed -> controller; at every tick of DRIVER_RATE_HZ observation -> command
-> inputs of the plant (`_Ride.decide`); the plant integrates these up to the next tick or sample;
states that were sampled -> Motion (true motion) -> `measure` -> Recording. Time 0 is the first
sample, SETTLING_TIME after the start of the car.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.simulation.driving.car import car_of
from vehest.simulation.driving.driver import DRIVER_RATE_HZ, Command, Observation
from vehest.simulation.driving.manoeuvre import SETTLING_TIME, Controller, Manoeuvre
from vehest.simulation.errors import SimulationError
from vehest.simulation.plant.motion import Motion
from vehest.simulation.plant.multi_body import MultiBodyPlant, PlantState, road_gravity
from vehest.simulation.plant.parameters import LIBRARY, LIBRARY_VERSION, Vehicle
from vehest.simulation.plant.regimes import STEER, VX, VY, YAW, YAW_RATE, X, Y
from vehest.simulation.plant.stability import StabilityControl, StabilityState
from vehest.simulation.plant.stability import stability_control as make_stability_control
from vehest.simulation.plant.wear import Stint
from vehest.simulation.road.surface import SURFACES, Surface
from vehest.simulation.sensors.levels import PRESETS, SensorLevels
from vehest.simulation.sensors.recording import described, measure

RATE_HZ = 100.0  # default sampling rate of recordings [Hz]
AFTER_STAND = 1.0  # time that is recorded after the car has come to its stand [s]
MAX_STOP_SECONDS = 60.0  # longest time until a car that spun or left the road has to stand [s]
# share of the grip with which a driver brakes after a spin or beside the road; assumed
STOPPING_SHARE = 0.7


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Outcome of a drive."""

    spun: bool  # whether the car slid beyond the validity of its equations of rolling
    # whether the car was farther beside its line than the manoeuvre's half_width
    left_road: bool = False
    stood: bool = False  # whether the car stands at the end
    # whether the manoeuvre came to its own end, and was not cut off because it took too long
    completed: bool
    # time at which the driver began to stop because of a spin or beside the road [s]; None: never
    gave_up_at: float | None = None
    # largest distance from the line [m]; None where there is no line
    largest_lateral_error: float | None = None
    largest_sideslip: float  # largest magnitude of the sideslip angle above 1 m/s [rad]
    largest_ay: float  # largest magnitude of the lateral acceleration [m/s²]
    # share of the recorded time in which stability control intervened; None where it is off
    stability_share: float | None = None


@dataclass(frozen=True, eq=False)
class Trip:
    """True motion and outcome of a drive."""

    motion: Motion  # true motion, from the first sample after the settling time on
    # distance of the car from its line, positive left of it [m], (T,); NaN where there is no line
    lateral_error: FloatArray
    flags: Flags  # outcome
    drawn: dict[str, Any]  # values that the seed drew


def simulate_drive(
    *,
    id: str,
    vehicle: Vehicle,
    manoeuvre: Manoeuvre,
    seed: int,
    rate_hz: float = RATE_HZ,
    sensors: SensorLevels = PRESETS["default"],
    stability_control: bool = False,
    surface: Surface = SURFACES["dry"],
    stint: Stint | None = None,
) -> Recording:
    """A recording of one drive; the same arguments give the same samples, bit by bit.

    A car that spins or leaves the road brakes to its stand, and the recording ends AFTER_STAND
    later; its provenance has ``flags``. The seed, zero or positive, is that of the driver, of what
    the manoeuvre draws, of patches on the surface and of the sensors' errors; a whole number of
    plant steps must fit between samples at ``rate_hz``; the loss of grip over the drive, ``stint``,
    is unknown to the driver.

    Parameters
    ----------
    id : str
        Of the recording.
    vehicle : Vehicle
        Car of the multi-body plant.
    manoeuvre : Manoeuvre
        What is driven; it decides when the recording ends.
    seed : int
        Zero or positive; it is the entropy of all random streams.
    rate_hz : float
        Sampling rate of the recording [Hz].
    sensors : SensorLevels
        Sizes of the sensors' errors.
    stability_control : bool
        Whether yaw moments by braking one side act on the car.
    surface : Surface
        Friction along the way.
    stint : Stint or None
        Loss of grip over the time of the drive; None: none.

    Returns
    -------
    Recording
        Of kind ``simulated``, starting at 0 s, with the channels that `measure` returns, reference
        channels included; the provenance is plain JSON data.

    Raises
    ------
    ConfigurationError
        A value that makes no sense, or a car that cannot do the manoeuvre.
    SimulationError
        The car rolled over, or a state is not finite.
    """
    plant = MultiBodyPlant(vehicle)
    with naming(id, seed):
        trip = drive(
            plant,
            manoeuvre,
            seed,
            rate_hz=rate_hz,
            surface=surface,
            stability_control=stability_control,
            stint=stint,
        )
    about = {
        "plant": "CommonRoad multi-body",
        "library": f"{LIBRARY} {LIBRARY_VERSION}",
        "parameter_set": vehicle.parameter_set,
        "overrides": vehicle.overrides,
        "plant_step": plant.step,
        "manoeuvre": manoeuvre.description(),
        "drawn": trip.drawn,
        "surface": asdict(surface),
        **({"tyres": asdict(stint)} if stint is not None else {}),
        **({"relaxation": vehicle.relaxation} if any(vehicle.relaxation) else {}),
        "stability_control": stability_control,
    }
    return recording_of(
        id, vehicle.name, trip, measure(trip.motion, sensors, seed), about, sensors, seed
    )


@contextmanager
def naming(id: str, seed: int) -> Iterator[None]:
    """Context in which errors of a simulation name the drive and its seed.

    Raises
    ------
    SimulationError
        The one raised inside, with both before its text; other errors pass unchanged.
    """
    try:
        yield
    except SimulationError as error:
        raise SimulationError(f"drive '{id}' with seed {seed}: {error}") from error


def recording_of(
    id: str,
    vehicle: str,
    trip: Trip,
    channels: dict[str, FloatArray],
    about: dict[str, Any],
    sensors: SensorLevels,
    seed: int,
) -> Recording:
    """The recording of a trip.

    Parameters
    ----------
    id, vehicle : str
        Of the recording.
    trip : Trip
        True motion and outcome.
    channels : dict
        Measured channels [SI], (T,) each, as `measure` returns them.
    about : dict
        First entries of the provenance: plant, manoeuvre, surface. Seed, sensors and flags follow.
    sensors : SensorLevels
        Levels of errors by which the channels were measured.
    seed : int
        Of the drive.
    """
    provenance = {
        **about,
        "seed": seed,
        "sensors": described(sensors, trip.motion),
        "flags": asdict(trip.flags),
    }
    return Recording(
        id=id,
        vehicle=vehicle,
        rate_hz=trip.motion.rate_hz,
        start_time=0.0,
        channels=channels,
        kind="simulated",
        provenance=json.loads(
            json.dumps(provenance)
        ),  # as it comes back from a file: lists for tuples
    )


def drive(
    plant: MultiBodyPlant,
    manoeuvre: Manoeuvre,
    seed: int,
    *,
    rate_hz: float = RATE_HZ,
    surface: Surface = SURFACES["dry"],
    stability_control: bool = False,
    stint: Stint | None = None,
) -> Trip:
    """Drive a car through a manoeuvre.

    Parameters
    ----------
    plant : MultiBodyPlant
        The car.
    manoeuvre : Manoeuvre
        Makes the driver for the car, the surface and the seed.
    seed : int
        Of the driver and of patches on the surface.
    rate_hz : float
        Rate of the recorded motion [Hz]; its samples lie on steps of the plant.
    surface : Surface
        Friction of the road.
    stability_control : bool
        Whether the car has one that brakes single wheels.
    stint : Stint or None
        Loss of grip over the drive, unknown to the driver.

    Returns
    -------
    Trip
        True motion from the end of the settling time on, and outcome.

    Raises
    ------
    ConfigurationError
        A rate does not fit the plant's step, or the car cannot do the manoeuvre.
    SimulationError
        The car rolled over, or a state is not finite.
    """
    per_command = steps_per_tick(DRIVER_RATE_HZ, plant.step, "driver's")
    per_sample = steps_per_tick(rate_hz, plant.step, "sampling")
    controller = manoeuvre.controller(car_of(plant), surface, seed)
    ride = _Ride(
        plant,
        manoeuvre,
        controller,
        make_stability_control(plant) if stability_control else None,
        stint,
    )

    stride = math.gcd(per_command, per_sample)
    first_sample = math.ceil(SETTLING_TIME / (plant.step * per_command)) * per_command
    now = 0
    while True:
        time = (now - first_sample) * plant.step
        if now % per_command == 0 and not ride.decide(time):
            break
        if now >= first_sample and (now - first_sample) % per_sample == 0:
            ride.keep_sample()
        try:
            ride.state = plant.advance(ride.state, ride.inputs, stride, ride.decision.friction)
        except SimulationError as error:
            raise SimulationError(
                f"manoeuvre '{manoeuvre.name}', {time:.2f} s after the first sample: {error}"
            ) from error
        now += stride
    return ride.trip(plant, rate_hz, controller.drawn)


class _Ride:
    """State of one drive in the loop of `drive`: the car, its driver, and the samples taken so
    far.
    """

    def __init__(
        self,
        plant: MultiBodyPlant,
        manoeuvre: Manoeuvre,
        controller: Controller,
        control: StabilityControl | None,
        stint: Stint | None,
    ) -> None:
        self._car = car_of(plant)
        self._controller = controller
        self._stint = stint
        self._half_width = float(getattr(manoeuvre, "half_width", math.inf))
        self._longest = manoeuvre.longest
        self.stability_control = control
        self.stability = StabilityState()
        self.state = plant.initial_state(*controller.start)
        self.inputs = np.zeros(5)
        self.decision = Command(0.0, 0.0)
        self.bank = self.grade = 0.0
        self.left_road = self.completed = False
        self.gave_up_at: float | None = None
        self._stands_since: float | None = None
        self._states: list[PlantState] = []
        self._inputs: list[FloatArray] = []
        self._road: list[tuple[float, float, float, float]] = []
        self._interventions = 0

    def decide(self, time: float) -> bool:
        """Let the driver decide, and set the inputs of the plant up to the next decision.

        A driver who has given up (a spin, or beside the road) straightens the wheels and brakes
        with STOPPING_SHARE of the grip. Gravity of bank and grade and the drag of the air, which
        the plant's equations leave out, enter as external accelerations.

        Parameters
        ----------
        time : float
            Since the first sample [s]; negative while the car settles.

        Returns
        -------
        bool
            False if the drive is over; the inputs are then those of the last decision.
        """
        observation = Observation(*self.state.values[[X, Y, YAW, VX, VY, YAW_RATE, STEER]].tolist())
        decision = self._controller.command(time, observation)
        if self._stint is not None:
            friction = decision.friction * self._stint.friction_at(time)
            decision = replace(decision, friction=friction)
        self.decision = decision
        self._judge(time, decision)
        if self._is_over(time, decision):
            return False
        steering_velocity = decision.steering_velocity
        acceleration = decision.acceleration
        if self.gave_up_at is not None:
            steering_velocity = (
                max(-0.5, min(0.5, -observation.steer / 0.3)) * self._car.steering_rate
            )
            acceleration = -STOPPING_SHARE * self._car.grip * decision.friction
        along, across = self._slope(observation.yaw)
        drag = self._car.drag * observation.speed
        if self.stability_control is not None:
            self.stability = self.stability_control.step(
                self.stability,
                1.0 / DRIVER_RATE_HZ,
                steer=observation.steer,
                vx=observation.vx,
                yaw_rate=observation.yaw_rate,
                friction=decision.friction,
            )
        moment = self.stability.moment
        self.inputs = np.array(
            [
                steering_velocity,
                acceleration,
                moment,
                along - drag * observation.vx,
                across - drag * observation.vy,
            ]
        )
        return True

    def _judge(self, time: float, decision: Command) -> None:
        """Note when the car left its road or spun, which makes the driver give up, and since when
        it stands.
        """
        if self.gave_up_at is None and abs(decision.lateral_error) > self._half_width:
            self.left_road = True
        if self.gave_up_at is None and (self.left_road or self.state.spun):
            self.gave_up_at = time
        if not self.state.is_standing:
            self._stands_since = None
        elif self._stands_since is None:
            self._stands_since = time

    def _is_over(self, time: float, decision: Command) -> bool:
        """Whether the drive is over: AFTER_STAND after the stand, MAX_STOP_SECONDS after the driver
        gave up, at the manoeuvre's own end, or after its longest time; sets ``completed``.
        """
        if self._stands_since is not None and time >= self._stands_since + AFTER_STAND - 1e-9:
            self.completed = self.gave_up_at is None
            return True
        if self.gave_up_at is not None:
            return time > self.gave_up_at + MAX_STOP_SECONDS
        self.completed = self._stands_since is None and decision.finished
        return self.completed or (self._stands_since is None and time >= self._longest - 1e-9)

    def _slope(self, yaw: float) -> tuple[float, float]:
        """Gravity along and across the car [m/s²]; keeps bank and grade as the car has them.

        The road's bank and grade are meant along its heading; a car at an angle to it has part of
        each in the other direction. The angles that are kept, and recorded, are those along the
        car's axes.
        """
        decision = self.decision
        if decision.bank == 0.0 and decision.grade == 0.0:
            self.bank = self.grade = 0.0
            return 0.0, 0.0
        along_road, across_road = road_gravity(decision.bank, decision.grade)
        sine = math.sin(yaw - decision.heading)
        cosine = math.cos(yaw - decision.heading)
        along = along_road * cosine + across_road * sine
        across = across_road * cosine - along_road * sine
        self.bank = math.asin(-across / GRAVITY)
        self.grade = math.asin(along / GRAVITY)
        return along, across

    def keep_sample(self) -> None:
        """Keep the present state as a sample.

        Keeps state, inputs, whether stability control acts, and the road at the car: friction,
        bank, grade and lateral error.
        """
        self._states.append(self.state)
        self._inputs.append(self.inputs)
        self._interventions += self.stability.active
        self._road.append(
            (self.decision.friction, self.bank, self.grade, self.decision.lateral_error)
        )

    def trip(self, plant: MultiBodyPlant, rate_hz: float, drawn: dict[str, Any]) -> Trip:
        """The samples that were kept.

        Parameters
        ----------
        plant : MultiBodyPlant
            The plant that drove, for accelerations and tyre forces at the samples.
        rate_hz : float
            Rate at which samples were kept [Hz].
        drawn : dict
            Values that the seed drew.

        Returns
        -------
        Trip
            True motion, with flags. Sideslip counts above 1 m/s only, where it has a meaning.
        """
        friction, bank, grade, lateral_error = np.array(self._road).T
        motion = plant.motion(
            self._states, np.array(self._inputs), rate_hz, friction=friction, bank=bank, grade=grade
        )
        moving = np.hypot(motion.vx, motion.vy) > 1.0
        on_line = np.abs(lateral_error[np.isfinite(lateral_error)])
        flags = Flags(
            spun=self.state.spun,
            left_road=self.left_road,
            stood=self.state.is_standing,
            completed=self.completed,
            gave_up_at=self.gave_up_at,
            largest_lateral_error=float(on_line.max()) if len(on_line) else None,
            largest_sideslip=float(np.abs(motion.sideslip[moving]).max(initial=0.0)),
            largest_ay=float(np.abs(motion.ay).max()),
            stability_share=self._interventions / len(motion)
            if self.stability_control is not None
            else None,
        )
        return Trip(motion, lateral_error.copy(), flags, drawn)


def steps_per_tick(rate_hz: float, step: float, rate_name: str) -> int:
    """Number of the plant's steps between two ticks of a rate.

    Parameters
    ----------
    rate_hz : float
        The rate [Hz].
    step : float
        Of the plant [s].
    rate_name : str
        Name of the rate in the error.

    Returns
    -------
    int
        At least 1.

    Raises
    ------
    ConfigurationError
        The number is not whole.
    """
    n_steps = round(1.0 / (rate_hz * step)) if rate_hz > 0 else 0
    if n_steps < 1 or abs(n_steps * step * rate_hz - 1.0) > 1e-9:
        raise ConfigurationError(
            f"the {rate_name} rate of {rate_hz} Hz does not fit the plant's step of {step} s: a "
            "whole number of steps must lie between two samples (with 0.001 s: 10, 20, 25, 40, "
            "50, 100, 125, 200, 250, 500 or 1000 Hz)"
        )
    return n_steps
