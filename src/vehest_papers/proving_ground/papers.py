"""Published figures of the real recordings, and how these were prepared."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from vehest.data.recording import Recording
from vehest.data.transforms import LowPass, Resample
from vehest_papers.ksnn.data_quality import PUBLISHED


@dataclass(frozen=True)
class PaperSet:
    """One set of recordings in a paper."""

    name: str  # in the paper
    drives: str  # our set, a name of drives without their counter
    values: Mapping[str, float]  # quantity of `Tally.values` -> the paper's value in the same unit


@dataclass(frozen=True)
class Profile:
    """A vehicle and the recordings of it in a paper."""

    title: str
    sets: tuple[PaperSet, ...] = ()  # what the paper's tables give
    # rate of the paper's recordings, and of ours before they are counted; None: as recorded
    rate_hz: float | None = None
    cutoff_hz: float | None = None  # of the paper's zero-phase low-pass; None: no filter
    ay_limit: float | None = None  # marked in the distribution of ay [m/s²]
    sideslip_limit: float | None = None  # likewise, of the sideslip angle [deg]
    limit_label: str = ""  # what those marks are
    counterpart: str | None = None  # data set with a real recording of the same car

    def prepared(self, recording: Recording) -> Recording:
        """The recording as the paper prepared its own, references included."""
        if self.cutoff_hz is not None and 2 * self.cutoff_hz < recording.rate_hz:
            recording = LowPass(self.cutoff_hz, channels=tuple(recording.channels))(recording)
        if self.rate_hz is not None and self.rate_hz < recording.rate_hz:
            recording = Resample(self.rate_hz)(recording)
        return recording


def _race(name: str) -> PaperSet:
    """A row of Table I of Da Lio et al. 2023, ``C-1`` say, whose drives begin with ``c1``."""
    row = PUBLISHED[name]
    values = {
        "duration": 60.0 * row.minutes,
        "distance": 1000.0 * row.length_km,
        "vx_min": row.u_min,
        "vx_max": row.u_max,
        "vy_q01": row.v_low,
        "vy_q99": row.v_high,
        "yaw_rate_min": row.yaw_rate_min,
        "yaw_rate_max": row.yaw_rate_max,
        "ay_abs_q99": row.ay,
    }
    return PaperSet(name, name.replace("-", "").lower(), values)


RACE_SETS = tuple(PUBLISHED)
"""Names of the sets of Da Lio et al. 2023, which state the same quantities."""

PROFILES: Mapping[str, Profile] = {
    "corvette_grand_sport": Profile(
        title="Corvette Grand Sport-like race car",
        sets=(_race("C-1"), _race("C-2")),
        rate_hz=20.0,
        ay_limit=PUBLISHED["C-2"].ay,
        limit_label="paper, 99 % of C-2",
    ),
    "ferrari_250_lm": Profile(
        title="Ferrari 250 LM-like race car",
        sets=(_race("F-1"), _race("F-2")),
        rate_hz=20.0,
        ay_limit=PUBLISHED["F-2"].ay,
        limit_label="paper, 99 % of F-2",
        counterpart="ferrari_250lm",
    ),
    "jaguar_e_type": Profile(title="Jaguar E-type-like race car", rate_hz=20.0),
    "bmw_545i": Profile(
        title="BMW 545i-like car",
        sets=(
            PaperSet("all", "all", {"drives": 216, "duration": 7200.0}),
            PaperSet("test set", "test", {"drives": 23}),
        ),
        cutoff_hz=5.0,
        ay_limit=10.0,
        sideslip_limit=3.0,
        limit_label="paper: range in words",
    ),
    "heavy_truck": Profile(
        title="Heavy-duty truck",
        sets=(
            PaperSet(
                "three laps",
                "nominal_laps",
                {"duration": 721.0, "distance": 7500.0, "speed_mean": 7500.0 / 721.0},
            ),
            PaperSet(
                "fast lap",
                "nominal_fast",
                {"distance": 2500.0, "speed_mean": 76.0 / 3.6, "vx_max": 115.0 / 3.6},
            ),
        ),
    ),
}


def profile_of(name: str) -> Profile:
    """The profile of a name; a plain one for a vehicle of no paper."""
    return PROFILES.get(name, Profile(title=name))


def profile_name(vehicle: str) -> str:
    """Name of the profile of a vehicle, or of the car of which it is a variant
    (``heavy_truck_worn``).
    """
    name = re.sub(r"[^a-z0-9_-]", "_", vehicle.lower()) or "vehicle"  # becomes a file's name
    return next((key for key in PROFILES if name == key or name.startswith(f"{key}_")), name)


def counterpart_of(dataset: str) -> str | None:
    """Name of the profile of the car that a real data set was recorded with."""
    return next(
        (name for name, profile in PROFILES.items() if profile.counterpart == dataset), None
    )
