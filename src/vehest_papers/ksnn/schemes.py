"""A comparison across vehicles: what learns on one car, stops on another and is tested on both,
with all errors of its candidates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.data.splits import Span
from vehest.evaluation.blocks import Segments, read_segments
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.runs import by_name
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import chosen_by_category, runs_of
from vehest_papers.ksnn.comparing import SegmentErrors, common_labels

CANDIDATES = {"zero": paper.ZERO, "static_map": paper.STATIC_MAP}  # name in blocks.csv -> category
STEERING = ("GRU with steering angle", "GRU without steering angle")  # each in parts of its own
THIRD = "j1"  # test set of a car that no network learns or stops on, where there is one


@lru_cache(maxsize=2000)
def _read(path: Path) -> dict[str, Segments]:
    return read_segments(path)


def segments_on(model: EvaluatedModel, test: str) -> Segments:
    """Errors of a model by segments of a test set, its file read once for all tests."""
    segments = _read(model.evaluation_folder / "blocks.csv")
    return segments[test] if test in segments else model.segments(test)


@dataclass(frozen=True, eq=False)
class Scheme:
    """One part, and which of its test sets is of which car."""

    name: str  # of the part
    title: str  # for people
    part: PartArtefacts  # what was compared
    training_test: str  # test set of the training car
    other_test: str  # test set of the car that is early-stopped on
    # test set -> block of each segment; empty: by the errors of this part alone
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """`candidates.runs_of` the part."""
        return runs_of(self.part)

    @cached_property
    def chosen(self) -> dict[str, pd.Series]:
        """Category -> the run that validation chooses."""
        return chosen_by_category(self.runs)

    @cached_property
    def kind(self) -> str:
        """``real``, ``simulated`` or both."""
        return words_of_kinds(self.part)

    def models(self, category: str) -> list[EvaluatedModel]:
        """All seeds of the structure that validation chooses of a category; none where it is not
        there.
        """
        return self.models_of(self.name_of(category))

    def models_of(self, name: str) -> list[EvaluatedModel]:
        """All seeds of a structure, named as `name_of` names them."""
        return [model for model in self.part.models if "/".join(model.name) == name]

    def key_of(self, candidate: str) -> str:
        """Name in `errors` of a candidate of claims.yaml; empty where it is not there.

        A category stands for the structure that validation chooses, ``CATEGORY, STRUCTURE`` for
        that structure.
        """
        if candidate in CANDIDATES:
            return self.name_of(CANDIDATES[candidate])
        if candidate in STEERING:
            names = dict.fromkeys("/".join(model.name) for model in self.part.models)
            return next((name for name in names if name.startswith("velocity_gru/")), "")
        if candidate in self.chosen:
            return self.name_of(candidate)
        for run in self.runs.to_dict("records"):
            if candidate == f"{run['category']}, {run['structure']}":
                return f"{run['estimator']}/{run['variant']}"
        return ""

    def model(self, category: str) -> EvaluatedModel | None:
        """The model of the run that validation chooses."""
        run = self.chosen.get(category)
        return next(
            (
                model
                for model in self.models(category)
                if run is not None and model.seed == run["seed"]
            ),
            None,
        )

    @cached_property
    def _errors(self) -> dict[str, SegmentErrors]:
        return {}

    def errors(self, test: str) -> SegmentErrors:
        """Of all structures on a test set, named as `name_of` names them."""
        if test not in self._errors:
            groups = by_name(self.part.models)
            recordings = [span.recording for span in self.part.split.tests[test]]
            self._errors[test] = SegmentErrors(
                {
                    "/".join(name): [segments_on(model, test) for model in models]
                    for name, models in groups.items()
                },
                self.labels.get(test),
                {
                    "/".join(name): [model.seed for model in models]
                    for name, models in groups.items()
                },
                recordings,
            )
        return self._errors[test]

    def name_of(self, category: str) -> str:
        """Name in `errors` of the structure that validation chooses of a category."""
        run = self.chosen.get(category)
        return "" if run is None else f"{run['estimator']}/{run['variant']}"

    def structures(self) -> dict[str, str]:
        """Name in `errors` -> category, of all structures of the paper's categories."""
        is_structure = self.runs["category"].isin(set(paper.CATEGORIES))
        rows = self.runs[is_structure].drop_duplicates(["estimator", "variant"])
        return {
            f"{row['estimator']}/{row['variant']}": str(row["category"])
            for row in rows.to_dict("records")
        }


def with_common_blocks(schemes: Mapping[str, Scheme]) -> dict[str, Scheme]:
    """The same parts, those that share a test range on the same blocks, so that candidates of two
    parts can be compared.
    """
    groups: dict[tuple[Span, ...], list[tuple[str, str]]] = {}
    for name, scheme in schemes.items():
        for test, spans in scheme.part.split.tests.items():
            groups.setdefault(tuple(spans), []).append((name, test))
    labels: dict[str, dict[str, NDArray[np.int64]]] = {name: {} for name in schemes}
    for members in groups.values():
        of_group = common_labels(
            [
                segments_on(model, test)
                for name, test in members
                for model in schemes[name].part.models
            ]
        )
        for name, test in members:
            labels[name][test] = of_group
    return {name: replace(scheme, labels=labels[name]) for name, scheme in schemes.items()}
