"""The report: claims judged by the engine, errors on pairs of cars, sub-models, window lengths and
real cars.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import PATENT_NOTE, REPORT, Block, Column, Document, Table, as_text
from vehest.report.style import MISSING, fixed
from vehest.report.template import fill_template
from vehest.studies.artefacts import StudyArtefacts
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.methods import absent_parts
from vehest_papers.kit.reading import recordings_of, words_of_kinds
from vehest_papers.kit.verdict_table import (
    DECIDED,
    claim_files,
    claims_table,
    figure_in_words,
    without_line_breaks,
)
from vehest_papers.kit.verdicts import VERDICTS
from vehest_papers.ksnn import block_errors, measures, paper
from vehest_papers.ksnn.behaviour import Behaviour
from vehest_papers.ksnn.data_quality import PUBLISHED, velocity_ratio
from vehest_papers.ksnn.pairs import (
    ORDER,
    PART,
    TABLE_CANDIDATES,
    TRAININGS,
    detectable_ratio,
    errors_figure,
    errors_table,
    geometric_mean,
    log_fvu,
    n_seeds,
    pair_errors,
    pair_parts,
    pair_rows,
    ratios_table,
)
from vehest_papers.ksnn.schemes import THIRD, Scheme, with_common_blocks
from vehest_papers.ksnn.sub_models import shares_of_parts, shares_table

NAME = "ksnn"  # of the paper's package
TEMPLATE = Path(__file__).with_name("report.md.j2")
SCHEMES = {"scheme_1": ("c2", "f2"), "scheme_2": ("f2", "c2")}
"""Part -> test set of the training car, test set of the other car."""

WINDOWS = re.compile(r"window_(\d+)_([12])")
NO_SCHEME = re.compile(r"pair_|window_|doubled_")  # parts that are no `Scheme`
REAL = ("ferrari_drive", "simulated_to_ferrari", "devbot_ferrari", "ferrari_devbot")
SMALL = ("f1tenth", "dart", "roboracer")
REAL_CANDIDATES = ("static_map", paper.LUENBERGER, paper.GRU, paper.LSTM, paper.NONLINEAR)
RATIO_SETS = {"Scheme 1": ("C-1", "F-2"), "Scheme 2": ("C-2", "F-1")}
RATIO_MARGIN = 0.05


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study; what is not trained yet is named, and claims on it are not assessed.

    Raises
    ------
    DataError
        No part has a trained estimator, a scheme has no test sets ``c2`` and ``f2``, or metrics are
        missing.
    """
    if not artefacts.parts:
        raise DataError(f"study '{artefacts.study}' has no trained part yet; train one first")
    for name in set(SCHEMES) & set(artefacts.parts):
        if not {"c2", "f2"} <= set(artefacts.parts[name].split.tests):
            raise DataError(
                f"study '{artefacts.study}': two test sets of part '{name}' must be called c2 and "
                "f2"
            )
    schemes = with_common_blocks(
        {name: scheme_of(artefacts, name) for name in artefacts.parts if not NO_SCHEME.match(name)}
    )
    content = claims_of(NAME)
    errors = pair_errors(artefacts.parts)
    rows = block_errors.error_rows(content, schemes, behaviours(schemes)) + pair_rows(errors)
    rows += block_errors.measured_rows(content, schemes | windows_of(artefacts))
    trained = block_errors.training_rows(content, artefacts.parts, schemes)
    kinds = kinds_of(artefacts)
    claims = claims_table(content, rows, trained, kinds)
    shares = shares_of(artefacts)
    overviews = [errors_table(errors, "raw")] if len(errors) else []
    overviews += [schemes_table(schemes)]
    tables: list[Block] = [
        replace(overviews[0], name="overview"),
        *overviews[1:],
    ]
    if len(errors):
        tables += [
            pair_claims(claims),
            errors_table(errors, "best_gain"),
            errors_figure(errors),
        ]
    if len(shares):
        tables.append(shares_table(shares))
    gates = velocity_ratios(artefacts)
    tables += [table for table in (gates, real_table(schemes)) if table]
    windows = windows_table(artefacts)
    verdicts = claims.frame["verdict"].value_counts()
    values = {
        "recommendation": without_line_breaks(content.recommendation),
        "kinds": " and ".join(
            sorted({word for kind in kinds.values() for word in kind.split(" and ")})
        ).upper(),
        "pairs": pairs_values(errors),
        "verdicts": {
            verdict: int(verdicts[verdict]) for verdict in VERDICTS if verdict in verdicts
        },
        "n_claims": len(claims.frame),
        "absent_parts": absent_parts(artefacts),
        "incomplete": incomplete(artefacts),
        "has_windows": len(windows) > 0,
        "searches": [
            {"title": as_text(trial.title), "value": f"{trial.validation:.4f}"}
            for trial in artefacts.trials
        ],
    }
    data = {"pairs_ratios": ratios_table(errors)} if len(errors) else {}
    data |= {"windows": windows} if len(windows) else {}
    data |= {"sub_models": shares, "pair_errors": errors}
    data |= {f"candidates_{name}": schemes[name].runs for name in SCHEMES if name in schemes}
    data |= claim_files(claims, rows, trained)
    blocks = [*fill_template(TEMPLATE, values, tables), PATENT_NOTE]
    return {REPORT: Document(artefacts.title, blocks, data)}


