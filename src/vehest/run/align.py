"""Output of `vehest data align`: recording -> alignment -> lines, JSON, and a folder of files.

Nothing is applied.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from vehest.alignment.align import READ_AS, Alignment, Parameter, align
from vehest.alignment.checks import refuse_errors
from vehest.alignment.settings import AlignmentSettings
from vehest.configuration.composition import Config
from vehest.configuration.files import choices
from vehest.data.errors import ConfigurationError, counted
from vehest.data.files import written_aside
from vehest.data.recording import Recording
from vehest.run.inspect_data import Lines, reading
from vehest.run.printing import TerminalTable
from vehest.sources.base import car_of, open_source, read_single

# files of an alignment's folder: report, table of parameters, transforms
FILES = ("alignment.md", "alignment.csv", "alignment.yaml")


def align_recording(
    source: str, overrides: Sequence[str], recording_id: str | None, settings: AlignmentSettings
) -> Alignment:
    """Estimate quantities from one recording.

    Parameters
    ----------
    source : str
        Name of a data set in conf/dataset, or path of a file.
    overrides : sequence of str
        Of conf/ingest.yaml for a data set, of conf/estimate.yaml for a file.
    recording_id : str or None
        Which recording; needed where a data set has several.
    settings : AlignmentSettings
        Without a wheelbase, that of the data set's car is used.

    Returns
    -------
    Alignment
        Nothing is applied or written.

    Raises
    ------
    VehestError
        It is not there, cannot be read or does not determine them.
    """
    with reading(source, overrides) as config:
        recording = _recording_of(source, config, recording_id)
        refuse_errors(
            recording, config["dataset"].get("accept") or (), f"recording '{recording.id}'"
        )
        if settings.wheelbase is None:
            settings = replace(settings, wheelbase=car_of(config["dataset"]).wheelbase)
        return align(recording, settings)


def alignment_lines(alignment: Alignment, out: Path | None) -> Lines:
    """Lines and tables for a terminal on an alignment; ``out`` is the folder where it was written.

    Returns
    -------
    Lines
        Lines and tables as `vehest.run.printing.emit` prints them; angles in degrees, delays in ms.
    """
    drive = alignment.recording
    first = (
        f"{drive.id}: {drive.kind}, {drive.duration:.6g} s at {drive.rate_hz:g} Hz; no "
        "correction is applied"
    )
    lines: Lines = [first, _parameters(alignment)]
    rows = [
        [
            residual.channel,
            *(f"{rms:.3g}" if math.isfinite(rms) else "–" for rms in residual.rms.values()),
            residual.unit,
        ]
        for residual in alignment.residuals
    ]
    if rows:
        lines += [
            "",
            TerminalTable(("residual RMS", "before", "after", "after, without tilt", "unit"), rows),
        ]
    proposal = f"to apply the corrections: '{override_of(alignment)}'"
    lines += [
        *(f"note: {note}" for note in alignment.notes),
        proposal if alignment.transforms else "no correction is proposed",
    ]
    return lines if out is None else [*lines, f"written: {out}"]


def override_of(alignment: Alignment) -> str:
    """The transforms of an alignment as one override in Hydra's grammar."""
    transforms = [dict(transform) for transform in alignment.transforms]
    text = yaml.safe_dump(transforms, default_flow_style=True, width=math.inf, sort_keys=False)
    return f"downsample.transforms={text.strip()}"


def as_plain(alignment: Alignment) -> dict[str, Any]:
    """Results of an alignment as plain values for JSON, in SI units.

    Returns
    -------
    dict
        Also correlation, transforms and the override that applies them; NaN where a residual was
        not computed.
    """
    drive = alignment.recording
    correlation = alignment.correlation
    return {
        "recording": drive.id,
        "kind": drive.kind,
        "rate_hz": drive.rate_hz,
        "duration": drive.duration,
        "estimated": alignment.settings.estimate,
        "cutoff_hz": alignment.settings.cutoff_at(drive.rate_hz),
        "parameters": [_plain_parameter(parameter) for parameter in alignment.parameters],
        "residuals": [
            {
                "channel": residual.channel,
                "unit": residual.unit,
                "rms_before": residual.rms["before"],
                "rms_after": residual.rms["after"],
                "rms_without_tilt": residual.rms["rest"],
            }
            for residual in alignment.residuals
        ],
        "correlation": None
        if correlation is None
        else {"of": correlation.signal, "peak": correlation.peak, "value": correlation.highest},
        "transforms": alignment.transforms,
        "override": override_of(alignment),
        "notes": alignment.notes,
    }


