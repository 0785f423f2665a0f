"""Gates on the simulated race cars: what their inputs must look like before any network is trained on them.

Fixed by what Da Lio et al. 2023 print of their recordings (Table I, Section VII-A) and by the one real recording. No estimator's
error is among them but that of the static map on its own car, the share of v that a map leaves unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from vehest.data.recording import Recording
from vehest.data.transforms import Resample
from vehest.estimators.static_map import StaticMap
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, fixed, new_figure
from vehest.studies.artefacts import StoredDataset
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.spectra import SEGMENT_SECONDS, decibels, mean_bias
from vehest_papers.ksnn.data_quality import (
    PUBLISHED,
    PUBLISHED_BIAS,
    Statistics,
    spectra_of,
    statistics,
)
from vehest_papers.proving_ground.papers import PROFILES
from vehest_papers.proving_ground.tally import MOVING

BEFORE = "sim_two_cars"
AFTER = "sim_race_cars"
"""Data sets whose gates are shown: the first simulated cars, and those that the study of the KS-NN learns on."""
RATE_HZ = 20.0  # rate of the paper's recordings, at which all is read
BANDS_HZ = tuple(
    float(0.1 * 2.0 ** (step / 3.0)) for step in range(14)
)  # centres of thirds of an octave, 0.1 to 2.0 Hz
SPECTRUM_DB = 3.0
MAP_RANGE = (0.08, 0.13)  # FVU of a static map fitted on the car itself; the real Ferrari: 0.10
BIAS_WITHIN = 0.03
CARS = {
    "c": "Corvette",
    "f": "Ferrari",
    "j": "Jaguar",
}  # first letter of a drive -> the car that it is like

READ_AT_HZ = (0.1, 0.3, 1.0)

QUANTITIES = {
    "v_low": ("v, 1 % quantile [m/s]", "relative", 0.20),
    "v_high": ("v, 99 % quantile [m/s]", "relative", 0.20),
    "ay": ("|ay|, 99 % quantile [m/s²]", "relative", 0.05),
    "ratio": ("v over ay, 1 to 99 % [s]", "relative", 0.20),
    "u_min": ("lowest speed [m/s]", "absolute", 4.0),
    "u_max": ("highest speed [m/s]", "absolute", 5.0),
    "yaw_rate_min": ("lowest yaw rate [rad/s]", "relative", 0.15),
    "yaw_rate_max": ("highest yaw rate [rad/s]", "relative", 0.15),
    "length_km": ("length [km]", "relative", 0.05),
    "minutes": ("duration [min]", "relative", 0.05),
}
"""Quantity of Table I -> its name, and how far from the paper's value it may lie: the paper's own two sets of a car are up to
24 % apart in v, 2.4 % in ay, 30 % in the lowest speed and 7 % in the yaw rate."""


@dataclass(frozen=True)
class Gate:
    """One quantity of one set of drives, and the range that it must lie in."""

    of: str  # set or car
    quantity: str  # in words, with its unit
    wanted: str  # what the paper or the real recording has, in words
    low: float  # of the range, included
    high: float  # likewise
    values: Mapping[
        str, float
    ]  # data set -> what it has; a data set without these drives is left out

    def met(self, dataset: str) -> bool:
        """Whether a data set's value lies in the range."""
        return dataset in self.values and self.low <= self.values[dataset] <= self.high


def static_map_of(recordings: Sequence[Recording]) -> StaticMap:
    """The baseline v = r (b - k u²) with both numbers fitted to recordings with vx, yaw_rate and vy_ref."""
    fitted = StaticMap(StaticMap.settings_type(RATE_HZ))
    fitted.values = fitted.closed_form(recordings)
    return fitted


def left_by(fitted: StaticMap, recordings: Sequence[Recording]) -> float:
    """FVU of a static map on recordings [1]."""
    vy = np.concatenate([own["vy_ref"] for own in recordings])
    mapped = np.concatenate(
        [fitted.run(own.stack(fitted.channels), None)[0]["vy"] for own in recordings]
    )
    return float(np.var(vy - mapped) / np.var(vy))


