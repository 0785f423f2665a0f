"""A drive in closed form with content at many frequencies, any channel of which may be late or
low-passed to the last digit.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from vehest.alignment.checks import checks_of_recording
from vehest.data.recording import Recording

NOISE = {"vx": 0.01, "yaw_rate": 0.002, "ax": 0.05, "ay": 0.05, "steer": 0.001}


class Wave:
    """A sum of sines that can be taken at any time, derived, delayed and sent through a first-order
    low-pass.
    """

    def __init__(self, amplitudes, omegas, phases, level=0.0):
        self.amplitudes = amplitudes
        self.omegas = omegas
        self.phases = phases
        self.level = level
        self._known = {}  # by uniform clock and order

    @classmethod
    def random(cls, generator, size, low, high, number=120, level=0.0, corner=0.5):
        frequencies = generator.uniform(low, high, number)
        amplitudes = size * np.sqrt(2.0 / number) / (1.0 + np.square(frequencies / corner))
        return cls(
            amplitudes, 2 * np.pi * frequencies, generator.uniform(0, 2 * np.pi, number), level
        )

    def __call__(self, time, order=0):
        key = time[0], time[-1], len(time), order
        if key not in self._known:
            angle = np.multiply.outer(time, self.omegas) + self.phases + order * np.pi / 2
            self._known[key] = np.sin(angle) @ (self.amplitudes * self.omegas**order) + (
                self.level if order == 0 else 0.0
            )
        return self._known[key]

    def low_passed(self, time_constant):
        """1 / (1 + iωT), in closed form."""
        response = 1.0 / (1.0 + 1j * self.omegas * time_constant)
        return Wave(
            self.amplitudes * np.abs(response),
            self.omegas,
            self.phases + np.angle(response),
            self.level,
        )


def broadband_drive(
    seconds=120.0, rate_hz=100.0, seed=0, late=None, lever=0.0, slow_yaw_rate=0.0, noise=1.0
):
    """d(vy)/dt = ay - vx·yaw_rate and d(vx)/dt = ax + vy·yaw_rate hold at each instant, but for
    noise and what is asked for.

    Channels are ``late`` by so many seconds; ``lever`` is how far ahead the inertial unit sits [m],
    ``slow_yaw_rate`` a time constant [s].
    """
    return _made(
        seconds, rate_hz, seed, tuple(sorted((late or {}).items())), lever, slow_yaw_rate, noise
    )


@cache
def _made(seconds, rate_hz, seed, late, lever, slow_yaw_rate, noise):
    """Made once; recordings cannot be written to."""
    turn, slide, speed, state = _waves(seed)
    generator = np.random.default_rng()
    generator.bit_generator.state = state
    measured_turn = turn.low_passed(slow_yaw_rate) if slow_yaw_rate else turn
    clock = np.arange(round(seconds * rate_hz)) / rate_hz

    def vy(time):
        return -0.9 * turn(time) + slide(time)

    exact = {
        "vx": speed,
        "yaw_rate": measured_turn,
        "ax": lambda time: speed(time, 1) - vy(time) * turn(time),
        "ay": lambda time: (
            -0.9 * turn(time, 1) + slide(time, 1) + speed(time) * turn(time) + lever * turn(time, 1)
        ),
        "steer": lambda time: 0.1 * turn(time),
        "vx_ref": speed,
        "vy_ref": vy,
        "sideslip_ref": lambda time: np.arctan2(vy(time), speed(time)),
        "yaw_rate_ref": turn,
    }
    channels = {}
    for name, quantity in exact.items():
        samples = quantity(clock - dict(late).get(name, 0.0))
        channels[name] = samples + noise * NOISE.get(name, 0.0) * generator.standard_normal(
            len(clock)
        )
    return Recording("broadband", "car", rate_hz, 5.0, channels)


@cache
def _waves(seed):
    """Waves of yaw rate, v and speed, and the generator's state after them."""
    generator = np.random.default_rng(seed)
    turn = Wave.random(generator, 0.3, 0.05, 4.0)
    slide = Wave.random(generator, 0.25, 0.05, 4.0)
    speed = Wave.random(generator, 6.0, 0.01, 1.5, level=20.0, corner=0.15)
    return turn, slide, speed, generator.bit_generator.state


def without(recording, *names):
    """The same drive without some channels."""
    return recording.select([name for name in recording.channels if name not in names])


def changed(recording, gappy=(), **changes):
    """The same drive with channels of other samples: channel -> these, or a function of its own."""
    channels = {
        name: change(recording[name]) if callable(change) else change
        for name, change in changes.items()
    }
    return replace(recording, channels={**recording.channels, **channels}, gappy=frozenset(gappy))


def found_by(check, recording):
    """What one check reports: channel -> finding."""
    return {
        finding.channel: finding
        for finding in checks_of_recording(recording)
        if finding.check == check
    }


def warned(recording):
    """Findings that are more than notes."""
    return [finding for finding in checks_of_recording(recording) if finding.level != "note"]
