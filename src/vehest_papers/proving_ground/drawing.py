"""What the pages show, as figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vehest.data.recording import Recording
from vehest_papers.proving_ground import noise
from vehest_papers.proving_ground import recording_figures as figures
from vehest_papers.proving_ground.handling import ANGLE_EDGES, AY_EDGES
from vehest_papers.proving_ground.noise_reading import NOISE_ABOVE
from vehest_papers.proving_ground.papers import Profile
from vehest_papers.proving_ground.vehicles import SHORTEST_TRACE, TRACE_SECONDS, Stretch, VehiclePage

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

MOST_STRETCHES = 8
QUANTITIES = {
    "vx": ("vx [m/s]", 1.0),
    "steer": ("steer [deg]", 180.0 / np.pi),
    "yaw_rate": ("yaw rate [rad/s]", 1.0),
    "ay": ("$a_y$ [m/s²]", 1.0),
    "sideslip_ref": ("β [deg]", 180.0 / np.pi),
}


def shown_stretches(stretches: Mapping[str, Stretch]) -> list[Stretch]:
    """At most `MOST_STRETCHES`, shortened to their busiest parts so that all together last about `TRACE_SECONDS`."""
    kept = list(stretches.values())[:MOST_STRETCHES]
    seconds = max(TRACE_SECONDS / len(kept), SHORTEST_TRACE)
    return [_busiest_part(stretch, seconds) for stretch in kept]


def traces(stretches: Sequence[Stretch]) -> MatplotlibFigure:
    """Speed, steering, yaw rate, lateral acceleration and sideslip."""
    shown = [
        figures.Trace(
            own.manoeuvre.replace("_", " "),
            own.time - own.time[0],
            {label: factor * own.channels[name] for name, (label, factor) in QUANTITIES.items() if name in own.channels},
        )
        for own in stretches
    ]
    return figures.recording_traces(shown)


def handling(page: VehiclePage) -> MatplotlibFigure:
    """All samples, medians of steady turns, and the plant's characteristics."""
    assert page.handling is not None
    sources = [("simulated", page.handling), *([("real", page.real_handling)] if page.real_handling is not None else [])]
    return figures.handling_figure(
        (AY_EDGES, ANGLE_EDGES),
        page.handling.everything,
        [figures.Curve(own.label, own.ay, own.angle, own.gradient) for own in page.characteristics],
        [figures.Points(kind, *points.medians()) for kind, points in sources],
    )


def distributions(page: VehiclePage, profile: Profile) -> MatplotlibFigure:
    """Sideslip in bins of 1°, lateral acceleration in bins of 1 m/s²."""
    kinds = [*(["simulated"] if page.simulated else []), *(["real"] if page.real else [])]
    sideslip, ay = ([figures.Distribution(kind, *page.merged(kind).histogram(name, 1.0)) for kind in kinds] for name in ("sideslip", "ay"))
    return figures.distribution_figure(
        sideslip, ay, sideslip_limit=profile.sideslip_limit, ay_limit=profile.ay_limit, limit_label=profile.limit_label
    )


def noise_spectra(samples: Mapping[str, Recording]) -> MatplotlibFigure:
    """Amplitude densities of six channels."""
    return figures.spectra_figure(noise.spectra(samples), NOISE_ABOVE)


def _busiest_part(stretch: Stretch, seconds: float) -> Stretch:
    rate_hz = (len(stretch.time) - 1) / float(stretch.time[-1] - stretch.time[0])
    n = min(round(seconds * rate_hz), len(stretch.time))
    power = np.convolve(np.square(stretch.channels["ay"]), np.full(n, 1.0 / n), mode="valid")
    kept = slice(int(power.argmax()), int(power.argmax()) + n)
    channels = {name: own[kept] for name, own in stretch.channels.items()}
    return replace(stretch, time=stretch.time[kept], channels=channels, power=float(power.max()))
