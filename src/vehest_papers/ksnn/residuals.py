"""Figure 8 of Da Lio et al. 2023: power spectral densities of the lateral velocity and of what estimators leave of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vehest.evaluation.metrics import Scored
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, REFERENCE_COLOUR, fixed, lines_of, listed, new_figure
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.spectra import SEGMENT_SECONDS, Periodogram, decibels, periodogram
from vehest_papers.ksnn.subjects import plain_frequencies

READ_AT_HZ = (0.1, 1.0)
HIGHEST_HZ = 8.0
PUBLISHED_ABOVE_KSNN = "7 dB at 0.1 Hz and 8 to 10 dB at 1 Hz"
"""LSTM above KS-NN on the Corvette, trained on the Ferrari: Da Lio et al. 2023, Section VIII-F."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Estimates of one estimator on a test set."""

    estimator: str  # name in conf/estimator
    variant: str  # what the paper calls it
    title: str  # for people, with the seed
    scored: Sequence[Scored]  # estimate and reference, range by range


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel of the figure."""

    test: str  # test set, for example ``Ferrari F-2``
    trained_on: str  # training set, for example ``Corvette C-1``
    data: str  # real or simulated, and which data set
    estimators: Sequence[Residuals]  # the KS-NN first: the others are compared with it
    rate_hz: float  # rate of the scored samples [Hz]

    @property
    def title(self) -> str:
        """What was tested after which training."""
        return f"{self.test}, trained on {self.trained_on}"


def residuals(panels: Sequence[Panel]) -> list[Block]:
    """Spectra of v and of the residuals, one panel a test set, and how far they lie apart; raises `DataError` for too short a range."""
    spectra = [_spectra(panel) for panel in panels]
    frame = pd.DataFrame(
        [row for panel, own in zip(panels, spectra, strict=True) for row in _rows(panel, own)]
    )
    return [_figure(panels, spectra), _in_words(panels, spectra), _table(frame, panels)]


def _spectra(panel: Panel) -> list[Periodogram]:
    """Of v, then of v̂ - v of each estimator."""
    reference = [part.vy_ref for part in panel.estimators[0].scored]
    errors = [[part.vy - part.vy_ref for part in own.scored] for own in panel.estimators]
    return [periodogram(series, panel.rate_hz) for series in (reference, *errors)]


def _figure(panels: Sequence[Panel], spectra: Sequence[Sequence[Periodogram]]) -> Figure:
    lines = lines_of(
        dict.fromkeys((own.estimator, own.variant) for panel in panels for own in panel.estimators)
    )
    with new_figure(DOUBLE_COLUMN * 0.85, 0.7 + 2.1 * len(panels)) as figure:
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axes, panel, (signal, *errors) in zip(grid, panels, spectra, strict=True):
            shown = (signal.frequency > 1.5 * signal.frequency[1]) & (
                signal.frequency <= min(HIGHEST_HZ, 0.4 * panel.rate_hz)
            )
            hz = signal.frequency[shown]
            axes.semilogx(
                hz,
                10 * np.log10(signal.density[shown]),
                color=REFERENCE_COLOUR,
                linewidth=1.5,
                label="measured v",
            )
            for own, error in zip(panel.estimators, errors, strict=True):
                line = lines[own.estimator, own.variant]
                axes.semilogx(
                    hz,
                    10 * np.log10(error.density[shown]),
                    color=line.colour,
                    linestyle=line.dash,
                    label=f"error of {own.title}",
                )
            axes.set_title(f"{panel.title} ({panel.data})", loc="left")
            axes.set_ylabel("PSD [dB re 1 (m/s)²/Hz]")
            axes.set_xlim(hz[0], hz[-1])
        grid[-1].set_xlabel("frequency [Hz]")
        plain_frequencies(grid[-1])
        legend_above(figure, *grid, columns=2)
    models = ". ".join(
        f"{panel.title}: {'; '.join(own.title for own in panel.estimators)} ({panel.data})"
        for panel in panels
    )
    caption = (
        f"Power spectral densities of the lateral velocity and of the estimation errors, Figure 8 of the paper. {models}. Welch's method, "
        f"Hann windows of {SEGMENT_SECONDS:g} s, {listed([str(own[0].n_segments) for own in spectra])} segments."
    )
    return Figure("residual_spectra", caption, figure)


def _rows(panel: Panel, spectra: Sequence[Periodogram]) -> list[dict[str, object]]:
    signal, *errors = spectra
    return [
        {
            "panel": panel.title,
            "data": panel.data,
            "estimator": own.title,
            **{f"below_v_{hz:g}": decibels(signal.level(hz), error.level(hz)) for hz in READ_AT_HZ},
            **{
                f"above_ksnn_{hz:g}": decibels(error.level(hz), errors[0].level(hz))
                for hz in READ_AT_HZ
            },
            "exceeds_v_from": exceeding(signal, error),
        }
        for own, error in zip(panel.estimators, errors, strict=True)
    ]


def exceeding(signal: Periodogram, error: Periodogram) -> float:
    """Frequency from which on the error has more power than the signal in every third of an octave; NaN if nowhere [Hz]."""
    top = min(HIGHEST_HZ, 0.8 * float(signal.frequency[-1]))
    centres = [
        own for own in 10.0 ** (np.arange(-20, 21) / 10.0) if signal.frequency[2] <= own <= top
    ]
    above = [error.level(hz) > signal.level(hz) for hz in centres]
    last_below = max(
        (position for position, is_above in enumerate(above) if not is_above), default=-1
    )
    return float(centres[last_below + 1]) if last_below + 1 < len(centres) else math.nan


def _table(frame: pd.DataFrame, panels: Sequence[Panel]) -> Table:
    columns = {
        "panel": Column("test"),
        "data": Column("data"),
        "estimator": Column("estimator"),
        **{
            f"below_v_{hz:g}": Column(f"below v at {hz:g} Hz [dB]", decimals=1) for hz in READ_AT_HZ
        },
        **{
            f"above_ksnn_{hz:g}": Column(f"above KS-NN at {hz:g} Hz [dB]", decimals=1)
            for hz in READ_AT_HZ
        },
        "exceeds_v_from": Column("exceeds v from [Hz]", decimals=2),
    }
    kinds = listed(list(dict.fromkeys(panel.data for panel in panels)))
    caption = f"Residuals in thirds of an octave: how far below the power of v, how far above the KS-NN's. Data: {kinds}."
    return Table("residual_levels", caption, frame, columns)


def _in_words(panels: Sequence[Panel], spectra: Sequence[Sequence[Periodogram]]) -> str:
    paragraphs = []
    for panel, (signal, *errors) in zip(panels, spectra, strict=True):
        compared = "; ".join(
            _beside(panel, own, error, errors[0])
            for own, error in zip(panel.estimators[1:], errors[1:], strict=True)
        )
        crossings = [
            (own.title, exceeding(signal, error))
            for own, error in zip(panel.estimators, errors, strict=True)
        ]
        noisy = [
            f"{title} from {fixed(hz, 1)} Hz on" for title, hz in crossings if not math.isnan(hz)
        ]
        quiet = [title for title, hz in crossings if math.isnan(hz)]
        sentences = [f"**{panel.title}** ({panel.data})."]
        if compared:
            sentences.append(f"Against the error of {panel.estimators[0].title}: {compared}.")
        if noisy:
            sentences.append(f"The error has more power than v itself: {'; '.join(noisy)}.")
        if quiet:
            sentences.append(f"It stays below v up to the highest frequencies: {'; '.join(quiet)}.")
        paragraphs.append(" ".join(sentences))
    return "\n\n".join(paragraphs)


def _beside(panel: Panel, own: Residuals, error: Periodogram, first: Periodogram) -> str:
    """How far one error lies above the first, and above the paper's where it is given."""
    levels = [decibels(error.level(hz), first.level(hz)) for hz in READ_AT_HZ]
    sides = [
        f"{fixed(abs(level), 1)} dB {'above' if level >= 0 else 'below'} at {hz:g} Hz"
        for level, hz in zip(levels, READ_AT_HZ, strict=True)
    ]
    known = (
        own.estimator == "lstm"
        and "corvette" in panel.test.lower()
        and "ferrari" in panel.trained_on.lower()
    )
    return f"{own.title} {listed(sides)}" + (
        f" (the paper, on the real cars: {PUBLISHED_ABOVE_KSNN} above)" if known else ""
    )
