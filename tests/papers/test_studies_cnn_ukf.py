"""The study of the UKF-informed network, from small models and drives made by the test."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml
from refusals import refusal
from study_parts import (
    figures_of,
    first_screen,
    metric_rows,
    part_of,
    stored,
    study_of,
    tables_of,
    text_of,
)
from test_network_ukf import LEVELS, TRAININGS, estimator_of
from test_sample_network import loaded_drive

from dugoff_drive import TYRES
from vehest.data.errors import DataError
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate
from vehest.data.transforms import transform_from_config
from vehest.estimators.base import FitData
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement
from vehest.estimators.model_files import load_model, save_model
from vehest.estimators.networks.sample_network import INPUTS
from vehest.estimators.networks.velocity_recurrent import SequenceSettings
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import Protocol, Scored, accuracy, score_all
from vehest.report.document import write_document
from vehest.studies.artefacts import EvaluatedModel
from vehest.training.samples import SampleSettings
from vehest.training.sequences import PhaseSettings
from vehest_papers.cnn_ukf import (
    block_errors,
    calibration,
    document,
    documents,
    factorial,
    measures,
    networks,
    observability,
    paper,
    perturbed,
)
from vehest_papers.cnn_ukf.indicators import MSE, MSE_NL, ManoeuvreErrors, sums_of
from vehest_papers.cnn_ukf.limited import limited
from vehest_papers.cnn_ukf.manoeuvres import car_of
from vehest_papers.cnn_ukf.networks import Outputs
from vehest_papers.cnn_ukf.subjects import (
    OFFLINE,
    Prepared,
    Run,
    candidate_of,
    chosen,
    runs_of,
    until,
)
from vehest_papers.kit.block_rows import BlockRow
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.verdicts import VERDICTS

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[2]
PROTOCOL = Protocol(rate_hz=100.0, warm_up_seconds=1.0, skip_seconds=0.5)
TESTS = ("test_j_turn_1", "test_slalom_1", "test_spiral_1", "test_lap_1")
NAMES = ("train_1", "validation_1", *TESTS)
SPLIT = Split(
    "made",
    (Span("car", "train_1"),),
    (Span("car", "validation_1"),),
    {"test": tuple(Span("car", name, 1.5) for name in TESTS)},
)
TRAINED = {"phase": {"patience": 6, "max_epochs": 30}, "batch_size": 32, "steps": 256}
SAMPLES = SampleSettings(PhaseSettings(learning_rate=1e-3, max_epochs=1))


def fitted_models(data):
    """Candidate -> a small model and its seeds."""
    car_settings = {"tyres": TYRES, "noise": LEVELS}
    models = {
        paper.MODEL: (estimator_class("dugoff_ukf").from_config(car_settings), [0]),
        paper.SMOOTH: (
            estimator_class("dugoff_ukf").from_config({**car_settings, "curve": "smooth"}),
            [0],
        ),
    }
    network = estimator_class("sideslip_ffnn").from_config({"hidden": [10, 6]})
    network.seed(0)
    network.fit(data, SAMPLES)
    models[paper.DATA] = network, [0, 1]
    for candidate, name in ((paper.DEEP, "ensemble_ukf"), (paper.CNN, "cnn_ukf")):
        hybrid = estimator_of(name)
        hybrid.fit(data, TRAININGS[name])
        models[candidate] = hybrid, [0, 1]
    models[paper.ZERO] = estimator_class("zero").from_config({"rate_hz": 100}), [0]
    models |= further_networks(data)
    return models


def further_networks(data):
    """A recurrent network with all 17 inputs."""
    recurrent = estimator_class("velocity_gru").from_config(
        {"inputs": list(INPUTS["full"]), "outputs": ["vy"], "n_states": 4}
    )
    phase = PhaseSettings(learning_rate=1e-3, max_epochs=1)
    recurrent.fit(
        data, SequenceSettings(phase, sequence_steps=100, validation_steps=100, dropped_steps=20)
    )
    return {paper.RECURRENT: (recurrent, [0, 1])}


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """The four methods, the smooth filter, baselines and further networks on four test manoeuvres
    of six seconds.
    """
    folder = tmp_path_factory.mktemp("study")
    recordings = {
        name: loaded_drive(6.0, seed=number, name=name) for number, name in enumerate(NAMES)
    }
    models = []
    rows = []
    fitted = fitted_models(FitData([recordings["train_1"]], [recordings["validation_1"]]))
    for number, (estimator, seeds) in enumerate(fitted.values()):
        for seed in seeds:
            home = folder / f"{number}-{seed}"
            home.mkdir()
            save_model(estimator, home)
            (home / "fit.csv").write_text("metric,value\nbest_validation_loss,1.0\nbest_epoch,1\n")
            pd.DataFrame({"epoch": [1, 2], "train_loss": 1.0, "validation_loss": 1.0}).to_csv(
                home / "history.csv", index=False
            )
            models.append(
                EvaluatedModel(
                    estimator.name,
                    estimator.variant,
                    estimator.full_title,
                    seed,
                    home,
                    home,
                    {} if estimator.name in ("dugoff_ukf", "zero") else TRAINED,
                )
            )
            for test, spans in {"validation": SPLIT.validation, **SPLIT.tests}.items():
                drives = [
                    recordings[span.recording]
                    .cut(span.start - PROTOCOL.warm_up_seconds, span.stop)
                    .without_references()
                    for span in spans
                ]
                estimates = estimator.estimate(drives)
                for position, estimate in enumerate(estimates):
                    write_estimate(estimate, home / test / f"{position}.parquet")
                figures = accuracy(
                    score_all(
                        estimates.__getitem__,
                        spans,
                        lambda span: recordings[span.recording],
                        PROTOCOL,
                    )
                )
                rows += metric_rows(
                    models[-1], test, figures | {"n_parameters": 9.0, "epochs": 2.0}
                )
    kinds = {"car": "simulated"}
    titles = {"car": "A car"}
    references = stored(folder, "car", recordings)
    return part_of(
        SPLIT,
        PROTOCOL,
        models,
        rows,
        kinds=kinds,
        data_titles=titles,
        references=references,
        facts=["Recordings are made"],
    )


@pytest.fixture(scope="module")
def part(everything):
    """What Table II needs."""
    of_table = [model for model in everything.models if model.estimator != "velocity_gru"]
    return replace(everything, models=of_table)


@pytest.fixture(scope="module")
def runs(part):
    return runs_of(part, Prepared(part))


@pytest.fixture(scope="module")
def report(part, everything):
    """Of a study whose parts are all made from the same small models."""
    of_estimator = {
        name: [model for model in part.models if model.estimator == name]
        for name in ("cnn_ukf", "ensemble_ukf", "sideslip_ffnn")
    }
    smooth = [model for model in part.models if model.variant.endswith("_smooth")]
    removed = ("adaptive_process", "adaptive_distrust", "pseudo_measurement")
    models = {
        "full": part.models,
        "before": of_estimator["cnn_ukf"],
        "free": [*smooth, *of_estimator["cnn_ukf"]],
        "ablation": [
            replace(cnn_model, variant=f"full_no_{element}")
            for element in removed
            for cnn_model in of_estimator["cnn_ukf"]
        ],
        "z_scores": [*of_estimator["sideslip_ffnn"], *of_estimator["cnn_ukf"]],
        "limited": [model for models in of_estimator.values() for model in models],
        "recurrent": [model for model in everything.models if model.estimator == "velocity_gru"],
        "factorial_plain_paper": [model for model in part.models if model.variant == "dugoff_full"],
        "factorial_smooth_paper": [*smooth, *of_estimator["cnn_ukf"]],
        "floor_1e-8": of_estimator["ensemble_ukf"],
    }
    return report_of(part, models)


def report_of(part, models, not_trained=None):
    """The report of a study whose parts have these models."""
    parts = {name: replace(part, models=of_part) for name, of_part in models.items()}
    return documents(study_of("cnn_ukf", parts, not_trained=not_trained or {}))["report"]


def test_report_has_every_table_figure_and_claim_of_the_paper_with_intervals(
    report,
):
    text = text_of(report)
    names = {*(f"figure_{number}" for number in range(4, 15)), "loss_curves"}
    assert figures_of(report).keys() == names
    assert tables_of(report).keys() == {
        "table_2",
        "by_car",
        "factorial",
        "effects",
        "ablation",
        "floor",
        "calibration",
        "verdicts",
        "table_3",
        "overview",
    }
    assert {"claims", "perturbed", "observability", "filters", "scaling", "budget"} <= set(
        report.data
    )
    assert "SIMULATED data" in text
    assert not re.search(r"\bnan\b", text)
    claims = report.data["claims"]
    content = claims_of("cnn_ukf")
    assert set(claims["id"]) == {claim.id for claim in content.claims}
    assert set(claims["verdict"]) <= set(VERDICTS)
    not_assessed = set(claims.loc[claims["verdict"] == "not assessed", "id"])
    assert not_assessed == {
        "model_based_above_cnn_ukf_braking",
        "model_based_above_cnn_ukf_skidpad",
    }, "no such manoeuvres in this test"


def test_first_screen_and_report_are_short(report, tmp_path):
    write_document(report, tmp_path, page=False)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    first_screen(text, document.TEMPLATE.read_text(encoding="utf-8"))


def test_factorial_has_a_ratio_per_effect_and_names_untrained_cells(report):
    cells = tables_of(report)["factorial"].set_index(["curve", "noise"])
    assert cells.loc[("plain", "free")].tolist() == ["not trained yet"] * 3
    assert cells.loc[("smooth", "paper's"), "ensemble"] == "not trained yet"
    effects = tables_of(report)["effects"].set_index("effect")
    assert effects["cells"].to_dict() == {
        "smooth over plain tyres": 1,
        "free over the paper's process noise": 0,
        "ensemble over no network": 0,
        "end to end over no network": 1,
        "end to end over ensemble": 0,
    }
    floors = tables_of(report)["floor"].set_index(["candidate", "floor"])
    assert floors.loc[(paper.DEEP, "1e-8"), "correlation"] == pytest.approx(
        floors.loc[(paper.DEEP, "1e-6"), "correlation"]
    )
    assert floors.loc[(paper.CNN, "1e-7"), "mse_nonlinear"] == "not trained yet"


def test_effects_are_geometric_means_over_manoeuvres_and_cells():
    levels = {("plain", "paper"): 2.0, ("smooth", "paper"): 1.0, ("plain", "free"): 1.0}
    levels[("smooth", "free")] = 0.25
    cell_runs = {
        factorial.cell_name((curve, noise, "none")): [
            planted_run("any", [size * WAVE * level for size in (1.0, 2.0, 3.0)])
        ]
        for (curve, noise), level in levels.items()
    }
    effects = factorial.effects_of(ManoeuvreErrors(cell_runs))
    figure, cells = effects["smooth over plain tyres"]
    assert cells == 2
    assert figure.value == pytest.approx(np.sqrt(0.5**2 * 0.25**2))
    assert effects["end to end over ensemble"][1] == 0


def test_raw_coverage_is_that_of_the_filters_normal_distribution():
    class FilterDrives:
        def with_covariances(self, model, test):
            zero = np.zeros(4)
            errors = np.array([0.5, -0.9, 1.5, -3.0])
            variance = np.ones((4, 1, 1))
            yield Scored(zero, errors, zero, zero, zero, zero, zero > -1, {}, variance, ("vy",))

    run = planted_run("any", [WAVE])
    assert calibration.raw_coverages(run, FilterDrives()).tolist() == [0.5, 0.75]


def test_a_partial_study_names_untrained_candidates(part):
    models = [model for model in part.models if model.estimator in ("zero", "sideslip_ffnn")]
    report = report_of(part, {"full": models}, {"full": ["cnn_ukf-seed0"], "ablation": ["a", "b"]})
    text = text_of(report)
    assert "3 planned trainings are not done, of the parts `full`, `ablation`" in text
    assert "CNN-UKF; " in text
    assert "DE-UKF is not trained yet" in text
    assert set(tables_of(report)["table_2"]["candidate"]) == {paper.DATA, paper.ZERO}
    states = report.data["training"].set_index("candidate")["training"]
    assert states[paper.CNN] == states[paper.MODEL] == "not trained"


def test_recordings_are_grouped_by_car():
    names = ("soft_lap_on_001", "standard_lap_on_001", "laden_lap_on_001", "test_lap_1")
    assert [car_of(name) for name in names] == [
        "softer tyres",
        "as in training",
        "laden",
        "as in training",
    ]


def test_report_writes_the_errors_of_every_manoeuvre_and_seed(report, part, runs):
    blocks = report.data["blocks"]
    assert blocks.columns.tolist() == list(BlockRow.__dataclass_fields__)
    assert not blocks.duplicated(["part", "candidate", "seed", "test_set", "metric", "block"]).any()
    content = claims_of("cnn_ukf")
    assert set(blocks["candidate"]) == {*content.candidates, "-"} - {"static_map"}
    test_blocks = blocks[(blocks["part"] == "full") & (blocks["test_set"] == "test")]
    test_blocks = test_blocks.groupby(["candidate", "seed", "metric"])[["value", "size"]].sum()
    for candidate in (*paper.OF_FOUR, paper.SMOOTH, paper.ZERO):
        for run in runs[candidate]:
            figures = {
                "mse_sideslip": run.kpis.mse,
                "mse_sideslip_nonlinear": run.kpis.mse_nonlinear,
                "max_error_sideslip": run.kpis.max_error,
                "max_error_sideslip_nonlinear": run.kpis.max_error_nonlinear,
            }
            for metric, figure in figures.items():
                value, size = test_blocks.loc[(candidate, run.model.seed, metric)]
                assert value / size == pytest.approx(figure, rel=1e-12)
    limited_set = blocks[(blocks["part"] == "limited") & (blocks["metric"] == "mse_sideslip")]
    pd.testing.assert_series_equal(
        limited_set[limited_set["candidate"] == paper.MODEL]["value"].reset_index(drop=True),
        blocks[
            (blocks["part"] == "full")
            & (blocks["metric"] == "mse_sideslip")
            & (blocks["candidate"] == paper.MODEL)
        ]["value"].reset_index(drop=True),
    )
    slaloms = blocks[blocks["test_set"] == "test_slalom"]
    assert set(slaloms["block"]) == {"test_slalom_1"}
    training = report.data["training"].set_index("candidate")["training"]
    assert training[paper.MODEL] == training["zero"] == "not applicable"
    assert training[paper.CNN] == "not checked"


def test_candidates_have_the_papers_names_and_lines(part):
    assert set(map(candidate_of, part.models)) == {*paper.OF_FOUR, paper.SMOOTH, paper.ZERO}
    away = replace(part.models[-2], estimator="cnn_ukf", variant="full_no_adaptive_process")
    assert candidate_of(away) == "CNN-UKF, constant process noise"
    twice = replace(part, models=[part.models[0], part.models[0]])
    assert "Model-based was trained twice with one seed" in refusal(
        lambda: runs_of(twice, Prepared(twice))
    )
    with pytest.raises(DataError, match="'GRU' is none of the paper's methods"):
        candidate_of(EvaluatedModel("gru", "states_5", "GRU", 0, Path(), Path()))


def planted_run(candidate, errors, seed=0, validation=None, ay=5.0):
    """A run whose manoeuvres, a slalom and J-turns, have these errors [deg]."""

    def scored(error):
        zero = np.zeros(len(error))
        time = np.arange(len(error)) / 100.0
        is_scored = np.ones(len(error), dtype=bool)
        return Scored(time, zero, zero, np.radians(error), zero, zero + ay, is_scored)

    names = ["slalom_0", *(f"j_turn_{number}" for number in range(1, len(errors)))]
    test = {name: [scored(error)] for name, error in zip(names, errors, strict=True)}
    judged = test if validation is None else {"j_turn": [scored(validation)]}
    return Run(candidate, EvaluatedModel("x", "x", "x", seed, Path(), Path()), judged, test)


WAVE = np.tile([1.0, -1.0], 50)


def noisy(level, generator, count=12):
    return [level * amplitude * WAVE for amplitude in generator.uniform(0.8, 1.2, count)]


def test_indicators_and_ratios_are_those_of_the_paper(runs):
    errors = ManoeuvreErrors(runs)
    for candidate, seeds in runs.items():
        for indicator in ("mse", "mse_nonlinear", "max_error", "max_error_nonlinear"):
            expected = np.mean([getattr(run.kpis, indicator) for run in seeds])
            assert errors.figure(candidate, indicator).value == pytest.approx(expected)
    generator = np.random.default_rng(0)
    levels = {"a": 1.0, "b": 1.5, "c": 1.0}
    planted_runs = {
        name: [planted_run(name, noisy(level, generator), seed) for seed in range(3)]
        for name, level in levels.items()
    }
    errors = ManoeuvreErrors(planted_runs)
    ratio = errors.ratio("a", "b", MSE)
    assert ratio.low < 1.0 / 2.25 < ratio.high < 0.7
    equal_ratio = errors.ratio("a", "c", MSE)
    assert equal_ratio.low < 1.0 < equal_ratio.high


def test_losses_of_a_manoeuvre_are_those_of_a_hand_calculation():
    run = planted_run("a", [np.array([1.0, -3.0]), np.array([2.0, 4.0, 0.0])])
    np.testing.assert_allclose(sums_of(run.test, MSE), [[10.0, 20.0], [2.0, 3.0]])
    np.testing.assert_allclose(sums_of(run.test, "max_error"), [[3.0, 4.0], [1.0, 1.0]])
    spread, sizes = sums_of(run.test, "variance_nonlinear")
    np.testing.assert_allclose(spread, [0.2**2 + 3.8**2, 1.2**2 + 3.2**2 + 0.8**2])
    assert sizes.tolist() == [2.0, 3.0]
    slow = planted_run("a", [np.array([1.0, -3.0])], ay=3.0)
    for indicator in (MSE_NL, "max_error_nonlinear"):
        assert [sums.tolist() for sums in sums_of(slow.test, indicator)] == [[0.0], [0.0]]
    error = np.arange(50.0)
    peaked = planted_run("a", [error])
    part = peaked.test["slalom_0"][0]
    part.sideslip_ref[30] = 0.1
    peaked.test["slalom_0"][0] = replace(part, sideslip=part.sideslip_ref + np.radians(error))
    assert sums_of(peaked.test, "error_at_peak")[0] == pytest.approx([30.0])


def outputs_of_seed(*distrusts, error=None, process=None, sideslip=None, nonlinear=None):
    """One seed's outputs in some manoeuvres."""
    count = len(distrusts[0])
    return [
        Outputs(
            np.arange(count) - 0.5 if error is None else error,
            distrust,
            process,
            np.zeros(count) if sideslip is None else sideslip,
            np.zeros(count, dtype=bool) if nonlinear is None else nonlinear,
        )
        for distrust in distrusts
    ]


