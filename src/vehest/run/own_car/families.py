"""Pipeline of a new car: families.yaml, recordings and values of the car -> sweeps with small budgets, and reasons of the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from vehest.constants import GRAVITY
from vehest.data.contents import Contents
from vehest.data.errors import VehestError
from vehest.estimators.registry import estimator_names
from vehest.run.config import compose_config
from vehest.run.config_files import choices
from vehest.run.usable import car_parameters, usability

STIFFNESS = 10.0  # cornering stiffness of an axle over its load [1/rad], as the baseline data_sheet assumes
HEIGHT = 0.2  # of the centre of gravity over the wheelbase; assumed
PRETRAINED = "training.start_from=pretrained"
PRETRAINED_HZ = 20.0
MINUTES = (0.5, 1.0, 2.0, 5.0)
"""Of reference, parts of the pipeline where there are more."""


@dataclass(frozen=True)
class Plan:
    """Estimators of a pipeline: overrides of each sweep with its description, and estimators left out with what each lacks."""

    sweeps: tuple[tuple[list[str], str], ...]
    lacking: dict[str, str]

    @property
    def estimators(self) -> tuple[str, ...]:
        """Those that are tried."""
        return tuple(name for words, _ in self.sweeps for name in words[0].removeprefix("estimator=").split(","))


def plan_of(contents: Sequence[Contents], vehicle: Mapping[str, float | None]) -> Plan:
    """Sweeps over the families that recordings and values of the car allow.

    Args:
        contents: of the recordings, as the data set makes them.
        vehicle: known values of the car.
    """
    values, sweeps = _car(vehicle), []
    lacking: dict[str, str] = {}
    known = {"learned_ukf_variant"}  # only a paper's study compares it
    for family in yaml.safe_load(Path(__file__).with_name("families.yaml").read_text(encoding="utf-8")):
        names, overrides = family["estimators"], family.get("overrides", "")
        known.update(names)
        if PRETRAINED in overrides and min(own.rate_hz for own in contents) < PRETRAINED_HZ * (1 - 1e-9):
            continue  # the next entry trains the same family from scratch
        unknown = [name for name in ("wheelbase", "mass") if not vehicle[name] and ("{car}" in overrides or f"{{{name}}}" in overrides)]
        car = " ".join(f"{key}={{{key.rpartition('.')[2]}}}" for key in car_parameters(names[0]))
        words = overrides.replace("{car}", car).format(**values).split()
        lacks = {name: f"the car's {' and '.join(unknown)}" if unknown else _lack(name, words, contents) for name in names}
        tried = [name for name in names if not lacks[name]]
        lacking |= {name: lack for name, lack in lacks.items() if lack}
        if tried:
            sweeps.append(([f"estimator={','.join(tried)}", *words], family["about"]))
    others = [name for name in dict.fromkeys((*choices("estimator"), *estimator_names())) if name not in known]
    return Plan(tuple(sweeps), lacking | dict.fromkeys(others, "none of the families tried by default; add it as you need it"))


def _car(vehicle: Mapping[str, float | None]) -> dict[str, str]:
    """Parameters of the car; with wheelbase and mass the others are assumed."""
    wheelbase, mass = vehicle["wheelbase"] or 0.0, vehicle["mass"] or 0.0
    half, stiffness = 0.5 * wheelbase, 0.5 * STIFFNESS * mass * GRAVITY
    values = {"mass": mass, "yaw_inertia": mass * half * half, "cg_height": HEIGHT * wheelbase}
    values |= {"cg_to_front_axle": half, "cg_to_rear_axle": half}
    values |= {"cornering_stiffness_front": stiffness, "cornering_stiffness_rear": stiffness}
    return {name: f"{value:.4g}" for name, value in values.items()} | {"wheelbase": f"{wheelbase:g}"}


def _lack(name: str, words: Sequence[str], contents: Sequence[Contents]) -> str:
    """Channels that an estimator lacks; empty if none."""
    first = [word if "[" in word else word.split(",")[0] for word in words if not word.startswith("seed=")]
    try:
        found = usability(name, compose_config("train", [f"estimator={name}", *first]), contents)
    except VehestError as error:
        return str(error)
    return ", ".join([*found.missing.in_words(), *(f"{channel} without gaps" for channel in found.gaps)]) or found.to_give


def pipeline_of(name: str, plan: Plan, minutes: float) -> dict[str, Any]:
    """A pipeline for study and split of a name: all recordings, then parts with less of the minutes of reference."""
    parts: dict[str, Any] = {"all": {"title": "all recordings", "split": name, "sweeps": [words for words, _ in plan.sweeps]}}
    scratch = ["estimator=ksnn", "estimator.n_local=2", "estimator.n_hidden=2", "training.max_epochs=100"]
    for own in MINUTES if "ksnn" in plan.estimators else ():
        if own < 0.8 * minutes:
            part = {"title": f"{own:g} min of reference", "split": name, "overrides": [f"++split.minutes={own:g}"]}
            parts[f"minutes_{own:g}"] = part | {"sweeps": [["estimator=zero,static_map"], scratch]}
            if any(PRETRAINED in words for words, _ in plan.sweeps):
                tuned = {"title": f"{part['title']}, trained on", "sweeps": [[*scratch, PRETRAINED]]}
                parts[f"minutes_{own:g}_tuned"] = part | tuned
    study = {"study": name, "title": f"Which estimator to trust on {name}", "report": "own_car", "publish": False}
    return study | {"evaluation": {"rate_hz": 20}, "parts": parts}
