"""The pipeline that `vehest new` writes: every family that the channels allow, most expected first, each with a small budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vehest.constants import GRAVITY
from vehest.data.contents import Contents
from vehest.data.errors import VehestError
from vehest.estimators.registry import estimator_names
from vehest.run.config import compose_config
from vehest.run.config_files import choices
from vehest.run.new_car import Vehicle
from vehest.run.usable import Usability, usability

STIFFNESS = 10.0  # cornering stiffness of an axle over its load [1/rad], as the baseline data_sheet assumes
HEIGHT = 0.2  # of the centre of gravity over the wheelbase; assumed


@dataclass(frozen=True)
class Family:
    """How a family is tried.

    Args:
        name: of the estimator, or of several that are tried alike.
        settings: overrides of its own.
        budget: overrides that bound its training.
        about: what it is, for the comment.
        car: parameters of the car that it wants.
        seeds: how many.
    """

    name: str
    settings: tuple[str, ...] = ()
    budget: tuple[str, ...] = ()
    about: str = ""
    car: tuple[str, ...] = ()
    seeds: int = 1


INERTIA = ("mass", "yaw_inertia", "cg_to_front_axle", "cg_to_rear_axle")
STIFF = (*INERTIA, "cornering_stiffness_front", "cornering_stiffness_rear")
IMU = "estimator.inputs=imu"
SEARCH = ("training.method=nelder_mead", "training.grid=1", "training.max_evaluations=40")
IDENTIFIED = (
    *("training.identification.method=nelder_mead", "training.identification.grid=1", "training.identification.max_evaluations=40"),
    *("training.identification.tyres_from='*'", "training.identification.restarts=1", "training.identification.generations=60"),
)
DUGOFF = (*SEARCH, "training.tyres_from='*'", "training.restarts=1", "training.generations=60")
SHIPPED = ("estimator.n_local=2", "estimator.n_hidden=2")
"""Settings of the KS-NN that comes with vehest."""
SHIPPED_RATE = 20.0  # Hz
MINUTES = (0.5, 1.0, 2.0, 5.0)
"""Of reference, that the curve is made of, where there are more."""
FAMILIES = (
    Family("zero", about="baselines: v = 0, two numbers, leaky integration; seconds"),
    Family("static_map"),
    Family("kinematic"),
    Family("data_sheet", about="baseline: steady cornering from the data sheet"),
    Family(
        "ksnn",
        SHIPPED,
        ("training.start_from=pretrained", "training.max_epochs=100"),
        "the network that comes with vehest, trained on; half a minute",
        seeds=2,
    ),
    Family(
        "ksnn",
        ("estimator.n_hidden=0,2", "estimator.bias=true"),
        ("training.max_epochs=100",),
        "the same family from scratch; a minute",
        seeds=2,
    ),
    Family("luenberger", (), ("training.grid=2", "training.max_evaluations=100"), "observer; a minute"),
    Family("kalman", (), (), "Kalman filter over a single track; nothing is learnt but noise levels", STIFF),
    Family("rational_ekf", (), ("training.grid=1", "training.max_evaluations=40"), "filter whose tyres adapt; a minute", STIFF),
    Family("gru", ("estimator.n_states=5",), ("training.max_epochs=100",), "recurrent networks; minutes", seeds=2),
    Family("lstm", ("estimator.n_states=5",), ("training.max_epochs=100",), seeds=2),
    Family("sideslip_ffnn", (IMU,), ("training.phase.max_epochs=100",), "feed-forward network over single samples; a minute"),
    Family("dugoff_ukf", (IMU,), DUGOFF, "unscented filter with Dugoff tyres; minutes", (*INERTIA, "cg_height")),
    Family("factor_graph", ("estimator.window=0.5",), (), "factor graph over half a second, causal; nothing is learnt", STIFF),
    Family(
        "velocity_gru",
        ("estimator.inputs=[yaw_rate,ax,ay,vx,steer]", "estimator.outputs=[vy]", "estimator.rate_hz=20"),
        ("training.phase.max_epochs=100",),
        "recurrent networks over all samples so far; minutes",
    ),
    Family(
        "velocity_lstm",
        ("estimator.inputs=[yaw_rate,ax,ay,vx,steer]", "estimator.outputs=[vy]", "estimator.rate_hz=20"),
        ("training.phase.max_epochs=100",),
    ),
    Family("ensemble_ukf", (IMU, "estimator.members=5"), IDENTIFIED, "filter with an ensemble's angle; minutes", (*INERTIA, "cg_height")),
    Family(
        "cnn_ukf",
        (IMU,),
        (*IDENTIFIED, "training.end_to_end.max_epochs=20"),
        "network trained through its filter; ten minutes and more",
        (*INERTIA, "cg_height"),
    ),
    Family(
        "learned_ukf",
        (),
        ("training.through.max_epochs=50",),
        "filter whose dynamics are learnt, of electric cars; long",
        ("mass", "wheelbase"),
    ),
)
"""In the order of what is expected of them on a car that nobody knows, cheap ones before dear ones of the same promise."""

OF_STUDIES = {"learned_ukf_variant"}
"""Variants of a family that only the study of its paper compares."""


@dataclass(frozen=True)
class Plan:
    """What a pipeline tries, and what it leaves out.

    Args:
        sweeps: overrides of each sweep with what it is, in order.
        lacking: estimator -> what it lacks.
    """

    sweeps: tuple[tuple[tuple[str, ...], str], ...]
    lacking: dict[str, str]

    @property
    def estimators(self) -> tuple[str, ...]:
        """Those that are tried."""
        words = [word.removeprefix("estimator=").split(",") for sweep, _ in self.sweeps for word in sweep if word.startswith("estimator=")]
        return tuple(name for names in words for name in names)


def plan_of(contents: Sequence[Contents], vehicle: Vehicle) -> Plan:
    """Families that recordings allow, and what the others lack.

    Args:
        contents: of the recordings, as the data set makes them.
        vehicle: what is known of the car.
    """
    sweeps: list[tuple[tuple[str, ...], str]] = []
    lacking: dict[str, str] = {}
    for family in FAMILIES:
        car, wanted = _car(family, vehicle)
        settings = [*family.settings, *car]
        lack = wanted or _lack(family.name, settings, contents)
        if not lack and family.settings == SHIPPED and not _takes_shipped(contents):
            continue  # the same family stands below, from scratch
        if lack:
            lacking[family.name] = lack
            continue
        seeds = (f"seed=range({family.seeds})",) if family.seeds > 1 else ()
        own = (f"estimator={family.name}", *settings, *family.budget, *seeds)
        before = sweeps[-1][0] if sweeps else ()
        if before[1:] == own[1:] and before:  # several that are tried alike
            sweeps[-1] = ((f"{before[0]},{family.name}", *own[1:]), sweeps[-1][1])
        else:
            sweeps.append((own, family.about))
    lacking = {name: what for name, what in lacking.items() if not any(name in sweep[0].split("=")[1].split(",") for sweep, _ in sweeps)}
    known = {family.name for family in FAMILIES} | OF_STUDIES
    for name in dict.fromkeys((*choices("estimator"), *estimator_names())):
        if name not in known:
            lacking[name] = "not one of vehest's own families; add it as you need it"
    return Plan(tuple(sweeps), lacking)


def _takes_shipped(contents: Sequence[Contents]) -> bool:
    """Whether recordings come at the rate of the model that comes with vehest, or faster."""
    return all(own.rate_hz >= SHIPPED_RATE * (1 - 1e-9) for own in contents)


def _car(family: Family, vehicle: Vehicle) -> tuple[list[str], str]:
    """Overrides of the car's parameters, and what of the vehicle is missing for them."""
    if family.name == "data_sheet":
        return ([f"estimator.wheelbase={vehicle.wheelbase:g}"], "") if vehicle.wheelbase else ([], "the car's wheelbase")
    if not family.car:
        return [], ""
    if not (vehicle.wheelbase and vehicle.mass):
        what = [name for name, value in (("wheelbase", vehicle.wheelbase), ("mass", vehicle.mass)) if not value]
        return [], f"the car's {' and '.join(what)}"
    half, mass = 0.5 * vehicle.wheelbase, vehicle.mass
    stiffness = 0.5 * STIFFNESS * mass * GRAVITY
    values = {
        "mass": mass,
        "wheelbase": vehicle.wheelbase,
        "yaw_inertia": mass * half * half,
        "cg_to_front_axle": half,
        "cg_to_rear_axle": half,
        "cg_height": HEIGHT * vehicle.wheelbase,
        "cornering_stiffness_front": stiffness,
        "cornering_stiffness_rear": stiffness,
    }
    return [f"estimator.car.{name}={values[name]:.4g}" for name in family.car], ""


