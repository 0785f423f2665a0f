"""A drive as the frames of a bus, estimated online from them, against the same model offline on the
drive itself.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from can_drive import SIGNALS, write_log

from vehest.api import estimate, load_model
from vehest.run.replay import replay_log

JITTER = 0.001
LOST = 0.01
SETTLED = 2.0  # s after the first estimate of both
FERRARI = (550.0, 700.0)  # s, the test range of its drive
MINUS = {1: "", -1: "-"}
ALL_SIGNALS = ",".join(
    f"{name}={MINUS[entry.get('sign', 1)]}{entry['column']}:{entry['unit']}"
    for name, entry in SIGNALS.items()
)


@dataclass(frozen=True)
class Compared:
    """Errors of one model on one drive, after both have settled: root mean squares of v [m/s] and β
    [deg] against the reference.
    """

    online: tuple[float, float]
    offline: tuple[float, float]
    # Those online if estimates counted for the instant of their sample, as if filters took no time.
    at_sample: tuple[float, float]
    samples: int
    lost: int  # samples at which a channel was missing
    latest_ms: float  # the longest step, as fast as it goes
    missed: int  # steps that took longer than a cycle

    @property
    def ratios(self):
        """Online over offline, of v and β."""
        return self.online[0] / self.offline[0], self.online[1] / self.offline[1]


def signals_for(channels):
    """--signals for a model's channels."""
    return ",".join(word for word in ALL_SIGNALS.split(",") if word.partition("=")[0] in channels)


def compare(model, drive, folder, output=None):
    """Estimate a drive with references offline, and online from the frames of a bus with jitter and
    lost frames.
    """
    written = write_log(drive, folder, jitter=JITTER, lost=LOST, seed=1)
    fitted = load_model(model, output)
    offline = estimate(fitted, drive.without_references())
    table = folder / "estimates.csv"
    words = {"model": model, "dbc": written.dbc, "signals": signals_for(fitted.channels)}
    figures = replay_log(
        written.log, [f"output={output}"] if output else [], speed="max", out=table, **words
    )
    online = pd.read_csv(table).dropna(subset=["vy", "sideslip"])
    has_estimate = ~np.isnan(offline["vy"])
    begin = SETTLED + max(online["time"].iloc[0] + written.origin, offline.time[has_estimate][0])
    end = min(online["time"].iloc[-1] + written.origin, offline.time[has_estimate][-1])

    def errors(times, vy, sideslip):
        inside = (times >= begin) & (times <= end)
        v = vy[inside] - np.interp(times[inside], drive.time, drive["vy_ref"])
        beta = np.degrees(
            sideslip[inside] - np.interp(times[inside], drive.time, drive["sideslip_ref"])
        )
        return float(np.sqrt(np.mean(v**2))), float(np.sqrt(np.mean(beta**2)))

    estimates = (online["vy"].to_numpy(), online["sideslip"].to_numpy())
    return Compared(
        online=errors(online["time"].to_numpy() + written.origin, *estimates),
        offline=errors(
            offline.time[has_estimate],
            offline["vy"][has_estimate],
            offline["sideslip"][has_estimate],
        ),
        at_sample=errors(online["sampled"].to_numpy() + written.origin, *estimates),
        samples=figures["samples"],
        lost=figures["samples_lost"],
        latest_ms=figures["latest_ms"],
        missed=figures["deadlines_missed"],
    )
