"""Table 3, what errors consist of, and why the order of the filters differs from the paper's where it does."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.constants import GRAVITY, FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.filtering.tyre_fit import TyreFit
from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed, listed
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.subjects import TYRES, corners
from vehest_papers.heavy_ekf.tyres import OwnCurves
from vehest_papers.kit.reading import percent_below

Rmse = Mapping[tuple[str, str], float]
DRIVES = {"laps": "three laps", "fast": "fast lap"}


def table_3(rmse: Rmse, names: list[str], data: str) -> Table:
    """RMSE(β) of every filter on every test, beside what the paper's prose gives."""
    rows = []
    for own in names:
        row: dict[str, object] = {"filter": own, "paper_laps": paper.LAPS.get(own, MISSING)}
        row |= {f"{tyres}_laps": rmse[own, f"{tyres}_laps"] for tyres in TYRES}
        row["paper_fast"] = paper.FAST.get(own, MISSING)
        rows.append(row | {f"{tyres}_fast": rmse[own, f"{tyres}_fast"] for tyres in TYRES})
    columns = {"filter": Column("filter")}
    for drive, words in DRIVES.items():
        columns[f"paper_{drive}"] = Column(f"{words}, paper (real)")
        columns |= {
            f"{tyres}_{drive}": Column(f"{words}, {title}, ours", decimals=3)
            for tyres, title in TYRES.items()
        }
    caption = (
        f"RMSE(β) [deg] (Table 3 of the paper, whose figures are those of its prose: its RATTE is below 0.5, 44 % below its RATT and 65 % "
        f"below its LINT on the three laps). Ours: {data}. Fitted on other laps with nominal tyres."
    )
    return Table("table_3", caption, pd.DataFrame(rows), columns)


def overview(rmse: Rmse, ferrari: Rmse, names: list[str]) -> Table:
    """What the terminal shows."""
    tests = [
        (f"truck, {words}, {title}", f"{tyres}_{drive}", rmse)
        for tyres, title in TYRES.items()
        for drive, words in DRIVES.items()
    ]
    if ferrari:
        tests.append(("real Ferrari", "test", ferrari))
    rows = []
    for title, test, values in tests:
        row: dict[str, object] = {"test": title} | {
            name: values.get((name, test), math.nan) for name in names
        }
        rows.append(
            row
            | {
                "order": " < ".join(
                    sorted(paper.ORDER, key=lambda name, of=values, on=test: of[name, on])  # type: ignore[misc]
                )
            }
        )
    columns = {
        "test": Column("test"),
        **{name: Column(f"{name} [deg]", decimals=3) for name in names},
    }
    columns["order"] = Column("order of the three")
    return Table(
        "overview",
        "Summary: RMSE(β) on every test; the paper's order is RATTE < RATT < LINT.",
        pd.DataFrame(rows),
        columns,
    )


def gains_table(rmse: Rmse) -> Table:
    """By how much filters are better than each other, beside the paper."""
    rows = []
    for (better, worse), known in paper.GAINS.items():
        row: dict[str, object] = {"pair": f"{better} below {worse}", "paper": f"{known:.0f} %"}
        for tyres in TYRES:
            for drive in DRIVES:
                row[f"{tyres}_{drive}"] = percent_below(
                    rmse[better, f"{tyres}_{drive}"], rmse[worse, f"{tyres}_{drive}"]
                )
        rows.append(row)
    columns = {"pair": Column("RMSE(β)"), "paper": Column("paper, three laps (real)")}
    columns |= {
        f"{tyres}_{drive}": Column(f"{words}, {title}")
        for drive, words in DRIVES.items()
        for tyres, title in TYRES.items()
    }
    caption = "By how much one filter lies below another; negative: above. Ours: SIMULATED."
    return Table("gains", caption, pd.DataFrame(rows), columns)


