"""Parts of the study of the KS-NN whose errors are planted, without a network or a drive."""

import math

import numpy as np
from study_parts import metric_rows, part_of

from vehest.data.splits import Span, Split
from vehest.evaluation.blocks import Segments, write_segments
from vehest.evaluation.metrics import Protocol
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.ksnn import paper

SEGMENTS, SAMPLES = 600, 20
DEVIATION = {"c2": 0.49, "f2": 0.70, "j1": 0.6}
"""Standard deviation of v on each test [m/s], about those of the paper's cars."""

NAMES = {
    paper.ZERO: ("zero", "zero"),
    paper.STATIC_MAP: ("static_map", "static_map"),
    paper.LUENBERGER: ("luenberger", "luenberger"),
    paper.GRU: ("gru", "states_5"),
    paper.LSTM: ("lstm", "states_5"),
    paper.LINEAR_BIAS: ("ksnn", "linear_bias_p2"),
    paper.NONLINEAR_BIAS: ("ksnn", "nonlinear_bias_p2_q3"),
    paper.LINEAR: ("ksnn", "linear_no_bias_p2"),
    paper.NONLINEAR: ("ksnn", "nonlinear_no_bias_p2_q3"),
}
N_PARAMETERS = {name: row.n_parameters for name, row in paper.TABLE_IV.items()} | {paper.ZERO: 0, paper.STATIC_MAP: 2}


def planted_segments(fvu, test, seed):
    """Segments of a drive in which so much of v is left, errors large where those of every other candidate are."""
    common = np.random.default_rng(len(test) + ord(test[0]))
    hard = common.lognormal(0.0, 0.4, SEGMENTS)
    vy = common.normal(0.0, 0.2, SEGMENTS)
    own = np.random.default_rng(seed).lognormal(0.0, 0.1, SEGMENTS)
    variance = DEVIATION[test] ** 2
    share = hard * own / np.mean(hard * own)
    reference = variance * SAMPLES * np.ones(SEGMENTS)
    return Segments(
        piece=np.repeat([0.0, 1.0], SEGMENTS // 2),
        start=np.tile(np.arange(SEGMENTS // 2, dtype=float), 2),
        samples=np.full(SEGMENTS, float(SAMPLES)),
        squared_error_vy=fvu * variance * SAMPLES * share,
        squared_error_sideslip=fvu * variance * SAMPLES * share * 4.0,
        error_vy=np.zeros(SEGMENTS),
        vy_ref=vy * 0.0,
        squared_vy_ref=reference,
    )


def planted_part(folder, fvus, *, train, seeds=3, spread=0.02, tests=("c2", "f2")):
    """A comparison whose candidates leave this FVU, category -> test set -> FVU, whose logarithm has a spread from seed to seed."""
    generator, rows, models = np.random.default_rng(1), [], []
    other = "f" if train == "c" else "c"
    for category, by_test in fvus.items():
        estimator, variant = NAMES[category]
        for seed in range(seeds if estimator in ("gru", "lstm", "ksnn") else 1):
            at = folder / f"{train}-{estimator}-{variant}-{seed}"
            at.mkdir(parents=True)
            own = {test: by_test[test] * math.exp(spread * generator.standard_normal()) for test in tests}
            write_segments(at / "blocks.csv", {test: planted_segments(own[test], test, seed + 10) for test in tests})
            models.append(EvaluatedModel(estimator, variant, category, seed, at, at))
            validation = own[f"{other}2"]
            values = {("validation", "fvu"): validation, ("validation", "rmse_vy"): math.sqrt(validation)}
            for test in tests:
                values |= {(test, "fvu"): own[test], (test, "rmse_vy"): math.sqrt(own[test]) * DEVIATION[test]}
                values |= {(test, "n_parameters"): N_PARAMETERS[category], (test, "epochs"): 10}
            for test in ("validation", *tests):
                values |= {(test, "r2"): 1.0 - values[test, "fvu"], (test, "rmse_sideslip"): 2.0 * values[test, "rmse_vy"]}
            rows += [row for (test, metric), value in values.items() for row in metric_rows(models[-1], test, {metric: value})]
    spans = {name: (Span("cars", f"{name}_001", -math.inf, math.inf),) for name in (f"{train}1", f"{other}1", *tests)}
    split = Split("scheme", spans[f"{train}1"], spans[f"{other}1"], {test: spans[test] for test in tests})
    return part_of(split, Protocol(), models, rows, kinds={"cars": "simulated"}, data_titles={"cars": "Cars"})


def of_the_paper(table, static_map=0.6):
    """Every category with the FVU that the paper prints, and the baselines."""
    printed = {name: {"c2": row.c2_fvu, "f2": row.f2_fvu} for name, row in table.items()}
    return {paper.ZERO: {"c2": 1.0, "f2": 1.0}, paper.STATIC_MAP: {"c2": static_map, "f2": static_map}, **printed}