def scheme_of(artefacts: StudyArtefacts, name: str) -> Scheme:
    """A part with the test sets of its cars.

    Cars of the paper follow from the name of the part, others from the data set of the training.
    """
    part = artefacts.parts[name]
    title = as_text(artefacts.titles[name])
    if name in SCHEMES:
        return Scheme(name, title, part, *SCHEMES[name])
    tests = list(part.split.tests)
    if {"c2", "f2"} <= set(tests):
        training_test = "c2" if name.endswith("_1") else "f2"
        return Scheme(name, title, part, training_test, "f2" if training_test == "c2" else "c2")
    datasets = {span.dataset for span in part.split.train}
    training_test = next(
        (test for test in tests if datasets & {span.dataset for span in part.split.tests[test]}),
        tests[0],
    )
    return Scheme(
        name,
        title,
        part,
        training_test,
        next((test for test in tests if test != training_test), training_test),
    )


def pair_claims(claims: Table) -> Table:
    """The claims that pairs of cars decide, without those that are open."""
    frame = claims.frame
    chosen = frame[frame["id"].str.endswith("_pairs") & frame["verdict"].isin(DECIDED)]
    subjects = chosen["claim"].str.removeprefix("Over pairs of cars, ")
    chosen = chosen.assign(claim=subjects.str.replace(" of the lateral velocity", ""))
    columns = {name: claims.columns[name] for name in ("claim", "published", "verdict")}
    caption = "Claims on the FVU of the lateral velocity that the pairs of cars decide. SIMULATED."
    return Table("pair_claims", caption, chosen, columns)


def behaviours(schemes: Mapping[str, Scheme]) -> dict[str, Behaviour]:
    """What the candidates of both schemes do at little yaw rate and without biases."""
    return {name: Behaviour.of(schemes[name]) for name in SCHEMES if name in schemes}


def windows_of(artefacts: StudyArtefacts) -> dict[str, Scheme]:
    """Parts with networks on windows of another length."""
    return {name: scheme_of(artefacts, name) for name in artefacts.parts if WINDOWS.fullmatch(name)}


def kinds_of(artefacts: StudyArtefacts) -> dict[str, str]:
    """Part in claims.yaml -> real or simulated."""
    kinds = {}
    for name, part in artefacts.parts.items():
        match = PART.fullmatch(name)
        title = f"pairs_{match[2]}" if match else re.sub(r"_[a-z]$", "", name)
        kinds[title] = words_of_kinds(part)
    return kinds


