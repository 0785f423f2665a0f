"""From simulated cars to a real one: what is learnt on, what is chosen by, and what the report says
of it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal
from study_parts import metric_rows, part_of, study_of, tables_of, text_of

from conftest import planar_drive
from vehest.configuration.composition import compose_config
from vehest.configuration.files import choices
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate, write_recording
from vehest.estimators.model_files import save_model
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import Protocol, accuracy, score
from vehest.report.document import write_document
from vehest.sources.base import kind_of, open_source
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.sim_to_real import documents

PROTOCOL = Protocol(rate_hz=20.0)
SPLITS = [name for name in choices("split") if name.startswith("sim_to_real_")]
LEARNT = (
    "sim_fleet_wide",
    "sim_fleet_fast",
    "sim_fleet_rough",
    "sim_fleet_more",
    "sim_fleet_level",
)
UNSEEN_FLEET = "sim_fleet_held_out"


def dataset(name):
    return compose_config("ingest", [f"dataset={name}"])["dataset"]


def courses(name):
    return {
        drive.manoeuvre["course"]
        for drive in open_source(dataset(name)).drives.values()
        if "course" in drive.manoeuvre
    }


@pytest.mark.parametrize("name", SPLITS)
def test_nothing_is_learnt_or_stopped_on_that_is_not_simulated(name):
    split = compose_config("train", [f"split={name}"])["split"]
    for entry in (*split["train"], *split["validation"]):
        assert kind_of(dataset(entry["dataset"])) == "simulated"
    assert [entry["dataset"] for entry in split["validation"]] == [UNSEEN_FLEET]
    assert split["tests"]["ferrari"] == [
        {"dataset": "ferrari_250lm", "recording": "20140222_01_01_03_250lm"}
    ]
    assert split["tests"]["race_cars"] == [{"dataset": "sim_two_cars", "recordings": "*"}]
    learns_on_it = "tum" in {entry["dataset"] for entry in split["train"]}
    assert ("other_simulator" in split["tests"]) != learns_on_it


@pytest.mark.parametrize("name", LEARNT)
def test_validation_cars_are_other_cars_on_other_courses(name):
    assert not courses(name) & courses(UNSEEN_FLEET)
    fleets = [open_source(dataset(of)) for of in (name, UNSEEN_FLEET)]
    seeds = [{fleet.seed_of(drive_id) for drive_id in fleet.drives} for fleet in fleets]
    assert not seeds[0] & seeds[1]


@pytest.mark.parametrize("name", [*LEARNT, UNSEEN_FLEET])
def test_fleets_take_nothing_that_was_read_off_the_real_recording(name):
    described = dataset(name)
    preset = (
        described["sensors"]["preset"]
        if isinstance(described["sensors"], Mapping)
        else described["sensors"]
    )
    assert preset == "default"
    assert "palm_beach_like" not in courses(name)
    assert {vehicle["name"] for vehicle in described["vehicles"].values()} == {
        "bmw_545i",
        "corvette_grand_sport",
    }


# Part -> errors of every seed on validation, on race cars, on the car of another simulation and on
# the real car.
ERRORS = {
    "one": [(0.30, 0.20, 0.0, 0.10), (0.31, 0.21, 0.0, 0.11)],
    "rough": [(0.20, 0.30, 4.00, 0.40), (0.10, 0.32, 4.10, 0.60), (0.16, 0.31, 4.20, 0.50)],
    "level": [(0.05, 0.25, 0.31, 0.05), (0.05, 0.26, 0.30, 0.06)],
}


def part(folder, name):
    """A part whose seeds err by given sizes on a drive of 60 s, which stands for validation and
    tests.
    """
    recording = planar_drive(60.0, 20.0, seed=3)
    file = folder / "lap.parquet"
    write_recording(recording, file)
    spans = {
        "validation": Span("sim", recording.id, 0.0, 30.0),
        "race_cars": Span("sim", recording.id, 30.0, 45.0),
        "other_simulator": Span("sim", recording.id, 45.0, 60.0),
        "ferrari": Span("ferrari", recording.id),
    }
    models = []
    rows = []
    for seed, sizes in enumerate([*ERRORS[name], *([None] if name == "level" else [])]):
        home = folder / name / str(seed)
        model = EvaluatedModel(
            "ksnn", "nonlinear_no_bias_p2_q2", "KS-NN", seed, home / "model", home
        )
        if sizes is None:
            model = replace(model, estimator="zero", variant="zero", title="v = 0", seed=0)
        models.append(model)
        model.model_folder.mkdir(parents=True)
        fitted = estimator_class("ksnn").from_config({"name": "ksnn"})
        weights = {
            key: np.full_like(value, 0.1 * (seed + 1)) for key, value in fitted.weights().items()
        }
        fitted.load_weights(weights)
        save_model(fitted, model.model_folder)
        for (test_set, span), size in zip(spans.items(), sizes or [0.0] * 4, strict=True):
            vy = recording["vy_ref"] * (sizes is not None) + size * np.sin(3.0 * recording.time)
            estimate = Estimate(
                recording.id,
                "ksnn",
                20.0,
                recording.start_time,
                {"vy": vy, "sideslip": np.arctan2(vy, recording["vx"])},
            )
            write_estimate(estimate, home / test_set / "0.parquet")
            metrics = accuracy([score(estimate, recording, span, PROTOCOL)])
            rows += metric_rows(model, test_set, metrics, dataset=span.dataset)
    tests = {
        test: (span,)
        for test, span in spans.items()
        if test != "validation" and (name, test) != ("one", "other_simulator")
    }
    split = Split(name, (Span("sim", f"{name}_lap"),), (spans["validation"],), tests)
    kinds = {"sim": "simulated", "ferrari": "real"}
    references = {(dataset, recording.id): file for dataset in ("sim", "ferrari")}
    return part_of(
        split,
        PROTOCOL,
        models,
        rows,
        kinds=kinds,
        references=references,
        facts=["the same for all"],
    )


@pytest.fixture(scope="module")
def artefacts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    parts = {name: part(folder, name) for name in ERRORS}
    return study_of("toy", parts, titles={name: name.title() for name in ERRORS})


@pytest.fixture(scope="module")
def document(artefacts):
    return documents(artefacts)["report"]


@pytest.fixture
def steps(document):
    """Table ``overview``."""
    (table,) = tables_of(document).values()
    return table.set_index("step", verify_integrity=True)


@pytest.fixture
def table(steps):
    """Trained steps by part."""
    return steps.drop("Level: v = 0").set_index("part")


def test_validation_race_cars_and_another_simulation_choose_in_turn_and_ship_a_seed(table):
    assert table.loc["rough", "chosen"] == "first", (
        "the lowest error on validation cars of those laid down beforehand, the highest on the real"
    )
    assert table.loc["level", "validation_rmse_vy"] < table.loc["rough", "validation_rmse_vy"]
    assert table.loc["level", "added"], "added later, and so not for the first choice"
    assert table.loc["rough", "fvu_median"] > table.loc["one", "fvu_median"]
    assert table.loc["one", "chosen"] == "second"
    assert table.loc["level", "chosen"] == "third"
    assert np.isnan(table.loc["one", "other_simulator_rmse_vy"]), (
        "the lowest error there, but not asked"
    )
    assert table.loc["level", "model_seed"] == 1, (
        "the best on the other simulation's car, not on the real one"
    )
    assert table.loc["level", "model_fvu"] == table.loc["level", "fvu_max"]
    assert table["model_fvu"].notna().sum() == 1


def test_report_lists_baselines_and_counts_candidates_worse_on_the_third_choice(document, steps):
    zero = steps.loc["Level: v = 0"]
    assert (zero["fvu_median"], zero["other_simulator_fvu"], zero["chosen"]) == (1.0, 1.0, "")
    assert (
        steps.loc["Rough: KS-NN", "other_simulator_fvu"]
        > 1.0
        > steps.loc["Level: KS-NN", "other_simulator_fvu"]
    )
    assert "1 of 2 candidates of the third choice are worse" in text_of(document)


def test_report_states_errors_of_each_choice_and_whether_the_first_suffices(
    document, table, tmp_path
):
    write_document(document, tmp_path)
    text = " ".join((tmp_path / "report.md").read_text(encoding="utf-8").split())
    for name in ("rough", "one", "level"):
        low, high = table.loc[name, "fvu_min"], table.loc[name, "fvu_max"]
        assert f"| {table.loc[name, 'fvu_median']:.3f} [{low:.3f}, {high:.3f}] |" in text
    assert table.loc["rough", "fvu_median"] > 0.10
    assert "and it missed the required value" in text
    assert list(document.data["budgets"]["part"]) == ["one", "rough", "level"]
    assert {"spread.png", "traces.png"} <= {file.name for file in (tmp_path / "figures").iterdir()}


def test_study_refuses_a_part_that_learns_on_the_real_car_or_stops_on_other_ranges(artefacts):
    simulated_part = artefacts.parts["one"]
    real = replace(
        simulated_part, split=replace(simulated_part.split, train=(Span("ferrari", "other"),))
    )
    with pytest.raises(
        DataError, match="part 'one' trains or chooses on 'ferrari', which is not simulated"
    ):
        documents(replace(artefacts, parts={**artefacts.parts, "one": real}))
    moved_validation = replace(
        simulated_part, split=replace(simulated_part.split, validation=(Span("sim", "elsewhere"),))
    )
    assert "validated or chosen on different ranges" in refusal(
        lambda: documents(replace(artefacts, parts={**artefacts.parts, "one": moved_validation}))
    )