def test_measured_values_are_those_of_a_hand_calculation():
    rising = np.geomspace(0.01, 10.0, 101)
    seeds = [outputs_of_seed(rising, rising[::-1], np.ones(101))]
    correlations = measures.distrust_correlations(seeds)
    assert correlations[0, 0] == pytest.approx(1.0, abs=1e-3)
    assert correlations[0, 1] == pytest.approx(-1.0, abs=1e-3)
    assert correlations[0, 2] == 0.0, "a constant deviation"
    narrow = [outputs_of_seed(np.geomspace(0.1, 10.0, 101))]
    ratios = measures.distrust_decades_ratios([outputs_of_seed(rising)], narrow)
    assert ratios == pytest.approx(np.array([[1.5]]))
    process = np.array([[1.0, 2.0], [1.0, 2.0], [3.0, 80.0], [3.0, 60.0]])
    turning = {
        "process": process,
        "sideslip": np.array([0.5, -0.9, 6.0, -7.0]),
        "nonlinear": np.array([False, False, True, True]),
    }
    seed = outputs_of_seed(np.ones(4), error=np.ones(4), **turning)
    straight = replace(seed[0], sideslip=np.zeros(4), nonlinear=np.zeros(4, dtype=bool))
    assert measures.yaw_rate_noise_rises([[seed[0], straight]]) == pytest.approx(
        np.array([[35.0, np.nan]]), nan_ok=True
    )
    assert measures.lateral_velocity_noise_rises([[seed[0], straight]]) == pytest.approx(
        np.array([[3.0, np.nan]]), nan_ok=True
    )


