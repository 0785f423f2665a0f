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
from vehest.trust.contract import GuardedStepper
from vehest.trust.front_end import CUTOFF, FrontEnd
from vehest.trust.guard import ENDLESS, Guard
from vehest.trust.health_kernel import Layout, Model
from vehest.trust.named_arrays import views

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


def health_table(packed: FloatArray | None) -> dict[str, Any] | None:
    """Tables of `vehest.trust.health_kernel` by name; None where no health was learnt."""
    if packed is None:
        return None
    layout = Layout(*packed.view(np.int64)[: len(Layout._fields)].tolist())
    model, _ = views(Model, packed, layout)
    return {
        **model._asdict(),
        **layout._asdict(),
        **{name: float(value) for name, value in model.settings._asdict().items()},
        "n_statistics": layout.statistics,
        "limits": model.limits.every,
        "inverse": model.inverse.every,
        "stops": _endless(model.stops),
        "wheels": bool(model.wheel.any()),
    }
