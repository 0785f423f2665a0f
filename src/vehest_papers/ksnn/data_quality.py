"""Table I and Figures 4 and 5 of Da Lio et al. 2023: what the drives are like, and how much noise the kinematics see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, MISSING, fixed, listed, new_figure
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.spectra import (
    Periodogram,
    decibels,
    lateral_velocity_rate,
    mean_bias,
    periodogram,
    process_noise,
)
from vehest_papers.ksnn.subjects import car_colours, car_title, kinds_of, plain_frequencies

NOISE_COLOUR = "#555555"
READ_AT_HZ = (0.1, 0.3, 1.0, 3.0)
HIGHEST_HZ = 8.0  # frequencies above are not shown: resampling to 20 Hz has removed them
MOST_POINTS = 5000
AY_WIDTH = 1.0
LEAST_SAMPLES = 50
COMPARED_AY = 8.0


@dataclass(frozen=True)
class Statistics:
    """A row of Table I."""

    u_min: float  # lowest forward speed [m/s]
    u_max: float  # highest forward speed [m/s]
    v_low: float  # 0.01 quantile of the lateral velocity [m/s]
    v_high: float  # 0.99 quantile of the lateral velocity [m/s]
    yaw_rate_min: float  # [rad/s]
    yaw_rate_max: float  # [rad/s]
    ay: float  # 0.99 quantile of |a_y| [m/s²]
    length_km: float  # distance driven
    minutes: float  # duration


PUBLISHED: Mapping[str, Statistics] = {
    "C-1": Statistics(11.5, 63.7, -1.03, 1.3, -0.67, 0.61, 11.33, 35.4, 19.0),
    "C-2": Statistics(11.1, 61.2, -1.28, 1.43, -0.67, 0.63, 11.60, 24.1, 12.6),
    "F-1": Statistics(10.1, 61.2, -1.66, 1.80, -0.56, 0.55, 10.55, 45.8, 25.7),
    "F-2": Statistics(7.6, 65.4, -1.73, 1.62, -0.59, 0.59, 10.78, 33.6, 18.1),
}
"""Da Lio et al. 2023, Table I."""

PUBLISHED_BIAS: Mapping[str, float] = {"corvette": 0.10, "ferrari": -0.03}
"""Mean of v̇ - (a_y - ωu_m) by car [m/s²]: Da Lio et al. 2023, Section VII-A1."""


def statistics(recordings: Sequence[Recording]) -> Statistics:
    """Table I's figures over all samples of some recordings with vx, yaw_rate, ay and vy_ref."""
    speed, yaw_rate, ay, velocity = (
        np.concatenate([own[name] for own in recordings])
        for name in ("vx", "yaw_rate", "ay", "vy_ref")
    )
    low, high = np.quantile(velocity, [0.01, 0.99])
    return Statistics(
        u_min=float(speed.min()),
        u_max=float(speed.max()),
        v_low=float(low),
        v_high=float(high),
        yaw_rate_min=float(yaw_rate.min()),
        yaw_rate_max=float(yaw_rate.max()),
        ay=float(np.quantile(np.abs(ay), 0.99)),
        length_km=sum(float(own["vx"].sum() / own.rate_hz) for own in recordings) / 1000.0,
        minutes=sum(own.duration for own in recordings) / 60.0,
    )


def data_quality(sets: Mapping[str, Sequence[Recording]], source: str) -> list[Block]:
    """Table I and Figs. 4 and 5 by car, over all its sets of one kind; ``C-1`` to ``F-2`` stand beside the paper's; raises `DataError`."""
    groups: dict[tuple[str, str], list[Recording]] = {}
    for recording in (recording for recordings in sets.values() for recording in recordings):
        groups.setdefault((recording.vehicle, recording.kind), []).append(recording)
    ordered = dict(
        sorted(
            groups.items(),
            key=lambda item: (item[0][1], "ferrari" not in item[0][0].lower(), item[0][0]),
        )
    )
    spectra = {group: spectra_of(recordings) for group, recordings in ordered.items()}
    return [
        _table(sets, source),
        _figure_4(ordered, spectra, source),
        _noise_in_words(ordered, spectra),
        _figure_5(ordered, source),
        _handling_in_words(ordered),
    ]


def _table(sets: Mapping[str, Sequence[Recording]], source: str) -> Table:
    rows = []
    for name, recordings in sets.items():
        cars = listed(
            [car_title(vehicle) for vehicle in dict.fromkeys(own.vehicle for own in recordings)]
        )
        if name in PUBLISHED:
            rows.append(_row(name, "paper", cars, PUBLISHED[name]))
        rows.append(_row(name, f"ours, {kinds_of(recordings)}", cars, statistics(recordings)))
    columns = {
        "set": Column("ID"),
        "data": Column("data"),
        "vehicle": Column("vehicle"),
        "u": Column("u range [m/s]"),
        "v": Column("v range† [m/s]"),
        "yaw_rate": Column("ω range [rad/s]"),
        "ay": Column("max† of the magnitude of a_y [m/s²]", decimals=2),
        "length_km": Column("length [km]", decimals=1),
        "minutes": Column("duration [min]", decimals=1),
    }
    caption = (
        f'Statistics of the sets (the paper\'s Table I). Rows called "paper" are those of the real drives as published; ours: {source}. '
        "† 0.01 to 0.99 quantile of v, 0.99 quantile of the magnitude of a_y."
    )
    return Table("data_statistics", caption, pd.DataFrame(rows), columns)


