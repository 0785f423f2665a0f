"""Sources of an export, as text.

The method, the contract around it with explicit state, and a program.

Numbers are read from a `GuardedStepper` itself, so that C and Python hold the same, to the last
bit.

    `GuardedStepper` --method_files--> vehest_method.h, .c
                     --context_of--> vehest_types.h, vehest_health.*, vehest_estimator.*
                     --> main.c, Makefile
"""

from __future__ import annotations

import math
import sys
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data import derived
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator
from vehest.estimators.registry import estimator_classes
from vehest.export.rendering import (
    Precision,
    ascii_only,
    bool_table,
    braced,
    integer_table,
    limit,
    render,
    render_block,
)
from vehest.trust import bands as band_rules
from vehest.trust import clock, health_kernel, verdict
from vehest.trust.contract import GuardedStepper
from vehest.trust.front_end import CUTOFF, FrontEnd
from vehest.trust.guard import (
    ENDLESS,
    STANDSTILL_SPEED,
    STANDSTILL_YAW_RATE,
    Guard,
)
from vehest.trust.health_kernel import Layout, Model
from vehest.trust.named_arrays import views
from vehest.trust.tyre_check import FRICTION_SLIP

TOLERANCES = {"double": 1e-9, "float": 1e-3}
"""Precision -> largest difference of the outputs of the test vectors from Python's [m/s, rad]."""
NEVER = "UINT32_MAX"  # C literal of a run length that is never reached
MAX_RATIO_DENOMINATOR = 1_000_000  # largest denominator of the ratio of rates
# names of constants of `vehest.trust.health_kernel` that the templates use
HEALTH_CONSTANTS = (
    *("PLAUSIBLE", "CLIP", "STEP_CLIP", "CALM", "CAP", "INVALID", "CLEAR"),
    *("BRAKING", "SLIPPING", "LOST", "REVERSED", "HOLDS", "LARGER", "SLIDE_SECONDS"),
    *("INSTANT_FEATURES", "FIRST_SMALL", "N_LEVELS"),
    *("FREE", "MISSING", "FROZEN", "HELD", "JUMP", "OFFSET", "SIGN", "UNIT", "CONTRADICTION"),
    *("OUTSIDE", "SPIN", "LOCKED", "DROPOUT"),
)
# names of constants of `vehest.trust.verdict` that the templates use
VERDICT_CONSTANTS = ("BAND_FACTORS", "WIDEST", "NO_ESTIMATE", "BEYOND_SPEED", "TOO_WIDE")
CLOCK_CONSTANTS = (
    *("CLOCK_STOPPED", "CLOCK_JUMPED", "CLOCK_UNEVEN", "REPEATED", "STOPPED", "EVEN_INTERVALS"),
    *("MIN_ADVANCE", "FAULT_SECONDS", "RECOVERY_SECONDS", "RESET_SECONDS"),
)
"""Names of constants of `vehest.trust.clock` that the templates use."""


def brief(value: float) -> str:
    """Text of a number with a decimal point, up to twelve digits."""
    text = f"{value:.12g}"
    return text if any(c in text for c in ".en") else f"{text}.0"


def method_files(estimator: Estimator, precision: Precision) -> dict[str, str]:
    """Header and source of a fitted estimator's method, by the family's template; name -> text.

    Raises `ConfigurationError`: the family has no C, or the estimator is not causal or not fitted.

    Parameters
    ----------
    estimator : Estimator
        Fitted and causal; its ``c_values`` fill the template.
    precision : Precision
        Type of ``vehest_real``.
    """
    if not estimator.template:
        raise ConfigurationError(
            f"estimator '{estimator.name}' cannot be exported to C; these can: "
            f"{', '.join(exportable())}; a class of your own needs 'template' and 'c_values' "
            "(docs/adding_an_estimator.md)"
        )
    estimator.online()  # raises where it is not causal, or not fitted
    path = f"methods/{estimator.template}.c.j2"
    beside = Path(str(sys.modules[type(estimator).__module__].__file__)).parent
    values = {
        "title": ascii_only(estimator.full_title),
        "family": estimator.name,
        "variant": estimator.variant,
        "rate_hz": estimator.settings.rate_hz,
        "horizon_steps": estimator.horizon_steps,
        "skippable": estimator.skippable,
        "channels": channels_of(estimator),
        **estimator.c_values(),
        "refuses_nan": [
            name
            for name in estimator.channels
            if "NaN" in estimator.refuses and name not in estimator.skippable
        ],
        "refuses_infinite": estimator.channels if "infinite" in estimator.refuses else (),
        "notes": estimator.notice,
        "checks_tyres": estimator.training_friction is not None,
    }
    state = render_block(path, "state", precision, beside, **values).rstrip()
    header = render("method.h.j2", precision, **values, state=state)
    return {"vehest_method.h": header, "vehest_method.c": render(path, precision, beside, **values)}


