"""Keys hold versions: readable texts that say nothing of where code stands."""

import re

from refusals import refusal

from vehest.data.errors import ConfigurationError
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.run.versions import code_of
from vehest.sources.base import source_names
from vehest.studies.registry import study_names
from vehest.training.supervised import SupervisedSettings


def trainings():
    return {name: code_of("train", name) for name in estimator_names()}


def test_versions_are_names_and_numbers_without_modules_and_hashes():
    texts = [code_of("downsample"), code_of("sweep"), *trainings().values()]
    texts += [code_of("ingest", name) for name in source_names()]
    texts += [code_of("report", name) for name in study_names()]
    texts += [
        code_of(stage, name) for name in estimator_names() for stage in ("calibrate", "evaluate")
    ]
    for text in texts:
        assert re.fullmatch(r"\w+=[\w.]+( \w+=[\w.]+)*", text), text
        assert "vehest." not in text
        assert not re.search(r"[0-9a-f]{8}", text), text
    assert code_of("train", "ksnn") == "train=1 ksnn=1 training=1"
    assert code_of("evaluate", "ksnn", faults=True) == "evaluate=2 ksnn=1 faults=3"
    assert code_of("ingest", "tabular") == "ingest=1 tabular=1"


def test_renamed_module_retrains_nothing(
    monkeypatch,
):
    before = trainings()
    for name in estimator_names():
        monkeypatch.setattr(estimator_class(name), "__module__", "vehest.elsewhere")
    assert trainings() == before
    monkeypatch.setattr(Ksnn, "version", "2")
    assert {name for name, text in trainings().items() if text != before[name]} == {"ksnn"}
    assert code_of("evaluate", "ksnn") == "evaluate=2 ksnn=2"
    monkeypatch.setattr(SupervisedSettings, "version", "2")
    assert {name for name, text in trainings().items() if text != before[name]} == {
        "ksnn",
        "gru",
        "lstm",
    }
    assert code_of("calibrate", "ksnn") == "calibrate=3 ksnn=2", (
        "weights tell a calibration what changed"
    )


def test_unversioned_objects_have_version_1():
    assert code_of("train", "zero").endswith(" training=1")
    assert code_of("report", "folds").endswith(" folds=3")
    assert "no study module 'nobody'" in refusal(
        lambda: code_of("report", "nobody"), ConfigurationError
    )
