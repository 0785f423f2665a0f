"""Hands the schemes of the study to the paper's analyses: which drives and which trained networks each of them looks at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehest.data.recording import Recording
from vehest.report.document import Block
from vehest.studies.artefacts import EvaluatedModel, StudyArtefacts
from vehest_papers.kit.reading import recordings_of, words_of_kinds
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.activation import activation
from vehest_papers.ksnn.candidates import chosen
from vehest_papers.ksnn.data_quality import data_quality
from vehest_papers.ksnn.interpretation import interpretation
from vehest_papers.ksnn.residuals import Panel, Residuals, residuals
from vehest_papers.ksnn.schemes import THIRD, Scheme
from vehest_papers.ksnn.sensitivities import sensitivities
from vehest_papers.ksnn.subjects import Trained

STRETCH_SECONDS = 30.0
TRAINED_ON = {"scheme_1": "Corvette C-1", "scheme_2": "Ferrari F-1"}
TESTED_ON = {
    "scheme_1": "Ferrari F-2",
    "scheme_2": "Corvette C-2",
}  # part -> the test set of the car that it does not train on


def of_the_data(artefacts: StudyArtefacts) -> list[Block]:
    """Table I, Figures 4 and 5: the four sets, a third car and the real drive where they are there."""
    first = artefacts.parts["scheme_1"]
    second = artefacts.parts["scheme_2"]
    sets: dict[str, list[Recording]] = {
        "C-1": recordings_of(second, second.split.validation),
        "C-2": recordings_of(first, first.split.tests["c2"]),
        "F-1": recordings_of(first, first.split.validation),
        "F-2": recordings_of(first, first.split.tests["f2"]),
    }
    if THIRD in first.split.tests:
        sets["third car"] = recordings_of(first, first.split.tests[THIRD])
    source = f"{words_of_kinds(first)} drives at {first.protocol.rate_hz:g} Hz"
    whole = artefacts.parts.get("ferrari_whole")
    if whole is not None:
        sets["one file of F-2"] = recordings_of(
            whole, [span for spans in whole.split.tests.values() for span in spans]
        )
        source += "; and one file of the paper's F-2, real, at the same rate"
    return data_quality(sets, source)


def of_activation(schemes: Sequence[Scheme]) -> list[Block]:
    """Figure 3: a network with three local models, as in the paper's example, or the chosen one where there is none."""
    scheme = schemes[0]
    networks = scheme.runs[scheme.runs["estimator"] == "ksnn"]
    three = networks[networks["structure"].str.startswith("P = 3")]
    if networks.empty:
        return []
    run = chosen(three if len(three) else networks)
    key = (run["estimator"], run["variant"], run["seed"])
    model = next(own for own in scheme.part.models if (own.estimator, own.variant, own.seed) == key)
    spans = [span for spans in scheme.part.split.tests.values() for span in spans]
    return activation(_trained(scheme, model), recordings_of(scheme.part, spans))


def of_sensitivities(schemes: Sequence[Scheme]) -> list[Block]:
    """Figure 7: KS-NN linear no bias beside the Luenberger observer, a column a scheme."""
    columns = []
    for scheme in schemes:
        network, observer = (
            scheme.model(category) for category in (paper.LINEAR, paper.LUENBERGER)
        )
        if network is not None and observer is not None:
            columns.append((_trained(scheme, network), _trained(scheme, observer)))
    return sensitivities(columns) if columns else []


def of_residuals(schemes: Sequence[Scheme]) -> list[Block]:
    """Figure 8: KS-NN nonlinear no bias, Luenberger, LSTM and the static map on the car that they have not learnt on."""
    panels = []
    for scheme in schemes:
        shown = (paper.NONLINEAR, paper.LUENBERGER, paper.LSTM, paper.STATIC_MAP)
        models = [model for category in shown if (model := scheme.model(category)) is not None]
        if not models or models[0].estimator != "ksnn":
            continue
        own = [
            Residuals(
                model.estimator, model.variant, model.title, scheme.part.scored(model, scheme.other)
            )
            for model in models
        ]
        panels.append(
            Panel(
                TESTED_ON[scheme.name],
                TRAINED_ON[scheme.name],
                scheme.kind,
                own,
                scheme.part.protocol.rate_hz,
            )
        )
    return residuals(panels) if panels else []


def of_interpretation(schemes: Sequence[Scheme]) -> list[Block]:
    """Section IV: networks of both schemes, and how an estimate comes about where a test drive slides most."""
    linear, nonlinear = (
        [
            _trained(scheme, model)
            for scheme in schemes
            if (model := scheme.model(category)) is not None
        ]
        for category in (paper.LINEAR, paper.NONLINEAR)
    )
    if not linear:
        return []
    first = schemes[0]
    drive = recordings_of(first.part, first.part.split.tests[first.other])[0]
    n = min(round(STRETCH_SECONDS * drive.rate_hz), len(drive))
    begin = int(np.convolve(np.square(drive["vy_ref"]), np.ones(n), mode="valid").argmax())
    stretch = (float(drive.time[begin]), float(drive.time[begin + n - 1]))
    return interpretation(
        linear,
        nonlinear,
        drive,
        stretch,
        f"{TESTED_ON[first.name]}, {first.kind}, recording {drive.id}",
    )


def _trained(scheme: Scheme, model: EvaluatedModel) -> Trained:
    return Trained.of(model, f"{TRAINED_ON[scheme.name]}, {scheme.kind}")
