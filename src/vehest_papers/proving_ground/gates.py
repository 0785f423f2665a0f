"""Gates on the simulated race cars: what their inputs must look like before any network is trained
on them.

Fixed by what Da Lio et al. 2023 print of their recordings (Table I, Section VII-A) and by the one
real recording. No estimator's error is among them but that of the static map on the car that it is
fitted to, the share of v that a map leaves unexplained.
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
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, MISSING, fixed, new_figure
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
from vehest_papers.proving_ground.tally import MIN_SPEED
from vehest_papers.proving_ground.vehicles import is_accident

BEFORE = "sim_two_cars"
AFTER = "sim_race_cars"
"""The first simulated race cars, and those that networks are trained on now."""

RATE_HZ = 20.0  # of the paper's recordings, to which all are resampled
BANDS_HZ = tuple(float(0.1 * 2.0 ** (step / 3.0)) for step in range(14))
"""Centres of thirds of an octave, 0.1 to 2.0 Hz."""

MAX_SPECTRUM_DB = 3.0
MAP_RANGE = (0.08, 0.13)  # FVU of a static map fitted to the car itself; the real Ferrari: 0.10
MAX_BIAS_DIFFERENCE = 0.03  # m/s²
CARS = {"c": "Corvette", "f": "Ferrari", "j": "Jaguar"}  # first letter of a drive -> car
EXCITATION_HZ = (0.1, 0.3, 1.0)
FIGURE_HZ = (0.08, 5.0)
CHANNELS = ("vx", "yaw_rate", "ay", "vy_ref")

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
"""Quantity of Table I -> its name, and how far from the paper's value it may be.