def test_contributions_of_manoeuvres_add_up_to_the_claimed_value():
    planted_errors = ManoeuvreErrors(
        {
            "a": [
                planted_run("a", [np.array([-1.0, -1.0]), np.array([0.5, 0.5])], seed)
                for seed in (0, 1)
            ],
            "b": [planted_run("b", [np.array([2.0, 2.0]), np.array([0.0, 0.0])])],
            "c": [planted_run("c", [np.array([-3.0, -3.0]), np.array([-5.0, -5.0])])],
        }
    )
    values = measures.mean_error_over_least_of_others(planted_errors, "a", ["b", "c"])
    assert values.shape == (2, 2)
    np.testing.assert_allclose(values.mean(axis=1), 0.25 - 1.0)
    groups, best = measures.is_best_in_group(planted_errors, "a", ["b", "c"])
    assert groups == ["J-turn", "slalom"] or groups == ["slalom", "J-turn"]
    assert dict(zip(groups, best.T.tolist(), strict=True)) == {
        "slalom": [1.0, 1.0],
        "J-turn": [0.0, 0.0],
    }

    def with_errors(a, b):
        return ManoeuvreErrors(
            {
                "a": [planted_run("a", [np.array(error) for error in a])],
                "b": [planted_run("b", [np.array(error) for error in b])],
            }
        )

    nominal = with_errors([[1.0], [1.0]], [[1.0], [2.0]])
    worse = with_errors([[2.0], [1.0]], [[1.0], [2.0]])
    worst_of_b = with_errors([[1.0], [1.0]], [[3.0], [4.0]])
    conditions = [nominal, worse, worst_of_b]
    rises = measures.stiffness_rise_differences(conditions, nominal, "a", "b")
    np.testing.assert_allclose(rises, [[3.0 - 8.0, 0.0 - 12.0]])
    largest = measures.largest_ratios_over_stiffnesses(conditions, "a", "b")
    np.testing.assert_allclose(largest, [[4.0, 0.25]])


