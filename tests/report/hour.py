"""An hour of made-up driving at 20 Hz with eight estimators, for what a page of it weighs and does."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as MatplotlibFigure

from vehest.report.document import Column, Document, Figure, ModelLink, Table
from vehest.report.explorer import Candidate, Explorer, Signal, reckoned_course
from vehest.report.style import Line

RATE, SECONDS = 20.0, 3600.0
COLOURS = ("#4aa5e0", "#0b4f9c", "#f59a23", "#b8480b", "#8e24aa", "#00876c", "#d6336c", "#767676")


def hour_of_driving():
    """Laps of 90 s, every signal with sensor noise; band and health with each estimator; sixteen channels."""
    rng = np.random.default_rng(0)
    time = np.arange(int(RATE * SECONDS)) / RATE

    def noisy(values, size):
        return values + size * rng.standard_normal(len(time))

    lap = 2 * np.pi * time / 90.0
    vx = noisy(30.0 + 10.0 * np.sin(3 * lap) + 2.0 * np.sin(0.013 * time), 0.05)
    yaw_rate = 2 * np.pi / 90.0 + 0.3 * np.sin(4 * lap) + 0.1 * np.sin(0.9 * time)
    vy = noisy(-0.9 * yaw_rate * (1.0 + 0.3 * np.sin(0.01 * time)), 0.01)
    ay = noisy(vx * yaw_rate, 0.3)
    inputs = [Signal("vx", "m/s", vx), Signal("yaw_rate", "deg/s", np.degrees(noisy(yaw_rate, 0.004))), Signal("ay", "m/s²", ay)]
    inputs += [Signal(f"wheel {i}", "rad/s", noisy(vx / 0.33, 0.2), False) for i in range(13)]
    candidates = []
    for i, colour in enumerate(COLOURS):
        estimated = noisy(vy + 0.03 * (i + 1) * np.sin(1.7 * time + i), 0.01)
        band = 0.1 + 0.05 * np.abs(yaw_rate)
        health = np.where(np.sin(0.02 * time + i) > 0.97, 1.0, 0.0) + np.where(np.sin(0.02 * time + i) > 0.995, 1.0, 0.0)
        candidates.append(Candidate(f"Estimator {i + 1}", Line(colour), estimated, band, np.degrees(band / vx), health))
    course = reckoned_course(vx, vy, yaw_rate, 1.0 / RATE)
    explorer = Explorer(0.0, 1.0 / RATE, "time [s]", (100.0, 120.0), vx, vy, ay, inputs, candidates, course, "Made up.")
    static = MatplotlibFigure()
    static.add_subplot().plot(vy[:500])
    errors = [float(np.sqrt(np.mean((own.vy - vy) ** 2))) for own in candidates]
    frame = pd.DataFrame({"title": [own.label for own in candidates], "error": errors})
    frame = frame.assign(low=0.8 * frame["error"], high=1.3 * frame["error"], interval="as drawn")
    columns = {"title": Column("estimator"), "error": Column("RMSE(v) [m/s]"), "interval": Column("interval", bar=("error", "low", "high"))}
    links = [ModelLink(f"../../train/model-{i}/", f"vehest estimate model-{i} lap.csv -o out.parquet") for i in range(len(candidates))]
    return Document("An hour", [Table("board", "Board.", frame, columns, links), Figure("traces", "Traces.", static, explorer)])
