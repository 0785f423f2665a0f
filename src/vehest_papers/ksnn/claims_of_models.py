"""The paper's statements on the behaviour of estimators: low yaw rates, convergence, biases, noise, spectra, cost, learnt parameters."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import signal

from vehest.constants import FloatArray
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.model_files import load_model
from vehest.report.document import Column, Table
from vehest.report.style import fixed
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.kit.claims import Claim
from vehest_papers.kit.reading import median_and_range
from vehest_papers.kit.spectra import SEGMENT_SECONDS, third_octave
from vehest_papers.kit.statements import (
    Change,
    Compared,
    Measured,
    Statement,
    counted,
    outcomes,
    short,
)
from vehest_papers.ksnn import behaviour, cost, paper
from vehest_papers.ksnn.comparing import N_RESAMPLES
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.schemes import Scheme
from vehest_papers.ksnn.sensitivities import HIGHEST_HZ, YAW_RATES, sensitivity_of

ENOUGH = "30"
LONGER = "60"  # samples of a window: the paper's 1.5 s, and twice that
SLACK = -0.05
BANDS_HZ = tuple(
    float(own) for own in 10.0 ** (np.arange(-10, 9) / 10.0)
)  # centres of thirds of an octave, 0.1 to 6.3 Hz
P2 = "linear_no_bias_p2"
BIASES = {"before": "as measured", "after": "corrected"}


def at_low_yaw_rates(schemes: Sequence[Scheme]) -> tuple[Statement, Table | None]:
    """Section II-B: below its threshold the observer knows nothing of v."""
    categories = (
        paper.ZERO,
        paper.STATIC_MAP,
        paper.LUENBERGER,
        paper.GRU,
        paper.LSTM,
        *paper.STRUCTURED,
    )
    tests = []
    rows = []
    for scheme in schemes:
        observer = behaviour.luenberger_of(scheme)
        if observer is None:
            continue
        errors, share = behaviour.at_low_yaw_rate(
            scheme, observer.threshold, categories, scheme.other
        )
        tests.append(
            Compared(
                f"S{scheme.name[-1]}", errors.change(paper.NONLINEAR, paper.LUENBERGER, "rmse_vy")
            )
        )
        row = {
            "scheme": scheme.title,
            "gain": observer.gain,
            "threshold": observer.threshold,
            "share": 100 * share,
        }
        rows += [
            row | {"model": name, "rmse": errors.in_words(name, "rmse_vy")}
            for name in categories
            if name in errors
        ]
    statement = Statement(
        "where |ω| is below the observer's threshold: RMSE(v) of nonlinear no bias on the other car below the observer's (reset to 0)",
        "“overcome”",
        schemes[0].kind,
        tests,
        "the observer is tuned to be reset never or always",
    )
    columns = {
        "scheme": Column("scheme"),
        "gain": Column("α", decimals=2),
        "threshold": Column("ω_th [rad/s]", decimals=3),
        "share": Column("samples below it [%]", decimals=0),
        "model": Column("model"),
        "rmse": Column("RMSE(v) there, other car [m/s]"),
    }
    caption = "Where the yaw rate lies below the observer's tuned threshold; all seeds of the structures that validation chooses, up to six."
    return statement, Table("low_yaw_rate", caption, pd.DataFrame(rows), columns) if rows else None


def tuned(schemes: Sequence[Scheme]) -> Claim:
    """The observer's two parameters."""
    words = []
    for scheme in schemes:
        observer = behaviour.luenberger_of(scheme)
        if observer is not None:
            words.append(
                f"S{scheme.name[-1]} α {fixed(observer.gain, 1)}, ω_th {fixed(observer.threshold, 3)} rad/s"
            )
    return Claim(
        "tuned α and ω_th of Luenberger",
        "boxes alone",
        "; ".join(words) or "–",
        schemes[0].kind,
        "not testable on this data",
        "not printed",
    )