def _quantities(own: Statistics) -> dict[str, float]:
    """A row of Table I by the names of `QUANTITIES`."""
    return {**asdict(own), "ratio": (own.v_high - own.v_low) / (2.0 * own.ay)}


def gates(
    drives: Mapping[str, Mapping[str, Sequence[Recording]]], real: Sequence[Recording]
) -> list[Gate]:
    """All gates, of data sets at `RATE_HZ`; without the real Ferrari the gate on its spectrum is left out."""
    found = [
        gate
        for name, published in PUBLISHED.items()
        for gate in _of_table_one(name, published, drives)
    ]
    by_car = {name: _by_car(sets) for name, sets in drives.items()}
    real_map = f"{left_by(static_map_of(real), real):.2f} (real Ferrari)" if real else "–"
    for letter, car in CARS.items():
        own = {name: cars[letter] for name, cars in by_car.items() if letter in cars}
        wanted = PUBLISHED_BIAS.get(car.lower())
        if wanted is not None:
            biases = {name: mean_bias(recordings) for name, recordings in own.items()}
            found.append(
                Gate(
                    car,
                    "mean bias of ay − ωu [m/s²]",
                    fixed(wanted, 2),
                    wanted - BIAS_WITHIN,
                    wanted + BIAS_WITHIN,
                    biases,
                )
            )
        left = {
            name: left_by(static_map_of(recordings), recordings) for name, recordings in own.items()
        }
        found.append(Gate(car, "FVU of the car's own static map", real_map, *MAP_RANGE, left))
    if real:
        noise = spectra_of(real)[1]
        own_noise = {name: spectra_of(cars["f"])[1] for name, cars in by_car.items() if "f" in cars}
        for hz in BANDS_HZ:
            levels = {
                name: decibels(own.level(hz), noise.level(hz)) for name, own in own_noise.items()
            }
            title = f"process noise at {hz:.2g} Hz, against the real one [dB]"
            found.append(Gate("Ferrari", title, "0", -SPECTRUM_DB, SPECTRUM_DB, levels))
    return found


def _by_car(sets: Mapping[str, Sequence[Recording]]) -> dict[str, list[Recording]]:
    """First letter of `CARS` -> all recordings of that car, if it has any."""
    cars = {
        letter: [own for key, part in sets.items() if key[:1] == letter for own in part]
        for letter in CARS
    }
    return {letter: recordings for letter, recordings in cars.items() if recordings}


def _of_table_one(
    name: str, published: Statistics, drives: Mapping[str, Mapping[str, Sequence[Recording]]]
) -> list[Gate]:
    """Gates on one row of Table I, ``C-1`` say, whose drives begin with ``c1``."""
    key = name.replace("-", "").lower()
    paper = _quantities(published)
    ours = {
        dataset: _quantities(statistics(sets[key]))
        for dataset, sets in drives.items()
        if sets.get(key)
    }
    found = []
    for quantity, (title, how, within) in QUANTITIES.items():
        wanted = paper[quantity]
        room = within * abs(wanted) if how == "relative" else within
        values = {dataset: own[quantity] for dataset, own in ours.items()}
        found.append(
            Gate(
                name, title, f"{wanted:.3g}".replace("-", "−"), wanted - room, wanted + room, values
            )
        )
    return found


def drives_of(
    datasets: Sequence[StoredDataset],
) -> tuple[dict[str, dict[str, list[Recording]]], list[Recording]]:
    """Recordings at `RATE_HZ` with what gates read: of the simulated race cars by data set and set, and of the real Ferrari."""
    drives: dict[str, dict[str, list[Recording]]] = {}
    real: list[Recording] = []
    for dataset in datasets:
        if (
            dataset.name not in (BEFORE, AFTER)
            and dataset.name != PROFILES["ferrari_250_lm"].counterpart
        ):
            continue
        for recording in dataset.recordings():
            kept = Resample(RATE_HZ)(recording.select(["vx", "yaw_rate", "ay", "vy_ref"]))
            if dataset.kind == "real":
                real.append(kept)
            else:
                drives.setdefault(dataset.name, {}).setdefault(
                    recording.id.split("_")[0], []
                ).append(kept)
    return drives, real


