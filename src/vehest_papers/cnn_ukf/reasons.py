"""Whether the paper's picture is found again, and what errors consist of where it is not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.evaluation.manoeuvres import is_nonlinear, kpis_by_group, sideslip_error
from vehest.evaluation.metrics import Scored
from vehest.evaluation.significance import paired_difference
from vehest.report.document import Block, Column, Table
from vehest.report.style import fixed, listed
from vehest.studies.kit.reading import median_and_range
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.subjects import Manoeuvres, Run, Runs, chosen, losses
from vehest_papers.cnn_ukf.tables import medians

OF_FOUR = (paper.MODEL, paper.DATA, paper.DEEP, paper.CNN)
PARTS = (
    (paper.DEEP, paper.MODEL),
    (paper.DEEP, paper.DATA),
    (paper.CNN, paper.SMOOTH),
    (paper.CNN, paper.DATA),
    (paper.SMOOTH, paper.MODEL),
)
"""Hybrids, and what they are made of: the filter that has the same tyres, and a network alone; and the two filters."""


def why(name: str, runs: Runs, title: str, rate_hz: float, data: str) -> list[Block]:
    """The paper's statements beside ours, hybrids beside what they are made of, and what errors consist of.

    Args:
        name: ``full`` or ``limited``.
        runs: of the part.
        title: of the part, for people.
        rate_hz: of what is scored [Hz].
        data: real or simulated.
    """
    if not set(OF_FOUR) <= set(runs):
        return []
    words = "\n".join(f"- {line}" for line in statements(name, runs))
    picked = {candidate: chosen(own) for candidate, own in runs.items()}
    return [
        f"### Is it the paper's picture?\n\n{words}",
        against_parts(runs, f"hybrids_{name}", title, rate_hz, data),
        parts_of_errors(picked, f"parts_{name}", title, data),
        *blend(picked, title),
    ]


def statements(name: str, runs: Runs) -> list[str]:
    """What the paper says of a set, each with ours, from medians of seeds of MSE_nl."""
    ours = medians(runs, "mse_nonlinear")
    known = {candidate: own.mse_nonlinear for candidate, own in paper.TABLES[name].items()}
    order = sorted(OF_FOUR, key=ours.__getitem__)

    def pair(first: str, second: str) -> str:
        there, here = (_beside(of[first], of[second]) for of in (known, ours))
        return f"there {first} {there} {second}, here {here}"

    if name == "full":
        lines = [
            f"Paper: CNN-UKF lowest on MSE_nl ({pair(paper.CNN, paper.DEEP)}). Here lowest of the four is {order[0]}.",
            f"Paper: DE-UKF and the data-driven method level ({pair(paper.DEEP, paper.DATA)}).",
            f"Paper: the model last ({pair(paper.MODEL, paper.DATA)}). Here last of the four is {order[-1]}.",
            _best_groups(runs),
        ]
    else:
        lines = [
            f"Paper: the data-driven method last ({pair(paper.DATA, paper.MODEL)}). Here last of the four is {order[-1]}.",
            f"Paper: the hybrids a hair below the model, which the paper calls not significant ({pair(paper.DEEP, paper.MODEL)}; "
            f"{pair(paper.CNN, paper.MODEL)}).",
        ]
    if paper.SMOOTH in ours:
        lines.append(f"Not in the paper: CNN-UKF {_beside(ours[paper.CNN], ours[paper.SMOOTH])} its own filter without the network.")
    lines.append(_end_to_end(runs[paper.CNN]))
    return [*lines, "All of medians of seeds; which differences are more than chance, the tables of differences say."]


def _end_to_end(runs: Sequence[Run]) -> str:
    """Whether training through the filter lowered the error on validation."""
    lowered, kept, best = 0, [], []
    for run in runs:
        fit, history = run.model.fit_metrics(), run.model.history()
        lowered += fit.get("best_epoch", 0.0) > 0.0
        kept.append(np.degrees(np.degrees(fit.get("best_validation_loss", math.nan))))
        if history is not None and "phase" in history:
            best.append(np.degrees(np.degrees(history[history["phase"] == history["phase"].max()]["validation_loss"].min())))
    here = f"Here it lowers the filter's MSE on the validation manoeuvres in {lowered} of {len(runs)} seeds"
    found = f"kept are networks with {_range(kept)} deg², the best after an epoch of it have {_range(best)} deg²"
    return f"Paper: end-to-end training lowers the error. {here}; {found}."


def _range(values: Sequence[float]) -> str:
    return median_and_range(np.array(values, dtype=np.float64), 4)


def _best_groups(runs: Runs) -> str:
    """In how many groups CNN-UKF is the best of the four."""
    of = {candidate: [kpis_by_group(run.test) for run in runs[candidate]] for candidate in OF_FOUR}
    groups = list(of[paper.CNN][0])
    best = [
        group
        for group in groups
        if min(OF_FOUR, key=lambda own, group=group: float(np.median([seed[group].mse_nonlinear for seed in of[own]]))) == paper.CNN  # type: ignore[misc]
    ]
    named = f" ({listed(best)})" if best else ""
    here = f"Here in {len(best)} of {len(groups)}{named}, by the median of seeds of MSE_nl."
    return f"Paper: CNN-UKF best in five of seven groups of manoeuvres. {here}"


def _beside(value: float, other: float) -> str:
    """``is 12 % below``, ``is 3 % above``, ``is level with`` within half a per cent."""
    share = 100.0 * (value / other - 1.0)
    return "is level with" if abs(share) < 0.5 else f"is {fixed(abs(share), 0)} % {'below' if share < 0 else 'above'}"


def against_parts(runs: Runs, name: str, title: str, rate_hz: float, data: str) -> Table:
    """Differences of hybrids from what they are made of, with intervals."""
    rows = []
    by_kpi = {kpi: losses(runs, nonlinear_only=kpi == "mse_nonlinear") for kpi in ("mse", "mse_nonlinear")}
    for first, second in PARTS:
        if first not in runs or second not in runs:
            continue
        row: dict[str, object] = {"first": first, "second": second}
        for kpi, (table, manoeuvre) in by_kpi.items():
            own = paired_difference(table[first], table[second], manoeuvre, rate_hz=rate_hz).mean
            row |= {f"{kpi}_value": own.value, f"{kpi}_low": own.low, f"{kpi}_high": own.high, f"{kpi}_p": own.p_value}
            row[kpi] = f"{fixed(own.value, 3)} [{fixed(own.low, 3)}, {fixed(own.high, 3)}]"
        rows.append(row)
    columns = {
        "first": Column("method"),
        "second": Column("less"),
        "mse": Column("difference of MSE [deg²], 95 % interval"),
        "mse_nonlinear": Column("difference of MSE_nl [deg²], 95 % interval"),
    }
    caption = (
        f"Hybrids less what they are made of, {title.lower()}: means over seeds; negative where the first is better. A method with one "
        f"seed counts as if all its trainings came out alike. Data: {data}."
    )
    return Table(name, caption, pd.DataFrame(rows), columns)


def parts_of_errors(picked: Mapping[str, Run], name: str, title: str, data: str) -> Table:
    """Parts of the MSE: constant over a manoeuvre, and not; where the car is linear, and not; likeness to the model's errors.

    Args:
        picked: candidate -> the seed that is looked at.
        name: of the file.
        title: of the part, for people.
        data: real or simulated.
    """
    reference = paper.SMOOTH if paper.SMOOTH in picked else paper.MODEL
    of_model = _whole(picked[reference].test)
    rows = []
    for candidate, run in picked.items():
        errors = [_errors(parts) for parts in run.test.values()]
        squares = np.square(np.concatenate(errors))
        constant = float(np.sum([len(error) * error.mean() ** 2 for error in errors]) / len(squares))
        nonlinear = np.concatenate([np.concatenate([is_nonlinear(part) for part in parts]) for parts in run.test.values()])
        rows.append(
            {
                "candidate": candidate,
                "mse": float(squares.mean()),
                "constant": constant,
                "varying": float(squares.mean()) - constant,
                "linear": _mean(squares[~nonlinear]),
                "nonlinear": _mean(squares[nonlinear]),
                "likeness": float(np.corrcoef(np.concatenate(errors), of_model)[0, 1]),
            }
        )
    columns = {
        "candidate": Column("method"),
        "mse": Column("MSE [deg²]", decimals=3),
        "constant": Column("of it constant over a manoeuvre", decimals=3),
        "varying": Column("and varying", decimals=3),
        "linear": Column("MSE below 4 m/s²", decimals=3),
        "nonlinear": Column("MSE_nl", decimals=3),
        "likeness": Column(f"correlation with the errors of: {reference}", decimals=2),
    }
    caption = (
        f"What errors consist of, {title.lower()}, of the seed that validation chooses. Constant over a manoeuvre are offsets of sensors "
        f"and of the reference and, in manoeuvres to one side, errors of the tyres. Data: {data}."
    )
    return Table(name, caption, pd.DataFrame(rows), columns)


def blend(picked: Mapping[str, Run], title: str) -> list[Block]:
    """What a constant blend of the filter alone and the network alone reaches, its weight from the validation manoeuvres.

    Args:
        picked: candidate -> the seed that is looked at.
        title: of the part, for people.
    """
    sentences = []
    for model in (paper.MODEL, paper.SMOOTH):
        if model not in picked or paper.DATA not in picked:
            continue
        one, other = ([_whole(manoeuvres) for manoeuvres in (picked[name].validation, picked[name].test)] for name in (model, paper.DATA))
        difference = one[0] - other[0]
        power = float(difference @ difference)
        weight = float(np.clip(-(other[0] @ difference) / power, 0.0, 1.0)) if power > 0.0 else 1.0
        blended, alone, network = (
            float(np.mean(np.square(error))) for error in (weight * one[1] + (1.0 - weight) * other[1], one[1], other[1])
        )
        sentences.append(
            f"{fixed(100.0 * weight, 0)} % of {model.lower()} and the rest of the data-driven method has an MSE of {fixed(blended, 3)} "
            f"deg² on the test ({fixed(alone, 3)} and {fixed(network, 3)} alone)"
        )
    if not sentences:
        return []
    return [
        f"What a constant blend of two estimates reaches, its weight from the validation manoeuvres, {title.lower()}, of the seeds that "
        f"validation chooses: {'; '.join(sentences)}. Hybrids, which weigh sample by sample, may do better."
    ]


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _whole(manoeuvres: Manoeuvres) -> FloatArray:
    return np.concatenate([_errors(parts) for parts in manoeuvres.values()])


def _errors(parts: Sequence[Scored]) -> FloatArray:
    """[deg]."""
    return np.concatenate([sideslip_error(part) for part in parts])