def on_convergence(schemes: Sequence[Scheme]) -> tuple[Statement, Table | None]:
    """Section III: windows of 30 samples, in which an estimator has to converge."""
    tests = []
    rows = []
    for scheme in schemes:
        for category in (paper.NONLINEAR, paper.LINEAR, paper.LSTM):
            if scheme.model(category) is None:
                continue
            errors = behaviour.after_start(scheme, category, scheme.other)
            if category == paper.NONLINEAR:
                tests.append(
                    Compared(
                        f"S{scheme.name[-1]}",
                        errors.change(LONGER, ENOUGH, "rmse_vy"),
                        "higher",
                        beyond=SLACK,
                    )
                )
            row: dict[str, object] = {"scheme": scheme.title, "model": category}
            rows.append(
                row
                | {
                    f"after_{length}": errors.value(str(length), "rmse_vy")
                    for length in behaviour.WINDOWS
                }
            )
    claim = "1.5 s are enough: with 3 s RMSE(v) is not 5 % lower, nonlinear no bias, other car"
    statement = Statement(claim, "asked for", schemes[0].kind, tests, "test drives too short")
    rate = schemes[0].part.protocol.rate_hz
    columns = {"scheme": Column("scheme"), "model": Column("model")}
    columns |= {
        f"after_{length}": Column(f"{length / rate:g} s", decimals=3)
        for length in behaviour.WINDOWS
    }
    caption = "RMSE(v) [m/s] on the other car so long after a start at v = 0, û = u_m, up to three seeds; trained on windows of 1.5 s."
    return statement, Table("after_start", caption, pd.DataFrame(rows), columns) if rows else None


def on_biases(schemes: Sequence[Scheme]) -> tuple[Statement, Table | None]:
    """Section IX-A: mean biases of a_y taken off before the networks see it."""
    categories = (paper.LSTM, *paper.STRUCTURED)
    tests = []
    rows = []
    for scheme in schemes:
        errors, biases = behaviour.without_biases(scheme, categories, scheme.other)
        for category in categories:
            change = errors.change(f"{category}, corrected", f"{category}, as measured", "rmse_vy")
            if change is None:
                continue
            if category in (paper.NONLINEAR, paper.NONLINEAR_BIAS, paper.LSTM):
                tests.append(
                    Compared(f"S{scheme.name[-1]} {category.removeprefix('KS-NN ')}", change)
                )
            row = {
                "scheme": scheme.title,
                "own": biases["own"],
                "other": biases["other"],
                "model": category,
                "change": change.in_percent(),
            }
            rows.append(
                row
                | {
                    word: errors.in_words(f"{category}, {key}", "rmse_vy")
                    for word, key in BIASES.items()
                }
            )
    claim = "biases of a_y removed (by the reference): RMSE(v) on the other car falls"
    statement = Statement(claim, "“expected”", schemes[0].kind, tests)
    columns = {
        "scheme": Column("scheme"),
        "own": Column("mean bias, own car [m/s²]", decimals=3),
        "other": Column("other car [m/s²]", decimals=3),
        "model": Column("model"),
        "before": Column("RMSE(v), as measured [m/s]"),
        "after": Column("corrected [m/s]"),
        "change": Column("change"),
    }
    caption = (
        "Mean of v̇ − (a_y − ωu_m) over each car's training set taken off (Section IX-A), which uses the reference. Networks are not "
        "trained again: those that can hold an offset get the other car's a_y with the own car's bias, the others without any. Up to "
        "three seeds."
    )
    return statement, Table(
        "biases_removed", caption, pd.DataFrame(rows), columns
    ) if rows else None