def pairs_values(errors: pd.DataFrame) -> list[dict[str, object]]:
    """Numbers of the answer: one entry, or none without a complete pair."""
    if not len(errors):
        return []
    first = paper.NONLINEAR
    stop, converged = (log_fvu(errors, training, "other", "raw") for training in TRAININGS)
    third, third_converged = (log_fvu(errors, training, "third", "raw") for training in TRAININGS)

    def ratio(table: pd.DataFrame, name: str, over: str) -> str:
        if name not in table or over not in table:
            return MISSING
        return figure_in_words(geometric_mean((table[name] - table[over]).to_numpy()))

    over = {"GRU": paper.GRU, "LSTM": paper.LSTM, "luenberger": paper.LUENBERGER}
    over |= {"static_map": "static_map"}
    detectable = [
        detectable_ratio((stop[first] - stop[name]).to_numpy())
        for name in (paper.GRU, paper.LSTM)
        if {first, name} <= set(stop)
    ]
    return [
        {
            "number": errors["pair"].nunique(),
            "seeds": n_seeds(errors, [name for name in (first, paper.GRU) if name in stop]),
            "stop": {key: ratio(stop, first, name) for key, name in over.items()},
            "third": {key: ratio(third, first, name) for key, name in over.items()},
            "converged": ratio(converged, first, "static_map"),
            "third_converged": ratio(third_converged, first, "static_map"),
            "kinematic": ratio(stop, paper.KINEMATIC_GAIN, first),
            "kinematic_third": ratio(third, paper.KINEMATIC_GAIN, first),
            "detectable": fixed(max(detectable, default=np.nan), 2),
        }
    ]


def shares_of(artefacts: StudyArtefacts) -> pd.DataFrame:
    """Shares of the sub-models in the KS-NNs of the pairs and of the real Ferrari."""
    groups = {"pairs": pair_parts(artefacts.parts)}
    groups |= {name: {name: artefacts.parts[name]} for name in REAL[:1] if name in artefacts.parts}
    tables = []
    for name, parts in groups.items():
        for part_name, part in parts.items():
            test = "own" if name == "pairs" else next(iter(part.split.tests))
            data = f"{name}, {words_of_kinds(part).upper()}"
            tables.append(shares_of_parts({part_name: part}, test, data))
    return pd.concat(tables) if tables else pd.DataFrame()


def incomplete(artefacts: StudyArtefacts) -> list[dict[str, object]]:
    """What is planned and not trained: one entry, or none."""
    counts = {name: len(names) for name, names in artefacts.not_trained.items() if names}
    if not counts:
        return []
    titles = dict.fromkeys("pairs" if name.startswith("pair_") else f"`{name}`" for name in counts)
    return [{"number": sum(counts.values()), "parts": ", ".join(titles)}]


def velocity_ratios(artefacts: StudyArtefacts) -> Table | None:
    """The gates on the pair of cars: v over ay of the Corvette over that of the Ferrari."""
    parts = [artefacts.parts[name] for name in SCHEMES if name in artefacts.parts]
    if len(parts) < len(SCHEMES):
        return None
    first, second = parts
    drives = {
        "C-1": recordings_of(first, first.split.train),
        "F-1": recordings_of(second, second.split.train),
        "C-2": recordings_of(first, first.split.tests["c2"]),
        "F-2": recordings_of(first, first.split.tests["f2"]),
    }
    rows = []
    for scheme, (corvette, ferrari) in RATIO_SETS.items():
        published = PUBLISHED[corvette].velocity_over_ay / PUBLISHED[ferrari].velocity_over_ay
        ours = velocity_ratio(drives[corvette], drives[ferrari])
        is_met = abs(ours / published - 1.0) <= RATIO_MARGIN
        rows.append(
            {
                "scheme": f"{scheme}: {corvette} over {ferrari}",
                "published": published,
                "ours": ours,
                "gate": f"within {100 * RATIO_MARGIN:.0f} %" if is_met else "not met",
            }
        )
    columns = {
        "scheme": Column("v over ay"),
        "published": Column("paper", decimals=3),
        "ours": Column("ours", decimals=3),
        "gate": Column("gate"),
    }
    caption = (
        "Ratio of v over ay between the two cars: mean size of the 0.01 and 0.99 quantiles of v "
        "over the 0.99 quantile of the magnitude of a_y. The gate was met before any network was "
        "trained."
    )
    return Table("velocity_ratios", caption, pd.DataFrame(rows), columns)


