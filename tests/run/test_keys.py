"""Keys hold what determines numbers: neither defaults nor texts."""

import shutil
from dataclasses import dataclass

import pytest

from place import PIPELINE
from vehest.artefacts.keys import changed_keys
from vehest.configuration.composition import compose_config
from vehest.data.recording_summary import RecordingSummary
from vehest.estimators.gru import Gru
from vehest.run.comparison import lower_rate
from vehest.run.train import training_options

pytestmark = pytest.mark.apart

STUDY = PIPELINE | {
    "publish": True,
    "sweeps": [
        ["estimator=zero"],
        ["estimator=gru", "estimator.n_states=2", "seed=0,1", "training.max_epochs=2"],
    ],
}
GRU = {"name": "gru", "rate_hz": 20, "window": 30, "n_states": 5}


@dataclass(frozen=True)
class Extended(Gru.settings_type):
    """Settings of a GRU with one more option."""

    extra: float = 0.5


@pytest.fixture
def published(place):
    """A small study that was trained and published, with a configuration of its estimator and no
    output root.
    """
    place.change("conf/estimator/gru.yaml", **GRU)
    place.change("pipelines/small.yaml", **STUDY)
    place.once("run", "small", "tracking=none")
    shutil.rmtree(place.folder / "outputs")
    return place


def lines_of(text, *starts):
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [line for line in lines if line.startswith(starts)]


def test_new_option_removed_default_and_edited_title_retrain_nothing(published, monkeypatch):
    monkeypatch.setattr(Gru, "settings_type", Extended)
    published.change("conf/dataset/mine.yaml", title="Another title of the car")
    published.change("pipelines/small.yaml", title="Another title", about="Other words")
    file = published.folder / "conf" / "estimator" / "gru.yaml"
    file.write_text("# a comment\nname: gru\nn_states: 5\n", encoding="utf-8")
    weights = published.folder / "results" / "small" / "weights.safetensors"
    before = weights.read_bytes()
    assert published("report", "--check") == (0, "small: up to date\n", "")
    _, output = published.done("run", "small", "tracking=none")
    assert lines_of(output, "note train") == [
        "note train 3 of 3 taken from results/small/weights.safetensors; --retrain trains them"
    ]
    assert not lines_of(output, "done train")
    assert weights.read_bytes() == before
    report = (published.folder / "results" / "small" / "report.md").read_text(encoding="utf-8")
    assert report.startswith("# Another title"), "the report itself has the new text"
    assert published("report", "--check") == (0, "small: up to date\n", "")


def test_option_that_differs_from_its_default_is_in_the_key():
    def options(*overrides):
        return training_options(
            compose_config("train", ["estimator=ksnn", "split=sim_bmw", *overrides])
        )

    assert options() == {"estimator": {"name": "ksnn"}, "training": {}, "seed": 0}
    assert options("estimator.rate_hz=20.0", "training.checkpoint_seconds=1") == options()
    assert options("estimator.bias=true", "training.patience=3") == {
        "estimator": {"name": "ksnn", "bias": True},
        "training": {"patience": 3},
        "seed": 0,
    }
    nested = training_options(
        compose_config(
            "train",
            [
                "estimator=learned_ukf",
                "split=sim_bmw",
                "estimator.car.mass=6",
                "training.through.max_epochs=50",
            ],
        )
    )
    assert nested["estimator"] == {"name": "learned_ukf", "car": {"mass": 6.0}}
    assert nested["training"] == {"through": {"max_epochs": 50}}


def test_sideslip_is_scored_by_the_wheelbase_of_today(published):
    published.change("conf/dataset/mine.yaml", car={"wheelbase": 0.33})
    code, output, _ = published("report", "--check")
    assert code == 3
    assert "evaluate zero, evaluate gru" in output
    assert "train" not in output


def test_rate_that_is_left_out_is_lowered_to_that_of_the_recordings_too():
    config = compose_config("eval", ["estimator=gru", "split=sim_bmw"])
    slow = RecordingSummary("slow", 10.0, frozenset())
    for group in ("estimator", "evaluation"):
        short = {**config, group: {**config[group]}}
        del short[group]["rate_hz"]
        lowered, notes = lower_rate(short, group, slow)
        assert lowered[group]["rate_hz"] == 10.0
        assert "10 Hz instead of" in notes[0][1]


def test_published_keys_are_compared_by_cause_and_those_of_absent_raw_files_are_not():
    recorded = {
        "ingest mine": {"code": "ingest=1", "configuration": "a", "data": "d"},
        "train gru": {"code": "train=1 gru=1", "configuration": "b"},
        "train lstm": {"code": "train=1 lstm=1", "configuration": "c"},
    }
    today = {
        "ingest mine": {"code": "ingest=1", "configuration": "a"},
        "train gru": {"code": "train=1 gru=2", "configuration": "b2"},
        "train ksnn": {"code": "train=1 ksnn=1", "configuration": "c"},
    }
    assert changed_keys(recorded, recorded) == []
    assert changed_keys(recorded, today) == [
        ("train gru", "code"),
        ("train gru", "configuration"),
        ("train ksnn added", "configuration"),
        ("train lstm removed", "configuration"),
    ]
    with_other_data = recorded | {"ingest mine": recorded["ingest mine"] | {"data": "e"}}
    assert changed_keys(recorded, with_other_data) == [("ingest mine", "data")]