def errors_table(
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
    names: list[str],
    minimum_speed: float,
) -> Table:
    """Errors of β as their mean and what varies about it, and where the car corners."""
    rows = []
    for test, drive in drives.items():
        scored = drive["vx"] >= minimum_speed
        for name in names:
            error = np.degrees(estimates[test][name]["sideslip"] - drive["sideslip_ref"])[scored]
            cornering = corners(drive)[scored]
            row: dict[str, object] = {"test": test.replace("_", ", "), "filter": name}
            row |= {"mean": float(error.mean()), "std": float(error.std())}
            rows.append(
                row | {"cornering": _rms(error[cornering]), "straight": _rms(error[~cornering])}
            )
    columns = {
        "test": Column("drive"),
        "filter": Column("filter"),
        "mean": Column("mean error of β [deg]", decimals=3),
        "std": Column("standard deviation [deg]", decimals=3),
        "cornering": Column("RMSE(β), |a_y| above 1.5 m/s² [deg]", decimals=3),
        "straight": Column("RMSE(β), below [deg]", decimals=3),
    }
    caption = "What the errors of β consist of, over whole drives at the scored speeds, SIMULATED."
    return Table("errors", caption, pd.DataFrame(rows), columns)


def order_in_words(
    rmse: Rmse,
    errors: pd.DataFrame,
    fit: TyreFit,
    own: Mapping[str, OwnCurves],
    drives: Mapping[str, Recording],
    wander: float,
) -> str:
    """Where the order of the three is the paper's, where it is not, and why; ``wander`` is RATTE's level of noise of its tyres [1/√s]."""
    tests = [f"{tyres}_{drive}" for tyres in TYRES for drive in DRIVES]
    orders = {
        test: tuple(sorted(paper.ORDER, key=lambda name, on=test: rmse[name, on]))  # type: ignore[misc]
        for test in tests
    }
    same = [test.replace("_", " ") for test in tests if orders[test] == paper.ORDER]
    other = [test for test in tests if orders[test] != paper.ORDER]
    sentences = [
        f"The order of the paper, RATTE < RATT < LINT, is ours on {listed(same)}."
        if same
        else "On no test is the paper's order ours."
    ]
    if not other:
        return sentences[0]
    sentences.append(
        "It differs on "
        + listed([f"{test.replace('_', ' ')} ({' < '.join(orders[test])})" for test in other])
        + ". Why:"
    )
    reasons = [f"- **Little to tell a linear tyre from a rational one.** {_curvature(fit)}"]
    reasons.append(f"- **What the parameters start from.** {_starts(own, fit)}")
    reasons.append(
        "- **How fast parameters may move.** The level at which the training drives, on nominal and on worn tyres, are estimated best lets "
        f"RATTE's parameters wander by {100.0 * wander * math.sqrt(60.0):.2g} % in a minute (one standard deviation)."
    )
    reasons.append(f"- **What is to be gained.** {_gained(errors)}")
    if (errors["filter"] == paper.HELD).any():
        reasons.append(
            f"- **Straight ahead there is nothing to adapt to but the crossfall.** {_held(rmse, errors)}"
        )
    worst = [test for test in other if rmse[paper.RATTE, test] > rmse[paper.RATT, test]]
    if worst:
        parts = []
        for test in worst:
            (mean, spread), (other_mean, other_spread) = (
                _parts(errors, test, name) for name in (paper.RATTE, paper.RATT)
            )
            parts.append(
                f"{test.replace('_', ' ')}: mean error {fixed(mean, 2)}° against {fixed(other_mean, 2)}°, standard deviation "
                f"{fixed(spread, 2)}° against {fixed(other_spread, 2)}°"
            )
        reasons.append(
            "- **Where parameters that move do harm.** RATTE against RATT, "
            + "; ".join(parts)
            + ". A filter that may move its tyres lays the crossfall and errors of the sensors upon them; the paper has states for neither."
        )
    shared = {
        drive.id: float(np.degrees(curves.offsets[drive.id][1]))
        for curves in own.values()
        for drive in drives.values()
        if drive.id in curves.offsets
    }
    apart = shared[drives["worn_laps"].id] - shared[drives["nominal_laps"].id]
    means = [_parts(errors, test, paper.RATT)[0] for test in ("nominal_laps", "worn_laps")]
    reasons.append(
        "- **Offsets of the reference.** The rear axle of the plant makes no force where the sensors show a slip angle of, in degrees: "
        + "; ".join(f"{name.replace('_', ' ')} {fixed(value, 2)}" for name, value in shared.items())
        + f". From the nominal to the worn laps that changes by {fixed(apart, 2)}° and the mean error of RATT by "
        + f"{fixed(means[1] - means[0], 2)}°; no filter can know an offset of the reference, so it is in the errors of all."
    )
    pulls = [f"{test.replace('_', ' ')} {fixed(_pull(drive), 2)}" for test, drive in drives.items()]
    reasons.append(
        f"- **Crossfall.** The mean of a_y - u r - dv/dt is, in m/s²: {'; '.join(pulls)}. The course falls by 1° to one side all along, "
        f"which makes {fixed(GRAVITY * math.sin(math.radians(1.0)), 2)}; the rest is the accelerometer's. A filter without a state for it "
        "turns it into β, and one whose tyres adapt into tyres."
    )
    return "\n\n".join([" ".join(sentences), "\n".join(reasons)])


