"""Draws a recording with estimates of it into a picture or a page (`vehest plot`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from vehest.configuration.estimate_options import EstimateOptions, estimate_options
from vehest.configuration.files import files_and_overrides, is_file_name
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.files import written_aside
from vehest.data.limits import use_limits
from vehest.data.recording import Recording
from vehest.inference.car_values import stated_wheelbase
from vehest.inference.reading import read_checked, without_references
from vehest.report.document import Document, Figure, as_text, page_of, pdf_of, png_of, svg_of
from vehest.report.drive_figure import drive_figure
from vehest.report.style import MatplotlibFigure
from vehest.run.estimate_tables import read_estimate_table


def _page(figure: MatplotlibFigure) -> bytes:
    """A figure as a self-contained HTML page."""
    title = as_text(figure.axes[0].get_title(loc="left"))
    caption = "Sideslip angle with band and health, lateral velocity, measured channels, course."
    return page_of(Document(title, [Figure("drive", caption, figure)]))


WRITERS: dict[str, Callable[[MatplotlibFigure], bytes]] = {
    ".png": partial(png_of, dpi=200),
    ".pdf": pdf_of,
    ".svg": svg_of,
    ".html": _page,
}
"""Suffix of a file -> function that returns a figure in its format."""


def check_plot_name(out: Path) -> None:
    """Raise `ConfigurationError` where a picture cannot be written to a path, before it is
    drawn.
    """
    if out.suffix.lower() not in WRITERS:
        raise ConfigurationError(
            f"'{out}': pictures are written as {', '.join(WRITERS)}; name such a file"
        )
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file")


def check_plot_of_estimate(out: Path, picture: Path) -> None:
    """Raise `ConfigurationError` where an estimate at ``out`` cannot be drawn to the path
    ``picture``.
    """
    check_plot_name(picture)
    if out.suffix.lower() != ".parquet":
        raise ConfigurationError(
            f"--plot needs the estimate as .parquet, which has its bands and health, not as '{out}'"
        )


def plot_estimate(words: Sequence[str], out: Path, picture: Path) -> None:
    """Draw an estimate that `vehest.run.estimate.estimate_file` wrote from the same words.

    Parameters
    ----------
    words : sequence of str
        Of the command: model (may be left out), recording, overrides.
    out : Path
        The estimate, as .parquet.
    picture : Path
        What is drawn; see `plot_files`.
    """
    has_model = len(words) > 1 and is_file_name(words[1])
    recording, *overrides = words[1:] if has_model else words
    plot_files([recording, str(out), *overrides], picture)


def plot_files(
    words: Sequence[str], out: Path, start: float | None = None, stop: float | None = None
) -> dict[str, Any]:
    """Draw a recording, and estimates of it, on one page.

    Parameters
    ----------
    words : sequence of str
        File of the recording, files of estimates as `read_estimate_table` reads them, overrides of
        conf/estimate.yaml.
    out : Path
        ``.png``, ``.pdf``, ``.svg`` or ``.html``; appears complete or not at all.
    start, stop : float, optional
        Range that is drawn [s]; by default all of it.

    Returns
    -------
    dict
        File, recording, its length [s], estimates, and whether it has a reference.

    Raises
    ------
    VehestError
        A file cannot be used or written.
    """
    check_plot_name(out)
    files, overrides = files_and_overrides(words)
    if not files:
        raise ConfigurationError("name the file of a recording: vehest plot lap.csv")
    recording_file, *estimate_files = files
    options = estimate_options(overrides)
    recording = _with_references_if_any(Path(recording_file), options)
    wheelbase = stated_wheelbase(recording.car, options.settings)
    recording = replace(recording, car=replace(recording.car, wheelbase=wheelbase))
    with use_limits(options.limits):
        estimates = [read_estimate_table(Path(file), recording) for file in estimate_files]
    figure = drive_figure(recording, estimates, start, stop)
    content = WRITERS[out.suffix.lower()](figure)
    with written_aside(out) as aside:
        aside.write_bytes(content)
    return {
        "out": str(out),
        "recording": recording.id,
        "seconds": recording.duration,
        "estimates": [str(Path(file)) for file in estimate_files],
        "has_reference": "vy_ref" in recording,
    }


def _with_references_if_any(file: Path, options: EstimateOptions) -> Recording:
    """A recording with the references of its data set; without them where the file lacks one."""
    try:
        return read_checked(file, options.dataset, options.limits)
    except DataError:
        return read_checked(file, without_references(options.dataset), options.limits)
