"""Tables on how estimators behave: at low yaw rates, after a start, without biases, and what twelve parameters have become."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.estimators.ksnn import Ksnn
from vehest.estimators.model_files import load_model
from vehest.report.document import Column, Table
from vehest_papers.kit.reading import median_and_range
from vehest_papers.ksnn import behaviour
from vehest_papers.ksnn.behaviour import Behaviour
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.schemes import Scheme

P2 = "linear_no_bias_p2"


def low_yaw_rate_table(
    schemes: Sequence[Scheme], behaviours: Mapping[str, Behaviour]
) -> Table | None:
    """Section II-B: below its threshold the observer knows nothing of v."""
    rows = []
    for scheme in schemes:
        own = behaviours[scheme.name]
        if own.observer is None:
            continue
        row = {
            "scheme": scheme.title,
            "gain": own.observer.gain,
            "threshold": own.observer.threshold,
            "share": 100 * own.share,
        }
        rows += [
            row | {"model": name, "rmse": own.low_yaw_rate.in_words(name, "rmse_vy")}
            for name in behaviour.AT_LOW_YAW_RATE
            if name in own.low_yaw_rate
        ]
    columns = {
        "scheme": Column("scheme"),
        "gain": Column("α", decimals=2),
        "threshold": Column("ω_th [rad/s]", decimals=3),
        "share": Column("samples below it [%]", decimals=0),
        "model": Column("model"),
        "rmse": Column("RMSE(v) there, other car [m/s]"),
    }
    caption = "Where the yaw rate lies below the observer's tuned threshold; all seeds of the structures that validation chooses."
    return Table("low_yaw_rate", caption, pd.DataFrame(rows), columns) if rows else None


def after_start_table(
    schemes: Sequence[Scheme], behaviours: Mapping[str, Behaviour]
) -> Table | None:
    """Section III: windows of 30 samples, in which an estimator has to converge."""
    rows = [
        {"scheme": scheme.title, "model": category}
        | {f"after_{length}": errors.value(str(length), "rmse_vy") for length in behaviour.WINDOWS}
        for scheme in schemes
        for category, errors in behaviours[scheme.name].after_start.items()
        if errors.segments
    ]
    rate = schemes[0].part.protocol.rate_hz
    columns = {"scheme": Column("scheme"), "model": Column("model")}
    columns |= {
        f"after_{length}": Column(f"{length / rate:g} s", decimals=3)
        for length in behaviour.WINDOWS
    }
    caption = "RMSE(v) [m/s] on the other car so long after a start at v = 0, û = u_m, up to three seeds; trained on windows of 1.5 s."
    return Table("after_start", caption, pd.DataFrame(rows), columns) if rows else None


def biases_table(schemes: Sequence[Scheme], behaviours: Mapping[str, Behaviour]) -> Table | None:
    """Section IX-A: mean biases of a_y taken off before the networks see it."""
    rows = []
    for scheme in schemes:
        own = behaviours[scheme.name]
        measured = scheme.errors(scheme.other)
        rows += [
            {
                "scheme": scheme.title,
                "own": own.biases["own"],
                "other": own.biases["other"],
                "model": category,
                "before": measured.in_words(scheme.name_of(category), "rmse_vy"),
                "after": own.corrected.in_words(category, "rmse_vy"),
            }
            for category in behaviour.BIASED
            if category in own.corrected
        ]
    columns = {
        "scheme": Column("scheme"),
        "own": Column("mean bias, own car [m/s²]", decimals=3),
        "other": Column("other car [m/s²]", decimals=3),
        "model": Column("model"),
        "before": Column("RMSE(v), as measured [m/s]"),
        "after": Column("corrected [m/s]"),
    }
    caption = (
        "Mean of v̇ − (a_y − ωu_m) over each car's training set taken off (Section IX-A), which uses the reference. Networks are not "
        "trained again: those that can hold an offset get the other car's a_y with the own car's bias, the others without any. All seeds."
    )
    return Table("biases_removed", caption, pd.DataFrame(rows), columns) if rows else None


def parameters_table(schemes: Sequence[Scheme]) -> Table | None:
    """Section IV: what the twelve parameters of the linear network without bias and with P = 2 have become, over all seeds."""
    rows = []
    for scheme in schemes:
        own = [
            LocalModels.of(network)
            for model in scheme.part.models
            if model.variant == P2 and isinstance(network := load_model(model.model_folder), Ksnn)
        ]
        if own:
            rows.append({"scheme": scheme.title, "n_seeds": len(own)} | _parameters_in_words(own))
    columns = {"scheme": Column("scheme"), "n_seeds": Column("seeds", decimals=0)}
    columns |= {
        f"{name}_{where}": Column(f"{symbol}, {words}")
        for name, symbol in _SYMBOLS.items()
        for where, words in (("low", "ω = 0"), ("high", "highest ω"))
    }
    caption = "The paper's own model of twelve parameters, linear without bias and P = 2, over all seeds: median [lowest, highest]."
    return Table("twelve_parameters", caption, pd.DataFrame(rows), columns) if rows else None


_SYMBOLS = {
    "gamma_1": "γ₁",
    "beta_1": "β₁",
    "gamma_2": "γ₂",
    "beta_2": "β₂",
    "weight_1": "w₁₁",
    "weight_2": "w₁₂",
}


def _parameters_in_words(models: Sequence[LocalModels]) -> dict[str, str]:
    words: dict[str, str] = {}
    linear = [own.linearised() for own in models]
    for name in _SYMBOLS:
        kind, row = name.rsplit("_", 1)
        values = np.array([getattr(own, kind)[:, int(row) - 1] for own in linear])
        words |= {
            f"{name}_low": median_and_range(values[:, 0], 3),
            f"{name}_high": median_and_range(values[:, -1], 3),
        }
    return words