def _parts(errors: pd.DataFrame, test: str, name: str) -> tuple[float, float]:
    """Mean and standard deviation of a filter's errors on a test [deg]."""
    row = errors[(errors["test"] == test.replace("_", ", ")) & (errors["filter"] == name)]
    return float(row["mean"].iloc[0]), float(row["std"].iloc[0])


def _curvature(fit: TyreFit) -> str:
    words = []
    for axle, values, slip in zip(("front", "rear"), (fit.front, fit.rear), fit.slip, strict=True):
        reach = float(np.quantile(np.abs(slip), 0.999))
        lost = reach**2 / (reach**2 + 2.0 * float(values[0]))
        words.append(
            f"{axle} {fixed(math.degrees(reach), 1)}°, where the fitted curve lies {fixed(100 * lost, 0)} % below its tangent"
        )
    return f"In the validation drives the slip angles reach (99.9 % of samples) {'; '.join(words)}."


def _gained(errors: pd.DataFrame) -> str:
    """Standard deviations of the errors, which no constant offset enters, of fixed tyres on drives with the same and with other ones."""
    words = []
    for drive in DRIVES:
        (same_mean, same), (worn_mean, worn) = (
            _parts(errors, f"{tyres}_{drive}", paper.RATT) for tyres in ("nominal", "worn")
        )
        words.append(
            f"{DRIVES[drive]} {fixed(same, 2)}° on nominal and {fixed(worn, 2)}° on worn tyres, beside mean errors of "
            f"{fixed(same_mean, 2)}° and {fixed(worn_mean, 2)}°"
        )
    return f"Standard deviations of RATT's errors: {'; '.join(words)}. Adapting can take away by how much those grow with worn tyres."


def _held(rmse: Rmse, errors: pd.DataFrame) -> str:
    """What a filter that holds its tyres straight ahead makes of the drives."""
    words = []
    for tyres in TYRES:
        for drive in DRIVES:
            test = f"{tyres}_{drive}"
            spread = [
                fixed(_parts(errors, test, name)[1], 2)
                for name in (paper.HELD, paper.RATTE, paper.RATT)
            ]
            errors_of = [
                fixed(rmse[name, test], 2) for name in (paper.HELD, paper.RATTE, paper.RATT)
            ]
            words.append(
                f"{tyres} {drive} {', '.join(errors_of)}° (standard deviations {', '.join(spread)}°)"
            )
    return (
        "There a filter lays the crossfall, and offsets of yaw rate and steering, upon its tyres, which it then brings into the next bend. "
        f"RMSE(β) of {paper.HELD}, whose parameters are held there, of RATTE and of RATT: {'; '.join(words)}."
    )


def _starts(own: Mapping[str, OwnCurves], fit: TyreFit) -> str:
    words = []
    for tyres, curves in own.items():
        if tyres == "nominal":
            continue
        nominal = own["nominal"].linear
        changes = [
            percent_below(float(after[0]), float(before[0]))
            for after, before in (
                (curves.linear.front, nominal.front),
                (curves.linear.rear, nominal.rear),
            )
        ]
        words.append(f"{TYRES[tyres]} {changes[0]} front and {changes[1]} rear")
    start = [
        percent_below(float(plant[0]), float(values[1]))
        for plant, values in (
            (own["nominal"].linear.front, fit.front),
            (own["nominal"].linear.rear, fit.rear),
        )
    ]
    return (
        f"The plant's own nominal stiffness, by a straight line through its forces, lies {start[0]} front and {start[1]} rear below what "
        f"the fit to accelerations starts the rational filters with; below the plant's nominal one are: {'; '.join(words)}."
    )


def _pull(drive: Recording) -> float:
    """Mean of a_y - u r - dv/dt [m/s²] while driving: the gravity of a crossfall, and an accelerometer's offset."""
    driven = drive["vx"] > 5.0
    slope = np.gradient(drive["vy_ref"]) * drive.rate_hz
    return float(np.mean((drive["ay"] - drive["vx_ref"] * drive["yaw_rate"] - slope)[driven]))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan
