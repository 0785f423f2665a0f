"""The vehicle: Table 2 with what had to be assumed, the eigenvalues of its single track, and Eqs. 61 to 64 on real wheel speeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.derived import SpeedFromWheels
from vehest.data.recording import Recording
from vehest.evaluation.significance import difference_of_blocks
from vehest.report.document import Block, Column, Table
from vehest.report.style import fixed
from vehest.studies.artefacts import PartArtefacts
from vehest.vehicle.parameters import SingleTrackParameters
from vehest.vehicle.single_track import lateral_model
from vehest_papers.heavy_ekf import paper
from vehest_papers.kit.reading import recordings_of, with_interval

SPEEDS = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 20.0, 30.0)
WHEELS = ("fl", "fr", "rl", "rr")
RADIUS = 0.2972  # m, of the AV-21, as in conf/dataset/av21.yaml
BLOCK_SECONDS = 10.0
SLOWEST = 5.0  # m/s
LOCKED = 0.5  # m of track by the wheels' difference, below which an axle turns as one


def table_2(car: SingleTrackParameters) -> Table:
    """Vehicle parameters: the paper's table is not legible."""
    rows = [
        (
            "mass M",
            "kg",
            car.mass,
            "the axle curves' largest forces, 39.0 + 38.6 kN, taken as the weight",
        ),
        (
            "front semi-wheelbase a_F",
            "m",
            car.cg_to_front_axle,
            "share of those forces; wheelbase 3.5 m, for the eigenvalue ratio",
        ),
        ("rear semi-wheelbase a_R", "m", car.cg_to_rear_axle, "likewise"),
        ("yaw inertia J", "kg m²", car.yaw_inertia, "M a_F a_R, for the eigenvalue ratio"),
        ("tracks t_F, t_R", "m", 2.08, "assumed"),
        ("height of the centre of gravity", "m", 0.85, "assumed: slides before it rolls over"),
    ]
    frame = pd.DataFrame(
        [{"parameter": a, "unit": b, "value": float(c), "from": d} for a, b, c, d in rows]
    )
    columns = {
        "parameter": Column("parameter"),
        "unit": Column("unit"),
        "value": Column("value", each=True, digits=5),
        "from": Column("from"),
    }
    return Table(
        "table_2",
        "Vehicle parameters (Table 2 of the paper, whose values are not legible): all assumed.",
        frame,
        columns,
    )


def eigenvalues_table(car: SingleTrackParameters) -> Table:
    """Eigenvalues of the linear single track with Table 1's stiffnesses, and the ratio of their sizes."""
    stiff = replace(
        car,
        cornering_stiffness_front=paper.CURVES["c2_front"],
        cornering_stiffness_rear=paper.CURVES["c2_rear"],
    )
    rows = []
    for speed, ratio, pair in zip(
        SPEEDS, ratios(stiff, np.array(SPEEDS)), eigenvalues(stiff, np.array(SPEEDS)), strict=True
    ):
        shown = " and ".join(
            f"{fixed(float(one.real), 1)}{f' ± {fixed(abs(float(one.imag)), 1)}i' if abs(one.imag) > 1e-9 else ''}"
            for one in pair
        )
        rows.append(
            {
                "speed": speed,
                "eigenvalues": shown if abs(pair[0].imag) <= 1e-9 else shown.split(" and ")[0],
                "ratio": float(ratio),
            }
        )
    columns = {
        "speed": Column("u [m/s]", decimals=0),
        "eigenvalues": Column("eigenvalues [1/s]"),
        "ratio": Column("ratio of their sizes", decimals=2),
    }
    caption = (
        "Eigenvalues of the linear single track; the paper: ratio 1 above 6 m/s, up to about 1.3 below. Inertia and wheelbase are chosen "
        "for it."
    )
    return Table("eigenvalues", caption, pd.DataFrame(rows), columns)


def eigenvalues(
    car: SingleTrackParameters, speed: FloatArray
) -> np.ndarray[tuple[int, int], np.dtype[np.complex128]]:
    """Both eigenvalues of (β, r) at each speed, (K, 2) [1/s]."""
    return np.asarray(np.linalg.eigvals(lateral_model(car, speed).A), dtype=np.complex128)


def ratios(car: SingleTrackParameters, speed: FloatArray) -> FloatArray:
    """Larger over smaller size of the eigenvalues at each speed, (K,)."""
    size = np.sort(np.abs(eigenvalues(car, speed)), axis=1)
    return np.asarray(size[:, 1] / size[:, 0], dtype=np.float64)


def tracks_of(drive: Recording) -> tuple[float, float]:
    """Front and rear track by least squares of the wheels' difference on the yaw rate [m]."""
    moving = drive["vx_ref"] > SLOWEST
    turn = drive["yaw_rate"][moving]
    found = []
    for left, right in (("fl", "fr"), ("rl", "rr")):
        scale = np.cos(drive["steer"][moving]) if left == "fl" else 1.0
        difference = (
            RADIUS * scale * (drive[f"wheel_speed_{right}"] - drive[f"wheel_speed_{left}"])[moving]
        )
        found.append(float(difference @ turn / (turn @ turn)))
    return found[0], found[1]


