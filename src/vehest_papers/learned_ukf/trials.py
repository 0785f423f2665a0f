"""Step sizes and batches that were tried, and their validation errors: as many trials for the
filter as for either recurrent network.
"""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import MISSING
from vehest.studies.artefacts import Trial
from vehest_papers.learned_ukf.candidates import candidate_of


def step_size(trial: Trial) -> float:
    """Step size of the training through the filter, or on sequences."""
    training = trial.training
    return float(training["through" if "through" in training else "phase"]["learning_rate"])


def trials_table(trials: Sequence[Trial]) -> Table:
    """A row a trial of the study's searches."""
    rows = [
        {
            "candidate": candidate_of(trial),
            "step_size": step_size(trial),
            "batch": int(trial.training["batch_size"]),
            "start": str(trial.training.get("start_noise", MISSING)),
            "seed": trial.seed,
            "validation": trial.validation,
            "chosen": "chosen" if trial.chosen else "",
        }
        for trial in trials
    ]
    frame = (
        pd.DataFrame(rows)
        .sort_values(["candidate", "step_size"], kind="stable")
        .reset_index(drop=True)
    )
    columns = {
        "candidate": Column("method"),
        "step_size": Column("step size", digits=1, each=True),
        "batch": Column("sequences in a batch", decimals=0),
        "start": Column("noise starts from"),
        "seed": Column("seed", decimals=0),
        "validation": Column("MSE (weighted), validation", decimals=4),
        "chosen": Column("chosen"),
    }
    caption = (
        "Step sizes and batches that were tried, on one seed that is not in the tables. "
        "Validation: tyre A, run 0."
    )
    return Table("trials", caption, frame, columns)