The paper's two sets of a car differ by up to 24 % in v, 2.4 % in ay, 30 % in the lowest speed and
7 % in the yaw rate.
"""

Drives = Mapping[str, Sequence[Recording]]  # set or car -> its recordings


@dataclass(frozen=True)
class Gate:
    """One quantity of one set of drives, and the range that it must be in."""

    subject: str  # set or car
    quantity: str  # name with unit
    reference: str  # value of the paper or the real recording
    low: float  # of the range, included
    high: float  # likewise
    values: Mapping[str, float]  # data set -> its value; without data sets that have no such drives

    def is_met(self, dataset: str) -> bool:
        """Whether the value of a data set is in the range."""
        return dataset in self.values and self.low <= self.values[dataset] <= self.high


def fit_static_map(recordings: Sequence[Recording]) -> StaticMap:
    """Fit the baseline v = r (b - k u²) to recordings with vx, yaw_rate and vy_ref."""
    static_map = StaticMap(StaticMap.settings_type(RATE_HZ))
    static_map.values = static_map.closed_form(recordings)
    return static_map


def fvu_of_map(static_map: StaticMap, recordings: Sequence[Recording]) -> float:
    """FVU of a static map on recordings [1]."""
    vy = np.concatenate([recording["vy_ref"] for recording in recordings])
    mapped = np.concatenate(
        [
            static_map.run(recording.stack(static_map.channels), None)[0]["vy"]
            for recording in recordings
        ]
    )
    return float(np.var(vy - mapped) / np.var(vy))


def gates(drives: Mapping[str, Drives], real: Sequence[Recording]) -> list[Gate]:
    """All gates; those on the spectrum are left out without the real Ferrari.

    Parameters
    ----------
    drives
        Data set -> its sets of drives, at `RATE_HZ`.
    real
        Recordings of the real Ferrari.
    """
    judged = [
        gate
        for name, published in PUBLISHED.items()
        for gate in _gates_of_table_1(name, published, drives)
    ]
    by_car = {dataset: _by_car(sets) for dataset, sets in drives.items()}
    real_fvu = f"{fvu_of_map(fit_static_map(real), real):.2f} (real Ferrari)" if real else MISSING
    for letter, car in CARS.items():
        of_car = {dataset: cars[letter] for dataset, cars in by_car.items() if letter in cars}
        bias = PUBLISHED_BIAS.get(car.lower())
        if bias is not None:
            biases = {dataset: mean_bias(recordings) for dataset, recordings in of_car.items()}
            low = bias - MAX_BIAS_DIFFERENCE
            high = bias + MAX_BIAS_DIFFERENCE
            title = "mean bias of ay − ωu [m/s²]"
            judged.append(Gate(car, title, fixed(bias, 2), low, high, biases))
        fvus = {
            dataset: fvu_of_map(fit_static_map(recordings), recordings)
            for dataset, recordings in of_car.items()
        }
        judged.append(Gate(car, "FVU of the car's own static map", real_fvu, *MAP_RANGE, fvus))
    return judged + (_gates_of_spectrum(by_car, real) if real else [])


def _gates_of_table_1(name: str, published: Statistics, drives: Mapping[str, Drives]) -> list[Gate]:
    """Gates on one row of Table I, ``C-1`` say, whose drives begin with ``c1``."""
    key = name.replace("-", "").lower()
    paper = _quantities(published)
    ours = {
        dataset: _quantities(statistics(sets[key]))
        for dataset, sets in drives.items()
        if sets.get(key)
    }
    judged = []
    for quantity, (title, kind, tolerance) in QUANTITIES.items():
        value = paper[quantity]
        margin = tolerance * abs(value) if kind == "relative" else tolerance
        values = {dataset: of_dataset[quantity] for dataset, of_dataset in ours.items()}
        reference = f"{value:.3g}".replace("-", "−")
        judged.append(Gate(name, title, reference, value - margin, value + margin, values))
    return judged


def _quantities(row: Statistics) -> dict[str, float]:
    """A row of Table I by the names of `QUANTITIES`."""
    return {**asdict(row), "ratio": row.velocity_over_ay}


def _gates_of_spectrum(by_car: Mapping[str, Drives], real: Sequence[Recording]) -> list[Gate]:
    """Gates on the process noise of the Ferrari, a third of an octave each."""
    real_noise = spectra_of(real)[1]
    noise = {dataset: spectra_of(cars["f"])[1] for dataset, cars in by_car.items() if "f" in cars}
    judged = []
    for hz in BANDS_HZ:
        levels = {
            dataset: decibels(spectrum.level(hz), real_noise.level(hz))
            for dataset, spectrum in noise.items()
        }
        title = f"process noise at {hz:.2g} Hz, against the real one [dB]"
        judged.append(Gate("Ferrari", title, "0", -MAX_SPECTRUM_DB, MAX_SPECTRUM_DB, levels))
    return judged


def _by_car(sets: Drives) -> dict[str, list[Recording]]:
    """First letter of `CARS` -> all recordings of that car, if it has any."""
    cars = {
        letter: [drive for key, of_set in sets.items() if key[:1] == letter for drive in of_set]
        for letter in CARS
    }
    return {letter: recordings for letter, recordings in cars.items() if recordings}


def drives_of(
    datasets: Sequence[StoredDataset],
) -> tuple[dict[str, dict[str, list[Recording]]], list[Recording]]:
    """Recordings at `RATE_HZ` with the channels that gates need.

    Returns
    -------
    dict
        Data set of simulated race cars -> set -> recordings.
    list of Recording
        Of the real Ferrari.
    """
    drives: dict[str, dict[str, list[Recording]]] = {}
    real: list[Recording] = []
    for dataset in datasets:
        if dataset.name not in (BEFORE, AFTER, PROFILES["ferrari_250_lm"].counterpart):
            continue
        for recording in dataset.recordings():
            resampled = Resample(RATE_HZ)(recording.select(CHANNELS))
            if dataset.kind == "real":
                real.append(resampled)
            else:
                name = recording.id.split("_")[0]
                drives.setdefault(dataset.name, {}).setdefault(name, []).append(resampled)
    return drives, real


def counts(judged: Sequence[Gate]) -> list[dict[str, object]]:
    """Numbers of gates for the template: one entry, or none without gates."""
    if not judged:
        return []
    missed = [
        f"{gate.subject}: {gate.quantity} ({gate.values.get(AFTER, math.nan):.3g})"
        for gate in judged
        if not gate.is_met(AFTER)
    ]
    return [
        {
            "n_gates": len(judged),
            "n_met": len(judged) - len(missed),
            "n_met_before": sum(gate.is_met(BEFORE) for gate in judged),
            "has_before": any(BEFORE in gate.values for gate in judged),
            "has_real": any("process noise" in gate.quantity for gate in judged),
            "missed": missed,
        }
    ]


def gates_frame(judged: Sequence[Gate]) -> pd.DataFrame:
    """Every gate with its range and values, a row each."""
    return pd.DataFrame(
        [
            {
                "of": gate.subject,
                "quantity": gate.quantity,
                "wanted": gate.reference,
                "low": gate.low,
                "high": gate.high,
                "before": gate.values.get(BEFORE, math.nan),
                "after": gate.values.get(AFTER, math.nan),
                "met": "yes" if gate.is_met(AFTER) else "NO",
            }
            for gate in judged
        ]
    )


def counts_table(judged: Sequence[Gate]) -> Table:
    """How many gates each set of drives and each car meets: table ``gates_met``."""
    rows = []
    for subject in dict.fromkeys(gate.subject for gate in judged):
        of_subject = [gate for gate in judged if gate.subject == subject]
        row: dict[str, object] = {"subject": subject, "gates": len(of_subject)}
        row |= {name: sum(gate.is_met(name) for gate in of_subject) for name in (BEFORE, AFTER)}
        rows.append(row)
    columns = {"subject": Column("set or car"), "gates": Column("gates", decimals=0)}
    columns |= {name: Column(f"met by {name}", decimals=0) for name in (BEFORE, AFTER)}
    return Table("gates_met", "Gates that are met. SIMULATED.", pd.DataFrame(rows), columns)


def excitation_table(datasets: Sequence[StoredDataset]) -> Table:
    """How much every vehicle slides, and how far its signal exceeds what the kinematics leave
    unexplained.

    Spectra are those of drives that last a segment or longer; a static map is fitted to the very
    drives.
    """
    rows: list[dict[str, object]] = []
    for dataset in datasets:
        cars: dict[str, list[Recording]] = {}
        for recording in dataset.recordings():
            if not is_accident(recording):
                drive = recording.select(CHANNELS)
                drive = Resample(RATE_HZ)(drive) if drive.rate_hz > RATE_HZ else drive
                cars.setdefault(recording.vehicle, []).append(drive)
        rows += [
            {"vehicle": vehicle, "dataset": dataset.name, "kind": dataset.kind}
            | _excitation(recordings)
            for vehicle, recordings in cars.items()
        ]
    columns = {
        "vehicle": Column("vehicle"),
        "dataset": Column("data set"),
        "kind": Column("kind"),
        "drives": Column("drives", decimals=0),
        "ay": Column("|ay| 99 % [m/s²]", decimals=2),
        "sideslip": Column("|β| 99 % [deg]", decimals=2),
        "map": Column("FVU of a static map fitted to it", decimals=3),
    }
    columns |= {
        f"above_{hz:g}": Column(f"v̇ over noise at {hz:g} Hz [dB]", decimals=1)
        for hz in EXCITATION_HZ
    }
    caption = (
        "Excitation of each vehicle at 20 Hz without accidents: 99 % quantiles above 5 m/s, FVU "
        "that a static map fitted to the drives leaves, and v̇ over the process noise."
    )
    return Table("excitation", caption, pd.DataFrame(rows), columns)


def _excitation(recordings: Sequence[Recording]) -> dict[str, object]:
    speed, ay, vy = (
        np.concatenate([recording[name] for recording in recordings])
        for name in ("vx", "ay", "vy_ref")
    )
    moving = speed > MIN_SPEED
    sideslip = np.degrees(np.arctan2(vy[moving], speed[moving]))
    row: dict[str, object] = {
        "drives": len(recordings),
        "ay": float(np.quantile(np.abs(ay[moving]), 0.99)),
        "sideslip": float(np.quantile(np.abs(sideslip), 0.99)),
        "map": fvu_of_map(fit_static_map(recordings), recordings),
    }
    long_drives = [drive for drive in recordings if drive.duration >= SEGMENT_SECONDS]
    if long_drives:
        rate, noise = spectra_of(long_drives)
        row |= {f"above_{hz:g}": decibels(rate.level(hz), noise.level(hz)) for hz in EXCITATION_HZ}
    return row


def static_maps_table(drives: Mapping[str, Drives]) -> Table:
    """FVU that a static map of one car leaves on another, by data set: table ``static_maps``."""
    rows = []
    for dataset in (BEFORE, AFTER):
        cars = _by_car(drives.get(dataset, {}))
        for letter, recordings in cars.items():
            static_map = fit_static_map(recordings)
            row: dict[str, object] = {"dataset": dataset, "fitted": CARS[letter]}
            row |= dict.fromkeys(CARS, math.nan)
            row |= {
                target_car: fvu_of_map(static_map, target) for target_car, target in cars.items()
            }
            row |= {"b": static_map.values["b"], "k": 1000.0 * static_map.values["k"]}
            rows.append(row)
    columns = {"dataset": Column("data set"), "fitted": Column("fitted to")}
    columns |= {letter: Column(f"FVU on the {car}", decimals=3) for letter, car in CARS.items()}
    columns |= {"b": Column("b [m]", decimals=2), "k": Column("k [10⁻³ s²/m]", decimals=2)}
    caption = (
        "FVU that the static map v = r·(b − k·u²) of one simulated car leaves on another: how far "
        "the cars differ."
    )
    return Table("static_maps", caption, pd.DataFrame(rows), columns)


def spectra_figure(drives: Mapping[str, Drives], real: Sequence[Recording]) -> Figure:
    """dv/dt and process noise of the real Ferrari and of each simulated car: figure
    ``gate_spectra``.
    """
    panels: list[tuple[str, Sequence[Recording]]] = [("Ferrari, real", real)] if real else []
    for letter, car in CARS.items():
        for dataset in (BEFORE, AFTER):
            of_car = _by_car(drives.get(dataset, {})).get(letter)
            if of_car:
                panels.append((f"{car}, simulated, {dataset}", of_car))
    n_rows = (len(panels) + 1) // 2
    with new_figure(DOUBLE_COLUMN, 1.9 * n_rows + 0.5) as figure:
        grid = figure.subplots(n_rows, 2, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes, (title, recordings) in zip(grid.flat, panels, strict=False):
            rate, noise = spectra_of(recordings)
            is_drawn = (rate.frequency >= FIGURE_HZ[0]) & (rate.frequency <= FIGURE_HZ[1])
            for spectrum, colour, dash, label in (
                (rate, "#0072B2", "solid", "$\\dot{v}$"),
                (noise, "#555555", "dashed", "process noise $\\dot{v} - (a_y - \\omega u)$"),
            ):
                frequency = spectrum.frequency[is_drawn]
                density = spectrum.density[is_drawn]
                axes.loglog(frequency, density, color=colour, linestyle=dash, label=label)
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
        "Spectra of v̇ and of the process noise. As in Figure 4 of Da Lio et al. 2023: how far the "
        "signal exceeds what the kinematics leave unexplained. Welch's method at 20 Hz, Hann "
        "windows of 25.6 s."
    )
    return Figure("gate_spectra", caption, figure)