def on_noise(schemes: Sequence[Scheme]) -> Claim:
    """Section VIII-E: noise of the accelerations in v̂, of every seed of the linear structure without bias, beside the observer's."""
    claim = "less sensitive to noise of a_y and a_x than Luenberger at 0.2 and 0.4 rad/s (linear no bias, 0 to 10 Hz)"
    ratios: list[FloatArray] = []
    found: list[bool] = []
    for scheme in schemes:
        observer = behaviour.luenberger_of(scheme)
        networks = [load_model(model.model_folder) for model in scheme.models(paper.LINEAR)]
        if observer is None or not networks:
            continue
        for yaw_rate in YAW_RATES:
            theirs = sensitivity_of(observer, yaw_rate).band_gains(HIGHEST_HZ)
            if not all(theirs):
                continue
            ours = np.array(
                [sensitivity_of(network, yaw_rate).band_gains(HIGHEST_HZ) for network in networks]
            ) / np.array(theirs)
            found += [bool(own < 1.0) for own in ours.ravel()]
            ratios.append(ours)
    words = "–"
    if ratios:
        low = np.min(np.concatenate(ratios), axis=0)
        high = np.max(np.concatenate(ratios), axis=0)
        words = f"ratios over seeds: a_y {short(low[0])} to {short(high[0])}, a_x {short(low[1])} to {short(high[1])}"
    return counted(
        claim, "“significantly lower”", words, schemes[0].kind, found, "every seed, or not"
    )


def on_spectra(schemes: Sequence[Scheme]) -> list[Claim | Statement]:
    """Section VIII-F: power of the residuals by thirds of an octave on the other car, of the runs that validation chooses."""
    entries: list[Claim | Statement] = []
    for scheme in schemes:
        shown = [paper.NONLINEAR, paper.LUENBERGER, paper.LSTM]
        models = {
            category: model for category in shown if (model := scheme.model(category)) is not None
        }
        claim = f"residual PSD lowest at every frequency, {scheme.title.lower()}"
        levels = band_levels(scheme, models, scheme.other) if len(models) == len(shown) else {}
        if not levels:
            entries.append(
                Claim(
                    claim,
                    "yes",
                    "–",
                    scheme.kind,
                    "not testable on this data",
                    "tests too short or candidates missing",
                )
            )
            continue
        pairs = [(hz, other) for other in shown[1:] for hz in BANDS_HZ]
        tests = [
            Compared("", Change.of(levels[paper.NONLINEAR, hz], levels[other, hz]))
            for hz, other in pairs
        ]
        found = [outcome for outcome, _ in outcomes(tests)]
        lower = sum(own.change is not None and own.change.log_ratio < 0 for own in tests)
        turned = found.count("the other way round")
        significant = found.count("as claimed")
        ours = f"lower in {lower} of {len(tests)} bands; by more than chance {significant} lower, {turned} higher"
        verdict = (
            "not reproduced" if turned else "reproduced" if lower == len(tests) else "undecided"
        )
        entries.append(
            Claim(
                claim,
                "yes",
                ours,
                scheme.kind,
                verdict,  # type: ignore[arg-type]
                "against Luenberger and LSTM, 0.1 to 6.3 Hz",
            )
        )
        if scheme is schemes[-1]:
            above = [
                Compared(
                    f"{hz:g} Hz",
                    Change.of(levels[paper.LSTM, hz], levels[paper.NONLINEAR, hz]),
                    "higher",
                    shown="decibels",
                )
                for hz in (BANDS_HZ[0], 1.0)
            ]
            entries.append(
                Statement(
                    "LSTM's above KS-NN's, scheme 2",
                    "7 dB at 0.1 Hz, 8 to 10 dB at 1 Hz",
                    scheme.kind,
                    above,
                )
            )
    return entries


