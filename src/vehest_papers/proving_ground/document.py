"""The report: gates on the race cars, and statistics of every car compared with papers and a
recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from vehest.data.errors import printable
from vehest.report.document import (
    REPORT,
    Block,
    Column,
    Document,
    Figure,
    Table,
    as_code,
    as_text,
    formatted,
)
from vehest.report.style import fixed, significant
from vehest.report.template import fill_template
from vehest.studies.artefacts import StudyArtefacts
from vehest_papers.proving_ground import drawing, gates
from vehest_papers.proving_ground.papers import RACE_SETS, profile_of
from vehest_papers.proving_ground.tally import FLAGS, MIN_SPEED
from vehest_papers.proving_ground.vehicles import DatasetTally, FlaggedDrive, VehicleData, survey

TEMPLATE = Path(__file__).with_name("report.md.j2")
SIMULATED = "simulated"
QUANTITIES: Mapping[str, str] = {
    "duration": "duration",
    "distance": "distance",
    "speed_mean": "mean speed",
    "vx_min": "smallest u",
    "vx_max": "largest u",
    "vy_q01": "v, 1 %",
    "vy_q99": "v, 99 %",
    "yaw_rate_min": "smallest ω",
    "yaw_rate_max": "largest ω",
    "ay_abs_q50": "|ay|, median",
    "ay_abs_q99": "|ay|, 99 %",
    "ax_q01": "ax, 1 %",
    "ax_q99": "ax, 99 %",
    "steer_abs_q99": "|steer|, 99 %",
    "sideslip_abs_q50": "|β|, median",
    "sideslip_abs_q99": "|β|, 99 %",
    "sideslip_abs_q999": "|β|, 99.9 %",
}
"""Quantity of `Tally.values` -> its name in a table."""


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises
    ------
    DataError
        A recording lacks a channel that is needed.
    """
    names = {dataset.name for dataset in artefacts.datasets}
    vehicles = survey(
        [
            dataset
            for dataset in artefacts.datasets
            if dataset.name != gates.BEFORE or gates.AFTER not in names
        ]
    )
    flagged = [drive for vehicle in vehicles.values() for drive in vehicle.flagged]
    blocks: list[Block] = [overview_table(vehicles), flagged_table(flagged)]
    blocks += real_tables(vehicles)
    beside_papers = papers_frame(vehicles)
    data = {"statistics": statistics(vehicles), "beside_papers": beside_papers}
    drives, real = gates.drives_of(artefacts.datasets)
    judged = gates.gates(drives, real) if gates.AFTER in drives else []
    if judged:
        data["gates"] = gates.gates_frame(judged)
        blocks += [
            gates.counts_table(judged),
            gates.spectra_figure(drives, real),
            gates.static_maps_table(drives),
            gates.excitation_table(artefacts.datasets),
        ]
    for vehicle in vehicles.values():
        blocks += vehicle_figures(vehicle)
    values = _values(artefacts, vehicles, flagged, judged) | papers_cells(beside_papers)
    return {REPORT: Document(artefacts.title, fill_template(TEMPLATE, values, blocks), data)}


