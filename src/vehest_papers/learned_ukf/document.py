"""The report: the claims on its first page, then Tables I and II, friction, bands and what learning through the filter changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import REPORT, Block, Document, as_text
from vehest.report.style import fixed, listed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest_papers.kit.block_rows import BLOCKS, TRAINING, BlockRow, TrainingRow, frame
from vehest_papers.kit.claims import Claim, claims_table
from vehest_papers.kit.methods import absent_parts, kinds_of_parts
from vehest_papers.kit.reading import with_interval, words_of_kinds
from vehest_papers.kit.statements import corrected
from vehest_papers.learned_ukf import (
    ablations,
    block_errors,
    claims,
    coverage,
    friction,
    paper,
    prediction,
    tables,
    traces,
)
from vehest_papers.learned_ukf.ablations import CURVATURE, DIAGONAL, LENGTH, SCRATCH
from vehest_papers.learned_ukf.appendix import appendix_of_part, how_it_was_made, minutes
from vehest_papers.learned_ukf.candidates import SETS, chosen, losses, models_by_candidate, runs_of
from vehest_papers.learned_ukf.errors import Losses
from vehest_papers.learned_ukf.filtering import drives_of, filtered, loaded, lost_sequences
from vehest_papers.learned_ukf.oracle import EPOCHS, train_on

MAIN = "real"
LIKELIHOOD = "likelihood"
ROMAN = {"tyre_a": "I", "tyre_d": "II"}
SHOWN_IN_FIGURE_4 = (paper.NNTF_UH, paper.NNTF_UH_LOW, paper.GRU)
NOTE = (
    "Of ratios, percentiles, states, friction and Figures 5 to 7 each interval stands by itself. All claims and rules were fixed before a "
    "test was run. The paper's unseen tyre is C; ours is D."
)


@dataclass
class Outcome:
    """What the main part gives to the report."""

    claims: list[Claim] = field(default_factory=list)
    picture: list[Block] = field(default_factory=list)
    front: list[Block] = field(default_factory=list)
    appendix: list[Block] = field(default_factory=list)
    added: list[Block] = field(default_factory=list)
    rows: list[BlockRow] = field(default_factory=list)
    timed: bool = False


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises:
        DataError: ``real`` is not there, its test sets are not ``tyre_a`` and ``tyre_d``, or metrics are missing.
        ConfigurationError: the protocol cuts no sequences.
    """
    part = artefacts.parts.get(MAIN)
    if part is None:
        raise DataError(f"study '{artefacts.study}' needs the part '{MAIN}'")
    if set(part.split.tests) != set(SETS):
        raise DataError(
            f"study '{artefacts.study}': the test sets of part '{MAIN}' must be called {' and '.join(SETS)}"
        )
    data: dict[str, pd.DataFrame] = {}
    outcome = _outcome(MAIN, part, artefacts, data)
    blocks: list[Block] = [
        *_asked(artefacts, part),
        claims_table([*outcome.claims, *claims.not_testable(timed=outcome.timed)], NOTE),
        *outcome.added,
        f"{_budgets_in_words(part)} {_left_out(artefacts)}".strip(),
        *outcome.picture,
        *outcome.front,
        *outcome.appendix,
        *how_it_was_made(artefacts, {MAIN: part}, data),
    ]
    rows = [*block_errors.error_rows(artefacts.parts), *outcome.rows]
    trained = block_errors.training_rows(artefacts.parts, MAIN)
    data |= {BLOCKS: frame(rows, BlockRow), TRAINING: frame(trained, TrainingRow)}
    return {REPORT: Document(artefacts.title, blocks, data)}


def _asked(artefacts: StudyArtefacts, part: PartArtefacts) -> list[Block]:
    words = f"{kinds_of_parts(artefacts, [MAIN])}. The paper's are real.{absent_parts(artefacts)}"
    learnt = f"{fixed(minutes(part, part.split.train), 1)} min ({words_of_kinds(part)})"
    words += f" Learnt on: {learnt}; in the paper about {fixed(paper.MINUTES_LEARNT, 1)} min of the same tyre."
    return [words, artefacts.about]


