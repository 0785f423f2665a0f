"""Tables III to VII of the paper: what it reports beside what came out here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed
from vehest.studies.sweep import interval, mean_and_half
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import chosen, chosen_by_category, seeds_like
from vehest_papers.ksnn.paper import Instances, Published

SETS = {"c2": "C-2", "f2": "F-2"}


def instances(runs: pd.DataFrame) -> Table:
    """Table III: the candidates, their number and their parameters."""
    rows = []
    for category, row in paper.TABLE_III.items():
        own = runs[runs["category"] == category].drop_duplicates(["estimator", "variant"])
        if own.empty:
            continue
        counts = own["n_parameters"].astype(int)
        ours = Instances(len(own), "", (counts.min(), counts.max()))
        rows.append(
            {
                "model": category,
                "hyperparameters": row.hyperparameters,
                "paper_variants": row.variants,
                "variants": ours.variants,
                "paper_n_parameters": _range(row.n_parameters),
                "n_parameters": _range(ours.n_parameters),
            }
        )
    columns = {
        "model": Column("model"),
        "hyperparameters": Column("hyperparameters"),
        "paper_variants": Column("variants, paper", decimals=0),
        "variants": Column("variants, ours", decimals=0),
        "paper_n_parameters": Column("parameters, paper"),
        "n_parameters": Column("parameters, ours"),
    }
    return Table("table_3", "Candidates (Table III of the paper).", pd.DataFrame(rows), columns)


def most_general(runs: pd.DataFrame, published: Mapping[str, Published], name: str, caption: str, tests: Mapping[str, str] = SETS) -> Table:
    """Table IV or V: of each category the run that validation, on the other car, chooses; and the spread over its seeds."""
    rows = []
    for category, run in chosen_by_category(runs).items():
        seeds = seeds_like(runs, run)
        row: dict[str, object] = {"model": category}
        known = published.get(category)
        row["paper_structure"] = known.structure if known else MISSING
        row |= {"structure": run["structure"], "n_parameters": int(run["n_parameters"]), "seed": int(run["seed"])}
        for test in tests:
            mean, half = interval(seeds[f"fvu.{test}"].to_numpy(dtype=float))
            row[f"paper_fvu_{test}"] = known.fvu(test) if known else math.nan
            row[f"fvu_{test}"] = run[f"fvu.{test}"]
            row[f"fvu_seeds_{test}"] = mean_and_half(mean, half, 3)
            row[f"paper_rmse_vy_{test}"] = known.rmse(test) if known else math.nan
            row[f"rmse_vy_{test}"] = run[f"rmse_vy.{test}"]
        row["epochs"] = run["epochs"] if run["epochs"] > 0 else math.nan
        rows.append(row)
    columns = {"model": Column("model"), "structure": Column("structure")}
    columns = columns | ({"paper_structure": Column("in the paper")} if published else {})
    columns |= {"n_parameters": Column("params", decimals=0), "seed": Column("seed", decimals=0)}
    for test, title in tests.items():
        if published:
            columns[f"paper_fvu_{test}"] = Column(f"{title} FVU, paper", decimals=3)
        columns[f"fvu_{test}"] = Column(f"{title} FVU, ours", decimals=3)
        columns[f"fvu_seeds_{test}"] = Column(f"{title} FVU, seeds")
        if published:
            columns[f"paper_rmse_vy_{test}"] = Column(f"{title} RMSE(v) [m/s], paper", decimals=3)
        columns[f"rmse_vy_{test}"] = Column(f"{title} RMSE(v) [m/s], ours", decimals=3)
    columns["epochs"] = Column("epochs", decimals=0)
    return Table(name, caption, pd.DataFrame(rows), columns)


def sideslip(schemes: pd.DataFrame, drive: pd.DataFrame | None, whole: pd.DataFrame | None, kind: str, name: str = "table_6") -> Table:
    """Table VI: RMSE of the sideslip angle.

    Args:
        schemes: runs of scheme 2; F-2 is read.
        drive: runs of one drive of the real Ferrari, its test range ``test``.
        whole: runs on the whole drive of the real Ferrari, of estimators that learn nothing.
        kind: of the data of scheme 2, ``real`` or ``simulated``.
        name: of the file.
    """
    rows = []
    lags = [name for name in dict.fromkeys(whole["category"]) if name.startswith(paper.FIXED_LAG)] if whole is not None else []
    for category in [*paper.TABLE_VI, *lags]:
        row: dict[str, object] = {"model": category, "paper": paper.TABLE_VI.get(category, math.nan)}
        for column, runs, test in (("real_drive", drive, "test"), ("real_whole", whole, "test"), ("scheme_2", schemes, "f2")):
            own = runs[runs["category"] == category] if runs is not None else pd.DataFrame()
            row[column] = chosen(own)[f"rmse_sideslip.{test}"] if len(own) else math.nan
        rows.append(row)
    columns = {
        "model": Column("model"),
        "paper": Column("paper: real F-2 [deg]", decimals=2),
        "real_drive": Column("ours: REAL, 550 to 700 s of one file of F-2 [deg]", decimals=3),
        "real_whole": Column("ours: REAL, all of that file [deg]", decimals=3),
        "scheme_2": Column(f"ours: {kind.upper()} F-2, scheme 2 [deg]", decimals=3),
    }
    caption = (
        "RMSE of the sideslip angle (Table VI of the paper). On the real drive networks and observer learn on 150 to 450 s and stop on 450 "
        "to 550 s of the same file; the paper's learn on F-1. Kalman filter and factor graph learn nothing from references; on the whole "
        "file the filter's noise levels are read off that file, and the graph is one batch. They need a car's parameters and were not run "
        "in scheme 2: no entry there."
    )
    return Table(name, caption, pd.DataFrame(rows), columns)


def regularisation(with_it: pd.DataFrame, without: pd.DataFrame) -> Table:
    """Table VII: the same two structures with and without cross-vehicle regularisation."""
    rows = []
    for (category, regularised), published in paper.TABLE_VII.items():
        runs = with_it if regularised else without
        own = runs[(runs["category"] == category) & (runs["structure"] == published.structure)]
        if own.empty:
            continue
        run = chosen(own)
        row: dict[str, object] = {
            "model": f"{category}, {published.structure}",
            "regularisation": "with" if regularised else "without",
            "n_parameters": int(run["n_parameters"]),
            "epochs": run["epochs"],
        }
        for test in SETS:
            mean, half = interval(own[f"fvu.{test}"].to_numpy(dtype=float))
            row |= {f"paper_fvu_{test}": published.fvu(test), f"fvu_{test}": run[f"fvu.{test}"]}
            row |= {f"fvu_seeds_{test}": mean_and_half(mean, half, 3)}
            row |= {f"paper_rmse_vy_{test}": published.rmse(test), f"rmse_vy_{test}": run[f"rmse_vy.{test}"]}
        rows.append(row)
    columns = {"model": Column("model"), "regularisation": Column("regularisation"), "n_parameters": Column("params", decimals=0)}
    for test, title in SETS.items():
        columns[f"paper_fvu_{test}"] = Column(f"{title} FVU, paper", decimals=3)
        columns[f"fvu_{test}"] = Column(f"{title} FVU, ours", decimals=3)
        columns[f"fvu_seeds_{test}"] = Column(f"{title} FVU, seeds")
        columns[f"paper_rmse_vy_{test}"] = Column(f"{title} RMSE(v) [m/s], paper", decimals=3)
        columns[f"rmse_vy_{test}"] = Column(f"{title} RMSE(v) [m/s], ours", decimals=3)
    columns["epochs"] = Column("epochs", decimals=0)
    caption = (
        "With and without cross-vehicle regularisation, scheme 2 (Table VII of the paper). Of each the seed with the lowest RMSE(v) on its "
        "validation set; `seeds` is the mean over seeds with half its 95 % confidence interval (Student's t)."
    )
    return Table("table_7", caption, pd.DataFrame(rows), columns)


def stopping(parts: Mapping[str, pd.DataFrame], titles: Mapping[str, str]) -> Table:
    """When training stopped, by part and category."""
    rows = []
    for name, runs in parts.items():
        for category in dict.fromkeys(runs["category"]):
            own = runs[(runs["category"] == category) & (runs["epochs"] > 0)]
            if own.empty:
                continue
            row: dict[str, object] = {"part": titles[name], "model": category, "fits": len(own)}
            row |= {"least": own["epochs"].min(), "median": own["epochs"].median(), "most": own["epochs"].max()}
            rows.append(row)
    columns = {
        "part": Column("part"),
        "model": Column("model"),
        "fits": Column("fits", decimals=0),
        "least": Column("epochs, least", decimals=0),
        "median": Column("median", decimals=0),
        "most": Column("most", decimals=0),
    }
    caption = "Epochs after which training stopped (the paper: typically about 200), all structures and seeds of a category."
    return Table("stopping", caption, pd.DataFrame(rows), columns)


def candidates(runs: pd.DataFrame, tests: Sequence[str]) -> pd.DataFrame:
    """Every candidate with its parameters, its chosen seed's figures and the spread over seeds; for a file of its own."""
    rows = []
    for (estimator, variant), own in runs.groupby(["estimator", "variant"], sort=False):
        run = chosen(own)
        row = {"estimator": estimator, "variant": variant, "category": run["category"], "n_parameters": int(run["n_parameters"])}
        row |= {"n_seeds": len(own), "seed": int(run["seed"]), "rmse_vy_validation": run["rmse_vy.validation"]}
        row |= {f"epochs_{what}": getattr(own["epochs"], what)() for what in ("min", "median", "max")}
        for test in tests:
            for metric in ("fvu", "r2", "rmse_vy", "rmse_sideslip"):
                row[f"{metric}_{test}"] = run[f"{metric}.{test}"]
            row[f"fvu_mean_{test}"], row[f"fvu_half_{test}"] = interval(own[f"fvu.{test}"].to_numpy(dtype=float))
        rows.append(row)
    return pd.DataFrame(rows)