def write_alignment(alignment: Alignment, folder: Path) -> None:
    """Write report, table and transforms into a folder of its own, all or nothing.

    Parameters
    ----------
    alignment : Alignment
        What was estimated.
    folder : Path
        New, or one that holds an earlier alignment alone (`FILES`).

    Raises
    ------
    ConfigurationError
        The folder is a file or a link, or holds something else.
    MissingError
        The folder cannot be written to, or the disk is full.
    """
    import pandas as pd

    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise ConfigurationError(f"'{folder}' is not a folder; name a new one")
    foreign = (
        sorted(path.name for path in folder.iterdir() if path.name not in FILES)
        if folder.is_dir()
        else []
    )
    if foreign:
        raise ConfigurationError(
            f"folder '{folder}' contains other files ('{foreign[0]}'); name a new one"
        )
    recording = {"recording": alignment.recording.id, "kind": alignment.recording.kind}
    table = pd.DataFrame(
        [recording | _plain_parameter(parameter) for parameter in alignment.parameters]
    )
    texts = (
        _report(alignment),
        table.to_csv(index=False, lineterminator="\n"),
        _transforms(alignment),
    )
    with written_aside(folder, replace_folder=True) as aside:
        aside.mkdir()
        for name, text in zip(FILES, texts, strict=True):
            (aside / name).write_text(text, encoding="utf-8", errors="backslashreplace")


def _recording_of(source: str, config: Config, recording_id: str | None) -> Recording:
    """Read the recording of a data set by its id, or the only one; or that of a file, whose id must
    agree.
    """
    if source in choices("dataset"):
        origin = open_source(config["dataset"])
        ids = origin.ids()
        if recording_id is None and len(ids) != 1:
            raise ConfigurationError(
                f"recordings of data set '{source}': {counted(ids)}; choose one by --recording ID"
            )
        return origin.read(ids[0] if recording_id is None else recording_id)
    recording = read_single(config["dataset"], Path(source))
    if recording_id not in (None, recording.id):
        raise ConfigurationError(
            f"'{source}' contains the recording '{recording.id}', not '{recording_id}'"
        )
    return recording


def _parameters(alignment: Alignment) -> TerminalTable:
    """Table of the parameters in degrees and milliseconds, with as many digits as the uncertainty
    warrants.
    """
    rows = []
    for parameter in alignment.parameters:
        factor, unit = READ_AS.get(parameter.unit, (1.0, parameter.unit))
        decimals = (
            min(max(1 - math.floor(math.log10(factor * parameter.uncertainty)), 0), 9)
            if parameter.uncertainty > 0
            else 6
        )
        numbers = (parameter.value, parameter.uncertainty, parameter.low, parameter.high)
        value, sigma, low, high = (f"{factor * number:.{decimals}f}" for number in numbers)
        rows.append([parameter.name, value, sigma, f"{low} … {high}", unit])
    return TerminalTable(
        ("quantity", "estimate", "standard uncertainty", "95 % interval", "unit"), rows
    )


def _report(alignment: Alignment) -> str:
    """The alignment as Markdown: parameters, residuals, notes, and the transforms as YAML and
    override.
    """
    from vehest.report.document import as_text

    printed = alignment_lines(alignment, None)[:-1]  # without the override, which stands below
    cutoff_hz = alignment.settings.cutoff_at(alignment.recording.rate_hz)
    parts = [
        f"# Alignment of {as_text(alignment.recording.id)}",
        f"Estimated: {', '.join(alignment.settings.estimate)}. Both sides are low-passed at "
        f"{cutoff_hz:.3g} Hz.",
        *(as_text(line) if isinstance(line, str) else _markdown(line) for line in printed),
    ]
    if alignment.transforms:
        parts += [
            "Transforms that apply the corrections, in this order, for `downsample`:",
            f"```yaml\n{_transforms(alignment).rstrip()}\n```",
            f"```sh\nvehest downsample DATASET rate_hz=… '{override_of(alignment)}'\n```",
        ]
    else:
        parts.append("No correction is proposed.")
    return "\n\n".join(part for part in parts if part) + "\n"


def _markdown(table: TerminalTable) -> str:
    """Text of a table in Markdown, with numbers aligned to the right."""
    lines = [table.header, [":--", *("--:" for _ in table.header[1:-1]), ":--"], *table.rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _transforms(alignment: Alignment) -> str:
    """YAML of the transforms, as they are placed under ``downsample`` in a configuration."""
    return yaml.safe_dump(
        {"transforms": [dict(transform) for transform in alignment.transforms]},
        sort_keys=False,
        allow_unicode=True,
    )


def _plain_parameter(parameter: Parameter) -> dict[str, Any]:
    """Values of a parameter and the contributions to its uncertainty, column of the table ->
    value.
    """
    plain = {
        key: getattr(parameter, key)
        for key in ("name", "value", "uncertainty", "low", "high", "unit")
    }
    return plain | {
        "from_scatter": parameter.scatter,
        "from_tilt": parameter.tilt,
        "from_model": parameter.model,
    }
