"""The report: three choices by simulated cars, and the errors of all steps on the real car."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.evaluation.metrics import Scored
from vehest.evaluation.ranking import BASELINES
from vehest.report import figures
from vehest.report.document import REPORT, Block, Column, Document, Figure, Table, as_code
from vehest.report.style import REFERENCE, fixed, line_of
from vehest.report.template import fill_template
from vehest.studies.artefacts import StudyArtefacts
from vehest_papers.kit.methods import scoring
from vehest_papers.kit.reading import median_and_range
from vehest_papers.sim_to_real.spread import Spread, spread_figure
from vehest_papers.sim_to_real.steps import (
    ADDED,
    METRICS,
    Choice,
    Step,
    choices_of,
    real_test,
    steps_of,
)

TEMPLATE = Path(__file__).with_name("report.md.j2")
SHIPPED = "third"
"""Choice whose model comes with vehest."""
REQUIRED_FVU = 0.10
GOAL_FVU = 0.06
TRACE_SECONDS = 60.0
PUBLISHED = (
    ("KS-NN trained on another real car", 0.145),
    ("KS-NN trained on the same real car", 0.06),
)
"""FVU on a real Ferrari 250 LM in Da Lio et al. 2023, on two recordings of it, one of which is used
here."""
CHANGES = (("wide", "fast"), ("fast", "rough"), ("more", "level"))
"""Pairs of parts of which one condition of the training differs."""
OVERVIEW_CAPTION = (
    "Errors of all steps on simulated cars, and on the whole recording of the real Ferrari: "
    "medians over seeds, for FVU also the lowest and highest. β₁(0): weight of the integrated "
    "acceleration at zero yaw rate (Eq. 7a). Below: baselines, and two values of Da Lio et al. "
    "2023."
)
SPREAD_CAPTION = (
    "Unexplained fraction of the variance of v (FVU) on the real Ferrari, every seed. In brackets: "
    "first, second and third choice. Diamonds: the seed with the lowest error on the simulated "
    "cars that choose; ticks: medians."
)
COLUMNS = {
    "step": Column("trained on: estimator"),
    "recordings": Column("drives", decimals=0),
    "validation_rmse_vy": Column("RMSE(v) [m/s], validation cars", decimals=3),
    "race_cars_rmse_vy": Column("race cars", decimals=3),
    "other_simulator_rmse_vy": Column("other simulation", decimals=3),
    "other_simulator_fvu": Column("FVU, other simulation", decimals=2),
    "chosen": Column("choice"),
    "fvu_median": Column("FVU, real", decimals=3),
    "fvu_min": Column("lowest", decimals=3),
    "fvu_max": Column("highest", decimals=3),
    "rmse_vy": Column("RMSE(v) [m/s], real", decimals=3),
    "rmse_sideslip": Column("RMSE(β) [deg], real", decimals=3),
    "weight": Column("β₁(0)", decimals=2),
}


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises
    ------
    DataError
        The steps were not validated on the same ranges, or not on simulated cars alone.
    """
    all_steps = steps_of(artefacts)
    steps = [step for step in all_steps if step.models[0].estimator not in BASELINES]
    baselines = [step for step in all_steps if step.models[0].estimator in BASELINES]
    choices = choices_of(steps)
    blocks: list[Block] = [
        _overview(steps, choices, baselines),
        _spread(steps, choices),
        _traces(choices[SHIPPED]),
    ]
    filled = fill_template(TEMPLATE, _values(artefacts, steps, choices), blocks)
    return {REPORT: Document(artefacts.title, filled, {"budgets": _budgets(artefacts)})}