def order_in_words(runs: pd.DataFrame, published: Mapping[str, Published], other: str) -> str:
    """The order of categories by FVU on the car not trained on, in the paper and here, and where they disagree by more than chance.

    By more than chance: the 95 % intervals of the means over seeds do not overlap.
    """
    picked = {name: run for name, run in chosen_by_category(runs).items() if name in published}
    ours = {name: float(run[f"fvu.{other}"]) for name, run in picked.items()}
    theirs = {name: published[name].fvu(other) for name in ours}
    over_seeds = {name: interval(seeds_like(runs, run)[f"fvu.{other}"].to_numpy(dtype=float)) for name, run in picked.items()}
    lists = [sorted(values, key=values.__getitem__) for values in (theirs, ours)]
    pairs = [(a, b) for position, a in enumerate(lists[0]) for b in lists[0][position + 1 :]]
    swapped = [(a, b) for a, b in pairs if ours[a] > ours[b]]
    words = (
        f"Order by FVU on {SETS[other]}, the car not trained on, best first. Paper: {_ordered(lists[0], theirs)}. "
        f"Ours: {_ordered(lists[1], ours)}. "
    )
    if not swapped:
        return words + f"The order is the paper's in all {len(pairs)} pairs."
    clear = [(a, b) for a, b in swapped if _above(over_seeds[a], over_seeds[b])]
    words += f"{len(swapped)} of {len(pairs)} pairs are the other way round here"
    if not clear:
        return words + ", none of them by more than chance: the intervals over seeds overlap."
    listed = "; ".join(f"{b} before {a} ({fixed(ours[b], 3)} against {fixed(ours[a], 3)})" for a, b in clear)
    return words + f", {len(clear)} of them by more than chance (the intervals over seeds do not overlap): {listed}."


