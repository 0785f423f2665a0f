"""C source of the contract around a method: one step with explicit state, from templates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

from vehest.data.channels import CHANNELS
from vehest.export.literals import braced, limit, truths, whole
from vehest.export.rendering import Precision, ascii_only, render
from vehest.export.tables import band_table, front_end_table, guard_table, health_table
from vehest.trust import health_kernel, verdict, watch
from vehest.trust.contract import GuardedStepper
from vehest.trust.guard import BRIDGED_SECONDS, STANDSTILL_SPEED, STANDSTILL_YAW_RATE

KINDS = (
    "FREE",
    "FROZEN",
    "HELD",
    "JUMP",
    "OFFSET",
    "SCALE",
    "SIGN",
    "UNIT",
    "CONTRADICTION",
    "OUTSIDE",
    "MISSING",
    "SPIN",
    "LOCKED",
    "DROPOUT",
    "LATE",
)


def brief(value: float) -> str:
    """A number as people write it, with a decimal point."""
    text = f"{value:.12g}"
    return text if any(c in text for c in ".en") else f"{text}.0"


def estimator_files(stepper: GuardedStepper, precision: Precision, title: str, notes: Sequence[str]) -> dict[str, str]:
    """Files of the contract around a method.

    Args:
        stepper: in its initial state; what it holds is written.
        precision: of ``vehest_real``.
        title: what is estimated by what, for the banners.
        notes: of the method, for the banners too.

    Returns:
        name -> text of ``vehest_types.h``, ``vehest_estimator.h/.c`` and, with health of channels, ``vehest_health.h/.c``.
    """
    context = context_of(stepper, precision, title, notes)
    wanted = {"vehest_types.h": "types.h.j2", "vehest_estimator.h": "estimator.h.j2", "vehest_estimator.c": "estimator.c.j2"}
    if context["health"] is not None:
        wanted |= {"vehest_health.h": "health.h.j2", "vehest_health.c": "health.c.j2"}
    return {name: render(template, precision, **context) for name, template in wanted.items()}


def context_of(stepper: GuardedStepper, precision: Precision, title: str, notes: Sequence[str]) -> dict[str, Any]:
    """What the templates of the contract are filled in with."""
    estimator, monitor, guard = stepper.estimator, stepper._monitor, stepper._guard
    rate, front = float(estimator.settings.rate_hz), stepper._front
    top_speed, largest_tan, _, interval = stepper._watch._settings.tolist()
    guards = [(guard_table(guard), "", "Limits at the method's rate.")]
    if front is not None:
        guards.append((guard_table(front._guard), "BUS_", "Limits at the bus's rate."))
    health, number = health_table(monitor._health), partial(limit, precision=precision)
    return {
        "title": ascii_only(title),
        "notes": [ascii_only(note) for note in notes],
        "channels": [(name, ascii_only(CHANNELS[name].meaning)) for name in estimator.channels],
        "names": list(estimator.channels),
        "skippable": [name in estimator.skippable for name in estimator.channels],
        "numbers": monitor._numbers,
        "rate_hz": rate,
        "input_rate_hz": float(stepper._rate),
        "horizon_steps": estimator.horizon_steps,
        "warm_up_steps": estimator.warm_up_steps,
        "guards": guards,
        "standstill_speed": STANDSTILL_SPEED,
        "standstill_yaw_rate": STANDSTILL_YAW_RATE,
        "front": front_end_table(front) if front is not None else None,
        "interval": interval,
        "top_speed": top_speed,
        "largest_tan_sideslip": largest_tan,
        "remembering": math.exp(-interval / watch.REMEMBERED_SECONDS),
        "fading": math.exp(-interval / watch.FADE_SECONDS),
        "w": vars(watch),
        "verdict": vars(verdict),
        "kernel": vars(health_kernel),
        "k": vars(health_kernel),
        "kinds": KINDS,
        "health": health,
        "h": health,
        "r": number,
        "reals": lambda values: braced(values, number),
        "whole": whole,
        "truths": truths,
        "brief": brief,
        "starts_anew": monitor._starts_anew,
        "rollback": monitor._rollback,
        "bands": band_table(stepper),
        "most_bridged": math.ceil(BRIDGED_SECONDS * stepper._rate) + 1,
        "pi": math.pi,
    }
