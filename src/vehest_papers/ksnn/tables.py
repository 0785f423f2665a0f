"""Tables III to VII of the paper: what it reports beside what came out here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed, listed
from vehest.studies.sweep import interval, mean_and_half
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import chosen
from vehest_papers.ksnn.paper import Instances
from vehest_papers.ksnn.schemes import SET_TITLES, THIRD, Scheme

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


def across_cars(
    schemes: Sequence[Scheme], name: str, caption: str, without: Sequence[str] = ()
) -> Table:
    """Tables IV and V and Figure 6 in one: of each category the structure chosen by validation, over all seeds, with 95 % intervals."""
    rows = []
    third = any(THIRD in scheme.part.split.tests for scheme in schemes)
    published = any(scheme.published for scheme in schemes)
    for scheme in schemes:
        tests = {"own": scheme.own, "other": scheme.other} | (
            {"third": THIRD} if THIRD in scheme.part.split.tests else {}
        )
        for category, run in scheme.chosen.items():
            if category in without:
                continue
            key = scheme.name_of(category)
            known = scheme.published.get(category)
            structure = str(run["structure"])
            row: dict[str, object] = {
                "scheme": scheme.title,
                "model": category,
                "structure": structure,
            }
            row["candidate"] = category if structure == MISSING else f"{category}, {structure}"
            row |= {
                "n_seeds": len(scheme.models(category)),
                "n_parameters": int(run["n_parameters"]),
            }
            row |= {
                f"paper_fvu_{word}": known.fvu(tests[word]) if known else math.nan
                for word in ("own", "other")
            }
            for word, test in tests.items():
                errors = scheme.errors(test)
                row |= {
                    f"{metric}_{word}": errors.value(key, metric) for metric in ("fvu", "rmse_vy")
                }
                row |= {
                    f"{metric}_{word}_shown": errors.in_words(key, metric)
                    for metric in ("fvu", "rmse_vy")
                }
            rows.append(row)
    columns = {"scheme": Column("scheme"), "candidate": Column("model")}
    for word, title in (("own", "own car"), ("other", "other car")):
        columns |= (
            {f"paper_fvu_{word}": Column(f"FVU, {title}, paper", decimals=3)} if published else {}
        )
        columns |= {
            f"fvu_{word}_shown" if word == "other" else f"fvu_{word}": Column(
                f"FVU, {title}", decimals=3
            )
        }
    columns |= {"rmse_vy_other": Column("RMSE(v), other car [m/s]", decimals=3)}
    if third:
        columns |= {"fvu_third_shown": Column("FVU, third car")}
    return Table(name, caption, pd.DataFrame(rows), columns)


def chosen_runs(scheme: Scheme, name: str, caption: str) -> Table:
    """Table IV or V as printed: of each category the one run that validation, on the other car, chooses."""
    rows = []
    for category, run in scheme.chosen.items():
        known = scheme.published.get(category)
        row: dict[str, object] = {
            "model": category,
            "paper_structure": known.structure if known else MISSING,
            "structure": run["structure"],
        }
        row |= {"n_parameters": int(run["n_parameters"]), "seed": int(run["seed"])}
        for test in (scheme.own, scheme.other):
            row[f"paper_fvu_{test}"] = known.fvu(test) if known else math.nan
            row[f"fvu_{test}"] = run[f"fvu.{test}"]
            row[f"paper_rmse_vy_{test}"] = known.rmse(test) if known else math.nan
            row[f"rmse_vy_{test}"] = run[f"rmse_vy.{test}"]
        row["epochs"] = run["epochs"] if run["epochs"] > 0 else math.nan
        rows.append(row)
    columns = {
        "model": Column("model"),
        "paper_structure": Column("in the paper"),
        "structure": Column("structure"),
    }
    columns |= {"n_parameters": Column("params", decimals=0), "seed": Column("seed", decimals=0)}
    for test in (scheme.own, scheme.other):
        title = SET_TITLES.get(test, test)
        columns |= {
            f"paper_fvu_{test}": Column(f"{title} FVU, paper", decimals=3),
            f"fvu_{test}": Column("ours", decimals=3),
        }
        columns |= {f"paper_rmse_vy_{test}": Column(f"{title} RMSE(v) [m/s], paper", decimals=3)}
        columns |= {f"rmse_vy_{test}": Column("ours", decimals=3)}
    columns["epochs"] = Column("epochs", decimals=0)
    return Table(name, caption, pd.DataFrame(rows), columns)


def small_cars(pairs: Sequence[Scheme]) -> Table:
    """Pairs of small cars: FVU on the car that was stopped on, a row a category."""
    categories = dict.fromkeys(category for scheme in pairs for category in scheme.chosen)
    rows = [
        {"model": category}
        | {
            scheme.name: scheme.errors(scheme.other).in_words(scheme.name_of(category), "fvu")
            for scheme in pairs
        }
        for category in categories
    ]
    rmse = {scheme.name: f"{scheme.title}" for scheme in pairs}
    caption = (
        "Pairs of small cars, real, all seen at a wheelbase of 0.33 m: FVU on the car that was stopped on, with 95 % intervals. Own cars "
        "and RMSE(v) stand in [this table](tables/small_cars_all.csv)."
    )
    return Table(
        "small_cars",
        caption,
        pd.DataFrame(rows),
        {"model": Column("model"), **{name: Column(title) for name, title in rmse.items()}},
    )


def sideslip(
    schemes: pd.DataFrame, drive: pd.DataFrame | None, whole: pd.DataFrame | None, kind: str
) -> Table:
    """Table VI: RMSE of the sideslip angle: F-2 of scheme 2, one drive of the real Ferrari, and its whole drive by what learns nothing."""
    rows = []
    lags = (
        [name for name in dict.fromkeys(whole["category"]) if name.startswith(paper.FIXED_LAG)]
        if whole is not None
        else []
    )
    for category in [*paper.BASELINES, *paper.TABLE_VI, *lags]:
        row: dict[str, object] = {
            "model": category,
            "paper": paper.TABLE_VI.get(category, math.nan),
        }
        for column, runs, test in (
            ("real_drive", drive, "test"),
            ("real_whole", whole, "test"),
            ("scheme_2", schemes, "f2"),
        ):
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
    return Table("table_6", caption, pd.DataFrame(rows), columns)


def regularisation(with_it: pd.DataFrame, without: pd.DataFrame) -> Table:
    """Table VII: the same two structures with and without cross-vehicle regularisation."""
    rows = []
    plain = {(name, True): None for name in paper.BASELINES}
    for (category, regularised), published in {**plain, **paper.TABLE_VII}.items():
        runs = with_it if regularised else without
        own = runs[
            (runs["category"] == category)
            & ((published is None) | (runs["structure"] == getattr(published, "structure", "")))
        ]
        if own.empty:
            continue
        run = chosen(own)
        row: dict[str, object] = {
            "model": category if published is None else f"{category}, {published.structure}",
            "regularisation": MISSING
            if published is None
            else "with"
            if regularised
            else "without",
            "n_parameters": int(run["n_parameters"]),
            "epochs": run["epochs"] if run["epochs"] > 0 else math.nan,
        }
        for test in SETS:
            mean, half = interval(own[f"fvu.{test}"].to_numpy(dtype=float))
            row |= {
                f"paper_fvu_{test}": published.fvu(test) if published else math.nan,
                f"fvu_{test}": run[f"fvu.{test}"],
            }
            row |= {f"fvu_seeds_{test}": mean_and_half(mean, half, 3)}
            row |= {
                f"paper_rmse_vy_{test}": published.rmse(test) if published else math.nan,
                f"rmse_vy_{test}": run[f"rmse_vy.{test}"],
            }
        rows.append(row)
    columns = {
        "model": Column("model"),
        "regularisation": Column("regularisation"),
        "n_parameters": Column("params", decimals=0),
    }
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
            row |= {
                "least": own["epochs"].min(),
                "median": own["epochs"].median(),
                "most": own["epochs"].max(),
            }
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
        row = {
            "estimator": estimator,
            "variant": variant,
            "category": run["category"],
            "n_parameters": int(run["n_parameters"]),
        }
        row |= {
            "n_seeds": len(own),
            "seed": int(run["seed"]),
            "rmse_vy_validation": run["rmse_vy.validation"],
        }
        row |= {
            f"epochs_{what}": getattr(own["epochs"], what)() for what in ("min", "median", "max")
        }
        for test in tests:
            for metric in ("fvu", "r2", "rmse_vy", "rmse_sideslip"):
                row[f"{metric}_{test}"] = run[f"{metric}.{test}"]
            row[f"fvu_mean_{test}"], row[f"fvu_half_{test}"] = interval(
                own[f"fvu.{test}"].to_numpy(dtype=float)
            )
        rows.append(row)
    return pd.DataFrame(rows)


def _range(limits: tuple[int, int]) -> str:
    return str(limits[0]) if limits[0] == limits[1] else f"{limits[0]} to {limits[1]}"


def whether_an_order_means_anything(scheme: Scheme) -> str:
    """The order on the car that was stopped on, unless a candidate fails there or on the very car that it learnt on.

    A candidate that leaves more of its own training car than v = 0 or the static map has not learnt that car; its error on another
    does not depend on structure alone.
    """
    own = scheme.errors(scheme.own)
    other = scheme.errors(scheme.other)
    names = {
        category: scheme.name_of(category)
        for category in scheme.chosen
        if category not in paper.BASELINES
    }
    limit = min(
        (
            1.0,
            *(
                own.value(scheme.name_of(name), "fvu")
                for name in paper.BASELINES
                if name in scheme.chosen
            ),
        )
    )
    failed = [category for category, name in names.items() if not own.value(name, "fvu") <= limit]
    fvu = {category: other.value(name, "fvu") for category, name in names.items()}
    order = sorted((name for name in fvu if math.isfinite(fvu[name])), key=fvu.__getitem__)
    listing = ", ".join(f"{name} ({fixed(fvu[name], 3)})" for name in order)
    words = (
        f"**{scheme.title}.** Order by FVU on the car that was stopped on, best first: {listing}."
    )
    if failed:
        where = f"on the car that they learnt on themselves {listed(failed)} do no better than the baselines"
        return f"{words} No order of families is read off this: {where}."
    if order and min(fvu.values()) > 1.0:
        return f"{words} All leave more than the whole variance of v: none knows that car."
    if {paper.LUENBERGER, *paper.PLAIN, *paper.WITHOUT_BIAS} <= set(fvu):
        middle = fvu[paper.LUENBERGER]
        if (
            max(fvu[name] for name in paper.WITHOUT_BIAS)
            < middle
            < min(fvu[name] for name in paper.PLAIN)
        ):
            words += " KS-NN without biases before the observer, the observer before GRU and LSTM: the paper's order of families."
    return words
