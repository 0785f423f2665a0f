"""Parts of studies from models and figures that a test makes."""

import pandas as pd

from vehest.data.store import write_recording
from vehest.studies.artefacts import METRIC_COLUMNS, PartArtefacts


def stored(folder, dataset, recordings):
    """(Data set, recording) -> the file that it was written to."""
    references = {(dataset, name): folder / f"{name}.parquet" for name in recordings}
    for (_, name), file in references.items():
        write_recording(recordings[name], file)
    return references


def metric_rows(model, test, figures, *, study="s", dataset="car", rate_hz=100.0):
    """Rows of a table of metrics, over all samples under nominal conditions."""
    head = (
        study,
        model.estimator,
        model.variant,
        dataset,
        dataset,
        "simulated",
        test,
        "all",
        "nominal",
        rate_hz,
        "causal",
        model.seed,
    )
    return [(*head, metric, value, "1", None, None) for metric, value in figures.items()]


def part_of(
    split,
    protocol,
    models,
    rows,
    *,
    study="s",
    kinds=None,
    data_titles=None,
    references=None,
    facts=(),
):
    """A part with these models, data and metrics."""
    metrics = pd.DataFrame(rows, columns=list(METRIC_COLUMNS))
    titles = data_titles or {}
    return PartArtefacts(
        study,
        "t",
        "a",
        "c",
        split,
        protocol,
        kinds or {},
        titles,
        metrics,
        list(models),
        references or {},
        list(facts),
    )