def band_levels(
    scheme: Scheme, models: Mapping[str, EvaluatedModel], test: str
) -> dict[tuple[str, float], Measured]:
    """Power of the errors by candidate and band, segments of 25.6 s that do not overlap resampled together; none where there are few."""
    rate = scheme.part.protocol.rate_hz
    length = round(SEGMENT_SECONDS * rate)
    power: dict[str, FloatArray] = {}
    frequency = np.zeros(0)
    for category, model in models.items():
        segments = []
        for part in scheme.part.scored(model, test):
            error = part.vy - part.vy_ref
            for start in range(0, len(error) - length + 1, length):
                frequency, density = signal.periodogram(
                    error[start : start + length], rate, window="hann", detrend="constant"
                )
                segments.append(density)
        if len(segments) < 8:
            return {}
        power[category] = np.stack(segments)
    number = len(next(iter(power.values())))
    generator = np.random.default_rng(zlib.crc32(test.encode()))
    counts = generator.multinomial(number - 1, np.full(number, 1.0 / number), size=N_RESAMPLES)
    levels = {}
    for category, own in power.items():
        for hz in BANDS_HZ:
            band = own[:, third_octave(frequency, hz)].mean(axis=1)
            levels[category, hz] = Measured(
                float(band.mean()), np.log(counts @ band / (number - 1)), np.zeros(1), number
            )
    return levels


def on_parameters(schemes: Sequence[Scheme]) -> tuple[list[Claim], Table | None]:
    """Section IV: what the twelve parameters of the linear network without bias and with P = 2 have become, over all seeds."""
    rows = []
    models = list[LocalModels]()
    for scheme in schemes:
        own = [
            LocalModels.of(network)
            for model in scheme.part.models
            if model.variant == P2 and isinstance(network := load_model(model.model_folder), Ksnn)
        ]
        models += own
        if own:
            rows.append({"scheme": scheme.title, "n_seeds": len(own)} | _parameters_in_words(own))
    data = schemes[0].kind
    gamma, beta = (
        np.array([getattr(own, name) for own in models]).reshape(-1, 2, 2)
        for name in ("gamma", "beta")
    )

    def of(values: NDArray[np.bool_]) -> str:
        return f"{int(values.sum())} of {len(values)}"

    nearer = gamma[:, 1, 0] > gamma[:, 0, 0]
    leaks = gamma[:, 0, 0] < 1.0
    reduced: NDArray[np.bool_] = np.all(beta[:, :, 0] < 1.0, axis=1)
    why = "all seeds, P = 2"
    claims = [
        counted("IV: γ₁ below one at ω = 0", "yes", of(leaks), data, leaks.tolist(), why),
        counted(
            "IV: γ₁ closer to one at the higher yaw rate",
            "yes",
            of(nearer),
            data,
            nearer.tolist(),
            why,
        ),
        counted("IV: β₁ below one", "“typically”", of(reduced), data, reduced.tolist(), why),
    ]
    columns = {"scheme": Column("scheme"), "n_seeds": Column("seeds", decimals=0)}
    columns |= {
        f"{name}_{where}": Column(f"{symbol}, {words}")
        for name, symbol in _SYMBOLS.items()
        for where, words in (("low", "ω = 0"), ("high", "highest ω"))
    }
    caption = "The paper's own model of twelve parameters, linear without bias and P = 2, over all seeds: median [lowest, highest]."
    return claims, Table(
        "twelve_parameters", caption, pd.DataFrame(rows), columns
    ) if rows else None


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


def on_cost(frame: pd.DataFrame, kind: str) -> Claim:
    """Section VIII-G, which gives no numbers."""
    claim = "few operations an estimate"
    if frame.empty:
        return Claim(claim, "no numbers", "–", kind, "not testable on this data", "no network here")
    shown = (paper.LUENBERGER, *paper.PLAIN, *paper.WITHOUT_BIAS)
    words = [
        f"{row['model'].removeprefix('KS-NN ')} {row['of_estimate']}"
        for row in frame.to_dict("records")
        if row["model"] in shown
    ]
    linear = cost.IN_C_US["ksnn", "linear_no_bias_p2"]
    lstm = cost.IN_C_US["lstm", "states_5"]
    timed = f"; in C {short(linear)} (linear, P = 2) to {short(lstm)} µs (LSTM, 5 states)"
    why = "GRU, LSTM affordable too" if {paper.GRU, paper.LSTM} & set(frame["model"]) else "counted"
    return Claim(claim, "“small”", ", ".join(words) + timed, "counted", "reproduced", why)