def families_in_words(runs: pd.DataFrame, other: str, title: str, where_as_in_the_paper: str = "") -> str:
    """Who comes first on the car not trained on: KS-NN, the observer, or networks without structure; and what the paper has.

    Args:
        runs: from `candidates.runs_of`.
        other: test set of the car not trained on.
        title: of that test set, for people.
        where_as_in_the_paper: what is said on top where the families come in the paper's order.
    """
    fvu = {name: float(run[f"fvu.{other}"]) for name, run in chosen_by_category(runs).items()}
    order = sorted(fvu, key=fvu.__getitem__)
    words = f"Order by FVU on the {title}, the car not trained on, best first: {_ordered(order, fvu)}."
    structured = [value for name, value in fvu.items() if name.startswith("KS-NN")]
    plain = [fvu[name] for name in (paper.GRU, paper.LSTM) if name in fvu]
    if min(fvu.values()) > 1.0:
        return f"{words} All leave more than the whole variance of v: none knows that car."
    if structured and plain and paper.LUENBERGER in fvu and max(structured) < fvu[paper.LUENBERGER] < min(plain):
        words += (
            " Every KS-NN comes before the Luenberger observer, and the observer before GRU and LSTM: the order of families that the paper "
            f"has in its scheme 1.{where_as_in_the_paper}"
        )
    elif structured and plain and max(structured) < min(plain):
        words += " Every KS-NN comes before GRU and LSTM, as in the paper."
    return words


def specialisation_in_words(runs: pd.DataFrame, published: Mapping[str, Published], own: str, other: str) -> str:
    """How many times the FVU of the own car is left on the other one, in the paper and here: what is learnt of one car alone."""
    ours = {name: float(run[f"fvu.{other}"]) / float(run[f"fvu.{own}"]) for name, run in chosen_by_category(runs).items()}
    listed = "; ".join(
        f"{name} {fixed(published[name].fvu(other) / published[name].fvu(own), 1)} in the paper, {fixed(ours[name], 1)} here"
        for name in ours
        if name in published
    )
    return (
        f"What a network learns of one car alone shows in how much more it leaves on the other, FVU on {SETS[other]} over {SETS[own]}: "
        f"{listed}."
    )


def _above(upper: tuple[float, float], lower: tuple[float, float]) -> bool:
    """Whether a mean's interval lies above another's; a single value has none."""
    halves = [0.0 if math.isnan(half) else half for _, half in (upper, lower)]
    return upper[0] - halves[0] > lower[0] + halves[1]


def _ordered(names: Sequence[str], values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} ({fixed(values[name], 3)})" for name in names)


def _range(limits: tuple[int, int]) -> str:
    return str(limits[0]) if limits[0] == limits[1] else f"{limits[0]} to {limits[1]}"
