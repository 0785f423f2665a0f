"""Published figures of the recordings that the simulated ones stand for, and how these were prepared."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from vehest.data.recording import Recording
from vehest.data.transforms import LowPass, Resample
from vehest_papers.ksnn.data_quality import PUBLISHED

TABLE_I = "Table I of Da Lio, Piccinini and Biral 2023"


@dataclass(frozen=True)
class PaperSet:
    """One set of recordings in a paper."""

    name: str  # in the paper
    drives: str  # our set, a name of drives without their counter
    values: Mapping[
        str, float
    ]  # quantity of `tally.Tally.values` -> what the paper gives, in the same units


@dataclass(frozen=True)
class Profile:
    """What stands on a vehicle's page besides its recordings."""

    title: str  # of the vehicle
    source: str = ""  # the paper, for the caption
    sets: tuple[PaperSet, ...] = ()  # what its tables give
    rate_hz: float | None = (
        None  # rate that its recordings were brought to, and ours before they are counted; none: as recorded
    )
    cutoff_hz: float | None = (
        None  # of the zero-phase low-pass that its recordings went through; none: none
    )
    prose: str = ""  # its text beside the figures, and how it was read
    ay_limit: float | None = (
        None  # marked in the distribution of the lateral acceleration [m/s²]: what the paper's 99 % or range are
    )
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

    @property
    def preparation(self) -> str:
        """The same in words."""
        steps = (
            [f"low-passed at {self.cutoff_hz:g} Hz without delay"]
            if self.cutoff_hz is not None
            else []
        )
        steps += [f"brought to {self.rate_hz:g} Hz"] if self.rate_hz is not None else []
        return f"{' and '.join(steps)} first, as in the paper" if steps else "as recorded"


def _race(name: str) -> PaperSet:
    """A row of Table I of Da Lio et al. 2023, ``C-1`` say, whose drives begin with ``c1``."""
    own = PUBLISHED[name]
    values = {
        "duration": 60.0 * own.minutes,
        "distance": 1000.0 * own.length_km,
        "vx_min": own.u_min,
        "vx_max": own.u_max,
        "vy_q01": own.v_low,
        "vy_q99": own.v_high,
        "yaw_rate_min": own.yaw_rate_min,
        "yaw_rate_max": own.yaw_rate_max,
        "ay_abs_q99": own.ay,
    }
    return PaperSet(name, name.replace("-", "").lower(), values)


_RACE_PROSE = (
    "The paper's recordings were brought from 1 kHz to 20 Hz; its ranges of v and its largest |ay| are 0.99 quantiles, read here as the 1 "
    "% and 99 % quantiles of v and the 99 % quantile of |ay|; its ranges of u and ω are taken as smallest and largest values."
)

PROFILES: Mapping[str, Profile] = {
    "corvette_grand_sport": Profile(
        title="Corvette Grand Sport-like race car",
        source=TABLE_I,
        sets=(_race("C-1"), _race("C-2")),
        rate_hz=20.0,
        prose=_RACE_PROSE,
        ay_limit=PUBLISHED["C-2"].ay,
        limit_label="paper, 99 % of C-2",
    ),
    "ferrari_250_lm": Profile(
        title="Ferrari 250 LM-like race car",
        source=TABLE_I,
        sets=(_race("F-1"), _race("F-2")),
        rate_hz=20.0,
        prose=_RACE_PROSE,
        ay_limit=PUBLISHED["F-2"].ay,
        limit_label="paper, 99 % of F-2",
        counterpart="ferrari_250lm",
    ),
    "jaguar_e_type": Profile(title="Jaguar E-type-like race car", rate_hz=20.0),
    "bmw_545i": Profile(
        title="BMW 545i-like car",
        source="Bertipaglia, Alirezaei, Happee and Shyrokau 2024",
        sets=(
            PaperSet("all", "all", {"drives": 216, "duration": 7200.0}),
            PaperSet("test set", "test", {"drives": 23}),
        ),
        cutoff_hz=5.0,
        prose=(
            "The paper's Fig. 4 shows the distributions of β and ay in bins of 1° and 1 m/s² on a logarithmic scale, of samples above 5 "
            "m/s. Its numbers are not published; its text says that the lateral acceleration is spread almost equally over ±10 m/s² and "
            "that the sideslip angle lies mainly within ±3°."
        ),
        ay_limit=10.0,
        sideslip_limit=3.0,
        limit_label="paper: range in words",
    ),
    "heavy_truck": Profile(
        title="Heavy-duty truck",
        source="Di Biase, Lenzo and Timpone 2020",
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
        prose=(
            "The paper drove three laps of about 2.5 km in 721 s (299, 227 and 195 s, about 30, 40 and 45 km/h), the last of which ends "
            "with a stop within about 5 s, and one fast lap of 76 km/h on average and 115 km/h at most. It shows lateral acceleration and "
            "sideslip in figures whose numbers are not published, so that none stand beside ours."
        ),
    ),
}


def profile_of(page: str) -> Profile:
    """The profile of a page, plain for a vehicle that stands for none in a paper."""
    return PROFILES.get(page, Profile(title=page))


def page_of(vehicle: str) -> str:
    """The page that a vehicle belongs on: its own, or that of the car of which it is a variant, as ``heavy_truck_worn`` is."""
    own = re.sub(r"[^a-z0-9_-]", "_", vehicle.lower()) or "vehicle"  # becomes a file's name
    return next((name for name in PROFILES if own == name or own.startswith(f"{name}_")), own)


def counterpart_page(dataset: str) -> str | None:
    """The page beside whose recordings a real data set stands."""
    return next(
        (name for name, profile in PROFILES.items() if profile.counterpart == dataset), None
    )