def blocks(datasets: Sequence[StoredDataset]) -> list[Block]:
    """The table of gates with its verdict in a sentence, and the spectra; nothing where the race cars are not among the data sets."""
    drives, real = drives_of(datasets)
    if AFTER not in drives:
        return []
    found = gates(drives, real)
    rows = [
        {
            "of": gate.of,
            "quantity": gate.quantity,
            "wanted": gate.wanted,
            "low": gate.low,
            "high": gate.high,
            "before": gate.values.get(BEFORE, np.nan),
            "after": gate.values.get(AFTER, np.nan),
            "met": "yes" if gate.met(AFTER) else "NO",
        }
        for gate in found
    ]
    missed = [
        f"{gate.of}: {gate.quantity} ({gate.values.get(AFTER, np.nan):.3g})"
        for gate in found
        if not gate.met(AFTER)
    ]
    met_before = sum(gate.met(BEFORE) for gate in found)
    verdict = f"{len(found) - len(missed)} of {len(found)} gates are met by `{AFTER}`"
    verdict += f"; before, by `{BEFORE}`, {met_before} were." if BEFORE in drives else "."
    verdict += f" Not met: {'; '.join(missed)}." if missed else ""
    absent = (
        "" if real else " The gate on the spectrum needs the real recording, which is not here."
    )
    table = Table(
        "gates",
        "Gates on the simulated race cars' inputs, fixed before any network was trained on them: what the paper prints of its recordings "
        "or the real Ferrari shows, the range that counts as met, the first simulated cars, and today's.",
        pd.DataFrame(rows),
        {
            "of": Column("of"),
            "quantity": Column("quantity"),
            "wanted": Column("paper or real"),
            "low": Column("from", each=True),
            "high": Column("to", each=True),
            "before": Column("before", each=True),
            "after": Column("after", each=True),
            "met": Column("met"),
        },
    )
    return [
        "## Are the race cars as hard as the road?",
        f"{verdict}{absent} No error of a network or an observer is a gate.",
        table,
        _figure(drives, real),
        _differ(drives),
        excitation(datasets),
    ]


def excitation(datasets: Sequence[StoredDataset]) -> Table:
    """How much every vehicle slides, and how far its signal stands above what the kinematics leave unexplained.

    Spectra are those of drives that last a segment or longer; a static map is fitted to the very drives.
    """
    rows: list[dict[str, object]] = []
    for dataset in datasets:
        cars: dict[str, list[Recording]] = {}
        for recording in dataset.recordings():
            flags = recording.provenance.get("flags", {})
            if not (flags.get("spun") or flags.get("left_road")):
                kept = recording.select(["vx", "yaw_rate", "ay", "vy_ref"])
                cars.setdefault(recording.vehicle, []).append(
                    Resample(RATE_HZ)(kept) if kept.rate_hz > RATE_HZ else kept
                )
        for vehicle, recordings in cars.items():
            u, ay, v = (
                np.concatenate([own[name] for own in recordings]) for name in ("vx", "ay", "vy_ref")
            )
            moving = u > MOVING
            long = [own for own in recordings if own.duration >= SEGMENT_SECONDS]
            row: dict[str, object] = {
                "vehicle": vehicle,
                "dataset": dataset.name,
                "kind": dataset.kind,
                "drives": len(recordings),
                "ay": float(np.quantile(np.abs(ay[moving]), 0.99)),
                "sideslip": float(
                    np.degrees(np.quantile(np.abs(np.arctan2(v[moving], u[moving])), 0.99))
                ),
                "map": left_by(static_map_of(recordings), recordings),
            }
            if long:
                rate, noise = spectra_of(long)
                row |= {
                    f"above_{hz:g}": decibels(rate.level(hz), noise.level(hz)) for hz in READ_AT_HZ
                }
            rows.append(row)
    return Table(
        "excitation",
        "What each vehicle's drives excite, accidents left out, at 20 Hz: 99 % quantiles above 5 m/s, FVU that a static map fitted to them "
        "leaves, and how far v̇ stands above the process noise. A map that leaves little, or a signal below the noise, tells "
        "estimators apart by little.",
        pd.DataFrame(rows),
        {
            "vehicle": Column("vehicle"),
            "dataset": Column("data set"),
            "kind": Column("kind"),
            "drives": Column("drives", decimals=0),
            "ay": Column("|ay| 99 % [m/s²]", decimals=2),
            "sideslip": Column("|β| 99 % [deg]", decimals=2),
            "map": Column("FVU of the own static map", decimals=3),
            **{
                f"above_{hz:g}": Column(f"v̇ over noise at {hz:g} Hz [dB]", decimals=1)
                for hz in READ_AT_HZ
            },
        },
    )


