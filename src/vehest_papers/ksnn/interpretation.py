"""Section IV of Da Lio et al. 2023: what a KS-NN has learned: its gains over |ω|, its three sub-models along a drive, its feedback."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.data.runs import true_runs
from vehest.estimators.ksnn import Ksnn
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import (
    DOUBLE_COLUMN,
    REFERENCE_COLOUR,
    fixed,
    listed,
    new_figure,
    significant,
)
from vehest_papers.kit.legends import legend_above
from vehest_papers.ksnn.activation import LOCAL_COLOURS, LOCAL_DASHES
from vehest_papers.ksnn.linear_system import LocalModels, LpvModel, SubModels, decomposed_estimate
from vehest_papers.ksnn.subjects import Trained

MODEL_COLOURS = ("#0b4f9c", "#c2182b", "#00876c", "#a6761d", "#8e24aa")
PART_COLOURS = {
    "slip_rate": "#0b4f9c",
    "pseudo_measurement": "#00876c",
    "speed": "#b8480b",
    "bias": "#8e24aa",
}
PART_DASHES = {
    "slip_rate": "solid",
    "pseudo_measurement": "dashed",
    "speed": "dashdot",
    "bias": "dotted",
}
PART_TITLES = {
    "slip_rate": "first: slip rate $a_y - \\omega u_m$",
    "pseudo_measurement": "second: $\\dot{u}_m - a_x$",
    "speed": "third: speed and yaw rate",
    "bias": "third: learned offsets",
}
PART_WORDS = {
    "slip_rate": "first (slip rate a_y − ωu_m)",
    "pseudo_measurement": "second (u̇_m − a_x)",
    "speed": "third (speed and yaw rate)",
    "bias": "third (learned offsets)",
}
SPEED = 25.0  # forward speed for which the third sub-model's steady value is given [m/s]
STEADY_YAW_RATE = 0.4  # yaw rate for it where the last centre is at zero [rad/s]


def interpretation(
    linear: Sequence[Trained],
    nonlinear: Sequence[Trained],
    drive: Recording,
    stretch: tuple[float, float],
    source: str,
) -> list[Block]:
    """Everything of Section IV: gains, sub-models of the first network along a drive, feedback functions; ``stretch`` [s] is drawn.

    Raises `ConfigurationError` where a model is no KS-NN of its kind, `DataError` where the drive lacks a channel or samples or the rate.
    """
    blocks = gain_curves(linear) if linear else []
    for own in (*linear, *nonlinear)[:1]:
        blocks += sub_models(own, drive, stretch, source)
    names = (
        [f"feedback_{number}" for number in range(1, len(nonlinear) + 1)]
        if len(nonlinear) > 1
        else ["feedback"]
    )
    for name, own in zip(names, nonlinear, strict=False):
        blocks += feedback_functions(own, drive, source, name=name)
    return blocks


# Gains over |ω|


def gain_curves(models: Sequence[Trained]) -> list[Block]:
    """γ, β, w, b and the poles of linear KS-NNs over |ω|, and what they mean in words; raises `ConfigurationError` where one is not."""
    linear = [_linear(own) for own in models]
    with_bias = any(np.any(model.bias) for model in linear)
    panels = ["gamma", "beta", "weight", *(["bias"] if with_bias else []), "poles"]
    labels = {
        "gamma": ("$\\gamma_1$", "$\\gamma_2$", "1"),
        "beta": ("$\\beta_1$", "$\\beta_2$", "1"),
        "weight": ("$w_{11}$", "$w_{12}$", "1"),
        "bias": ("$b_{11}$", "$b_{12}$", "m/s"),
        "poles": ("larger pole", "smaller pole", "1"),
    }
    columns = math.ceil(len(panels) / 2)
    with new_figure(DOUBLE_COLUMN, 4.2) as figure:
        grid = figure.subplots(2, columns, squeeze=False).ravel()
        for axes, panel in zip(grid, panels, strict=False):
            for position, (own, model) in enumerate(zip(models, linear, strict=True)):
                yaw_rate = np.union1d(np.linspace(0.0, 1.1 * model.centres[-1], 200), model.centres)
                values = (
                    _poles(model, yaw_rate)
                    if panel == "poles"
                    else getattr(model.gains(yaw_rate), panel)
                )
                colour = MODEL_COLOURS[position % len(MODEL_COLOURS)]
                for column, dash in enumerate(("solid", "dashed")):
                    label = own.described if not column and panel == "gamma" else None
                    axes.plot(
                        yaw_rate, values[:, column], color=colour, linestyle=dash, label=label
                    )
                    if panel != "poles":
                        axes.plot(
                            model.centres,
                            getattr(model, panel)[:, column],
                            color=colour,
                            marker="o",
                            linestyle="none",
                            markersize=3.0,
                        )
            first, second, unit = labels[panel]
            axes.set_title(
                f"{first} solid, {second} dashed" + (f" [{unit}]" if unit != "1" else ""),
                loc="left",
            )
            axes.set_xlabel("$|\\omega|$ [rad/s]")
            if panel in ("gamma", "beta", "poles"):
                axes.axhline(1.0, color="#888888", linewidth=0.7, linestyle="dotted")
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        legend_above(figure, grid[0], columns=1)
    caption = (
        f"Learned gains of linear KS-NNs over the magnitude of the yaw rate: {'; '.join(own.described for own in models)}. Dots are local "
        "models; poles are those of the recursion at constant yaw rate, in magnitude."
    )
    return [
        Figure("learned_gains", caption, figure),
        "\n\n".join(gains_in_words(own) for own in models),
    ]


def gains_in_words(own: Trained) -> str:
    """What the gains of a linear KS-NN mean, from their values; raises `ConfigurationError` where it is no linear KS-NN."""
    model = _linear(own)
    sentences = [
        _of_the_leak(model),
        _of_the_slip_rate(model),
        _of_the_speed(model),
        _of_the_third(model),
        _of_the_poles(model),
    ]
    if np.any(model.bias):
        first, second = (
            f"{fixed(float(column.min()), 3)} to {fixed(float(column.max()), 3)} m/s"
            for column in model.bias.T
        )
        sentences.append(
            f"Learned offsets: b₁₁ {first}, b₁₂ {second}; they belong to this car and its sensors."
        )
    return f"**{own.described}.** " + " ".join(sentences)


def _of_the_leak(model: LpvModel) -> str:
    still = float(model.gamma[0, 0])
    turning = float(model.gamma[-1, 0])
    if still >= 1.0:
        words = "γ₁ = 1 at ω = 0: nothing makes v̂ forget while driving straight, where it cannot be observed."
    else:
        words = (
            f"γ₁ = {fixed(still, 3)} at ω = 0: while driving straight v̂ leaks towards zero with a time constant of "
            f"{significant(_time_constant(still, model.step), 2)} s, the network's answer to v being unobservable there."
        )
    if len(model.centres) == 1:
        return words
    side = (
        "nearer to one, as the paper argues, since v is observable there"
        if abs(1 - turning) < abs(1 - still)
        else "not nearer to one, other than the paper argues"
    )
    return f"{words} At |ω| = {fixed(float(model.centres[-1]), 2)} rad/s it is {fixed(turning, 3)}, {side}."


def _of_the_slip_rate(model: LpvModel) -> str:
    lowest = float(model.beta[:, 0].min())
    highest = float(model.beta[:, 0].max())
    span = (
        f"β₁ lies between {fixed(lowest, 2)} and {fixed(highest, 2)}"
        if len(model.centres) > 1
        else f"β₁ is {fixed(lowest, 2)}"
    )
    if lowest < 0.0:
        return f"{span}: at some yaw rates the slip rate enters with the opposite sign, so this is no longer an integration of Eq. 4a."
    if highest < 1.0:
        return f"{span}, below one as in the paper: the slip rate is integrated at a reduced weight, and so is its noise."
    if lowest >= 1.0:
        return f"{span}, not below one as the paper finds it: the slip rate is integrated at its full weight or more."
    return f"{span}: the slip rate is integrated at a reduced weight at some yaw rates only."


def _of_the_speed(model: LpvModel) -> str:
    gamma, weight = (float(own[0, 1]) for own in (model.gamma, model.weight))
    values = f"γ₂ = {fixed(gamma, 3)} at ω = 0 and {fixed(float(model.gamma[-1, 1]), 3)} at the last centre"
    if abs(gamma - weight) >= 1.0:
        factor = fixed(abs(gamma - weight), 3)
        return f"{values}: driving straight û − u_m does not settle but grows by a factor of {factor} a sample, which v̂ does not see there."
    share = 100.0 * weight / (1.0 - gamma + weight)
    meaning = (
        "û is the forward speed"
        if abs(share - 100.0) < 1.0
        else "û is not the forward speed but a state of the network's own"
    )
    offsets = ", offsets aside," if np.any(model.bias) else ""
    return f"{values}: driving straight at constant speed û{offsets} settles at {share:.0f} % of u_m, so {meaning}."


def _of_the_third(model: LpvModel) -> str:
    yaw_rate = float(model.centres[-1]) or STEADY_YAW_RATE
    if _poles(model, np.array([yaw_rate]))[0, 0] >= 1.0:
        return f"At {fixed(yaw_rate, 2)} rad/s the third sub-model has no steady value."
    return (
        f"In a steady left turn at {fixed(yaw_rate, 2)} rad/s and {SPEED:g} m/s the third sub-model alone, offsets aside, settles at "
        f"v = {fixed(steady_third(model, yaw_rate, SPEED), 2)} m/s: what the network knows of the car."
    )


def _of_the_poles(model: LpvModel) -> str:
    yaw_rate = np.linspace(0.0, float(model.centres[-1]) or 1.0, 201)
    largest = _poles(model, yaw_rate)[:, 0]
    at = int(np.argmax(largest))
    after = float(largest.max()) ** model.n_window
    where = f"at |ω| = {fixed(float(yaw_rate[at]), 2)} rad/s"
    if largest[at] >= 1.0:
        return (
            f"The recursion is not stable at |ω| = {_ranges(yaw_rate, largest >= 1.0)} rad/s: its largest pole is "
            f"{fixed(float(largest[at]), 3)}, {where}. Only the window keeps it finite, in which that pole grows by a factor of "
            f"{significant(after, 3)}."
        )
    return (
        f"The slowest pole is {fixed(float(largest[at]), 3)}, {where}: a time constant of "
        f"{significant(_time_constant(float(largest[at]), model.step), 2)} s, of which a window of {model.n_window} samples leaves "
        f"{significant(100.0 * after, 2)} %."
    )


def _ranges(values: FloatArray, chosen: NDArray[np.bool_]) -> str:
    """Runs of chosen values in words."""
    runs = true_runs(chosen).tolist()
    return listed(
        [
            f"{fixed(float(values[first]), 2)} to {fixed(float(values[after - 1]), 2)}"
            for first, after in runs
        ]
    )


def steady_third(model: LpvModel, yaw_rate: float, speed: float) -> float:
    """Lateral velocity of the third sub-model without offsets in a steady turn: C(1)ω/D(1) = ωw₁₁(1 - γ₂)u_m/D(1) [m/s]."""
    own = model.gains(yaw_rate)
    denominator = np.linalg.det(np.eye(2) - model.state_matrix(yaw_rate))
    return float(yaw_rate * own.weight[0] * (1.0 - own.gamma[1]) * speed / denominator)


def _time_constant(pole: float, step: float) -> float:
    return -step / math.log(pole) if 0.0 < pole < 1.0 else math.inf


def _poles(model: LpvModel, yaw_rate: FloatArray) -> FloatArray:
    """Magnitudes of both poles, the larger first, (T,) -> (T, 2)."""
    magnitudes: FloatArray = np.abs(np.linalg.eigvals(model.state_matrix(yaw_rate)))
    return -np.sort(-magnitudes, axis=-1)


# Sub-models along a drive


def sub_models(
    own: Trained, drive: Recording, stretch: tuple[float, float], source: str
) -> list[Block]:
    """Parts of an estimate along a drive, and what each adds to its variance; ``stretch`` [s] is drawn; raises as `interpretation` does."""
    estimator = _ksnn(own)
    parts = decomposed_estimate(estimator, drive)
    estimate = estimator.estimate([drive.without_references()])[0]["vy"]
    largest = float(np.nanmax(np.abs(parts.total - estimate)))
    table = _table_of_parts(own, drive, parts, source)
    bits = 8 * estimator.weights()["gamma"].dtype.itemsize
    sums = (
        f"The parts add up to the network's output along the whole drive within {significant(1e6 * largest, 2)} µm/s; the network computes "
        f"with {bits} bits. The start of each window at v = 0, û = u_m is no part of its own: in v̂ and û − u_m the recursion starts "
        "from zero."
    )
    return [
        _figure_of_parts(own, drive, parts, stretch, source),
        f"{_shares_in_words(table.frame)} {sums}",
        table,
    ]


def _shares_in_words(frame: pd.DataFrame) -> str:
    shares = dict(zip(frame["part"], frame["share_percent"], strict=True))
    third = sum(share for part, share in shares.items() if part.startswith("third"))
    words = listed([f"the {part} {fixed(share, 0)} %" for part, share in shares.items()])
    text = f"Of the variance of v̂ over the whole drive the sub-models make: {words}."
    if third > 50.0:
        text += (
            ' Most of the estimate is thus a learned relation between v, ω and u_m, the sub-model that "implicitly considers vehicle '
            'dynamics" (footnote 2 of the paper), and not integrated accelerations.'
        )
    return text


def _shown(own: Trained) -> list[str]:
    return [
        "slip_rate",
        "pseudo_measurement",
        "speed",
        *(["bias"] if _ksnn(own).settings.bias else []),
    ]


def _figure_of_parts(
    own: Trained, drive: Recording, parts: SubModels, stretch: tuple[float, float], source: str
) -> Figure:
    drive.cut(*stretch)
    first, last = drive.index_range(*stretch)
    shown = np.s_[first:last]
    time = drive.time[first:last]
    with new_figure(DOUBLE_COLUMN, 4.4) as figure:
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.5, 0.6))
        top.plot(
            time,
            parts.total[shown],
            color="#c2182b",
            linewidth=1.3,
            label="KS-NN, sum of the parts",
        )
        top.plot(
            time, drive["vy_ref"][shown], color=REFERENCE_COLOUR, linewidth=0.9, label="measured"
        )
        for name in _shown(own):
            looks = {"color": PART_COLOURS[name], "linestyle": PART_DASHES[name]}
            middle.plot(time, getattr(parts, name)[shown], label=PART_TITLES[name], **looks)
        bottom.plot(time, drive["yaw_rate"][shown], color="#444444", linewidth=0.8)
        for axes, label in zip(
            (top, middle, bottom),
            ("lateral velocity [m/s]", "parts [m/s]", "$\\omega$ [rad/s]"),
            strict=True,
        ):
            axes.set_ylabel(label)
            axes.margins(x=0.0)
        bottom.set_xlabel("time [s]")
        figure.align_ylabels()
        legend_above(figure, top, middle, columns=3)
    caption = (
        f"The three sub-models of Equation 11 along a drive. Model: {own.described}; drive: {source}, {drive.kind}. At varying yaw rate "
        "they are superposed on the parameter-varying recursion, each driven by its own input."
    )
    return Figure("sub_models", caption, figure)


def _table_of_parts(own: Trained, drive: Recording, parts: SubModels, source: str) -> Table:
    known = np.isfinite(parts.total)
    total = parts.total[known]
    reference = drive["vy_ref"][known]
    rows = []
    for name in _shown(own):
        part = getattr(parts, name)[known]
        rows.append(
            {
                "part": PART_WORDS[name],
                "rms": float(np.sqrt(np.mean(part**2))),
                "share_percent": 100.0
                * float(np.mean((part - part.mean()) * (total - total.mean())))
                / float(np.var(total)),
                "correlation": float(np.corrcoef(part, reference)[0, 1])
                if np.ptp(part) and np.ptp(reference)
                else math.nan,
            }
        )
    columns = {
        "part": Column("sub-model"),
        "rms": Column("rms [m/s]", decimals=3),
        "share_percent": Column("share of the variance of v̂ [%]", decimals=0),
        "correlation": Column("correlation with measured v", decimals=2),
    }
    caption = (
        f"What the sub-models contribute over the whole drive. Model: {own.described}; drive: {source}, {drive.kind}. Shares are "
        "covariances with v̂ over its variance and add up to 100 %; below zero a part works against the others."
    )
    return Table("sub_model_shares", caption, pd.DataFrame(rows), columns)


# Nonlinear feedback


def feedback_functions(
    own: Trained, drive: Recording, source: str, *, name: str = "feedback"
) -> list[Block]:
    """f₁ and f₂ of each local model over e = û - u_m, and how their gain varies where e lies along a drive; raises `ConfigurationError`."""
    estimator = _ksnn(own)
    if not estimator.settings.n_hidden:
        raise ConfigurationError(
            f"{own.named} is linear; its feedback functions are straight lines"
        )
    models = LocalModels.of(estimator)
    error = decomposed_estimate(estimator, drive).error
    low, middle, high = np.nanquantile(error, [0.01, 0.5, 0.99]).tolist()
    reach = 1.4 * max(abs(low), abs(high), 1e-3)
    grid = np.linspace(-reach, reach, 401)
    values = models.feedback(grid)
    slopes = models.slope(grid)
    with new_figure(DOUBLE_COLUMN, 4.0) as figure:
        panels = figure.subplots(2, 2, sharex=True)
        for column in (0, 1):
            for axes, curves in ((panels[0, column], values), (panels[1, column], slopes)):
                axes.axvspan(low, high, color="#e9e9e9", zorder=0)
                axes.axvline(0.0, color="#888888", linewidth=0.6)
                for position in range(len(models.centres)):
                    colour = LOCAL_COLOURS[position % len(LOCAL_COLOURS)]
                    dash = LOCAL_DASHES[position % len(LOCAL_DASHES)]
                    label = f"$|\\omega|$ = {models.centres[position]:.2f} rad/s"
                    axes.plot(
                        grid, curves[:, position, column], color=colour, linestyle=dash, label=label
                    )
            panels[0, column].set_title(f"$f_{column + 1}$ [m/s]", loc="left")
            panels[1, column].set_title(f"$df_{column + 1}/de$", loc="left")
            panels[1, column].set_xlabel("$e = \\hat{u} - u_m$ [m/s]")
        panels[0, 0].set_xlim(-reach, reach)
        legend_above(figure, panels[0, 0])
    caption = (
        f"Feedback functions of the local models and their slopes. Model: {own.described}. Grey: where 98 % of the differences û − u_m "
        f"lie at the ends of windows along a drive ({source}, {drive.kind}), median {fixed(middle, 2)} m/s."
    )
    return [Figure(name, caption, figure), _feedback_in_words(own, models, low, high)]


def _feedback_in_words(own: Trained, models: LocalModels, low: float, high: float) -> str:
    inside = np.linspace(low, high, 101)
    slopes = models.slope(inside)
    items = []
    for position, centre in enumerate(models.centres.tolist()):
        words = []
        for column in (0, 1):
            curve = slopes[:, position, column]
            factor = float(np.max(np.abs(curve)) / max(float(np.min(np.abs(curve))), 1e-12))
            changes_sign = bool(np.any(np.sign(curve) != np.sign(curve[0])))
            spread = f"{significant(float(curve.min()), 2)} to {significant(float(curve.max()), 2)}"
            words.append(
                f"slope of f{'₁₂'[column]} {spread} ({'changes sign' if changes_sign else f'factor {fixed(factor, 1)}'})"
            )
        items.append(f"- |ω| = {fixed(centre, 2)} rad/s: {listed(words)}.")
    lead = (
        f"**{own.described}.** Nonlinear feedback is a gain that varies with û − u_m; where that lies along the drive ({fixed(low, 2)} to "
        f"{fixed(high, 2)} m/s):"
    )
    return lead + "\n\n" + "\n".join(items)


def _ksnn(own: Trained) -> Ksnn:
    if not isinstance(own.estimator, Ksnn):
        raise ConfigurationError(f"{own.named} is no KS-NN but a '{own.estimator.name}'")
    return own.estimator


def _linear(own: Trained) -> LpvModel:
    estimator = _ksnn(own)
    if estimator.settings.n_hidden:
        raise ConfigurationError(
            f"{own.named} is nonlinear; its gains depend on û - u_m as well as on |ω|"
        )
    return LocalModels.of(estimator).linearised()