def test_validation_chooses_the_seed():
    better_on_test = planted_run(paper.MODEL, [np.full(10, 1.0)], 0, validation=np.full(10, 2.0))
    better_on_validation = planted_run(
        paper.MODEL, [np.full(10, 2.0)], 1, validation=np.full(10, 1.0)
    )
    assert chosen([better_on_test, better_on_validation]).model.seed == 1
    quiet = planted_run("a", [WAVE] * 9 + [4.0 * WAVE], 0)
    wild = planted_run("a", [1.35 * WAVE] * 10, 1)
    assert quiet.kpis.mse > wild.kpis.mse
    assert chosen([quiet, wild]).model.seed == 0


def test_twice_the_epochs_check_the_full_set():
    content = claims_of("cnn_ukf")
    trained = {"phase": {"max_epochs": 40}}
    first = planted_run(paper.DATA, [WAVE], 0)
    first = replace(first, model=replace(first.model, training=trained))
    better = planted_run(paper.DATA, [0.5 * WAVE], 0)
    parts = {"full": {paper.DATA: [first]}, "doubled": {paper.DATA: [better]}}
    (row,) = block_errors.training_rows(parts, content)
    assert (row.epochs, row.epochs_paper) == ("40", "not stated, early stopping")
    assert row.training == "insufficient"
    assert "by -75.0 %" in row.reason