def _values(
    artefacts: StudyArtefacts,
    vehicles: Mapping[str, VehicleData],
    flagged: Sequence[FlaggedDrive],
    judged: Sequence[gates.Gate],
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    return {
        "about": artefacts.about,
        "command": as_code(artefacts.command),
        "datasets": [
            {
                "name": dataset.name,
                "title": as_text(dataset.title),
                "kind": dataset.kind.upper(),
                "seed": dataset.config.get("seed"),
                "recordings": len(dataset.files),
            }
            for dataset in artefacts.datasets
        ],
        "absent": [
            {
                "name": dataset.name,
                "title": as_text(dataset.title),
                "licence": as_text(dataset.licence),
            }
            for dataset in artefacts.absent_datasets
        ],
        "gates": gates.counts(judged),
        "n_simulated": sum(vehicle.merged(SIMULATED).drives for vehicle in vehicles.values()),
        "n_flagged": len(flagged),
        "n_spun": sum(bool(drive.flags.get("spun")) for drive in flagged),
        "n_left_road": sum(bool(drive.flags.get("left_road")) for drive in flagged),
        "min_speed": f"{MIN_SPEED:g}",
        "ratios": [
            _ratios_to_real(vehicle)
            for vehicle in vehicles.values()
            if vehicle.real and vehicle.simulated
        ],
        "spreads": [
            spread for vehicle in vehicles.values() if (spread := _spread(vehicle)) is not None
        ],
        "vehicles": [
            {"name": name, "title": profile_of(name).title, "has_traces": bool(vehicle.segments)}
            for name, vehicle in vehicles.items()
        ],
    }


def _ratios_to_real(vehicle: VehicleData) -> dict[str, str]:
    """99 % quantiles of |β| and |ay| of the simulated drives over those of the real recording."""
    simulated = vehicle.merged(SIMULATED)
    real = vehicle.merged("real")
    ratios = {
        name: simulated.quantile(name, 0.99, absolute=True)
        / real.quantile(name, 0.99, absolute=True)
        for name in ("sideslip", "ay")
    }
    return {"title": profile_of(vehicle.name).title} | {
        name: fixed(ratio, 2) for name, ratio in ratios.items()
    }


def _spread(vehicle: VehicleData) -> dict[str, str] | None:
    """How evenly lateral acceleration and sideslip angle are spread within the limits of a paper's
    text.
    """
    profile = profile_of(vehicle.name)
    if profile.ay_limit is None or profile.sideslip_limit is None:
        return None
    tally = vehicle.merged(SIMULATED)
    edges, counts = tally.histogram("ay", 1.0)
    inside = counts[(edges[:-1] >= -profile.ay_limit) & (edges[1:] <= profile.ay_limit)]
    ratio = float(inside.max() / inside.min()) if inside.min() > 0 else math.inf
    return {
        "title": profile.title,
        "ay_limit": f"{profile.ay_limit:g}",
        "ay_share": fixed(100 * tally.share_within("ay", profile.ay_limit), 1),
        "fullest_over_emptiest": significant(ratio, 2),
        "sideslip_limit": f"{profile.sideslip_limit:g}",
        "sideslip_share": fixed(100 * tally.share_within("sideslip", profile.sideslip_limit), 1),
        "sideslip_999": fixed(tally.quantile("sideslip", 0.999, absolute=True), 1),
    }


def _tallies(vehicles: Mapping[str, VehicleData]) -> Iterator[tuple[str, DatasetTally]]:
    """Name of a vehicle and a data set of it, the simulated ones first."""
    for vehicle in vehicles.values():
        for of_dataset in (*vehicle.simulated.values(), *vehicle.real.values()):
            yield vehicle.name, of_dataset


def overview_table(vehicles: Mapping[str, VehicleData]) -> Table:
    """Drives, distances and quantiles of each vehicle and data set: table ``overview``."""
    rows = []
    for name, of_dataset in _tallies(vehicles):
        values = {key: value for key, (value, _) in of_dataset.all.values().items()}
        kind = of_dataset.dataset.kind
        row: dict[str, object] = {"vehicle": name, "dataset": of_dataset.dataset.name, "kind": kind}
        row |= {"drives": values["drives"], "minutes": values["duration"] / 60.0}
        row |= {"km": values["distance"] / 1000.0}
        row |= {key: values[key] for key in ("ay_abs_q99", "sideslip_abs_q99")}
        row |= {flag: values[flag] if kind == SIMULATED else math.nan for flag in FLAGS}
        rows.append(row)
    columns = {
        "vehicle": Column("vehicle"),
        "dataset": Column("data set"),
        "kind": Column("kind"),
        "drives": Column("drives", decimals=0),
        "minutes": Column("duration [min]", decimals=1),
        "km": Column("distance [km]", decimals=1),
        "ay_abs_q99": Column("|ay| 99 % [m/s²]", decimals=2),
        "sideslip_abs_q99": Column("|β| 99 % [deg]", decimals=2),
        "spun": Column("spun", decimals=0),
        "left_road": Column("left the road", decimals=0),
        "stood": Column("stood", decimals=0),
    }
    caption = (
        "Vehicles and data sets. Spun and left the road: by accident. Stood: drives at whose end "
        "the car stands, on purpose or after an accident."
    )
    return Table("overview", caption, pd.DataFrame(rows, columns=list(columns)), columns)


def statistics(vehicles: Mapping[str, VehicleData]) -> pd.DataFrame:
    """Every statistic of every set of drives, a row each."""
    columns = ["dataset", "kind", "vehicle", "set", "quantity", "value", "unit"]
    rows = [
        (dataset.name, dataset.kind, name, drives, quantity, float(f"{value:.9g}"), unit)
        for name, of_dataset in _tallies(vehicles)
        for dataset in [of_dataset.dataset]
        for drives, tally in of_dataset.tallies.items()
        for quantity, (value, unit) in tally.values().items()
        if dataset.kind == SIMULATED or quantity not in FLAGS
    ]
    return pd.DataFrame(rows, columns=columns)


def flagged_table(flagged: Sequence[FlaggedDrive]) -> Table:
    """Drives that spun or left the road by accident, a row each: table ``flagged``."""
    rows = [
        {
            "dataset": drive.dataset,
            "recording": printable(drive.recording),
            "vehicle": drive.vehicle,
            "manoeuvre": drive.manoeuvre,
            "stability_control": "on" if drive.stability_control else "off",
            "spun": "yes" if drive.flags.get("spun") else "no",
            "left_road": "yes" if drive.flags.get("left_road") else "no",
            "gave_up_at": _number(drive.flags.get("gave_up_at")),
            "largest_sideslip": math.degrees(_number(drive.flags.get("largest_sideslip"))),
        }
        for drive in flagged
    ]
    columns = {
        "recording": Column("drive"),
        "vehicle": Column("vehicle"),
        "manoeuvre": Column("manoeuvre"),
        "stability_control": Column("stability control"),
        "spun": Column("spun"),
        "left_road": Column("left the road"),
        "gave_up_at": Column("driver gave up at [s]", decimals=1),
        "largest_sideslip": Column("largest |β| above 1 m/s [deg]", decimals=1),
    }
    caption = "Drives that spun or left the road by accident."
    return Table("flagged", caption, pd.DataFrame(rows, columns=["dataset", *columns]), columns)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def papers_frame(vehicles: Mapping[str, VehicleData]) -> pd.DataFrame:
    """What the papers' tables and text state of their recordings, and ours, a row a quantity of a
    set.
    """
    rows = []
    for vehicle in vehicles.values():
        for of_dataset in vehicle.simulated.values():
            for published in profile_of(vehicle.name).sets:
                if published.drives not in of_dataset.tallies:
                    continue
                ours = of_dataset.tallies[published.drives].values()
                for quantity, value in published.values.items():
                    simulated, unit = ours[quantity]
                    rows.append(
                        {
                            "vehicle": vehicle.name,
                            "set": published.name,
                            "quantity": QUANTITIES.get(quantity, quantity),
                            "unit": unit,
                            "paper": value,
                            "simulated": simulated,
                            "ratio": simulated / value,
                        }
                    )
    columns = ["vehicle", "set", "quantity", "unit", "paper", "simulated", "ratio"]
    return pd.DataFrame(rows, columns=columns)


def papers_cells(frame: pd.DataFrame) -> dict[str, object]:
    """Cells of `papers_frame` for the template.

    Returns
    -------
    dict
        ``race_sets``, names of the race cars' sets; ``race_rows``, a quantity in every row with
        the pair ``paper / simulated`` of each of these sets; ``other_rows``, set, quantity, paper
        and simulated of the other sets.
    """
    numbers = {"paper": Column("paper", each=True), "simulated": Column(SIMULATED, each=True)}
    _, pairs, _ = formatted(Table("beside_papers", "", frame, numbers))
    race_rows: dict[str, list[str]] = {}
    other_rows = []
    for row, pair in zip(frame.to_dict("records"), pairs, strict=True):
        unit = "" if row["unit"] == "1" else f" [{row['unit']}]"
        quantity = f"{row['quantity']}{unit}".replace("|", "\\|")
        if row["set"] in RACE_SETS:
            race_rows.setdefault(quantity, []).append(" / ".join(pair))
        else:
            other_rows.append([f"{row['vehicle']}, {row['set']}", quantity, *pair])
    return {
        "race_sets": [name for name in frame["set"].unique() if name in RACE_SETS],
        "race_rows": [[quantity, *cells] for quantity, cells in race_rows.items()],
        "other_rows": other_rows,
    }


def real_tables(vehicles: Mapping[str, VehicleData]) -> list[Block]:
    """Statistics of the simulated car and of a real recording of it: table ``beside_real``."""
    rows = []
    for vehicle in vehicles.values():
        if not (vehicle.real and vehicle.simulated):
            continue
        real = vehicle.merged("real").values()
        rows += [
            {
                "vehicle": vehicle.name,
                "quantity": QUANTITIES[quantity],
                "unit": unit,
                "real": real[quantity][0],
                "simulated": value,
            }
            for quantity, (value, unit) in vehicle.merged(SIMULATED).values().items()
            if quantity in QUANTITIES
        ]
    names = list(dict.fromkeys(str(row["vehicle"]) for row in rows))
    columns = {
        **({"vehicle": Column("vehicle")} if len(names) > 1 else {}),
        "quantity": Column("quantity"),
        "unit": Column("unit"),
        "real": Column("real", each=True),
        "simulated": Column(SIMULATED, each=True),
    }
    caption = f"All drives of the simulated {', '.join(names)}, and the real recording."
    return [Table("beside_real", caption, pd.DataFrame(rows), columns)] if rows else []


def vehicle_figures(vehicle: VehicleData) -> list[Block]:
    """Traces, handling diagram and distributions of a vehicle: ``NAME_traces`` and so on."""
    profile = profile_of(vehicle.name)
    kinds = [kind for kind in (SIMULATED, "real") if getattr(vehicle, kind)]
    data = " and ".join(kinds).upper()
    figures: list[Block] = []
    if vehicle.segments:
        traces = drawing.traces(drawing.shortened(vehicle.segments))
        figures.append(Figure(f"{vehicle.name}_traces", "Traces, SIMULATED.", traces))
    if vehicle.handling is not None:
        caption = f"Handling diagram, {data}."
        figures.append(Figure(f"{vehicle.name}_handling", caption, drawing.handling(vehicle)))
    marks = f" Dotted: {profile.limit_label}." if profile.limit_label else ""
    caption = f"Sideslip angle and lateral acceleration, {data}.{marks}"
    distributions = drawing.distributions(vehicle, profile)
    return [*figures, Figure(f"{vehicle.name}_distributions", caption, distributions)]