def _left_out(artefacts: StudyArtefacts) -> str:
    """What the paper has and this run does not."""
    known = {
        SCRATCH: "training through the filter from scratch (Section III-B)",
        LENGTH: "the length of training sequences (Figure 7)",
        CURVATURE: "the E terms of Equation 3",
        DIAGONAL: "diagonal noise, which the paper leaves out as well",
    }
    absent = [
        words
        for part, words in known.items()
        if not any(name.startswith(part) for name in artefacts.parts)
    ]
    return f"Not run here, for their budget: {listed(absent)}." if absent else ""


def _budgets_in_words(part: PartArtefacts) -> str:
    """Epochs of the methods that are compared first, beside the paper's."""
    groups = models_by_candidate(part)
    words = []
    if paper.NNTF_UH in groups and groups[paper.NNTF_UH][0].training:
        training = groups[paper.NNTF_UH][0].training
        one_step, through = (training[phase]["max_epochs"] for phase in ("one_step", "through"))
        words.append(
            f"{paper.NNTF_UH} has {one_step} epochs one-step and {through} through the filter (paper: 1000 and 1000)"
        )
    words += [
        f"{name} {groups[name][0].training['phase']['max_epochs']}"
        for name in (paper.GRU, paper.LSTM)
        if name in groups and groups[name][0].training
    ]
    if paper.NN in groups and groups[paper.NN][0].training:
        words.append(
            f"{paper.NN} {groups[paper.NN][0].training['one_step']['max_epochs']} one-step"
        )
    if not words:
        return ""
    return f"Epochs ({words_of_kinds(part)}): {', '.join(words)}."


def _outcome(
    name: str, part: PartArtefacts, artefacts: StudyArtefacts, data: dict[str, pd.DataFrame]
) -> Outcome:
    """Everything of the main part and of those beside it on data of the same kind."""
    runs = runs_of(part)
    kind = words_of_kinds(part)
    where = f"{kind.upper()}, {listed([as_text(part.data_titles.get(dataset, dataset)) for dataset in part.split.datasets])}"
    errors = {test: losses(part, test) for test in SETS}
    own = Outcome()
    _add_oracle(part, runs, errors)
    for test in SETS:
        own.claims += claims.pair_claims(errors[test], test, kind)
    own.claims += [*claims.factor_claims(errors, kind), *claims.percentile_claims(errors, kind)]
    _accuracy(own, name, errors, kind)
    _friction(own, name, part, where, kind)
    _instability(own, name, part, kind)
    beside = {
        title: other for title, other in artefacts.parts.items() if words_of_kinds(other) == kind
    }
    _likelihood(own, name, part, beside, kind)
    _prediction(own, name, part, where, kind, data)
    added = ablations.additions(name, part, beside, errors, kind)
    own.added = [*added.front()]
    own.timed = added.timed
    own.appendix += added.appendix
    groups = models_by_candidate(part)
    shown: dict[str, EvaluatedModel] = {
        method: chosen(part, runs, method) for method in SHOWN_IN_FIGURE_4 if method in groups
    }
    if shown:
        figure, drawn = traces.hard_sequence(part, shown, "tyre_d", name, where)
        data[f"traces_{name}"] = drawn
        own.picture.append(figure)
    own.appendix += appendix_of_part(artefacts.titles[name], name, part, runs, errors, where, data)
    return own


def _add_oracle(part: PartArtefacts, runs: pd.DataFrame, errors: Mapping[str, Losses]) -> None:
    """Losses of the oracle on each test, beside those of the methods."""
    if paper.NNTF_UH not in models_by_candidate(part):
        return
    skip = round(part.protocol.skip_seconds * part.protocol.rate_hz)
    for test, own in errors.items():
        estimator = loaded(chosen(part, runs, paper.NNTF_UH))
        drives = drives_of(part, estimator, test)
        means = filtered(train_on(estimator, drives, skip), drives).steps.filtered.mean
        error = (means - drives.states)[:, skip:, :3].double().numpy().reshape(-1, 3)
        own.add(paper.ORACLE, error)


