"""What the candidates of the parts beside the main one were trained on, and their validation
losses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.splits import VALIDATION
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.kit.reading import lengths_of, median_and_range, metric_values

Candidate = tuple[PartArtefacts, Sequence[EvaluatedModel]]  # part and the candidate's seeds


def budgets(candidates: Mapping[str, Candidate]) -> pd.DataFrame:
    """Epochs, batches, samples and validation losses, a row for each candidate, by its title."""
    rows: list[dict[str, object]] = []
    for title, (part, models) in candidates.items():
        training = models[0].training
        losses = validation_losses(part, models)
        rows.append(
            {
                "title": title,
                "seeds": len(models),
                "one_step": int(training["one_step"]["max_epochs"]),
                "through": int(_second_phase(models[0])["max_epochs"]),
                "steps": int(training["steps"]),
                "batch": int(training["batch_size"]),
                "step_size": float(training["through"]["learning_rate"]),
                "samples": samples_trained_on(part, models[0]),
                "validation": median_and_range(losses, 4),
            }
            | {
                f"validation_seed_{model.seed}": float(loss)
                for model, loss in zip(models, losses, strict=True)
            }
        )
    return pd.DataFrame(rows)


def validation_losses(part: PartArtefacts, models: Sequence[EvaluatedModel]) -> FloatArray:
    """Weighted MSE on the validation range, (S,)."""
    values = metric_values(part)
    return np.array(
        [
            values[model.estimator, model.variant, model.seed, VALIDATION, "mse_weighted"]
            for model in models
        ]
    )


def samples_trained_on(part: PartArtefacts, model: EvaluatedModel) -> int:
    """Samples that a seed is trained on, each counted as often as it is used: pairs one-step,
    sequences through the filter.
    """
    training = model.training
    drives = lengths_of(part, part.split.train)
    steps = int(training["steps"])
    pairs = sum(length - 1 for length in drives)
    samples = sum(length // steps * steps for length in drives)
    prediction_samples = int(training["one_step"]["max_epochs"]) * pairs
    return prediction_samples + int(_second_phase(model)["max_epochs"]) * samples


def _second_phase(model: EvaluatedModel) -> Mapping[str, float]:
    """Settings of the training through the filter, or of the noise alone."""
    phase: Mapping[str, float] = model.training["through" if "_u" in model.variant else "noise"]
    return phase