def schemes_table(schemes: Mapping[str, Scheme]) -> Table:
    """FVU on the other car of the structure that validation chooses of each kind: table
    ``schemes``.

    Its CSV file has the training car and a third car too.
    """
    rows: dict[str, dict[str, str]] = {}
    columns = {"candidate": Column("candidate")}
    for name in (*SCHEMES, "one_vehicle_1", "one_vehicle"):
        scheme = schemes.get(name)
        if scheme is None:
            continue
        columns[f"{name}_other"] = Column(scheme.title)
        tests = {"other": scheme.other_test, "own": scheme.training_test, "third": THIRD}
        for candidate in TABLE_CANDIDATES:
            key = scheme.key_of(candidate)
            for title, test in tests.items():
                if test in scheme.part.split.tests and key in scheme.errors(test):
                    row = rows.setdefault(candidate, {"candidate": candidate})
                    row[f"{name}_{title}"] = scheme.errors(test).in_words(key, "fvu")
    order = sorted(rows, key=TABLE_CANDIDATES.index)
    table = pd.DataFrame([rows[name] for name in order]).fillna(MISSING)
    caption = "FVU on the other car, 95 % intervals over blocks and seeds; `zero` has 1."
    return Table("schemes", caption, table, columns if len(table) else {})


def windows_table(artefacts: StudyArtefacts) -> pd.DataFrame:
    """FVU of networks trained on windows of N samples at the stop, mean over seeds.

    Returns
    -------
    DataFrame
        ``scheme``, ``candidate``, and ``own_N`` and ``other_N`` on the training and the other car,
        on the samples that networks of all lengths estimate.
    """
    schemes = {name: scheme_of(artefacts, name) for name in artefacts.parts if name in SCHEMES}
    windows = windows_of(artefacts)
    rows = []
    for number, (scheme_name, scheme) in enumerate(schemes.items(), start=1):
        lengths = {30: scheme} | {
            int(match[1]): of_length
            for name, of_length in windows.items()
            if (match := WINDOWS.fullmatch(name)) and match[2] == scheme_name[-1]
        }
        if len(lengths) < 2:
            continue
        for candidate in (paper.NONLINEAR, paper.GRU):
            row: dict[str, object] = {"scheme": f"Scheme {number}", "candidate": candidate}
            for length in sorted(lengths):
                for test in (scheme.training_test, scheme.other_test):
                    fvu = measures.fvu_after_longest_window(lengths[length], candidate, test)
                    row[f"{'own' if test == scheme.training_test else 'other'}_{length}"] = fvu
            rows.append(row)
    return pd.DataFrame(rows)


def real_table(schemes: Mapping[str, Scheme]) -> Table | None:
    """RMSE of v on the tests of real cars, with the baselines."""
    names = [name for name in schemes if name in REAL or set(name.split("_")) <= set(SMALL)]
    rows = []
    for name in names:
        scheme = schemes[name]
        for test in dict.fromkeys([scheme.training_test, scheme.other_test]):
            errors = scheme.errors(test)
            row: dict[str, object] = {"trained": scheme.title, "test": test}
            for candidate in ORDER:
                key = scheme.key_of(candidate)
                row[candidate] = errors.in_words(key, "fvu") if key in errors else MISSING
            rows.append(row)
    if not rows:
        return None
    columns = {"trained": Column("comparison"), "test": Column("test")}
    columns |= {name: Column(name) for name in REAL_CANDIDATES}
    caption = "FVU, 95 % intervals over blocks and seeds; `zero` has 1, the CSV has all candidates."
    return Table("real_cars", caption, pd.DataFrame(rows), columns)
