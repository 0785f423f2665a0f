"""Parts of studies from models and figures that a test makes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.data.recording import Recording
from vehest.data.splits import Split
from vehest.data.store import write_recording
from vehest.evaluation.metrics import Protocol
from vehest.studies.artefacts import METRIC_COLUMNS, EvaluatedModel, PartArtefacts


def stored(folder: Path, dataset: str, recordings: Mapping[str, Recording]) -> dict[tuple[str, str], Path]:
    """(Data set, recording) -> the file that it was written to."""
    references = {(dataset, name): folder / f"{name}.parquet" for name in recordings}
    for (_, name), file in references.items():
        write_recording(recordings[name], file)
    return references


def metric_rows(
    model: EvaluatedModel, test: str, figures: Mapping[str, float], *, study: str = "s", dataset: str = "car", rate_hz: float = 100.0
) -> list[tuple[Any, ...]]:
    """Rows of a table of metrics, over all samples under nominal conditions."""
    head = (study, model.estimator, model.variant, dataset, dataset, "simulated", test, "all", "nominal", rate_hz, "causal", model.seed)
    return [(*head, metric, value, "1", None, None) for metric, value in figures.items()]


def part_of(
    split: Split,
    protocol: Protocol,
    models: Iterable[EvaluatedModel],
    rows: Iterable[tuple[Any, ...]],
    *,
    study: str = "s",
    kinds: Mapping[str, str] | None = None,
    data_titles: Mapping[str, str] | None = None,
    references: Mapping[tuple[str, str], Path] | None = None,
    facts: Iterable[str] = (),
) -> PartArtefacts:
    """A part with these models, data and metrics."""
    metrics = pd.DataFrame(rows, columns=list(METRIC_COLUMNS))
    titles = data_titles or {}
    return PartArtefacts(study, "t", "a", "c", split, protocol, kinds or {}, titles, metrics, list(models), references or {}, list(facts))
