"""Parts of studies from models and figures that a test makes."""

import pandas as pd

from vehest.data.store import write_recording
from vehest.report.document import Figure, Table
from vehest.studies.artefacts import METRIC_COLUMNS, PartArtefacts, StudyArtefacts


def study_of(name, parts=None, **options):
    """A study of these parts, and of no title worth reading."""
    content = {"titles": dict.fromkeys(parts or (), "T"), "parts": parts or {}}
    return StudyArtefacts(name, "t", "a", "c", **{**content, **options})


def text_of(document):
    """Paragraphs and captions of a report, in one line."""
    words = (block if isinstance(block, str) else block.caption for block in document.blocks)
    return " ".join("\n".join(words).split())


def tables_of(document):
    """Name -> table of a report."""
    return {block.name: block.frame for block in document.blocks if isinstance(block, Table)}


def first_screen(text, template):
    """The first 300 words of a short report that answers there, and whose template decides
    nothing.
    """
    words = text.split()
    assert max(len(words), len(template.split())) <= 3000
    assert "{% if" not in template
    first_300 = " ".join(words[:300])
    for heading in ("Question", "Answer", "Evidence", "Recommendation"):
        assert f"**{heading}.**" in first_300
    return first_300


def figures_of(document):
    """Name -> figure of a report."""
    return {block.name: block for block in document.blocks if isinstance(block, Figure)}


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