def exportable() -> tuple[str, ...]:
    """Names of families that have C."""
    return tuple(name for name, family in estimator_classes().items() if family.template)


def channels_of(estimator: Estimator) -> list[tuple[str, str]]:
    """Channels that an estimator reads: name and meaning of each, in ASCII."""
    return [(name, ascii_only(CHANNELS[name].meaning)) for name in estimator.channels]


def program_files(stepper: GuardedStepper, precision: Precision, title: str) -> dict[str, str]:
    """Sources that build anywhere: the method, the contract around it, and `main`, name -> text.

    Parameters
    ----------
    stepper : GuardedStepper
        In its initial state; what it holds is written.
    precision : Precision
        Of ``vehest_real``.
    title : str
        What is estimated by what, for the banners.

    Raises
    ------
    ConfigurationError
        The estimator cannot be written in C.
    """
    files = method_files(stepper.estimator, precision)
    context = context_of(stepper, precision, title)
    contract_files = [
        "types.h",
        "estimator.h",
        "estimator.c",
        *(["health.h", "health.c"] if context["h"] is not None else []),
    ]
    files |= {
        f"vehest_{name}": render(f"{name}.j2", precision, **context) for name in contract_files
    }
    values = {
        "names": context["names"],
        "tolerance": TOLERANCES[precision],
        "exact": precision == "double",
        "notes": context["notes"],
        "sources": sorted(name for name in files if name.endswith(".c")),
    }
    # files hold double, whatever the model computes in
    files["main.c"] = render("main.c.j2", "double", **values)
    files["Makefile"] = render("makefile.j2", "double", **values)
    return files


def context_of(stepper: GuardedStepper, precision: Precision, title: str) -> dict[str, Any]:
    """Variables of the contract's templates.

    Parameters
    ----------
    stepper : GuardedStepper
        In its initial state; guard, front end, watch, health, bands and clock are read from it.
    precision : Precision
        By which limits become literals.
    title : str
        For the banners; characters beyond ASCII are replaced.
    """
    estimator = stepper.estimator
    monitor = stepper.monitor
    rate = float(estimator.settings.rate_hz)
    front = stepper.front_end
    guards = [(guard_table(stepper.guard), "", "Limits at the method's rate.")]
    if front is not None:
        guards.append((guard_table(front.guard), "BUS_", "Limits at the bus's rate."))
    health = health_table(monitor.packed_health)
    number = partial(limit, precision=precision)
    return {
        "title": ascii_only(title),
        "notes": [ascii_only(note) for note in estimator.notice],
        "channels": channels_of(estimator),
        "names": list(estimator.channels),
        "skippable": [name in estimator.skippable for name in estimator.channels],
        "numbers": monitor.channel_numbers,
        "rate_hz": rate,
        "input_rate_hz": float(stepper.input_rate_hz),
        "horizon_steps": estimator.horizon_steps,
        "warm_up_steps": estimator.warm_up_steps,
        "guards": guards,
        "no_sideslip_speed": derived.STANDSTILL_SPEED,
        "standstill_speed": STANDSTILL_SPEED,
        "standstill_yaw_rate": STANDSTILL_YAW_RATE,
        "front": front_end_table(front) if front is not None else None,
        "watch": stepper.watch.c_values(),
        "clock": stepper.clock,
        "clock_rules": {name: getattr(clock, name) for name in CLOCK_CONSTANTS},
        "verdict": {name: getattr(verdict, name) for name in VERDICT_CONSTANTS},
        "k": {name: getattr(health_kernel, name) for name in HEALTH_CONSTANTS},
        "h": health,
        "r": number,
        "reals": lambda values: braced(values, number),
        "integer_table": integer_table,
        "bool_table": bool_table,
        "brief": brief,
        "starts_anew": monitor.starts_anew,
        "adapts": monitor.adapts,
        "persistent_steps": monitor.persistent_steps,
        "bands": band_table(stepper),
        "checks_tyres": estimator.training_friction is not None,
        "pi": math.pi,
    }


