"""Figure 7 of Da Lio et al. 2023: how noise of the accelerations comes through, in closed form and by injecting noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.luenberger import Luenberger
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, fixed, line_of, listed, new_figure
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.reading import percent_below
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.noise_sensitivity import (
    NoiseSensitivity,
    ksnn_sensitivity,
    luenberger_sensitivity,
)
from vehest_papers.ksnn.subjects import Trained

YAW_RATES = (
    0.2,
    0.4,
)  # as in the paper: about the median of |ω| in its drives, and twice that [rad/s]
LOWEST_HZ = 0.01
HIGHEST_HZ = 10.0
CHANNELS = ("ay", "ax")
INJECTED_SAMPLES = 200_000
INJECTED_SIZE = 0.5  # standard deviation of the injected noise [m/s²]
SPEED = 25.0  # forward speed of the turn into which noise is injected [m/s]
SETTLING_SAMPLES = 2000
DASHES = ("solid", "dashed", "dashdot", "dotted")


@dataclass(frozen=True)
class Injected:
    """Outcome of injecting white noise into one acceleration of an estimator in a steady turn."""

    gain: float  # standard deviation of what is added to v̂, for noise of one m/s² a sample [m/s]
    scatter: float  # standard deviation of ``gain`` by chance, relative; successive outputs are correlated


def sensitivity_of(estimator: Estimator, yaw_rate: float, error: float = 0.0) -> NoiseSensitivity:
    """Closed form at constant yaw rate: a KS-NN's by its windows, linearised at û - u_m = ``error`` where it is not linear.

    Raises `ConfigurationError` where it is neither a KS-NN nor a Luenberger observer.
    """
    if isinstance(estimator, Ksnn):
        return ksnn_sensitivity(LocalModels.of(estimator).linearised(error), yaw_rate).truncated(
            estimator.settings.window
        )
    if isinstance(estimator, Luenberger):
        return luenberger_sensitivity(estimator, yaw_rate)
    raise ConfigurationError(
        f"noise sensitivities are known of 'ksnn' and 'luenberger', not of '{estimator.name}'"
    )


def injected(
    estimator: Estimator,
    yaw_rate: float,
    channel: str,
    *,
    n_samples: int = INJECTED_SAMPLES,
    seed: int = 0,
    error: float = 0.0,
) -> Injected:
    """Run an estimator through a steady turn with and without white noise in one acceleration.

    Args:
        estimator: as `sensitivity_of` takes it.
        yaw_rate: of the turn [rad/s].
        channel: ``ay`` or ``ax``.
        n_samples: length of the turn, of which the first `SETTLING_SAMPLES` do not count.
        error: û - u_m at which the closed form, from which the scatter comes, linearises a nonlinear network [m/s].
    """
    constants = {"yaw_rate": yaw_rate, "vx": SPEED, "ay": yaw_rate * SPEED, "ax": 0.0}
    clean = {name: np.full(n_samples, constants[name]) for name in estimator.channels}
    noisy = {
        **clean,
        channel: clean[channel]
        + INJECTED_SIZE * np.random.default_rng(seed).standard_normal(n_samples),
    }
    rate_hz = estimator.settings.rate_hz
    runs = estimator.estimate(
        [
            Recording("turn", "none", rate_hz, 0.0, channels, "simulated")
            for channels in (clean, noisy)
        ]
    )
    added = (runs[1]["vy"] - runs[0]["vy"])[SETTLING_SAMPLES:]
    response = sensitivity_of(estimator, yaw_rate, error).whole_impulse_responses()[
        CHANNELS.index(channel)
    ]
    energy = float(np.sum(response**2))
    n_correlated = (
        float(np.sum((np.correlate(response, response, mode="full") / energy) ** 2))
        if energy
        else 0.0
    )
    return Injected(
        float(np.sqrt(np.mean(added**2))) / INJECTED_SIZE,
        math.sqrt(n_correlated / (2 * len(added))),
    )


def sensitivities(
    columns: Sequence[tuple[Trained, Trained]],
    *,
    n_samples: int = INJECTED_SAMPLES,
    error: float = 0.0,
) -> list[Block]:
    """Magnitudes of H_Y and H_X, a column a training vehicle (KS-NN and Luenberger observer), with the check by injection.

    ``error`` [m/s] is the û - u_m at which nonlinear networks are linearised. Raises `ConfigurationError` for estimators of another kind.
    """
    frames = [
        pd.DataFrame([row for own in pair for row in _rows(own, n_samples, error)])
        for pair in columns
    ]
    return [
        _figure(columns, error),
        _in_words(columns, frames),
        _table(pd.concat(frames, ignore_index=True), n_samples),
    ]


def _rows(own: Trained, n_samples: int, error: float) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for yaw_rate in YAW_RATES:
        closed = sensitivity_of(own.estimator, yaw_rate, error)
        for position, channel in enumerate(CHANNELS):
            gain = closed.white_noise_gains()[position]
            band = closed.band_gains(HIGHEST_HZ)[position]
            found = injected(
                own.estimator, yaw_rate, channel, n_samples=n_samples, seed=len(rows), error=error
            )
            rows.append(
                {
                    "trained_on": own.trained_on,
                    "estimator": own.named,
                    "yaw_rate": yaw_rate,
                    "channel": channel,
                    "closed_form": gain,
                    "injected": found.gain,
                    "difference_percent": 100.0 * (found.gain / gain - 1.0) if gain else math.nan,
                    "scatter_percent": 100.0 * found.scatter,
                    "rate_hz": closed.rate_hz,
                    "pole": float(np.abs(closed.poles[0])),
                    "band": band,
                }
            )
    return rows


def _table(frame: pd.DataFrame, n_samples: int) -> Table:
    columns = {
        "trained_on": Column("trained on"),
        "estimator": Column("estimator"),
        "yaw_rate": Column("ω [rad/s]", decimals=1),
        "channel": Column("noise in"),
        "rate_hz": Column("rate [Hz]", decimals=0),
        "pole": Column("largest pole", decimals=4),
        "closed_form": Column("closed form, white [m/s]", decimals=4),
        "injected": Column("injected [m/s]", decimals=4),
        "difference_percent": Column("difference [%]", decimals=2),
        "scatter_percent": Column("chance, 1 σ [%]", decimals=2),
        "band": Column("0 to 10 Hz [m/s]", decimals=4),
    }
    caption = (
        "Closed form against injected noise: standard deviation of v̂ for white noise of 1 m/s² a sample in one acceleration, in a "
        f"steady turn at {SPEED:g} m/s ({fixed(n_samples, 0)} samples, simulated, σ = {INJECTED_SIZE:g} m/s², seeds 0 to 3). "
        "Estimators of different rates are compared by the last column: noise of density 1 (m/s²)/√Hz from 0 to 10 Hz in either."
    )
    return Table("noise_injection", caption, frame, columns)


def _figure(columns: Sequence[tuple[Trained, Trained]], error: float) -> Figure:
    frequency = np.geomspace(LOWEST_HZ, HIGHEST_HZ, 400)
    with new_figure(DOUBLE_COLUMN, 4.4) as figure:
        grid = figure.subplots(2, len(columns), sharex=True, sharey="row", squeeze=False)
        for column, pair in zip(grid.T, columns, strict=True):
            for own in pair:
                line = line_of(own.estimator.name, own.estimator.variant)
                for yaw_rate, dash in zip(YAW_RATES, DASHES, strict=False):
                    windowed = sensitivity_of(own.estimator, yaw_rate, error)
                    strong = replace(windowed, memory=None) if _settles(windowed) else windowed
                    label = f"{own.estimator.title}, |ω| = {yaw_rate:g} rad/s"
                    for axes, response, cut in zip(
                        column,
                        strong.response(frequency),
                        windowed.response(frequency),
                        strict=True,
                    ):
                        axes.loglog(
                            frequency,
                            np.abs(response),
                            color=line.colour,
                            linestyle=dash,
                            label=label,
                        )
                        if strong is not windowed and windowed.memory is not None:
                            axes.loglog(
                                frequency,
                                np.abs(cut),
                                color=line.colour,
                                linestyle=dash,
                                linewidth=0.6,
                                alpha=0.75,
                            )
            column[0].set_title(f"trained on {pair[0].trained_on}", loc="left")
            column[1].set_xlabel("frequency [Hz]")
        for row, label in zip(
            grid, ("|$H_Y$| [(m/s)/(m/s²)]", "|$H_X$| [(m/s)/(m/s²)]"), strict=True
        ):
            row[0].set_ylabel(label)
            top = max(
                float(np.max(line.get_ydata()))
                for axes in row
                for line in axes.lines
                if len(line.get_ydata())
            )
            row[0].set_ylim(top / 5000.0, 1.6 * top)
        grid[0, 0].set_xlim(LOWEST_HZ, HIGHEST_HZ)
        legend_above(figure, grid[0, 0], columns=2)
    nonlinear = [
        own
        for own, _ in columns
        if isinstance(own.estimator, Ksnn) and own.estimator.settings.n_hidden
    ]
    linearised = (
        f" The KS-NN is nonlinear: shown is its linearisation at û − u_m = {error:g} m/s."
        if nonlinear
        else ""
    )
    unstable = [
        (own, yaw_rate)
        for pair in columns
        for own in pair
        for yaw_rate in YAW_RATES
        if not _settles(sensitivity_of(own.estimator, yaw_rate, error))
    ]
    growing = "".join(
        f" The recursion of {own.described} does not settle at {yaw_rate:g} rad/s, which Appendix B does not cover: its window is shown."
        for own, yaw_rate in unstable
    )
    models = "; ".join(own.described for pair in columns for own in pair)
    caption = (
        f"Sensitivities of v̂ to noise of the lateral and of the longitudinal acceleration, Figure 7 of the paper. Models: {models}. Strong "
        f"lines: closed form of Appendix B; thin lines: of the windows that the network really sees, which forget.{linearised}{growing}"
    )
    return Figure("noise_sensitivities", caption, figure)


def _settles(sensitivity: NoiseSensitivity) -> bool:
    """Whether the recursion's own response to noise ends."""
    return float(np.abs(sensitivity.poles[0])) < 1.0


