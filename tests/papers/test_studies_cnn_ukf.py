"""The study of the UKF-informed network, from small models and drives made by the test."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from test_network_ukf import LEVELS, TRAININGS, estimator_of
from test_sample_network import loaded_drive

from dugoff_drive import TYRES
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate, write_recording
from vehest.data.transforms import transform_from_config
from vehest.estimators.base import Estimator, FitData
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.filtering.network_ukf import Word
from vehest.estimators.model_files import save_model
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import Protocol, Scored, accuracy, score_all
from vehest.report.document import Figure, Table
from vehest.studies.artefacts import METRIC_COLUMNS, EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.training.samples import SampleSettings
from vehest.training.sequences import PhaseSettings
from vehest_papers.cnn_ukf import documents, paper, reasons, robustness, tables, traces
from vehest_papers.cnn_ukf.subjects import OFFLINE, Prepared, Run, candidate_of, chosen, losses, runs_of

ROOT = Path(__file__).parents[2]
PROTOCOL = Protocol(rate_hz=100.0, warm_up_seconds=1.0, skip_seconds=0.5)
TESTS = ("test_j_turn_1", "test_slalom_1", "test_spiral_1", "test_lap_1")
NAMES = ("train_1", "validation_1", *TESTS)
SPLIT = Split("made", (Span("car", "train_1"),), (Span("car", "validation_1"),), {"test": tuple(Span("car", name, 1.5) for name in TESTS)})
TRAINED = {"phase": {"patience": 6, "max_epochs": 30}, "batch_size": 32, "steps": 256}
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
def part(tmp_path_factory: pytest.TempPathFactory) -> PartArtefacts:
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
            models.append(EvaluatedModel(estimator.name, estimator.variant, estimator.full_title, seed, home, home, TRAINED))
            for test, spans in {"validation": SPLIT.validation, **SPLIT.tests}.items():
                seen = [
                    recordings[span.recording].cut(span.start - PROTOCOL.warm_up_seconds, span.stop).without_references() for span in spans
                ]
                own = estimator.estimate(seen)
                for position, estimate in enumerate(own):
                    write_estimate(estimate, home / test / f"{position}.parquet")
                figures = accuracy(score_all(own.__getitem__, spans, lambda span: recordings[span.recording], PROTOCOL))
                figures |= {"n_parameters": 9.0, "epochs": 2.0}
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
                rows += [(*head, metric, value, "1", None, None) for metric, value in figures.items()]
    return PartArtefacts(
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
def runs(part: PartArtefacts) -> dict[str, list[Run]]:
    return runs_of(part, Prepared(part))


def test_report_has_every_table_and_figure_of_the_paper_and_says_what_its_data_are(part: PartArtefacts) -> None:
    names = ("full", "limited", "limited_alone", "causal", "ferrari")
    alone = PartArtefacts(**{**vars(part), "models": part.models[:2]})
    parts = {**dict.fromkeys(names, part), "limited_alone": alone}
    document = documents(StudyArtefacts("cnn_ukf", "t", "a", "c", {name: f"Part {name}" for name in names}, parts, []))["report"]
    text = "\n".join(block if isinstance(block, str) else block.caption for block in document.blocks)
    shown = {block.name for block in document.blocks if isinstance(block, Figure)}
    assert {*(f"figure_{number}" for number in range(4, 15)), "groups_limited"} == shown
    of_tables = {block.name for block in document.blocks if isinstance(block, Table)}
    assert {"overview", "table_2", "table_3", "causal", "ferrari", "filters", "scaling", "budget", "networks_full"} <= of_tables
    assert "Part full: SIMULATED data" in text
    assert not re.search(r"\bnan\b", text)
    assert "training ends 6 epochs after the best mean likelihood" in text


def test_a_report_without_its_main_part_is_refused(part: PartArtefacts) -> None:
    with pytest.raises(DataError, match="needs part 'full'"):
        documents(StudyArtefacts("cnn_ukf", "t", "a", "c", {"limited": "l"}, {"limited": part}, []))


def test_candidates_have_the_papers_names(part: PartArtefacts) -> None:
    assert list(dict.fromkeys(candidate_of(model) for model in part.models)) == list(paper.CANDIDATES)
    twice = PartArtefacts(**{**vars(part), "models": [part.models[0], part.models[0]]})
    with pytest.raises(DataError, match="Model-based was trained twice with one seed"):
        runs_of(twice, Prepared(twice))


def test_the_study_prepares_references_as_the_pipeline_prepares_recordings() -> None:
    content = yaml.safe_load((ROOT / "pipelines" / "cnn_ukf.yaml").read_text())
    offline = {
        override for name in ("full", "limited", "limited_alone") for sweep in content["parts"][name]["sweeps"] for override in sweep
    }
    (told,) = {override for override in offline if override.startswith("downsample.transforms=")}
    assert tuple(transform_from_config(entry) for entry in yaml.safe_load(told.partition("=")[2])) == OFFLINE


def test_references_and_accelerations_are_low_passed_before_they_are_scored(part: PartArtefacts) -> None:
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


def test_the_manoeuvre_drawn_is_the_one_with_the_largest_angle_whose_car_did_not_spin(part: PartArtefacts, tmp_path: Path) -> None:
    calm = Prepared(part).recording("car", "test_j_turn_1")
    references, spans = dict(part.references), list(SPLIT.tests["test"])
    for name, factor, spun in (("test_j_turn_2", 1.5, False), ("test_j_turn_3", 2.0, True)):
        channels = {**calm.channels, "vy_ref": factor * calm["vy_ref"]}
        references["car", name] = tmp_path / f"{name}.parquet"
        flagged = replace(calm, id=name, channels=channels, provenance={"flags": {"spun": spun}})
        write_recording(flagged, references["car", name])
        spans.append(Span("car", name, 1.5))
    split = Split("made", SPLIT.train, SPLIT.validation, {"test": tuple(spans)})
    more = PartArtefacts(**{**vars(part), "references": references, "split": split})
    assert traces.manoeuvre_of(more, Prepared(more), "J-turn").recording == "test_j_turn_2"
    with pytest.raises(DataError, match="no test manoeuvre is a skidpad"):
        traces.manoeuvre_of(part, Prepared(part), "skidpad")


def test_what_networks_say_is_held_against_the_reference_of_the_same_time(
    part: PartArtefacts, runs: dict[str, list[Run]], monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = Prepared(part)

    def knowing(run: Run, drives: Sequence[Recording]) -> list[Word]:
        whole = [prepared.recording("car", drive.id).cut(drive.start_time, drive.end_time + 0.005) for drive in drives]
        true = [np.arctan2(own["vy_ref"], own["vx"]) for own in whole]
        return [Word(angle, np.full(len(angle), np.radians(2.0) ** 2)) for angle in true]

    monkeypatch.setattr(tables, "words_of", knowing)
    row = tables.networks_alone(runs, prepared, "t", "c").frame.iloc[0]
    assert row["median_mse"] == pytest.approx(0.0, abs=1e-12)
    assert row["median_linear_sigma"] == pytest.approx(2.0)
    assert row["median_filter_mse"] > 1e-6


def test_filters_that_are_not_those_that_were_found_are_named(runs: dict[str, list[Run]], tmp_path: Path) -> None:
    assert "are those that the full part found" in tables.given_as_found(runs, {paper.MODEL: runs[paper.MODEL]})
    other = estimator_class("dugoff_ukf").from_config({"tyres": {**TYRES, "friction_rear": 1.2 * TYRES["friction_rear"]}, "noise": LEVELS})
    save_model(other, tmp_path)
    changed = replace(runs[paper.MODEL][0], model=replace(runs[paper.MODEL][0].model, model_folder=tmp_path))
    words = tables.given_as_found(runs, {paper.MODEL: [changed]})
    assert "are not those that the full part finds now" in words
    assert "the largest difference is 20 % (friction_rear of Model-based)" in words


def test_stiffness_is_changed_in_a_copy_of_either_axle() -> None:
    for name in ("dugoff_ukf", "cnn_ukf"):
        fitted = estimator_class(name).from_config({"tyres": TYRES, "noise": LEVELS})
        changed = robustness.with_stiffness(fitted, 0.1, -0.1)
        before, after = ((own if isinstance(own, DugoffUkf) else own.model).tyres for own in (fitted, changed))  # type: ignore[attr-defined]
        np.testing.assert_allclose(after / before, [1.1, 1.0, 1.0, 0.9, 1.0, 1.0])
    with pytest.raises(DataError, match="has no cornering stiffness"):
        robustness.with_stiffness(estimator_class("sideslip_ffnn").from_config({}), 0.1, 0.1)


def test_wrong_tyres_cost_the_model_more_than_nothing_and_a_network_alone_nothing(part: PartArtefacts, runs: dict[str, list[Run]]) -> None:
    table = robustness.errors({name: runs[name][:1] for name in (paper.MODEL, paper.DATA)}, Prepared(part))
    of = {candidate: own["mse"].to_numpy() for candidate, own in table.groupby("candidate")}
    assert of[paper.MODEL].argmin() == robustness.COMBINATIONS.index((0.0, 0.0))
    assert np.ptp(of[paper.DATA]) == 0.0


def made_run(candidate: str, test: np.ndarray, seed: int = 0, validation: np.ndarray | None = None, ay: float = 5.0) -> Run:
    """A run whose only manoeuvre has these errors [deg]."""

    def scored(error: np.ndarray) -> dict[str, list[Scored]]:
        zero = np.zeros(len(error))
        return {"j_turn": [Scored(np.arange(len(error)) / 100.0, zero, zero, np.radians(error), zero, zero + ay)]}

    return Run(
        candidate, EvaluatedModel("x", "x", "x", seed, Path(), Path()), scored(test if validation is None else validation), scored(test)
    )


WAVE = np.tile([1.0, -1.0], 50)


def test_errors_are_split_into_what_stays_and_what_varies() -> None:
    run = made_run(paper.MODEL, WAVE + 2.0)
    part = run.test["j_turn"][0]
    halves = replace(run, test={"j_turn": [replace(part, ay=np.where(np.arange(100) < 50, 5.0, 0.0))]})
    frame = reasons.parts_of_errors({paper.MODEL: halves}, "t", "t", "d").frame
    assert frame.loc[0, ["mse", "constant", "varying", "linear", "nonlinear"]].tolist() == pytest.approx([5.0, 4.0, 1.0, 5.0, 5.0])


def test_a_blend_takes_its_weight_from_validation() -> None:
    picked = {
        paper.MODEL: made_run(paper.MODEL, np.full(100, 1.0), validation=WAVE),
        paper.DATA: made_run(paper.DATA, np.full(100, 5.0), validation=-3.0 * WAVE),
    }
    (words,) = reasons.blend(picked, "Full set")
    assert (
        "75 % of model-based and the rest of the data-driven method has an MSE of 4.000 deg² on the test (1.000 and 25.000 alone)" in words
    )


def test_validation_chooses_the_seed() -> None:
    one = made_run(paper.MODEL, np.full(10, 1.0), 0, validation=np.full(10, 2.0))
    other = made_run(paper.MODEL, np.full(10, 2.0), 1, validation=np.full(10, 1.0))
    assert chosen([one, other]).model.seed == 1
    assert tables.medians({paper.MODEL: [one, other]}, "mse") == {paper.MODEL: pytest.approx(2.5)}


def of_levels(**levels: float) -> dict[str, list[Run]]:
    """Runs with these root mean square errors [deg], in the order of `paper.CANDIDATES`."""
    return {candidate: [made_run(candidate, level * WAVE)] for candidate, level in zip(paper.CANDIDATES, levels.values(), strict=True)}


def test_statements_say_what_came_out_whichever_way() -> None:
    as_paper = reasons.statements("full", of_levels(model=0.53, smooth=0.5, data=0.4, deep=0.4, cnn=0.34))
    assert "Here lowest of the four is CNN-UKF." in as_paper[0]
    assert "there DE-UKF is level with Data-driven, here is level with" in as_paper[1]
    assert "Here in 1 of 1 (J-turn)" in as_paper[3]
    turned = reasons.statements("full", of_levels(model=0.2, smooth=0.1, data=0.4, deep=0.3, cnn=0.5))
    assert "there CNN-UKF is 25 % below DE-UKF, here is 178 % above). Here lowest of the four is Model-based." in turned[0]
    assert "Here last of the four is CNN-UKF." in turned[2]
    assert "there Data-driven is 29 % above Model-based" in reasons.statements("limited", of_levels(m=1.0, s=1.0, d=2.0, e=1.0, c=1.0))[0]


def test_ratios_of_causal_preprocessing_are_of_the_same_seed() -> None:
    offline = {paper.MODEL: [made_run(paper.MODEL, level * WAVE, seed) for seed, level in enumerate((1.0, 2.0, 3.0))]}
    frame = tables.causal_cost(offline, {paper.MODEL: [made_run(paper.MODEL, 2.0 * WAVE)]}, "t", "c").frame
    assert frame.loc[0, "ratio_mse"] == pytest.approx(4.0)
    assert frame.loc[0, "seeds"] == "3, 1"


def test_manoeuvres_in_two_ranges_are_refused(part: PartArtefacts) -> None:
    spans = (*SPLIT.tests["test"], Span("car", "test_lap_1", 4.0))
    twice = PartArtefacts(**{**vars(part), "split": Split("made", SPLIT.train, SPLIT.validation, {"test": spans})})
    with pytest.raises(DataError, match="has several ranges, but a manoeuvre is one"):
        runs_of(twice, Prepared(twice))


def test_a_method_that_the_paper_does_not_have_is_refused() -> None:
    with pytest.raises(DataError, match="'GRU' is none of the paper's methods"):
        candidate_of(EvaluatedModel("gru", "states_5", "GRU", 0, Path(), Path()))
