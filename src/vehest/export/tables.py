"""The numbers that a stepper runs with, as templates write them: limits, tables of health, bands, sections of the front end.

They are read from a `GuardedStepper` itself, so that C and Python hold the same, to the last bit.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.trust import bands as band_rules
from vehest.trust import health_kernel as kernel
from vehest.trust.contract import GuardedStepper
from vehest.trust.front_end import CUTOFF, FrontEnd
from vehest.trust.guard import ENDLESS, Guard
from vehest.trust.health import PackedHealth
from vehest.trust.health_kernel import N_FEATURES, N_FORMS, N_LEVELS, Layout

NEVER = "UINT32_MAX"
MOST_OF = 1_000_000  # largest denominator of the ratio of rates


def guard_table(guard: Guard) -> dict[str, Any]:
    """Low, high, jump, lower and upper stop of each channel, longest runs, samples that are bridged and that a new level has to stand."""
    runs = [NEVER if math.isinf(run) else f"{math.floor(run)}U" for run in guard._limits[:, 3]]
    limits = _endless(guard._limits[:, [0, 1, 2, 4, 5]]).tolist()
    return {"limits": limits, "runs": runs, "bridged": int(guard._settings[2]), "persists": int(guard._settings[3])}


def _endless(values: FloatArray) -> FloatArray:
    """The same with infinity for what stands for it."""
    return np.where(np.abs(values) >= ENDLESS, np.copysign(np.inf, values), values)


def front_end_table(front: FrontEnd) -> dict[str, Any]:
    """Sections of the low-pass, and of how many samples how many rows are made."""
    ratio = Fraction(front._ratio).limit_denominator(MOST_OF)
    rate = front._ratio * front._guard.rate_hz
    return {
        "sections": front._sections.tolist(),
        "every": ratio.numerator,
        "of": ratio.denominator,
        "delay": front.delay,
        "cutoff": CUTOFF * rate,
    }


def band_table(stepper: GuardedStepper) -> dict[str, Any] | None:
    """Factors, squared floors, weights and domain of the bands; None where none are calibrated."""
    packed = stepper._monitor._bands
    if packed is None:
        return None
    head, terms = packed.numbers[: band_rules._HEAD], packed.numbers[band_rules._HEAD :].reshape(3, -1)
    return {
        "factor_vy": head[0],
        "factor_sideslip": head[1],
        "floor_vy": head[2],
        "floor_sideslip": head[3],
        "lowest_speed": head[4],
        "weights_vy": terms[0],
        "weights_sideslip": terms[1],
        "largest": terms[2],
        "terms": ("P", "1", "vx", "ax", "ay", "yaw rate vx", "steer vx", "vy"),
        "first_feature": band_rules._FIRST_FEATURE,
        "farthest": stepper._monitor._farthest,
    }


def health_table(packed: PackedHealth | None) -> dict[str, Any] | None:
    """Tables of `vehest.trust.health_kernel` by name; None where no health was learnt."""
    if packed is None:
        return None
    numbers, sizes = packed
    layout = Layout(*(int(value) for value in sizes[: len(Layout._fields)]))
    C, p, R, K = layout.channels, layout.order, layout.relations, layout.n_statistics

    def table(at: int, *shape: int) -> FloatArray:
        return numbers[sizes[at] : sizes[at] + math.prod(shape)].reshape(shape)

    def index(at: int, *shape: int) -> Any:
        return sizes[sizes[at] : sizes[at] + math.prod(shape)].reshape(shape)

    settings = table(kernel.AT_SETTINGS, 9)
    names = (
        "least_speed",
        "still_yaw_rate",
        "still_ay",
        "step",
        "spin_yaw_rate",
        "spin_turning",
        "forget_share",
        "forget_ax",
        "forget_late",
    )
    wheels = index(kernel.AT_WHEEL, C)
    return {
        **layout._asdict(),
        **dict(zip(names, settings.tolist(), strict=True)),
        "n_statistics": K,
        "constant": table(kernel.AT_CONSTANT, C),
        "lags": table(kernel.AT_LAGS, p, C, C),
        "precision": table(kernel.AT_PRECISION, C, C),
        "deviation": table(kernel.AT_DEVIATION, C),
        "instant": table(kernel.AT_INSTANT, C, N_FEATURES),
        "average": table(kernel.AT_AVERAGE, R, N_FEATURES),
        "rate_gain": table(kernel.AT_RATE_GAIN, R),
        "usual": table(kernel.AT_USUAL, C),
        "largest": table(kernel.AT_LARGEST, C),
        "speeds": table(kernel.AT_SPEEDS, N_LEVELS),
        "levels": table(kernel.AT_LEVELS, N_LEVELS, C),
        "settled_gain": table(kernel.AT_SETTLED_GAIN, C, C),
        "steps": table(kernel.AT_STEPS, p, C, C),
        "step_power": table(kernel.AT_STEP_POWER, C, C),
        "healthy": table(kernel.AT_HEALTHY, N_FORMS, C),
        "heaviest": table(kernel.AT_HEAVIEST, N_FORMS, C),
        "forget_energy": table(kernel.AT_FORGET_ENERGY, layout.energies),
        "forget_ratio": table(kernel.AT_FORGET_RATIO, layout.ratios),
        "forget_average": table(kernel.AT_FORGET_AVERAGE, layout.averages),
        "stops": _endless(table(kernel.AT_STOPS, 2, C)),
        "limits": table(kernel.AT_LIMITS, K),
        "inverse": table(kernel.AT_INVERSE, K),
        "priority": table(kernel.AT_PRIORITY, K),
        "modelled": index(kernel.AT_MODELLED, C),
        "rests": index(kernel.AT_RESTS, C),
        "gap_limit": index(kernel.AT_GAP_LIMIT, C),
        "wheel": wheels,
        "wheels": bool(np.any(wheels)),
        "code": index(kernel.AT_CODE, C),
        "target": index(kernel.AT_TARGET, R),
        "kind": index(kernel.AT_KIND, K),
        "accused": index(kernel.AT_ACCUSED, K),
        "partner": index(kernel.AT_PARTNER, K),
        "involved": index(kernel.AT_INVOLVED, R, C),
        "versus": index(kernel.AT_VERSUS, R),
    }