def test_a_drive_is_scored_until_it_slides_and_sliding_drives_are_counted():
    angle = np.array([0.1, 0.2, 0.22, 0.1])
    part = Scored(np.arange(4.0), angle, angle, angle, angle, angle, np.ones(4, dtype=bool))
    assert len(until(part, 0.21).time) == 2
    assert len(until(part, 0.3).time) == len(until(part, np.inf).time) == 4

    def driven(*largest):
        test = {
            f"drive {k}": [SimpleNamespace(sideslip_ref=np.radians([0.0, -angle]))]
            for k, angle in enumerate(largest)
        }
        return SimpleNamespace(runs={"any": [SimpleNamespace(test=test)]})

    assert document.number_beyond(driven(3.0, 43.0, 11.9, 180.0), 0.21) == 2
    assert document.number_beyond(driven(3.0), 0.21) == 0


def test_network_outputs_are_compared_with_the_reference_of_the_same_time(part, runs, monkeypatch):
    prepared = Prepared(part)

    def knowing(run, drives):
        prepared_drives = [
            prepared.recording("car", drive.id).cut(drive.start_time, drive.end_time + 0.005)
            for drive in drives
        ]
        true = [
            np.arctan2(prepared_drive["vy_ref"], prepared_drive["vx"])
            for prepared_drive in prepared_drives
        ]
        return [
            PseudoMeasurement(angle, np.full(len(angle), np.radians(2.0) ** 2)) for angle in true
        ]

    monkeypatch.setattr(networks, "pseudo_measurements_of", knowing)
    outputs = networks.outputs_of(runs[paper.CNN][0], prepared)
    for output in outputs:
        np.testing.assert_allclose(output.error, 0.0, atol=1e-9)
        np.testing.assert_allclose(output.distrust, 2.0)