def _values(
    artefacts: StudyArtefacts, steps: Sequence[Step], choices: Mapping[str, Choice]
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    planned = [step for step in steps if step.part not in ADDED]
    best = min(planned, key=lambda step: step.fvu)
    other_fvus = [step.other_fvu for step in steps if np.isfinite(step.other_fvu)]
    shipped = choices[SHIPPED]
    return {
        "choices": {name: _values_of_choice(choice) for name, choice in choices.items()},
        "required": f"{REQUIRED_FVU:.2f}",
        "goal": f"{GOAL_FVU:.2f}",
        "n_planned": len(planned),
        "n_within": sum(step.fvu <= REQUIRED_FVU for step in planned),
        "best": {"part": best.part, "fvu": fixed(best.fvu, 3)},
        "shipped": {
            "seed": shipped.model.seed,
            **{metric: fixed(shipped.step.test[metric][shipped.seed], 3) for metric in METRICS},
        },
        "n_other": len(other_fvus),
        "n_worse_than_zero": sum(fvu > 1.0 for fvu in other_fvus),
        "correlations": _rank_correlations(steps),
        "changes": _changes(steps),
        "scoring": scoring(artefacts.first),
        "command": as_code(artefacts.command),
    }


def _values_of_choice(choice: Choice) -> dict[str, object]:
    test = choice.step.test
    return {
        "label": f"`{choice.step.part}`, {choice.model.title}",
        "n_seeds": len(test["fvu"]),
        "fvu": fixed(choice.step.fvu, 3),
        "fvu_range": median_and_range(test["fvu"], 3),
        "meets": choice.step.fvu <= REQUIRED_FVU,
        "rmse_vy": fixed(float(np.median(test["rmse_vy"])), 3),
        "rmse_sideslip": fixed(float(np.median(test["rmse_sideslip"])), 3),
    }


def _rank_correlations(steps: Sequence[Step]) -> list[str]:
    """Over steps, between RMSE(v) on the cars of each choice and FVU on the real car."""
    criteria = pd.DataFrame([step.median_criteria for step in steps])
    real = pd.Series([step.fvu for step in steps])
    return [
        fixed(float(criteria[place].rank().corr(real.where(criteria[place].notna()).rank())), 2)
        for place in criteria
    ]


def _changes(steps: Sequence[Step]) -> dict[str, dict[str, str]]:
    """Later part of `CHANGES` -> errors before and after; empty unless all of these are there."""
    variant = steps[0].models[0].variant
    by_part = {step.part: step for step in steps if step.models[0].variant == variant}
    if not {part for pair in CHANGES for part in pair} <= set(by_part):
        return {}
    changes = {}
    for before, after in CHANGES:
        first, second = by_part[before], by_part[after]
        validation = [fixed(step.median_criteria[0], 3) for step in (first, second)]
        real = [fixed(step.fvu, 3) for step in (first, second)]
        changes[after] = {"validation": " → ".join(validation), "real": " → ".join(real)}
    return changes


def _budgets(artefacts: StudyArtefacts) -> pd.DataFrame:
    """What is stated of the trainings and recordings of each part."""
    rows = [
        {"part": name, "fact": fact}
        for name, part in artefacts.parts.items()
        for fact in part.facts
    ]
    return pd.DataFrame(rows, columns=["part", "fact"])


def _overview(
    steps: Sequence[Step], choices: Mapping[str, Choice], baselines: Sequence[Step]
) -> Table:
    rows = [_overview_row(step, choices) for step in (*steps, *baselines)]
    rows += [
        {"part": "paper", "step": f"paper: {title}", "chosen": "", "fvu_median": fvu}
        for title, fvu in PUBLISHED
    ]
    return Table("overview", OVERVIEW_CAPTION, pd.DataFrame(rows), COLUMNS)


def _overview_row(step: Step, choices: Mapping[str, Choice]) -> dict[str, object]:
    recordings = {(span.dataset, span.recording) for span in step.artefacts.split.train}
    validation, race_cars, other_simulator = step.median_criteria
    row: dict[str, object] = {
        "part": step.part,
        "step": step.label,
        "chosen": ", ".join(name for name, choice in choices.items() if choice.step is step),
        "added": step.part in ADDED,
        "recordings": len(recordings),
        "seeds": len(step.models),
        "validation_rmse_vy": validation,
        "race_cars_rmse_vy": race_cars,
        "other_simulator_rmse_vy": other_simulator,
        "other_simulator_fvu": step.other_fvu,
        "weight": float(np.median(step.weight)),
        "fvu_median": step.fvu,
        "fvu_min": step.test["fvu"].min(),
        "fvu_max": step.test["fvu"].max(),
        "rmse_vy": float(np.median(step.test["rmse_vy"])),
        "rmse_sideslip": float(np.median(step.test["rmse_sideslip"])),
    }
    shipped = choices[SHIPPED]
    if step is shipped.step:
        row |= {f"model_{metric}": step.test[metric][shipped.seed] for metric in METRICS}
        row |= {"model_seed": shipped.model.seed, "model": shipped.model.model_folder.name}
    return row


def _spread(steps: Sequence[Step], choices: Mapping[str, Choice]) -> Figure:
    rows = []
    for step in steps:
        names = [name for name, choice in choices.items() if choice.step is step]
        seed = choices[names[0]].seed if names else int(np.argmin(step.validation["rmse_vy"]))
        model = step.models[0]
        title = model.title.removeprefix("KS-NN ").replace(" no bias", "")
        label = f"{step.part}, {title}" + (f" ({', '.join(names)})" if names else "")
        line = line_of(model.estimator, model.variant)
        rows.append(Spread(label, line, step.test["fvu"], float(step.test["fvu"][seed])))
    return Figure("spread", SPREAD_CAPTION, spread_figure(rows, "FVU on the real car"))


def _traces(choice: Choice) -> Figure:
    model = choice.model
    artefacts = choice.step.artefacts
    (scored,) = artefacts.scored(model, real_test(artefacts))
    window = _busiest(scored, round(TRACE_SECONDS * artefacts.protocol.rate_hz))
    reference = figures.Traces(
        "measured", REFERENCE, scored.vy_ref[window], np.degrees(scored.sideslip_ref[window])
    )
    estimate = figures.Traces(
        model.title,
        line_of(model.estimator, model.variant),
        scored.vy[window],
        np.degrees(scored.sideslip[window]),
    )
    caption = (
        "Lateral velocity and sideslip angle of the real Ferrari. Black: measured; coloured: seed "
        f"{model.seed}, trained on simulated cars alone; the {TRACE_SECONDS:.0f} s with the "
        "largest mean square of the measured sideslip."
    )
    drawn = figures.zoom_figure(
        scored.time[window], scored.ay[window], reference, [estimate], "time [s]"
    )
    return Figure("traces", caption, drawn)


def _busiest(scored: Scored, n_samples: int) -> slice:
    """Consecutive samples with the largest mean square of the reference sideslip."""
    length = min(n_samples, len(scored.time))
    power = np.convolve(np.square(scored.sideslip_ref), np.ones(length), mode="valid")
    first = int(power.argmax())
    return slice(first, first + length)