def _accuracy(own: Outcome, name: str, errors: Mapping[str, Losses], kind: str) -> None:
    own.front.append(
        "## Tables I and II\n\n"
        + "\n\n".join(_standing(of_test, SETS[test]) for test, of_test in errors.items())
    )
    own.front.append(tables.overview(errors, kind))
    own.appendix.append(f"## Appendix: Tables I and II, {kind}")
    for test, tyre in SETS.items():
        learnt = (
            "which was learnt on"
            if test == "tyre_a"
            else "unseen; the paper's are of tyre C and do not compare"
        )
        caption = (
            f"Table {ROMAN[test]} of the paper: {tyre}, {learnt}. Ours: {kind.upper()}, means over seeds, 95 % intervals over sequences "
            f"and seeds. {paper.ORACLE}: {paper.NNTF_UH} trained on, {EPOCHS} epochs, on the test itself. Baselines take vx from "
            f"the rims and the yaw rate from the gyroscope."
        )
        own.appendix.append(
            tables.accuracy(
                errors[test], test, f"table_{1 if test == 'tyre_a' else 2}_{name}", caption
            )
        )


def _standing(errors: Losses, tyre: str) -> str:
    """Method with the lowest error, whether the difference is significant, and methods below the baselines."""
    means = {
        name: float(own.mean()) for name, own in errors.squared.items() if name != paper.ORACLE
    }
    order = sorted(means, key=means.__getitem__)
    best = order[0]
    against = [errors.of_pair(best, name) for name in order[1:]]
    level = [
        name for name, (_, apart) in zip(order[1:], corrected(against), strict=True) if not apart
    ]
    interval = errors.mean(errors.squared[best])
    figure = with_interval(interval.value, interval.low, interval.high, 4)
    if not level and best not in paper.BASELINES:
        words = f"On {tyre} **{best}** has the lowest MSE, {figure}: below every other method and the baselines, each by more than chance."
    else:
        words = f"On {tyre} **no method can be called best**: the lowest MSE is that of {best}, {figure}, not told apart from {listed(level)}."
    baselines = [name for name in paper.BASELINES if name in means]
    if baselines:
        pairs = [(name, other) for name in order if name not in baselines for other in baselines]
        tested = corrected([errors.of_pair(*pair) for pair in pairs])
        lower = {
            pair
            for pair, (own, apart) in zip(pairs, tested, strict=True)
            if own.value < 0 and apart
        }
        weak = [
            name
            for name in order
            if name not in baselines and not all((name, other) in lower for other in baselines)
        ]
        if len(weak) == len(order) - len(baselines):
            words += f" No method is below all of {listed(baselines)} by more than chance."
        else:
            words += f" Not below all of {listed(baselines)} by more than chance: {listed(weak) if weak else 'none'}."
    return words + " Corrected by Holm."


def _friction(own: Outcome, name: str, part: PartArtefacts, where: str, kind: str) -> None:
    """Friction over time, its claims, and what its start is worth."""
    models = models_by_candidate(part).get(paper.NNTF_UH)
    if not models:
        return
    filters = [loaded(model) for model in models]
    drives = {test: drives_of(part, filters[0], test) for test in SETS}
    skip = part.protocol.skip_seconds
    tracks = {
        test: {start: friction.tracks_of(filters, own_drives, start) for start in friction.STARTS}
        for test, own_drives in drives.items()
    }
    trained = tracks["tyre_d"][friction.TRAINED_FROM]
    times = friction.interval_of(trained.times(), friction.median)
    final = friction.interval_of(trained.final, friction.mean)
    own.claims += claims.friction_claims(times, final, kind)
    measured = {
        ("friction_settles_within_2_s", paper.NNTF_UH): trained.times(),
        ("friction_ends_near_nominal", paper.NNTF_UH): np.abs(
            trained.final - paper.NOMINAL_FRICTION["tyre_d"]
        ),
    }
    seeds = [model.seed for model in models]
    own.rows += block_errors.measured_rows(name, part, "tyre_d", measured, seeds)
    own.front += ["## Friction", friction.figure(tracks, skip, name, where)]
    own.appendix += [
        f"## Appendix: the start of the friction, {kind}",
        friction.convergence_table(tracks, skip, name, kind.upper()),
        friction.start_table(filters, drives, part.protocol, name, kind.upper()),
    ]