def _lack(name: str, settings: Sequence[str], contents: Sequence[Contents]) -> str:
    """What an estimator lacks of recordings, for people; empty if nothing."""
    single = [word.split(",")[0] if "[" not in word else word for word in settings]
    try:
        found = usability(name, compose_config("train", [f"estimator={name}", *single]), contents)
    except VehestError as error:
        return str(error)
    return "" if found.usable != "no" and not _unmet(found) else _in_words(found)


def _unmet(found: Usability) -> bool:
    """Whether a channel is missing; patterns of training recordings are given with the budget."""
    return bool(found.missing or found.gaps)


def _in_words(found: Usability) -> str:
    parts = []
    for missing in found.missing:
        made = f" ({missing.supply.in_words()})" if missing.supply is not None else ""
        parts.append(f"{missing.channel}{'' if missing.to_estimate else ' to learn from'}{made}")
    parts += [f"{name} without gaps" for name in found.gaps]
    return ", ".join(parts) or found.to_give or "more than these recordings have"


def pipeline_text(name: str, plan: Plan, minutes: float, *, assumed: bool) -> str:
    """A file in pipelines/.

    Args:
        name: of the study and of its split.
        plan: what it tries.
        minutes: of reference to learn and to stop by.
        assumed: whether parameters of the car were made of wheelbase and mass.
    """
    lines = [
        f"# What is tried on {name}: every family that its channels allow, the most promising first, with small budgets. Run it by",
        f"#   vehest run {name} --minutes 15",
        "# which does as much as fits, and goes on when it is run again. Lines may go, budgets may grow (training.max_epochs=1000 is what",
        "# the papers' comparisons use); what is done is not done again.",
    ]
    if assumed:
        lines += [
            "# The car's parameters are made of wheelbase and mass: centre of gravity in the middle and at 0.2·L, yaw inertia m·(L/2)²,",
            "# cornering stiffness of an axle 10/rad times its load. Write yours where you know them.",
        ]
    lines += [f"study: {name}", f"title: Which estimator to trust on {name}", "report: own_car", "publish: false"]
    lines += ["evaluation:", "  rate_hz: 20                                # every estimate is read at this rate", "parts:"]
    lines += ["  all:", "    title: all recordings", f"    split: {name}", "    sweeps:"]
    for sweep, about in plan.sweeps:
        lines += [f"      # {about}"] if about else []
        lines.append(_sweep(sweep))
    if plan.lacking:
        lines.append("  # Left out, with what each lacks:")
        lines += [f"  #   {own}: {what}" for own, what in plan.lacking.items()]
    return "\n".join([*lines, *_curve(name, plan, minutes), ""])