def guard_table(guard: Guard) -> dict[str, Any]:
    """Limits of each channel, longest runs, bridged samples, and samples that confirm a new level,
    for the template.

    A row of limits is low, high, jump, lower and upper stop.

    Infinite runs become `NEVER`, and limits beyond `ENDLESS` infinity.
    """
    runs = [NEVER if math.isinf(run) else f"{math.floor(run)}U" for run in guard.limits[:, 3]]
    limits = _endless(guard.limits[:, [0, 1, 2, 4, 5]]).tolist()
    return {
        "limits": limits,
        "runs": runs,
        "bridged": guard.bridged_samples,
        "persists": guard.persistent_samples,
    }


def _endless(values: FloatArray) -> FloatArray:
    """The values with infinity in place of `ENDLESS`."""
    return np.where(np.abs(values) >= ENDLESS, np.copysign(np.inf, values), values)


def front_end_table(front: FrontEnd) -> dict[str, Any]:
    """Sections of the low-pass, and the ratio of rates, for the template.

    The ratio of the rates is the nearest fraction with a denominator of at most
    `MAX_RATIO_DENOMINATOR`: ``of`` rows are made of ``every`` samples.
    """
    ratio = Fraction(front.ratio).limit_denominator(MAX_RATIO_DENOMINATOR)
    rate = front.ratio * front.guard.rate_hz
    return {
        "sections": front.sections.tolist(),
        "every": ratio.numerator,
        "of": ratio.denominator,
        "delay": front.delay,
        "cutoff": CUTOFF * rate,
    }


def band_table(stepper: GuardedStepper) -> dict[str, Any] | None:
    """Factors, squared floors, weights and domain of the bands; None where none are calibrated."""
    packed = stepper.monitor.packed_bands
    if packed is None:
        return None
    head = packed.numbers[: band_rules.HEAD_LENGTH]
    terms = packed.numbers[band_rules.HEAD_LENGTH :].reshape(3, -1)
    return {
        "factor_vy": head[0],
        "factor_sideslip": head[1],
        "floor_vy": head[2],
        "floor_sideslip": head[3],
        "lowest_speed": head[4],
        "tyre_weight_vy": head[5],
        "tyre_weight_sideslip": head[6],
        "weights_vy": terms[0],
        "weights_sideslip": terms[1],
        "largest": terms[2],
        "terms": ("P", "1", "vx", "ax", "ay", "yaw rate vx", "steer vx", "vy"),
        "first_feature": band_rules.FIRST_FEATURE,
        "farthest": stepper.monitor.largest_vy,
        "tyre_check": stepper.monitor.tyre_check,
        "friction_slip": FRICTION_SLIP,
    }


def health_table(packed: FloatArray | None) -> dict[str, Any] | None:
    """Tables of `vehest.trust.health_kernel` by name; None where no health was calibrated."""
    if packed is None:
        return None
    layout = Layout(*map(int, views(Layout, packed, ())[0]))
    model, _ = views(Model, packed, layout)
    of_model, of_layout, settings = (part._asdict() for part in (model, layout, model.settings))
    return {
        **of_model,
        **of_layout,
        **{name: float(value) for name, value in settings.items()},
        "n_statistics": layout.statistics,
        "limits": model.limits.all_values,
        "inverse": model.inverse.all_values,
        "stops": _endless(model.stops),
        "wheels": bool(model.wheel.any()),
    }
