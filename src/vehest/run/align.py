"""Output of `vehest data align`: recording -> alignment -> lines, JSON, and a folder of files. Nothing is applied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from vehest.alignment.align import READ_AS, UNITS, Alignment, Parameter, align
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.settings import AlignmentSettings
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.files import written_aside
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import Recording
from vehest.run.config import Config
from vehest.run.config_files import choices
from vehest.run.inspect_data import config_of
from vehest.run.printing import TerminalTable
from vehest.sources.base import open_source, read_single

FILES = ("alignment.md", "alignment.csv", "alignment.yaml", "alignment.png", "alignment.svg")
PARAMETER_HEADER = ("quantity", "estimate", "standard uncertainty", "95 % interval", "unit")
RESIDUAL_HEADER = ("residual rms", "before", "after", "and without tilt", "unit")
TITLES = {
    "lever_x": "lever arm, forward",
    "lever_y": "lever arm, to the left",
    "yaw": "mounting rotation",
    "delay": "delay",
    "offset_ax": "offset of ax",
    "offset_ay": "offset of ay",
    "offset_yaw_rate": "offset of yaw_rate",
    "steering_ratio": "steering ratio",
    "steering_offset": "steering offset",
    "understeer_gradient": "understeer gradient",
}


def align_recording(source: str, overrides: Sequence[str], recording_id: str | None, settings: AlignmentSettings) -> Alignment:
    """Estimate quantities from one recording.

    Args:
        source: a data set, or a CSV or Parquet file.
        overrides: of the configuration that reads it.
        recording_id: which recording of a data set; not needed where it has one.
        settings: quantities to estimate.

    Raises:
        VehestError: there is no such recording, it cannot be read, or it does not determine them.
    """
    config = config_of(source, overrides)
    with use_limits(limits_from_config(config["limits"])):
        return align(_one_recording(source, config, recording_id), settings)


def parameter_rows(alignment: Alignment) -> list[list[str]]:
    """The cells under `PARAMETER_HEADER`, for people: degrees and milliseconds, as many digits as the uncertainty warrants."""
    rows = []
    for parameter in alignment.parameters:
        factor, unit = READ_AS.get(UNITS[parameter.name], (1.0, UNITS[parameter.name]))
        decimals = min(max(1 - math.floor(math.log10(factor * parameter.uncertainty)), 0), 9) if parameter.uncertainty > 0 else 6
        value, sigma, low, high = (
            f"{factor * number:.{decimals}f}" for number in (parameter.value, parameter.uncertainty, parameter.low, parameter.high)
        )
        rows.append([TITLES[parameter.name], value, sigma, f"{low} … {high}", unit])
    return rows


def residual_rows(alignment: Alignment) -> list[list[str]]:
    """The cells under `RESIDUAL_HEADER`."""
    return [
        [residual.channel, *(_three_digits(size) for size in (residual.rms_before, residual.rms_after, residual.rms_rest)), residual.unit]
        for residual in alignment.residuals
    ]


def in_words(alignment: Alignment, out: Path | None) -> list[str | TerminalTable]:
    """An alignment for a terminal; ``out`` is where it was written."""
    first = f"{alignment.recording_id}: {alignment.kind}, {alignment.duration:.6g} s at {alignment.rate_hz:g} Hz; nothing is applied"
    lines: list[str | TerminalTable] = [first, TerminalTable("", PARAMETER_HEADER, parameter_rows(alignment))]
    if alignment.residuals:
        lines += ["", TerminalTable("", RESIDUAL_HEADER, residual_rows(alignment))]
    lines += [*(f"note: {note}" for note in alignment.notes), f"to correct it: '{override_of(alignment)}'"]
    return lines if out is None else [*lines, f"written: {out}"]


def override_of(alignment: Alignment) -> str:
    """The transforms as an override that Hydra reads."""
    transforms = [dict(transform) for transform in alignment.transforms]
    return f"downsample.transforms={yaml.safe_dump(transforms, default_flow_style=True, width=math.inf, sort_keys=False).strip()}"


def as_plain(alignment: Alignment) -> dict[str, Any]:
    """All figures as plain values, SI units throughout."""
    correlation = alignment.correlation
    return {
        "recording": alignment.recording_id,
        "kind": alignment.kind,
        "rate_hz": alignment.rate_hz,
        "duration": alignment.duration,
        "estimated": list(alignment.settings.estimate),
        "cutoff_hz": alignment.settings.cutoff_hz,
        "parameters": [_plain_parameter(parameter) for parameter in alignment.parameters],
        "residuals": [
            {key: getattr(one, key) for key in ("channel", "unit", "rms_before", "rms_after")} | {"rms_without_tilt": one.rms_rest}
            for one in alignment.residuals
        ],
        "correlation": None if correlation is None else {"of": correlation.signal, "peak": correlation.peak, "value": correlation.highest},
        "transforms": [dict(transform) for transform in alignment.transforms],
        "override": override_of(alignment),
        "notes": list(alignment.notes),
    }


def write_alignment(alignment: Alignment, folder: Path) -> None:
    """Write the report, its table, the transforms and the figure into a folder of their own, all or nothing.

    Raises:
        ConfigurationError: the folder holds other files.
        MissingError: it cannot be written.
    """
    from vehest.report.alignment_figures import alignment_figure, figure_files

    refuse_other_files(folder)
    contents = {f"alignment.{ending}": content for ending, content in figure_files(alignment_figure(alignment)).items()}
    texts = {"alignment.md": _report(alignment), "alignment.csv": _table(alignment), "alignment.yaml": _transforms(alignment)}
    contents |= {name: text.encode("utf-8", "backslashreplace") for name, text in texts.items()}
    with written_aside(folder, replace_folder=True) as aside:
        aside.mkdir()
        for name in FILES:
            (aside / name).write_bytes(contents[name])


def refuse_other_files(folder: Path) -> None:
    """Keep other files than those of a former alignment.

    Raises:
        ConfigurationError: the folder holds others, or is none.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise ConfigurationError(f"'{folder}' is not a folder; name a new one")
    others = sorted(path.name for path in folder.iterdir() if path.name not in FILES) if folder.is_dir() else []
    if others:
        raise ConfigurationError(f"folder '{folder}' holds other files ('{others[0]}'); name a new one")


