"""Hands the parts of the study to the paper's analyses: which drives and which trained networks each of them looks at."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.data.recording import Recording
from vehest.report.document import Block
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.kit.reading import recordings_of, words_of_kinds
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.activation import activation
from vehest_papers.ksnn.candidates import chosen_by_category
from vehest_papers.ksnn.data_quality import data_quality
from vehest_papers.ksnn.interpretation import interpretation
from vehest_papers.ksnn.residuals import Panel, Residuals, residuals
from vehest_papers.ksnn.sensitivities import sensitivities
from vehest_papers.ksnn.subjects import Trained

STRETCH_SECONDS = 30.0
TRAINED_ON = {"scheme_1": "Corvette C-1", "scheme_2": "Ferrari F-1"}
TESTED_ON = {"scheme_1": ("Ferrari F-2", "f2"), "scheme_2": ("Corvette C-2", "c2")}
"""Part -> the test set of the car that it does not train on."""

Runs = Mapping[str, pd.DataFrame]


def of_the_data(artefacts: StudyArtefacts) -> list[Block]:
    """Table I, Figures 4 and 5: the four sets, and the real drive where it is at hand."""
    first, second = artefacts.parts["scheme_1"], artefacts.parts["scheme_2"]
    sets: dict[str, list[Recording]] = {
        "C-1": recordings_of(second, second.split.validation),
        "C-2": recordings_of(first, first.split.tests["c2"]),
        "F-1": recordings_of(first, first.split.validation),
        "F-2": recordings_of(first, first.split.tests["f2"]),
    }
    source = f"{words_of_kinds(first)} drives at {first.protocol.rate_hz:g} Hz"
    whole = artefacts.parts.get("ferrari_whole")
    if whole is not None:
        sets["one file of F-2"] = recordings_of(whole, [span for spans in whole.split.tests.values() for span in spans])
        source += "; and one file of the paper's F-2, real, at the same rate"
    return data_quality(sets, source)


def of_activation(artefacts: StudyArtefacts, runs: Runs) -> list[Block]:
    """Figure 3: a network with three local models, as in the paper's example, or the chosen one where there is none."""
    part, own = artefacts.parts["scheme_1"], runs["scheme_1"]
    networks = own[own["estimator"] == "ksnn"]
    three = networks[networks["structure"].str.startswith("P = 3")]
    if networks.empty:
        return []
    run = next(iter(chosen_by_category(three if len(three) else networks).values()))
    return activation(_trained(part, run, "scheme_1"), recordings_of(part, [span for spans in part.split.tests.values() for span in spans]))


def of_sensitivities(artefacts: StudyArtefacts, runs: Runs) -> list[Block]:
    """Figure 7: KS-NN linear no bias beside the Luenberger observer, a column a scheme."""
    columns = []
    for name in TRAINED_ON:
        picked = chosen_by_category(runs[name])
        if paper.LINEAR in picked and paper.LUENBERGER in picked:
            pair = [_trained(artefacts.parts[name], picked[category], name) for category in (paper.LINEAR, paper.LUENBERGER)]
            columns.append((pair[0], pair[1]))
    return sensitivities(columns) if columns else []


def of_residuals(artefacts: StudyArtefacts, runs: Runs) -> list[Block]:
    """Figure 8: KS-NN nonlinear no bias, Luenberger and LSTM on the car that they have not learnt on."""
    panels = []
    for name, (title, test) in TESTED_ON.items():
        part, picked = artefacts.parts[name], chosen_by_category(runs[name])
        shown = [picked[category] for category in (paper.NONLINEAR, paper.LUENBERGER, paper.LSTM) if category in picked]
        if not shown or shown[0]["category"] != paper.NONLINEAR:
            continue
        models = [model_of(part, run) for run in shown]
        own = [Residuals(model.estimator, model.variant, model.title, part.scored(model, test)) for model in models]
        panels.append(Panel(title, TRAINED_ON[name], words_of_kinds(part), own, part.protocol.rate_hz))
    return residuals(panels) if panels else []


def of_interpretation(artefacts: StudyArtefacts, runs: Runs) -> list[Block]:
    """Section IV: networks of both schemes, and how an estimate comes about where a test drive slides most."""
    picked = {name: chosen_by_category(runs[name]) for name in TRAINED_ON}
    linear, nonlinear = (
        [_trained(artefacts.parts[name], own[category], name) for name, own in picked.items() if category in own]
        for category in (paper.LINEAR, paper.NONLINEAR)
    )
    if not linear:
        return []
    part = artefacts.parts["scheme_1"]
    title, test = TESTED_ON["scheme_1"]
    drive = recordings_of(part, part.split.tests[test])[0]
    n = min(round(STRETCH_SECONDS * drive.rate_hz), len(drive))
    first = int(np.convolve(np.square(drive["vy_ref"]), np.ones(n), mode="valid").argmax())
    stretch = (float(drive.time[first]), float(drive.time[first + n - 1]))
    return interpretation(linear, nonlinear, drive, stretch, f"{title}, {words_of_kinds(part)}, recording {drive.id}")


def model_of(part: PartArtefacts, run: pd.Series) -> EvaluatedModel:
    """The model of a run."""
    key = (run["estimator"], run["variant"], run["seed"])
    return next(model for model in part.models if (model.estimator, model.variant, model.seed) == key)


def _trained(part: PartArtefacts, run: pd.Series, name: str) -> Trained:
    return Trained.of(model_of(part, run), f"{TRAINED_ON[name]}, {words_of_kinds(part)}")
