"""Whether the paper's picture is found again, and what errors consist of where it is not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.data.recording import FloatArray
from vehest.evaluation.manoeuvres import is_nonlinear, sideslip_error
from vehest.evaluation.metrics import Scored
from vehest.report.document import Block, Column, Table
from vehest.report.style import fixed
from vehest.studies.cnn_ukf import paper
from vehest.studies.cnn_ukf.subjects import Manoeuvres, Run, chosen
from vehest.studies.cnn_ukf.tables import medians

Runs = Mapping[str, Sequence[Run]]


def why(name: str, runs: Runs, title: str, data: str) -> list[Block]:
    """The paper's statements beside ours, and a table of what errors consist of.

    Args:
        name: ``full`` or ``limited``.
        runs: of the part.
        title: of the part, for people.
        data: real or simulated.
    """
    middle = medians(runs, "mse_nonlinear")
    if not {paper.MODEL, paper.DATA, paper.DEEP, paper.CNN} <= set(middle):
        return []
    words = "\n".join(f"- {line}" for line in (_full(middle) if name == "full" else _limited(middle)))
    picked = {candidate: chosen(own) for candidate, own in runs.items()}
    return [f"### Is it the paper's picture?\n\n{words}", parts_of_errors(picked, f"parts_{name}", title, data), *_blend(picked, title)]


def _full(middle: Mapping[str, float]) -> list[str]:
    of_four = [paper.MODEL, paper.DATA, paper.DEEP, paper.CNN]
    order = sorted(of_four, key=middle.__getitem__)
    deep, data = middle[paper.DEEP], middle[paper.DATA]
    return [
        f"Paper: CNN-UKF lowest on MSE_nl, 25 % below DE-UKF. Here lowest of the four is {order[0]}, and CNN-UKF "
        f"{_beside(middle[paper.CNN], deep)} DE-UKF.",
        f"Paper: DE-UKF and the data-driven method level. Here DE-UKF {_beside(deep, data)} the data-driven method.",
        f"Paper: the model last, 77 % above both. Here last is {order[-1]}; the model {_beside(middle[paper.MODEL], data)} the data-driven "
        f"method"
        + (f", and with the smooth tyres of the CNN-UKF it {_beside(middle[paper.SMOOTH], data)} it." if paper.SMOOTH in middle else "."),
    ]


def _limited(middle: Mapping[str, float]) -> list[str]:
    of_four = [paper.MODEL, paper.DATA, paper.DEEP, paper.CNN]
    order = sorted(of_four, key=middle.__getitem__)
    smooth = f", {_beside(middle[paper.CNN], middle[paper.SMOOTH])} the model with its smooth tyres" if paper.SMOOTH in middle else ""
    return [
        f"Paper: the data-driven method last, 29 % above the model. Here last is {order[-1]}; the data-driven method "
        f"{_beside(middle[paper.DATA], middle[paper.MODEL])} the model.",
        f"Paper: the hybrids 3 % below the model, and level. Here DE-UKF {_beside(middle[paper.DEEP], middle[paper.MODEL])} the model, "
        "CNN-UKF "
        f"{_beside(middle[paper.CNN], middle[paper.MODEL])} it{smooth}.",
    ]


def _beside(value: float, other: float) -> str:
    """``is 12 % below``, ``is 3 % above``."""
    share = 100.0 * (value / other - 1.0)
    return f"is {fixed(abs(share), 0)} % {'below' if share < 0 else 'above'}"


def parts_of_errors(picked: Mapping[str, Run], name: str, title: str, data: str) -> Table:
    """Shares of the MSE: constant over a manoeuvre, and not; where the car is linear, and not; likeness to the model's errors."""
    reference = paper.SMOOTH if paper.SMOOTH in picked else paper.MODEL
    of_model = np.concatenate([_errors(parts) for parts in picked[reference].test.values()])
    rows = []
    for candidate, run in picked.items():
        errors = [_errors(parts) for parts in run.test.values()]
        total = float(np.mean(np.square(np.concatenate(errors))))
        constant = float(np.sum([len(error) * error.mean() ** 2 for error in errors]) / sum(len(error) for error in errors))
        nonlinear = np.concatenate([np.concatenate([is_nonlinear(part) for part in parts]) for parts in run.test.values()])
        squares = np.square(np.concatenate(errors))
        rows.append(
            {
                "candidate": candidate,
                "mse": total,
                "constant": constant,
                "varying": total - constant,
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
        f"What errors consist of, {title.lower()}, of the seed that validation chooses. What is constant over a manoeuvre is offsets, of "
        f"sensors and of the reference, that no method can see in one drive. Data: {data}."
    )
    return Table(name, caption, pd.DataFrame(rows), columns)


def _blend(picked: Mapping[str, Run], title: str) -> list[Block]:
    """What a fixed blend of the filter alone and the network alone would reach, its weight from the validation manoeuvres."""
    sentences = []
    for model in (paper.MODEL, paper.SMOOTH):
        if model not in picked or paper.DATA not in picked:
            continue
        one, other = ([_whole(manoeuvres) for manoeuvres in (picked[name].validation, picked[name].test)] for name in (model, paper.DATA))
        difference = one[0] - other[0]
        weight = float(np.clip(-(other[0] @ difference) / (difference @ difference), 0.0, 1.0))
        error = weight * one[1] + (1.0 - weight) * other[1]
        sentences.append(
            f"{fixed(100.0 * weight, 0)} % of {model.lower()} and the rest of the data-driven method has an MSE of "
            f"{fixed(float(np.mean(np.square(error))), 3)} deg²"
        )
    if not sentences:
        return []
    return [
        f"How much there is to gain from putting both together: a constant blend of two estimates, its weight from the validation "
        f"manoeuvres, {title.lower()}: {'; '.join(sentences)}."
    ]


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _whole(manoeuvres: Manoeuvres) -> FloatArray:
    return np.concatenate([_errors(parts) for parts in manoeuvres.values()])


def _errors(parts: Sequence[Scored]) -> FloatArray:
    return np.concatenate([sideslip_error(part) for part in parts])