def _instability(own: Outcome, name: str, part: PartArtefacts, kind: str) -> None:
    claim = {paper.NNT: "nnt_becomes_unstable", paper.NNT_U: "nnt_u_becomes_unstable"}
    groups = {
        method: models for method, models in models_by_candidate(part).items() if method in claim
    }
    lost = {}
    for method, models in groups.items():
        filters = [loaded(model) for model in models]
        drives = drives_of(part, filters[0], "tyre_d")
        of_seeds = np.array([lost_sequences(estimator, drives) for estimator in filters])
        lost[method] = [(int(of_seed.sum()), len(of_seed)) for of_seed in of_seeds]
        measured = {(claim[method], method): of_seeds.astype(np.float64)}
        seeds = [model.seed for model in models]
        own.rows += block_errors.measured_rows(name, part, "tyre_d", measured, seeds)
    own.claims += claims.instability_claims(lost, kind)


def _likelihood(
    own: Outcome, name: str, part: PartArtefacts, beside: Mapping[str, PartArtefacts], kind: str
) -> None:
    if LIKELIHOOD in beside:
        trained = {
            words: (which, models_by_candidate(which)[paper.NNTF_UH])
            for words, which in (("squared errors", part), ("with likelihood", beside[LIKELIHOOD]))
        }
        own.appendix += [
            "## Appendix: bands",
            coverage.coverage_table(trained, paper.NNTF_UH, name, kind.upper()),
        ]


def _prediction(
    own: Outcome,
    name: str,
    part: PartArtefacts,
    where: str,
    kind: str,
    data: dict[str, pd.DataFrame],
) -> None:
    groups = models_by_candidate(part)
    by_seed = [
        {model.seed: model for model in groups.get(method, [])}
        for method in (prediction.BEFORE, prediction.AFTER)
    ]
    seeds = sorted(set(by_seed[0]) & set(by_seed[1]))
    if not seeds:
        return
    pairs = {seed: (loaded(by_seed[0][seed]), loaded(by_seed[1][seed])) for seed in seeds}
    drives = {test: drives_of(part, pairs[seeds[0]][0], test) for test in SETS}
    found = prediction.compared(pairs, drives, part.protocol)
    states, swaps = prediction.frames(found, seeds)
    own.rows += block_errors.prediction_rows(name, part, found, drives, seeds)
    data |= {f"figure_5_{name}": states, f"figure_6_{name}": swaps}
    own.appendix += [
        "## Appendix: what learning through the filter changes",
        prediction.figure_5(states, name, where),
        prediction.figure_6(swaps, name, where),
    ]
    for test, tyre in SETS.items():
        on = f"{kind}, {tyre}"
        estimated = found[test].states("estimation", {"vx": True, "vy": True, "yaw_rate": True})
        predicted = found[test].states("one_step", {"yaw_rate": False, "rim_speed": False})
        lower = f"{paper.NNTF_U} estimates every velocity better than {paper.NNTF}"
        own.claims.append(claims.states_claim(lower, "Figure 5", estimated, on))
        higher = f"{paper.NNTF_U} predicts yaw rate and rim speed worse"
        own.claims.append(claims.states_claim(higher, "Figure 5", predicted, on))
        mse = found[test].swaps
        change = prediction.over_sequences(mse[1, 0], mse[0, 0])
        swapped = f"{paper.NNTF_U} in the prediction alone: lower MSE"
        values = (float(mse[1, 0].mean()), float(mse[0, 0].mean()))
        own.claims.append(
            claims.difference_claim(swapped, "18 % lower, Figure 6", change, values, on)
        )