def _in_words(columns: Sequence[tuple[Trained, Trained]], frames: Sequence[pd.DataFrame]) -> str:
    sentences = []
    for (ksnn, luenberger), frame in zip(columns, frames, strict=True):
        bands = {
            (row["estimator"], row["yaw_rate"], row["channel"]): float(row["band"])
            for row in frame.to_dict("records")
        }
        words = []
        for yaw_rate in YAW_RATES:
            own, other = (
                [bands[title, yaw_rate, channel] for channel in CHANNELS]
                for title in (ksnn.named, luenberger.named)
            )
            if not any(other):
                words.append(
                    f"At |ω| = {yaw_rate:g} rad/s the Luenberger observer is reset and passes nothing."
                )
                continue
            compared = [
                f"{_compared(*sizes)} of a_{channel[1]}"
                for channel, *sizes in zip(CHANNELS, own, other, strict=True)
            ]
            words.append(
                f"At |ω| = {yaw_rate:g} rad/s the KS-NN passes {listed(compared)} than the Luenberger observer."
            )
        sentences.append(f"**Trained on {ksnn.trained_on}.** {' '.join(words)}")
    everything = pd.concat(frames)
    deviations = (everything["difference_percent"].abs() / everything["scatter_percent"]).dropna()
    check = (
        f"Injected noise and closed form differ by at most {fixed(float(deviations.max()), 1)} standard deviations of chance, "
        f"{fixed(float(everything['difference_percent'].abs().max()), 1)} %."
    )
    lead = "Noise of equal density from 0 to 10 Hz in an acceleration, by the standard deviation that it leaves in v̂:"
    return f"{lead}\n\n" + "\n".join(f"- {sentence}" for sentence in sentences) + f"\n\n{check}"


def _compared(value: float, other: float) -> str:
    return (
        f"{percent_below(value, other)} less"
        if value <= other
        else f"{100 * (value / other - 1):.0f} % more"
    )