def test_a_filter_moves_by_no_more_than_its_network_and_less_where_it_distrusts(part, runs):
    shift_ratio = networks.shift_of(runs[paper.CNN][0], Prepared(part))
    assert 0.0 < shift_ratio < 1.0
    perfect = networks.with_perfect_distrust(runs[paper.CNN][0], Prepared(part), "oracle")
    assert list(perfect.test) == list(runs[paper.CNN][0].test)
    assert perfect.kpis.mse < max(runs[paper.CNN][0].kpis.mse, 1e-3)


def test_tyres_and_body_are_changed_in_a_copy_and_wrong_ones_cost_more(part, runs):
    for name in ("dugoff_ukf", "cnn_ukf"):
        fitted = estimator_class(name).from_config({"tyres": TYRES, "noise": LEVELS})
        changed = perturbed.with_stiffness(fitted, 0.1, -0.1)
        heavy = perturbed.with_body(fitted, 1.1, 0.9)
        before, after, heavier = (
            (
                filter_or_hybrid
                if isinstance(filter_or_hybrid, DugoffUkf)
                else filter_or_hybrid.model
            )
            for filter_or_hybrid in (fitted, changed, heavy)
        )
        np.testing.assert_allclose(
            after.axle_tyres / before.axle_tyres, [1.1, 1.0, 1.0, 0.9, 1.0, 1.0]
        )
        assert heavier.track().car.mass == pytest.approx(1.1 * before.track().car.mass)
        assert heavier.track().car.yaw_inertia == pytest.approx(
            0.9 * before.track().car.yaw_inertia
        )
    for change in (perturbed.with_stiffness, perturbed.with_body):
        with pytest.raises(DataError, match=r"has no cornering stiffness|knows no mass"):
            change(estimator_class("sideslip_ffnn").from_config({}), 0.1, 0.1)
    table = perturbed.values(perturbed.perturbed({paper.MODEL: runs[paper.MODEL]}, Prepared(part)))
    assert table["mse"].to_numpy().argmin() == perturbed.NOMINAL