def _differ(drives: Mapping[str, Mapping[str, Sequence[Recording]]]) -> Table:
    """How much of v a static map of one car leaves on another, data set by data set."""
    rows = []
    for dataset in (name for name in (BEFORE, AFTER) if name in drives):
        cars = _by_car(drives[dataset])
        for letter, source in cars.items():
            fitted = static_map_of(source)
            errors = {other: left_by(fitted, target) for other, target in cars.items()}
            numbers = {"b": fitted.values["b"], "k": 1000.0 * fitted.values["k"]}
            rows.append(
                {
                    "dataset": dataset,
                    "fitted": CARS[letter],
                    **dict.fromkeys(CARS, math.nan),
                    **errors,
                    **numbers,
                }
            )
    return Table(
        "static_maps",
        "FVU that the static map v = r·(b − k·u²) of one simulated car leaves on another: how far the cars differ.",
        pd.DataFrame(rows),
        {
            "dataset": Column("data set"),
            "fitted": Column("fitted on"),
            **{letter: Column(f"FVU on the {car}", decimals=3) for letter, car in CARS.items()},
            "b": Column("b [m]", decimals=2),
            "k": Column("k [10⁻³ s²/m]", decimals=2),
        },
    )


def _figure(
    drives: Mapping[str, Mapping[str, Sequence[Recording]]], real: Sequence[Recording]
) -> Figure:
    """Figure 4 of the paper: dv/dt and process noise, the real Ferrari, and each simulated car before and after."""
    panels: list[tuple[str, Sequence[Recording]]] = [("Ferrari, real", real)] if real else []
    for letter, car in CARS.items():
        for name, when in ((BEFORE, "simulated, before"), (AFTER, "simulated, after")):
            own = _by_car(drives.get(name, {})).get(letter)
            if own:
                panels.append((f"{car}, {when}", own))
    with new_figure(DOUBLE_COLUMN, 1.9 * ((len(panels) + 1) // 2) + 0.5) as figure:
        grid = figure.subplots((len(panels) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes, (title, recordings) in zip(grid.flat, panels, strict=False):
            rate, noise = spectra_of(recordings)
            shown = (rate.frequency >= 0.08) & (rate.frequency <= 5.0)
            axes.loglog(
                rate.frequency[shown], rate.density[shown], color="#0072B2", label="$\\dot{v}$"
            )
            axes.loglog(
                noise.frequency[shown],
                noise.density[shown],
                color="#555555",
                linestyle="dashed",
                label="process noise $\\dot{v} - (a_y - \\omega u)$",
            )
            axes.set_title(title, loc="left")
            above = decibels(rate.level(1.0), noise.level(1.0))
            axes.annotate(
                f"{above:.0f} dB at 1 Hz",
                (1.0, rate.level(1.0)),
                textcoords="offset points",
                xytext=(4, 6),
                fontsize=7,
            )
            axes.set_ylabel("density [(m/s²)²/Hz]")
        for axes in grid[-1]:
            axes.set_xlabel("frequency [Hz]")
        legend_above(figure, grid[0, 0], columns=2)
    caption = (
        "Spectra of v̇ and of the process noise, as in the paper's Figure 4: how far the signal stands above what the kinematics leave "
        "unexplained. Welch's method at 20 Hz, Hann windows of 25.6 s."
    )
    return Figure("gate_spectra", caption, figure)