def _row(name: str, data: str, vehicle: str, own: Statistics) -> dict[str, object]:
    words = {
        "u": f"{fixed(own.u_min, 1)} to {fixed(own.u_max, 1)}",
        "v": f"{fixed(own.v_low, 2)} to {fixed(own.v_high, 2)}",
        "yaw_rate": f"{fixed(own.yaw_rate_min, 2)} to {fixed(own.yaw_rate_max, 2)}",
    }
    return {"set": name, "data": data, "vehicle": vehicle, **words, **asdict(own)}


def spectra_of(recordings: Sequence[Recording]) -> tuple[Periodogram, Periodogram]:
    """Periodograms of dv/dt and of the process noise dv/dt - (a_y - ωu) [(m/s²)²/Hz] of recordings at one rate."""
    rate_hz = recordings[0].rate_hz
    return (
        periodogram([lateral_velocity_rate(own) for own in recordings], rate_hz),
        periodogram([process_noise(own) for own in recordings], rate_hz),
    )


def _figure_4(
    groups: Mapping[tuple[str, str], Sequence[Recording]],
    spectra: Mapping[tuple[str, str], tuple[Periodogram, Periodogram]],
    source: str,
) -> Figure:
    colours = car_colours(groups)
    with new_figure(DOUBLE_COLUMN * 0.75, 0.6 + 1.75 * len(groups)) as figure:
        panels = figure.subplots(len(groups), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        lowest = np.inf
        for axes, ((vehicle, kind), (rate, noise)) in zip(panels, spectra.items(), strict=True):
            shown = (rate.frequency > 1.5 * rate.frequency[1]) & (rate.frequency <= HIGHEST_HZ)
            hz = rate.frequency[shown]
            above = rate.density[shown]
            below = noise.density[shown]
            lowest = min(lowest, float(above.min()), float(below.min()))
            fill = partial(axes.fill_between, hz, above, below, linewidth=0, interpolate=True)
            fill(
                where=above >= below,
                color=colours[vehicle, kind],
                alpha=0.16,
                label="signal above noise",
            )
            fill(where=above < below, color=NOISE_COLOUR, alpha=0.28, label="noise above signal")
            axes.loglog(hz, above, color=colours[vehicle, kind], label="$\\dot{v}$")
            axes.loglog(
                hz,
                below,
                color=NOISE_COLOUR,
                linestyle="dashed",
                label="process noise $\\dot{v} - (a_y - \\omega u_m)$",
            )
            axes.set_title(
                f"{car_title(vehicle)}, {kind}",
                loc="left",
                color=colours[vehicle, kind],
                fontweight="bold",
            )
            axes.set_title(
                f"mean bias {fixed(mean_bias(groups[vehicle, kind]), 3)} m/s²", loc="right"
            )
            axes.set_ylabel("density [(m/s²)²/Hz]")
            axes.set_xlim(hz[0], HIGHEST_HZ)
        panels[-1].set_xlabel("frequency [Hz]")
        plain_frequencies(panels[-1])
        legend_above(figure, panels[0], columns=2)
    segments = listed(
        [
            f"{noise.n_segments} segments ({car_title(vehicle)}, {kind})"
            for (vehicle, kind), (_, noise) in spectra.items()
        ]
    )
    caption = (
        f"Periodograms of v̇ and of the process noise v̇ − (a_y − ωu_m), Figure 4 of the paper. Data: {source}. Welch's method, Hann windows "
        f"of {1.0 / next(iter(spectra.values()))[0].frequency[1]:.1f} s, {segments}; shaded where signal and noise differ."
    )
    return Figure("process_noise", caption, figure)


def _noise_in_words(
    groups: Mapping[tuple[str, str], Sequence[Recording]],
    spectra: Mapping[tuple[str, str], tuple[Periodogram, Periodogram]],
) -> str:
    sentences = []
    for (vehicle, kind), (rate, noise) in spectra.items():
        differences = [decibels(rate.level(hz), noise.level(hz)) for hz in READ_AT_HZ]
        listed_levels = listed(
            [
                f"{fixed(own, 1)} dB at {hz:g} Hz"
                for own, hz in zip(differences, READ_AT_HZ, strict=True)
            ]
        )
        published = next(
            (bias for name, bias in PUBLISHED_BIAS.items() if name in vehicle.lower()), None
        )
        beside = (
            "" if published is None else f" (the paper, on real drives: {fixed(published, 2)} m/s²)"
        )
        bias = fixed(mean_bias(groups[vehicle, kind]), 3)
        sentences.append(
            f"**{car_title(vehicle)}** ({kind}): v̇ against the process noise {listed_levels}; mean bias {bias} m/s²{beside}."
        )
    lead = "How far v̇ stands out of what the kinematics leave unexplained (positive: signal above noise; means over a third of an octave):"
    return f"{lead}\n\n" + "\n".join(f"- {sentence}" for sentence in sentences)


def _figure_5(groups: Mapping[tuple[str, str], Sequence[Recording]], source: str) -> Figure:
    colours = car_colours(groups)
    with new_figure(DOUBLE_COLUMN * 0.75, 3.4) as figure:
        axes = figure.add_subplot()
        reach = 0.0
        points = []
        point_colours = []
        for position, ((vehicle, kind), recordings) in enumerate(groups.items()):
            ay, velocity = (
                np.concatenate([own[name] for own in recordings]) for name in ("ay", "vy_ref")
            )
            kept = np.linspace(0, len(ay) - 1, min(len(ay), MOST_POINTS)).round().astype(int)
            points.append(np.stack([ay[kept], velocity[kept]]))
            point_colours += [colours[vehicle, kind]] * len(kept)
            centres, medians = _medians(ay, velocity)
            label = f"{car_title(vehicle)}, {kind}"
            looks: dict[str, Any] = {
                "marker": "os^D"[position % 4],
                "markeredgecolor": "white",
                "markeredgewidth": 0.5,
                "markersize": 4.5,
            }
            axes.plot(
                centres,
                medians,
                color=colours[vehicle, kind],
                linewidth=1.4,
                label=label,
                zorder=3,
                **looks,
            )
            reach = max(reach, float(np.quantile(np.abs(velocity), 0.9995)))
        order = np.random.default_rng(0).permutation(
            len(point_colours)
        )  # so that no car hides another
        scattered = np.concatenate(points, axis=1)[:, order]
        axes.scatter(
            scattered[0],
            scattered[1],
            c=np.array(point_colours)[order],
            s=1.6,
            alpha=0.25,
            linewidths=0,
            rasterized=True,
            zorder=2,
        )
        axes.set_ylim(-1.08 * reach, 1.08 * reach)
        axes.set_xlabel("lateral acceleration $a_y$ [m/s²]")
        axes.set_ylabel("lateral velocity $v$ [m/s]")
        axes.legend(loc="best", title="medians in bins of 1 m/s²", alignment="left")
    caption = (
        f"Lateral velocity against lateral acceleration of each car, Figure 5 of the paper. Data: {source}; at most {MOST_POINTS} evenly "
        f"spaced samples a car, lines are medians over all samples in bins of {AY_WIDTH:g} m/s²."
    )
    return Figure("velocity_over_ay", caption, figure)


def _medians(ay: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres of bins of ay with enough samples, and the median velocity in each."""
    index = np.round(ay / AY_WIDTH).astype(int)
    kept = [own for own in np.unique(index) if (index == own).sum() >= LEAST_SAMPLES]
    return np.array(kept) * AY_WIDTH, np.array([np.median(velocity[index == own]) for own in kept])


def _handling_in_words(groups: Mapping[tuple[str, str], Sequence[Recording]]) -> str:
    sizes = {}
    for group, recordings in groups.items():
        ay, velocity = (
            np.concatenate([own[name] for own in recordings]) for name in ("ay", "vy_ref")
        )
        near = np.abs(np.abs(ay) - COMPARED_AY) < 0.5 * AY_WIDTH
        sizes[group] = (
            float(np.median(np.abs(velocity[near]))) if near.sum() >= LEAST_SAMPLES else np.nan
        )
    words = [
        f"{car_title(vehicle)} ({kind}) {fixed(size, 2) + ' m/s' if np.isfinite(size) else MISSING}"
        for (vehicle, kind), size in sizes.items()
    ]
    text = f"Median |v| at |a_y| between {COMPARED_AY - 0.5:g} and {COMPARED_AY + 0.5:g} m/s²: {listed(words)}."
    for kind in sorted({kind for _, kind in sizes}):
        cars = {
            name: [
                size
                for (vehicle, own), size in sizes.items()
                if own == kind and name in vehicle.lower()
            ]
            for name in PUBLISHED_BIAS
        }
        if all(len(own) == 1 and np.isfinite(own[0]) for own in cars.values()):
            larger = cars["ferrari"][0] > cars["corvette"][0]
            text += " In the paper the Ferrari reaches the larger lateral velocities for the same lateral acceleration; "
            text += f"of the {kind} cars here it {'does' if larger else 'does not'}."
    return text