def test_the_model_is_observable_straight_ahead_as_well():
    estimator = estimator_class("dugoff_ukf").from_config(
        {"tyres": TYRES, "noise": LEVELS, "curve": "smooth"}
    )
    ranks = observability.local(estimator)
    straight = ranks[(ranks["steer"] == 0.0) & (ranks["measured"] == "ay, yaw rate, both forces")]
    assert set(straight["rank"]) == {2}
    names, steady = measures.ranks(ranks, is_straight=False)
    assert (steady == 2.0).all()
    assert steady.shape == (1, len(names))
    names, straights = measures.ranks(ranks, is_straight=True)
    assert names == [f"{speed:g} m/s, 0°" for speed in observability.SPEEDS]
    assert (straights == 2.0).all()


def test_scaling_of_the_full_set_changes_the_filter_and_nothing_else(part, runs, tmp_path):
    prepared = Prepared(part)
    learnt = {name: runs[name] for name in (paper.DATA, *paper.HYBRIDS)}
    limitations = limited(runs, learnt, prepared)
    as_tuned = [run.kpis.mse for run in runs[paper.DEEP]]
    rescaled = [run.kpis.mse for run in limitations.compared[paper.FULL_SCALING]]
    assert rescaled == pytest.approx(as_tuned, rel=2e-3)  # estimated on raw drives
    rescaled_model = load_model(runs[paper.DEEP][0].model.model_folder)
    rescaled_model.scaling = rescaled_model.scaling + np.array([4.0, 0.0])  # DE-UKF
    save_model(rescaled_model, tmp_path)
    of_full = [
        replace(run, model=replace(run.model, model_folder=tmp_path)) for run in runs[paper.DEEP]
    ]
    changed = limited({**runs, paper.DEEP: of_full}, learnt, prepared)
    assert [run.kpis.mse for run in changed.rescaled] != pytest.approx(as_tuned, rel=1e-2)
    assert paper.MODEL in changed.comparison  # the filter of the full set
    partial = limited(runs, {paper.DATA: learnt[paper.DATA]}, prepared)
    assert set(partial.outputs) == set()


