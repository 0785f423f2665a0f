"""An hour of synthetic driving at 20 Hz with eight estimators, for tests of its page."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as MatplotlibFigure

from vehest.report.document import Column, Document, Figure, ModelLink, Table
from vehest.report.explorer import explorer_json, reckoned_course
from vehest.report.style import on_dark

RATE = 20.0
SECONDS = 3600.0
COLOURS = ("#4aa5e0", "#0b4f9c", "#f59a23", "#b8480b", "#8e24aa", "#00876c", "#d6336c", "#767676")


def hour_of_driving():
    """Laps of 90 s, every signal with sensor noise.

    Band and health with each estimator; sixteen channels.
    """
    rng = np.random.default_rng(0)
    time = np.arange(int(RATE * SECONDS)) / RATE

    def noisy(values, size):
        return values + size * rng.standard_normal(len(time))

    lap = 2 * np.pi * time / 90.0
    vx = noisy(30.0 + 10.0 * np.sin(3 * lap) + 2.0 * np.sin(0.013 * time), 0.05)
    yaw_rate = 2 * np.pi / 90.0 + 0.3 * np.sin(4 * lap) + 0.1 * np.sin(0.9 * time)
    vy = noisy(-0.9 * yaw_rate * (1.0 + 0.3 * np.sin(0.01 * time)), 0.01)
    ay = noisy(vx * yaw_rate, 0.3)
    columns = {
        "vx": vx,
        "vy": vy,
        "ay": ay,
        "input0": vx,
        "input1": np.degrees(noisy(yaw_rate, 0.004)),
        "input2": ay,
    }
    inputs = [
        {"label": label, "unit": unit, "drawn": True}
        for label, unit in (("vx", "m/s"), ("yaw_rate", "deg/s"), ("ay", "m/s²"))
    ]
    columns |= {f"input{3 + i}": noisy(vx / 0.33, 0.2) for i in range(13)}
    inputs += [{"label": f"wheel {i}", "unit": "rad/s", "drawn": False} for i in range(13)]
    titles = [f"Estimator {i + 1}" for i in range(len(COLOURS))]
    for i in range(len(COLOURS)):
        columns[f"vy{i}"] = noisy(vy + 0.03 * (i + 1) * np.sin(1.7 * time + i), 0.01)
        band = 0.1 + 0.05 * np.abs(yaw_rate)
        columns |= {f"bandv{i}": band, f"bandb{i}": np.degrees(band / vx)}
        columns[f"health{i}"] = np.where(np.sin(0.02 * time + i) > 0.97, 1.0, 0.0) + np.where(
            np.sin(0.02 * time + i) > 0.995, 1.0, 0.0
        )
    columns["scored"] = np.ones(len(time))
    columns["x"], columns["y"] = reckoned_course(vx, vy, yaw_rate, 1.0 / RATE)
    looks = [
        {"label": title, "colour": colour, "dark": on_dark(colour), "dash": "solid"}
        for title, colour in zip(titles, COLOURS, strict=True)
    ]
    content = {
        "start": 0.0,
        "step": 1.0 / RATE,
        "length": len(time),
        "timeLabel": "time [s]",
        "zoom": [100.0, 120.0],
        "inputs": inputs,
    }
    explorer = explorer_json({**content, "candidates": looks, "courseNote": "Made up."}, columns)
    static = MatplotlibFigure()
    static.add_subplot().plot(vy[:500])
    errors = [float(np.sqrt(np.mean((columns[f"vy{i}"] - vy) ** 2))) for i in range(len(COLOURS))]
    frame = pd.DataFrame({"title": titles, "error": errors})
    frame = frame.assign(low=0.8 * frame["error"], high=1.3 * frame["error"], interval="as drawn")
    panels = {
        "title": Column("estimator"),
        "error": Column("RMSE(v) [m/s]"),
        "interval": Column("interval", bar=("error", "low", "high")),
    }
    links = [
        ModelLink(f"../../train/model-{i}/", f"vehest estimate model-{i} lap.csv -o out.parquet")
        for i in range(len(COLOURS))
    ]
    return Document(
        "An hour",
        [
            Table("board", "Board.", frame, panels, links),
            Figure("traces", "Traces.", static, explorer),
        ],
    )
