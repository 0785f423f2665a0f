"""Step sizes and batches that were tried, and their validation errors: as many trials for the
filter as for either recurrent network.
"""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from vehest.report.style import MISSING
from vehest.studies.artefacts import Trial
from vehest_papers.learned_ukf.candidates import candidate_of


def step_size(trial: Trial) -> float:
    """Step size of the training through the filter, or on sequences."""
    training = trial.training
    return float(training["through" if "through" in training else "phase"]["learning_rate"])


def trials_table(trials: Sequence[Trial]) -> pd.DataFrame:
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
    frame = pd.DataFrame(rows).sort_values(["candidate", "step_size"], kind="stable")
    return frame.reset_index(drop=True)
