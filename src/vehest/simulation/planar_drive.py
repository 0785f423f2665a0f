"""One simulated drive of a small car on the planar plant, as its own sensors record it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from vehest.data.recording import Recording
from vehest.simulation.drive import RATE_HZ, Flags, Trip, naming, recording_of, steps_per_tick
from vehest.simulation.driving.driver import Observation
from vehest.simulation.driving.freestyle import COMMAND_RATE_HZ, Freestyle
from vehest.simulation.driving.manoeuvre import SETTLING_TIME
from vehest.simulation.plant.planar import STEER, VX, VY, YAW, YAW_RATE, PlanarPlant, X, Y
from vehest.simulation.plant.planar_car import PlanarCar
from vehest.simulation.road.surface import SURFACES, Surface
from vehest.simulation.sensors.levels import PRESETS, SensorLevels
from vehest.simulation.sensors.recording import measure

# name -> manoeuvre, of cars of the planar plant
PLANAR_MANOEUVRES: Mapping[str, type[Freestyle]] = {Freestyle.name: Freestyle}

CHANNELS = (
    "vx",
    "yaw_rate",
    "ax",
    "ay",
    "steer",
    "motor_speed",
    "motor_current",
    "vx_ref",
    "vy_ref",
    "yaw_rate_ref",
)
"""Channels of a small car: it has no sensors at single wheels, and the inertial unit's other axes
are not kept.
"""

SPUN = np.pi / 2.0  # sideslip angle beyond which a drive counts as one with a spin [rad]


def simulate_planar_drive(
    *,
    id: str,
    car: PlanarCar,
    manoeuvre: Freestyle,
    seed: int,
    rate_hz: float = RATE_HZ,
    sensors: SensorLevels = PRESETS["small_car"],
    surface: Surface = SURFACES["dry"],
) -> Recording:
    """A recording of one drive, with arguments as of `simulate_drive`.

    ``vx`` is the motor's speed at the rim, as such a car knows its speed: it errs where the wheels
    slip. Spins are driven on from.

    Returns
    -------
    Recording
        The channels are CHANNELS; the flag ``spun`` means a sideslip beyond 90°.

    Raises
    ------
    ConfigurationError
        A value that makes no sense.
    SimulationError
        A state is not finite.
    """
    plant = PlanarPlant(car)
    with naming(id, seed):
        trip = drive_freely(plant, manoeuvre, seed, rate_hz=rate_hz, surface=surface)
    channels = measure(trip.motion, sensors, seed)
    channels["vx"] = car.wheel_radius * channels["motor_speed"]
    about = {
        "plant": "planar, four wheels",
        "parameters": car.parameters,
        "plant_step": plant.step,
        "manoeuvre": manoeuvre.description(),
        "drawn": trip.drawn,
        "surface": asdict(surface),
        "stability_control": False,
    }
    return recording_of(
        id, car.name, trip, {name: channels[name] for name in CHANNELS}, about, sensors, seed
    )


def drive_freely(
    plant: PlanarPlant,
    manoeuvre: Freestyle,
    seed: int,
    *,
    rate_hz: float = RATE_HZ,
    surface: Surface = SURFACES["dry"],
) -> Trip:
    """Drive a small car for the time of a recording and return its true motion; it starts from
    standstill, SETTLING_TIME before the first sample.

    Parameters
    ----------
    plant : PlanarPlant
        The car and its step.
    manoeuvre : Freestyle
        Habits of the driver and duration of the recording.
    seed : int
        Of the driver and of the surface's patches.
    rate_hz : float
        Sampling rate [Hz].
    surface : Surface
        Friction of the open area.

    Returns
    -------
    Trip
        Lateral errors are NaN: there is no line.

    Raises
    ------
    ConfigurationError
        Rate or step make no sense.
    SimulationError
        A state is not finite.
    """
    per_command = steps_per_tick(COMMAND_RATE_HZ, plant.step, "driver's")
    per_sample = steps_per_tick(rate_hz, plant.step, "sampling")
    stride = int(np.gcd(per_command, per_sample))
    driver = manoeuvre.controller(plant.car, surface, seed)
    first_sample = round(SETTLING_TIME / plant.step)
    state = plant.initial_state()
    states = []
    inputs_of_samples = []
    for now in range(0, first_sample + round(driver.duration * rate_hz) * per_sample, stride):
        if now % per_command == 0:
            inputs = driver.inputs(
                now * plant.step, Observation(*state[[X, Y, YAW, VX, VY, YAW_RATE, STEER]].tolist())
            )
        if now >= first_sample and (now - first_sample) % per_sample == 0:
            states.append(state)
            inputs_of_samples.append(inputs)
        state = plant.advance(state, inputs, stride)
    motion = plant.motion(states, inputs_of_samples, rate_hz)
    moving = np.hypot(motion.vx, motion.vy) > 1.0
    sideslip = float(np.abs(motion.sideslip[moving]).max(initial=0.0))
    flags = Flags(
        spun=sideslip > SPUN,
        completed=True,
        largest_sideslip=sideslip,
        largest_ay=float(np.abs(motion.ay).max()),
    )
    return Trip(motion, np.full(len(motion), np.nan), flags, driver.drawn)