def wheels_blocks(part: PartArtefacts) -> list[Block]:
    """Eqs. 61 to 64 on the AV-21's wheel speeds: tracks from the training range, then the test ranges."""
    tracks = trained_tracks(part)
    rows = []
    for test, of_drives in wheel_sums(part).items():
        sums = of_drives.values()
        raw, corrected, raw_spread, spread, sizes = (
            np.concatenate(values) for values in zip(*sums, strict=True)
        )
        means, spreads = (
            difference_of_blocks(second[None], first[None], sizes).root
            for first, second in ((raw, corrected), (raw_spread, spread))
        )
        row: dict[str, object] = {"test": test.replace("_", " "), "blocks": len(sizes)}
        for name, before, after, own in (
            ("spread", raw_spread, spread, spreads),
            ("mean", raw, corrected, means),
        ):
            row[f"{name}_raw"], row[name] = (
                float(np.sqrt(values.sum() / sizes.sum())) for values in (before, after)
            )
            row[f"{name}_change"] = with_interval(own.value, own.low, own.high, 3)
        rows.append(row)
    columns = {
        "test": Column("range"),
        "blocks": Column("blocks of 10 s", decimals=0),
        "spread_raw": Column("spread of the wheels, measured [m/s]", decimals=3),
        "spread": Column("corrected [m/s]", decimals=3),
        "spread_change": Column("change [m/s]"),
        "mean_raw": Column("RMSE of their mean, measured [m/s]", decimals=3),
        "mean": Column("corrected [m/s]", decimals=3),
        "mean_change": Column("change [m/s]"),
    }
    caption = (
        f"Equations 61 to 64 on real wheel speeds, REAL, the AV-21 race car at more than {SLOWEST:g} m/s: spread of the four wheels about "
        "their mean, and their mean against the reference's speed; 95 % intervals over blocks of 10 s. Tracks from the training range by "
        f"least squares, {fixed(float(tracks[0]), 2)} and {fixed(float(tracks[1]), 2)} m; rolling radius {RADIUS:g} m. "
        f"{_locked_in_words(tracks)}Its yaw rate is low-passed by 0.4 s."
    )
    return [Table("wheels_av21", caption, pd.DataFrame(rows), columns)]


def _locked_in_words(tracks: FloatArray) -> str:
    """Which axles turn as one, where the equations would add a difference that is not there."""
    axles = zip(("front", "rear"), ("61, 62", "63, 64"), tracks, strict=True)
    locked = [f"{name} (Eqs. {which})" for name, which, track in axles if track <= LOCKED]
    return (
        f"The wheels of the {' and '.join(locked)} axle turn alike, as with a locked differential: it is left as it is. "
        if locked
        else ""
    )


def trained_tracks(part: PartArtefacts) -> FloatArray:
    """Front and rear track by least squares on the training range, (2,) [m]."""
    drives = recordings_of(part, part.split.train)
    return np.asarray(np.mean([tracks_of(drive) for drive in drives], axis=0), dtype=np.float64)


def wheel_sums(part: PartArtefacts) -> dict[str, dict[str, tuple[FloatArray, ...]]]:
    """Test set -> name of a drive -> `block_sums` of it; an axle whose wheels turn as one is left as it is."""
    tracks = trained_tracks(part)
    turning = np.where(tracks > LOCKED, tracks, 0.0)
    wheels = SpeedFromWheels(
        wheel_radius=RADIUS, track_front=float(turning[0]), track_rear=float(turning[1])
    )
    return {
        test: {
            f"{drive.id} {drive.start_time:.2f} s": block_sums(drive, wheels)
            for drive in recordings_of(part, spans)
            if (drive["vx_ref"] > SLOWEST).any()
        }
        for test, spans in part.split.tests.items()
    }


def block_sums(
    drive: Recording, wheels: SpeedFromWheels
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Over blocks of 10 s: squared error of the wheels' mean as measured and corrected, their variance likewise, and samples."""
    moving = (drive["vx_ref"] > SLOWEST).astype(np.float64)
    raw = wheels.wheel_radius * drive.stack([f"wheel_speed_{wheel}" for wheel in WHEELS]).T
    starts = np.arange(0, len(drive), round(BLOCK_SECONDS * drive.rate_hz))
    sums = []
    for speeds in (raw, wheels.corrected(drive)):
        sums.append(np.add.reduceat(np.square(speeds.mean(0) - drive["vx_ref"]) * moving, starts))
        sums.append(np.add.reduceat(speeds.var(0) * moving, starts))
    sizes = np.add.reduceat(moving, starts)
    kept = sizes > 0
    return sums[0][kept], sums[2][kept], sums[1][kept], sums[3][kept], sizes[kept]