def test_manoeuvres_in_two_ranges_and_reports_without_a_main_part_are_refused(part):
    spans = (*SPLIT.tests["test"], Span("car", "test_lap_1", 4.0))
    twice = replace(part, split=Split("made", SPLIT.train, SPLIT.validation, {"test": spans}))
    assert "has several ranges, but a manoeuvre is one" in refusal(
        lambda: runs_of(twice, Prepared(twice))
    )
    with pytest.raises(DataError, match="needs part 'full'"):
        documents(study_of("cnn_ukf", {"limited": part}))


def test_recordings_are_prepared_as_the_pipeline_does(part):
    content = yaml.safe_load((ROOT / "pipelines" / "cnn_ukf.yaml").read_text())
    offline = {
        override
        for part in content["parts"].values()
        for sweep in part["sweeps"]
        for override in sweep
    }
    (transforms_override,) = {
        override for override in offline if override.startswith("downsample.transforms=")
    }
    assert (
        tuple(
            transform_from_config(entry)
            for entry in yaml.safe_load(transforms_override.partition("=")[2])
        )
        == OFFLINE
    )
    prepared = Prepared(part)
    noisy = part.references["car", "test_lap_1"]
    assert np.std(np.diff(prepared.recording("car", "test_lap_1")["ay"], 2)) < 0.1 * np.std(
        np.diff(pd.read_parquet(noisy)["ay"], 2)
    )
