"""Step sizes that were tried, and their validation errors: as many trials for the filter as for either recurrent network."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.data.splits import VALIDATION
from vehest.report.document import Column, Table
from vehest.report.style import MISSING
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.kit.reading import metric_values
from vehest_papers.learned_ukf.candidates import candidate_of


def step_size(model: EvaluatedModel) -> float:
    """Of the training through the filter, or on sequences."""
    training = model.training
    return float(training["through" if "through" in training else "phase"]["learning_rate"])


def trials_table(
    parts: Mapping[str, PartArtefacts], used: Mapping[str, float]
) -> tuple[Table, list[str]]:
    """A row a trial, and the candidates whose tables do not use what validation chose; ``used``: candidate -> step size of the tables."""
    rows = []
    for part in parts.values():
        values = metric_values(part)
        for model in part.models:
            key = (model.estimator, model.variant, model.seed, VALIDATION, "mse_weighted")
            row = {
                "candidate": candidate_of(model),
                "step_size": step_size(model),
                "seed": model.seed,
            }
            row["start"] = str(model.training.get("start_noise", MISSING))
            rows.append(row | {"validation": values.get(key, np.nan)})
    frame = (
        pd.DataFrame(rows)
        .sort_values(["candidate", "step_size"], kind="stable")
        .reset_index(drop=True)
    )
    frame["chosen"] = [
        "chosen"
        if own["validation"] == frame[frame["candidate"] == own["candidate"]]["validation"].min()
        else ""
        for own in frame.to_dict("records")
    ]
    best = {
        str(row["candidate"]): float(row["step_size"])
        for row in frame[frame["chosen"] == "chosen"].to_dict("records")
    }
    other = [
        candidate
        for candidate, size in best.items()
        if candidate in used and used[candidate] != size
    ]
    columns = {
        "candidate": Column("method"),
        "step_size": Column("step size", digits=1, each=True),
        "start": Column("noise starts from"),
        "seed": Column("seed", decimals=0),
        "validation": Column("MSE (weighted), validation", decimals=4),
        "chosen": Column("chosen"),
    }
    caption = "Step sizes that were tried, on one seed that is not in the tables. Validation: tyre A, run 0."
    return Table("trials", caption, frame, columns), other