def _curve(name: str, plan: Plan, minutes: float) -> list[str]:
    """Parts with less reference: the network that comes with vehest, the same from scratch, and two numbers."""
    fewer = [own for own in MINUTES if own < 0.8 * minutes]
    if not fewer or "ksnn" not in plan.estimators:
        return []
    scratch = ("estimator=ksnn", *SHIPPED, "training.max_epochs=100")
    shipped = any("training.start_from=pretrained" in sweep for sweep, _ in plan.sweeps)
    lines = ["  # How many minutes of reference are needed: the same test, less to learn from."]
    for own in fewer:
        head = [f"    split: {name}", f"    overrides: [++split.minutes={own:g}]", "    sweeps:"]
        lines += [f"  minutes_{own:g}:", f"    title: {own:g} min of reference", *head]
        lines += [_sweep(("estimator=zero,static_map",)), _sweep(scratch)]
        if shipped:
            tuned = (*scratch, "training.start_from=pretrained")
            lines += [f"  minutes_{own:g}_tuned:", f"    title: {own:g} min of reference, trained on", *head, _sweep(tuned)]
    return lines


def _sweep(words: Sequence[str]) -> str:
    return f"      - [{', '.join(_quoted(word) for word in words)}]"


def _quoted(word: str) -> str:
    return f'"{word}"' if any(mark in word for mark in ",[]{}'*") else word
