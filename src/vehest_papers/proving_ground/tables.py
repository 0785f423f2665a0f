"""What the index and the vehicles' pages share: columns, rows and words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.data.errors import printable
from vehest.report.document import Column, Table, as_text
from vehest.studies.artefacts import AbsentDataset
from vehest_papers.proving_ground.tally import FLAGS, Tally
from vehest_papers.proving_ground.vehicles import FlaggedDrive

OVERVIEW = (
    "drives",
    "minutes",
    "km",
    "ay_abs_q99",
    "sideslip_abs_q99",
    "spun",
    "left_road",
    "stood",
)

QUANTITIES: Mapping[str, str] = {
    "drives": "drives",
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
"""Quantities of `Tally.values`, for people."""

COLUMNS: Mapping[str, Column] = {
    "drives": Column("drives", decimals=0),
    "minutes": Column("duration [min]", decimals=1),
    "km": Column("distance [km]", decimals=1),
    "ay_abs_q99": Column("|ay| 99 % [m/s²]", decimals=2),
    "sideslip_abs_q99": Column("|β| 99 % [deg]", decimals=2),
    "spun": Column("spun", decimals=0),
    "left_road": Column("left the road", decimals=0),
    "stood": Column("stood", decimals=0),
}


def row_of(tally: Tally, *, with_flags: bool = True) -> dict[str, float]:
    """The cells under `COLUMNS`; a real drive has no flags."""
    values = {name: value for name, (value, _) in tally.values().items()}
    row = {**values, "minutes": values["duration"] / 60.0, "km": values["distance"] / 1000.0}
    hidden = () if with_flags else FLAGS
    return {name: math.nan if name in hidden else row[name] for name in OVERVIEW}


def accidents(flagged: Sequence[FlaggedDrive], drives: int) -> str:
    """How many drives went wrong, a sentence or two."""
    if not flagged:
        return (
            f"None of the {drives} simulated drives spun or left the road by accident."
            if drives
            else ""
        )
    spun, left = (
        sum(bool(drive.flags.get(name)) for drive in flagged) for name in ("spun", "left_road")
    )
    return (
        f"Of {drives} simulated drives {len(flagged)} went wrong by accident: {spun} spun, {left} left the road (a drive can do both). "
        f"They are kept and counted in all figures but the traces; the driver then brakes, and the drive ends when the car stands."
    )


def flagged_table(name: str, flagged: Sequence[FlaggedDrive]) -> Table:
    """Drives that went wrong, a row each."""
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
    return Table(
        name,
        "Drives that spun or left the road by accident: when the driver gave up, and the largest true sideslip angle above 1 m/s.",
        pd.DataFrame(rows),
        {
            "recording": Column("drive"),
            "vehicle": Column("vehicle"),
            "manoeuvre": Column("manoeuvre"),
            "stability_control": Column("stability control"),
            "spun": Column("spun"),
            "left_road": Column("left the road"),
            "gave_up_at": Column("at [s]", decimals=1),
            "largest_sideslip": Column("largest |β| [deg]", decimals=1),
        },
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def how_to_get(dataset: AbsentDataset) -> str:
    """What to do to see a data set that is not here."""
    return (
        f"To have it in: get the recording ({as_text(dataset.licence)}), set `VEHEST_DATA` to its folder, see with "
        f"`vehest data check {dataset.name}` that it is found, and run the same command again."
    )
