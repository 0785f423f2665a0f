"""The study of the UKF-informed network, from small models and drives made by the test."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from dugoff_drive import TYRES
from test_network_ukf import LEVELS, TRAININGS, estimator_of
from test_sample_network import loaded_drive
from vehest.data.errors import DataError
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate, write_recording
from vehest.data.transforms import transform_from_config
from vehest.estimators.base import Estimator, FitData
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.model_files import save_model
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import Protocol, Scored, accuracy, score_all
from vehest.report.document import Figure, Table, write_document
from vehest.studies.artefacts import METRIC_COLUMNS, EvaluatedModel, PartsArtefacts, StudyArtefacts
from vehest.studies.cnn_ukf import build_parts, paper, reasons, robustness, tables, traces
from vehest.studies.cnn_ukf.subjects import OFFLINE, Prepared, Run, candidate_of, chosen, losses, runs_of
from vehest.training.samples import SampleSettings
from vehest.training.settings import PhaseSettings

ROOT = Path(__file__).parents[1]
PROTOCOL = Protocol(rate_hz=100.0, warm_up_seconds=1.0, skip_seconds=0.5)
TESTS = ("test_j_turn_1", "test_slalom_1", "test_spiral_1", "test_lap_1")
NAMES = ("train_1", "validation_1", *TESTS)
SPLIT = Split("made", (Span("car", "train_1"),), (Span("car", "validation_1"),), {"test": tuple(Span("car", name) for name in TESTS)})
SAMPLES = SampleSettings(PhaseSettings(learning_rate=1e-3, max_epochs=1))


def fitted_models(data: FitData) -> dict[str, tuple[Estimator, list[int]]]:
    """Candidate -> a small model and its seeds."""
    given = {"tyres": TYRES, "noise": LEVELS}
    made: dict[str, tuple[Estimator, list[int]]] = {
        paper.MODEL: (estimator_class("dugoff_ukf").from_config(given), [0]),
        paper.SMOOTH: (estimator_class("dugoff_ukf").from_config({**given, "curve": "smooth"}), [0]),
    }
    network = estimator_class("sideslip_ffnn").from_config({"hidden": [10, 6]})
    network.seed(0)
    network.fit(data, SAMPLES)
    made[paper.DATA] = network, [0, 1]
    for candidate, name in ((paper.DEEP, "ensemble_ukf"), (paper.CNN, "cnn_ukf")):
        hybrid = estimator_of(name)
        hybrid.fit(data, TRAININGS[name])
        made[candidate] = hybrid, [0, 1]
    return made


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> StudyArtefacts:
    """All five candidates on four test manoeuvres of six seconds."""
    folder = tmp_path_factory.mktemp("study")
    recordings = {name: loaded_drive(6.0, seed=number, name=name) for number, name in enumerate(NAMES)}
    references = {}
    for name, own in recordings.items():
        references["car", name] = folder / f"{name}.parquet"
        write_recording(own, references["car", name])
    models, rows = [], []
    for number, (estimator, seeds) in enumerate(fitted_models(FitData([recordings["train_1"]], [recordings["validation_1"]])).values()):
        for seed in seeds:
            home = folder / f"{number}-{seed}"
            home.mkdir()
            save_model(estimator, home)
            (home / "fit.csv").write_text("metric,value\nbest_validation_loss,1.0\nbest_epoch,1\n")
            pd.DataFrame({"epoch": [1, 2], "train_loss": 1.0, "validation_loss": 1.0}).to_csv(home / "history.csv", index=False)
            models.append(EvaluatedModel(estimator.name, estimator.variant, estimator.full_title, seed, home, home))
            for test, spans in {"validation": SPLIT.validation, **SPLIT.tests}.items():
                own = estimator.estimate([recordings[span.recording].without_references() for span in spans])
                for position, estimate in enumerate(own):
                    write_estimate(estimate, home / test / f"{position}.parquet")
                figures = accuracy(score_all(own.__getitem__, spans, lambda span: recordings[span.recording], PROTOCOL))
                figures |= {"n_parameters": 9.0, "epochs": 2.0, "train_seconds": 3.0, "step_seconds": 1e-3}
                head = (
                    "cnn_ukf",
                    estimator.name,
                    estimator.variant,
                    "car",
                    "car",
                    "simulated",
                    test,
                    "all",
                    "nominal",
                    100.0,
                    "causal",
                    seed,
                )
                rows += [(*head, metric, value, "1") for metric, value in figures.items()]
    return StudyArtefacts(
        study="cnn_ukf",
        title="t",
        about="a",
        command="c",
        split=SPLIT,
        protocol=PROTOCOL,
        kinds={"car": "simulated"},
        data_titles={"car": "A car"},
        metrics=pd.DataFrame(rows, columns=list(METRIC_COLUMNS)),
        models=models,
        references=references,
        facts=["Recordings are made"],
    )


@pytest.fixture(scope="module")
def runs(part: StudyArtefacts) -> dict[str, list[Run]]:
    return runs_of(part, Prepared(part))


def test_report_has_every_table_and_figure_of_the_paper_and_says_what_its_data_are(part: StudyArtefacts, tmp_path: Path) -> None:
    names = ("full", "limited", "limited_alone", "causal", "ferrari")
    alone = StudyArtefacts(**{**vars(part), "models": part.models[:2]})
    parts = {**dict.fromkeys(names, part), "limited_alone": alone}
    document = build_parts(PartsArtefacts("cnn_ukf", "t", "a", "c", {name: f"Part {name}" for name in names}, parts, []))
    write_document(document, tmp_path, page=False)
    text = (tmp_path / "report.md").read_text()
    shown = {block.name for block in document.blocks if isinstance(block, Figure)}
    assert {*(f"figure_{number}" for number in (4, 5, 7, 8, 9, 10, 11, 12, 13, 14)), "groups_full", "groups_limited"} == shown
    of_tables = {block.name for block in document.blocks if isinstance(block, Table)}
    assert {"overview", "table_2", "table_3", "causal", "ferrari", "filters", "scaling", "budget", "networks_full"} <= of_tables
    assert "Part full: SIMULATED data" in text
    assert not re.search(r"\bnan\b", text)
    assert "the largest difference is 0 %" in text.replace("0.0 %", "0 %")


def test_a_report_without_its_main_part_is_refused(part: StudyArtefacts) -> None:
    with pytest.raises(DataError, match="needs part 'full'"):
        build_parts(PartsArtefacts("cnn_ukf", "t", "a", "c", {"limited": "l"}, {"limited": part}, []))


def test_candidates_have_the_papers_names(part: StudyArtefacts) -> None:
    assert list(dict.fromkeys(candidate_of(model) for model in part.models)) == list(paper.CANDIDATES)
    twice = StudyArtefacts(**{**vars(part), "models": [part.models[0], part.models[0]]})
    with pytest.raises(DataError, match="Model-based was trained twice with one seed"):
        runs_of(twice, Prepared(twice))


def test_the_study_prepares_references_as_the_pipeline_prepares_recordings() -> None:
    content = yaml.safe_load((ROOT / "pipelines" / "cnn_ukf.yaml").read_text())
    offline = {
        override for name in ("full", "limited", "limited_alone") for sweep in content["parts"][name]["sweeps"] for override in sweep
    }
    (told,) = {override for override in offline if override.startswith("downsample.transforms=")}
    assert tuple(transform_from_config(entry) for entry in yaml.safe_load(told.partition("=")[2])) == OFFLINE


def test_references_and_accelerations_are_low_passed_before_they_are_scored(part: StudyArtefacts) -> None:
    prepared = Prepared(part)
    noisy = part.references["car", "test_lap_1"]
    assert np.std(np.diff(prepared.recording("car", "test_lap_1")["ay"], 2)) < 0.1 * np.std(np.diff(loaded_ay(noisy), 2))


def loaded_ay(path: Path) -> np.ndarray:
    return pd.read_parquet(path)["ay"].to_numpy()


def test_losses_are_those_of_the_samples_that_count(runs: dict[str, list[Run]]) -> None:
    every, manoeuvre = losses(runs)
    beyond, _ = losses(runs, nonlinear_only=True)
    for candidate, own in runs.items():
        assert every[candidate].shape == (len(own), len(manoeuvre))
        assert every[candidate][0].mean() == pytest.approx(own[0].kpis.mse)
        assert beyond[candidate][0].mean() == pytest.approx(own[0].kpis.mse_nonlinear)
    assert len(set(manoeuvre.tolist())) == len(TESTS)


def test_the_manoeuvre_drawn_is_the_one_with_the_largest_angle_whose_car_did_not_spin(part: StudyArtefacts) -> None:
    prepared = Prepared(part)
    assert traces.manoeuvre_of(part, prepared, "J-turn").recording == "test_j_turn_1"
    with pytest.raises(DataError, match="no test manoeuvre is a skidpad"):
        traces.manoeuvre_of(part, prepared, "skidpad")


def test_stiffness_is_changed_in_a_copy_of_either_axle() -> None:
    for name in ("dugoff_ukf", "cnn_ukf"):
        fitted = estimator_class(name).from_config({"tyres": TYRES, "noise": LEVELS})
        changed = robustness.with_stiffness(fitted, 0.1, -0.1)
        before, after = ((own if isinstance(own, DugoffUkf) else own.model).tyres for own in (fitted, changed))  # type: ignore[attr-defined]
        np.testing.assert_allclose(after / before, [1.1, 1.0, 1.0, 0.9, 1.0, 1.0])
    with pytest.raises(DataError, match="has no cornering stiffness"):
        robustness.with_stiffness(estimator_class("sideslip_ffnn").from_config({}), 0.1, 0.1)


def test_wrong_tyres_cost_the_model_more_than_nothing_and_a_network_alone_nothing(part: StudyArtefacts, runs: dict[str, list[Run]]) -> None:
    table = robustness.errors({name: runs[name][:1] for name in (paper.MODEL, paper.DATA)}, Prepared(part))
    of = {candidate: own["mse"].to_numpy() for candidate, own in table.groupby("candidate")}
    assert of[paper.MODEL].argmin() == robustness.COMBINATIONS.index((0.0, 0.0))
    assert np.ptp(of[paper.DATA]) == 0.0


def made_run(candidate: str, error_deg: np.ndarray, seed: int = 0) -> Run:
    """A run whose only manoeuvre has these errors."""
    zero = np.zeros(len(error_deg))
    scored = Scored(np.arange(len(error_deg)) / 100.0, zero, zero, np.radians(error_deg), zero, zero + 5.0)
    model = EvaluatedModel("x", "x", "x", seed, Path(), Path())
    return Run(candidate, model, {"m": [scored]}, {"m": [scored]})


def test_errors_are_split_into_what_stays_and_what_varies() -> None:
    wave = np.tile([1.0, -1.0], 50)
    frame = reasons.parts_of_errors({paper.MODEL: made_run(paper.MODEL, wave + 2.0)}, "t", "t", "d").frame
    assert frame.loc[0, ["mse", "constant", "varying"]].tolist() == pytest.approx([5.0, 4.0, 1.0])


def test_a_blend_of_opposite_errors_leaves_none() -> None:
    wave = np.tile([1.0, -1.0], 50)
    picked = {paper.MODEL: made_run(paper.MODEL, wave), paper.DATA: made_run(paper.DATA, -3.0 * wave)}
    (words,) = reasons._blend(picked, "Full set")
    assert "75 % of model-based and the rest of the data-driven method has an MSE of 0.000 deg²" in words


def test_validation_chooses_the_seed() -> None:
    one, other = made_run(paper.MODEL, np.full(10, 2.0), 0), made_run(paper.MODEL, np.full(10, 1.0), 1)
    assert chosen([one, other]).model.seed == 1
    assert tables.medians({paper.MODEL: [one, other]}, "mse") == {paper.MODEL: pytest.approx(2.5)}