def _one_recording(source: str, config: Config, recording_id: str | None) -> Recording:
    dataset = config["dataset"]
    if source in choices("dataset"):
        origin = open_source(dataset)
        known = origin.ids()
        if recording_id is None and len(known) != 1:
            shown = ", ".join(known[:8]) + (", …" if len(known) > 8 else "")
            raise ConfigurationError(f"data set '{source}' has {len(known)} recordings ({shown}); say which: --recording ID")
        recording = origin.read(known[0] if recording_id is None else recording_id)
    else:
        recording = read_single(dataset, Path(source))
        if recording_id not in (None, recording.id):
            raise ConfigurationError(f"'{source}' holds the recording '{recording.id}', not '{recording_id}'")
    accepted = set(dataset.get("accept") or [])
    for finding in checks_of_recording(recording):
        if finding.level == "error" and finding.check not in accepted:
            raise DataError(
                f"recording '{recording.id}': channel '{finding.channel}': {finding.message} (or dataset.accept=[{finding.check}])"
            )
    return recording


def _report(alignment: Alignment) -> str:
    from vehest.report.document import as_text

    settings = alignment.settings
    parts = [
        f"# Alignment of {as_text(alignment.recording_id)}",
        f"Estimated from a {alignment.kind} recording of {alignment.duration:.6g} s at {alignment.rate_hz:g} Hz: "
        f"{', '.join(settings.estimate)}. Both sides are low-passed at {settings.cutoff_hz:g} Hz. Nothing has been applied.",
        _markdown_table(PARAMETER_HEADER, parameter_rows(alignment)),
    ]
    if alignment.residuals:
        parts += ["Sensor less reference, root mean square below the cut-off:", _markdown_table(RESIDUAL_HEADER, residual_rows(alignment))]
    parts += [
        "\n".join(f"- {note}" for note in alignment.notes),
        "Transforms that would correct it, in this order, for `downsample`:",
        f"```yaml\n{_transforms(alignment).rstrip()}\n```",
        f"```sh\nvehest downsample DATASET rate_hz=… '{override_of(alignment)}'\n```",
        "![Cross-correlation, residuals before and after](alignment.png)",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, [":--", *("--:" for _ in header[1:-1]), ":--"], *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _table(alignment: Alignment) -> str:
    """Parameters with all digits, SI units."""
    import pandas as pd

    recording = {"recording": alignment.recording_id, "kind": alignment.kind}
    table = pd.DataFrame([recording | _plain_parameter(parameter) for parameter in alignment.parameters])
    return str(table.to_csv(index=False, lineterminator="\n"))


def _transforms(alignment: Alignment) -> str:
    """What belongs under ``downsample`` in a configuration."""
    return yaml.safe_dump({"transforms": [dict(transform) for transform in alignment.transforms]}, sort_keys=False, allow_unicode=True)


def _plain_parameter(parameter: Parameter) -> dict[str, Any]:
    plain = {key: getattr(parameter, key) for key in ("name", "value", "uncertainty", "low", "high", "unit")}
    return plain | {"from_scatter": parameter.scatter, "from_tilt": parameter.tilt}


def _three_digits(size: float) -> str:
    return f"{size:.3g}" if math.isfinite(size) else "–"
