"""The study of the learned UKF, from small models and recordings made by the test."""

import importlib
import math
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from refusals import refusal
from study_parts import (
    figures_of,
    first_screen,
    metric_rows,
    part_of,
    stored,
    study_of,
    tables_of,
)

from place import undrawn
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import VALIDATION, Span, Split
from vehest.data.store import read_estimate, write_estimate
from vehest.estimators.learned_ukf import LearnedUkf
from vehest.estimators.model_files import save_model
from vehest.evaluation.metrics import (
    Protocol,
    Scored,
    accuracy,
    reference_state,
    score_all,
    sequences,
)
from vehest.report.document import write_document
from vehest.studies.artefacts import EvaluatedModel, Trial
from vehest.training.through_filter import Drive
from vehest_papers.kit.block_errors import BlockErrors, Key, blocks_of, read_training
from vehest_papers.kit.block_rows import BlockRow, checked_training
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.reading import metric_values
from vehest_papers.kit.verdict_table import DECIDED
from vehest_papers.kit.verdicts import VERDICTS
from vehest_papers.learned_ukf import block_errors, documents, friction, measures, paper, tables
from vehest_papers.learned_ukf.budgets import samples_trained_on, validation_losses
from vehest_papers.learned_ukf.candidates import (
    candidate_of,
    chosen,
    models_by_candidate,
    runs_of,
    scored_of,
)
from vehest_papers.learned_ukf.data_amount import data_table, extrapolated
from vehest_papers.learned_ukf.filtering import (
    drives_of,
    filtered,
    loaded,
    lost_sequences,
    one_step_squares,
    swapped,
)
from vehest_papers.learned_ukf.lengths import lengths
from vehest_papers.learned_ukf.order import order_lines
from vehest_papers.learned_ukf.slips import rear_slip
from vehest_papers.learned_ukf.traces import hardest

RESULTS = Path(__file__).parents[2] / "results"
PROTOCOL = Protocol(
    rate_hz=100.0, warm_up_seconds=0.0, skip_seconds=0.2, sequence_seconds=1.0, initial_state=True
)
SPANS = {name: Span("car", name) for name in ("learnt", "judged", "a", "d")}
SPLIT = Split(
    "tyres",
    (SPANS["learnt"],),
    (SPANS["judged"],),
    {"tyre_a": (SPANS["a"],), "tyre_d": (SPANS["d"],)},
)
HALF_OF_TRAINING = 1.5  # s
PHASE = {"learning_rate": 5e-4, "max_epochs": 1000, "schedule": "constant"}
AS_THE_PAPER = dict.fromkeys(("one_step", "through", "noise"), PHASE)
AS_THE_PAPER |= {
    "batch_size": 256,
    "placing": "fixed",
    "start_spread": 0.0,
    "mirrored": 0.0,
    "start_noise": "given",
}
AS_THE_PAPER |= {"drop_steps": 200, "steps": 500}
CANDIDATES = {
    "NNT": {"dynamics": "tyre_network", "noise": "constant", "through_filter": False},
    "NNTF": {"noise": "constant", "through_filter": False},
    "NNTF_U": {"noise": "constant"},
    "NNTF_UH": {},
    "NNTF_UH*": {"start_friction": 0.4},
}


def recording(name, seconds=3.2, seed=0):
    """A drive of smooth motion that no model explains."""
    time = np.arange(round(100 * seconds)) / 100.0
    vx = 2.5 + 0.4 * np.sin(1.3 * time + seed)
    vy = 0.3 * np.sin(2.0 * time + seed)
    yaw_rate = 1.2 * np.cos(1.1 * time + seed)
    noise = np.random.default_rng(seed).normal(0.0, 0.05, (4, len(time)))
    measured = {"vx": vx, "motor_speed": 20.0 * vx + noise[0], "yaw_rate": yaw_rate + noise[1]}
    measured |= {
        "ax": noise[2],
        "ay": vx * yaw_rate + noise[3],
        "steer": 0.2 * yaw_rate,
        "motor_current": 10.0 + 5.0 * np.sin(time),
    }
    return Recording(
        name,
        "car",
        100.0,
        0.0,
        {**measured, "vx_ref": vx, "vy_ref": vy, "yaw_rate_ref": yaw_rate},
        "simulated",
    )


def filter_of(seed=0, **settings):
    """A filter with networks of random weights, not trained."""
    estimator = LearnedUkf(LearnedUkf.settings_type(**{"width": 4, "scaled": False, **settings}))
    estimator.filter.double().reset(torch.Generator().manual_seed(seed))
    return estimator


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """Five filters and a network, two seeds each, on two sets of three sequences."""
    folder = tmp_path_factory.mktemp("study")
    recordings = {name: recording(name, seed=number) for number, name in enumerate(SPANS)}
    models = []
    rows = []
    for candidate in (*CANDIDATES, "GRU"):
        for seed in (0, 1):
            home = folder / f"{candidate.strip('*')}{candidate.count('*')}-{seed}"
            home.mkdir()
            estimator = (
                filter_of(seed, **CANDIDATES[candidate]) if candidate in CANDIDATES else None
            )
            name, variant = (
                (estimator.name, estimator.variant) if estimator else ("velocity_gru", "states_64")
            )
            models.append(
                EvaluatedModel(
                    name,
                    variant,
                    candidate,
                    seed,
                    home,
                    home,
                    AS_THE_PAPER if estimator else {"phase": PHASE},
                )
            )
            for test, span in {
                "validation": SPANS["judged"],
                "tyre_a": SPANS["a"],
                "tyre_d": SPANS["d"],
            }.items():
                pieces = sequences([span], lambda span: recordings[span.recording], PROTOCOL)
                cut = [recordings[span.recording].cut(piece.start, piece.stop) for piece in pieces]
                states = [reference_state(recordings[span.recording], piece) for piece in pieces]
                estimates = (
                    estimator.estimate([segment.without_references() for segment in cut], states)
                    if estimator
                    else [constant(segment) for segment in cut]
                )
                for position, estimate in enumerate(estimates):
                    write_estimate(estimate, home / test / f"{position}.parquet")
                scored = score_all(
                    estimates.__getitem__, [span], lambda span: recordings[span.recording], PROTOCOL
                )
                figures = accuracy(scored) | {"n_parameters": 100, "epochs": 4, "n_sequences": 3}
                rows += metric_rows(models[-1], test, figures)
            if estimator:
                save_model(estimator, home)
                pd.DataFrame(
                    {"metric": ["skipped_steps", "best_epoch"], "value": [1.0, 2.0]}
                ).to_csv(home / "fit.csv", index=False)
                history = pd.DataFrame(
                    {
                        "phase": [0.0, 1.0, 1.0],
                        "epoch": [1, 1, 2],
                        "train_loss": 1.0,
                        "validation_loss": 1.0,
                    }
                )
                history.to_csv(home / "history.csv", index=False)
    facts = ["Recordings are made", "learned_ukf: through_filter"]
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
        facts=facts,
    )


def constant(segment):
    """An estimate without covariance that stays at the start."""
    channels = {
        name: np.full(len(segment), segment[f"{name}_ref"][0]) for name in ("vx", "vy", "yaw_rate")
    }
    return Estimate(
        segment.id,
        "velocity_gru",
        100.0,
        segment.start_time,
        {**channels, "sideslip": channels["vy"] / channels["vx"]},
    )


def model(part, candidate, seed=0):
    return models_by_candidate(part)[candidate][seed]


@pytest.mark.parametrize(
    ("settings", "candidate"),
    [({"dynamics": "pacejka", "noise": "constant", "through_filter": False}, "PC")]
    + [({"dynamics": "residual", "noise": "constant", "through_filter": False}, "PCR")]
    + [({"dynamics": "neural", "noise": "constant"}, "NN_U")]
    + [(settings, candidate) for candidate, settings in CANDIDATES.items()],
)
def test_candidates_have_the_papers_names(settings, candidate):
    estimator = LearnedUkf(LearnedUkf.settings_type(width=4, **settings))
    assert (
        candidate_of(
            EvaluatedModel(
                "learned_ukf", estimator.variant, estimator.full_title, 0, Path(), Path()
            )
        )
        == candidate
    )


def test_candidates_keep_their_names_and_studies_without_test_sets_are_refused(part):
    twice = replace(part, models=[part.models[0], part.models[0]])
    assert "NNT was trained twice with one seed" in refusal(lambda: models_by_candidate(twice))
    (name,) = models_by_candidate(only(part, "NNTF_UH", {"one_step": {**PHASE, "max_epochs": 0}}))
    assert name == "NNTF_UH from scratch"
    assert (
        candidate_of(EvaluatedModel("learned_ukf", "pc_curved", "", 0, Path(), Path()))
        == "PC with E"
    )
    metrics = part.metrics[
        ~((part.metrics["metric"] == "mae_weighted") & (part.metrics["seed"] == 1))
    ]
    assert "seed1 has no mae_weighted.tyre_a; evaluate it again" in refusal(
        lambda: runs_of(replace(part, metrics=metrics))
    )
    assert "needs the part 'real'" in refusal(lambda: documents(study_of("s")))
    wet_part = replace(
        part, split=Split("s", SPLIT.train, SPLIT.validation, {"wet": SPLIT.tests["tyre_a"]})
    )
    assert "must be called tyre_a and tyre_d" in refusal(
        lambda: documents(study_of("s", {"real": wet_part}))
    )


def test_report_has_every_table_and_figure_of_the_paper_and_names_its_data(
    part, tmp_path, monkeypatch
):
    undrawn(monkeypatch)
    titles = {
        "real": "Tyre sets",
        "curvature": "Curved tyres",
        "likelihood": "With likelihood",
    }
    parts = {
        "real": part,
        **{f"length_{steps}": of_length(part, steps) for steps in (50, 100)},
        "likelihood": part,
        "half_1": cut_training(part, HALF_OF_TRAINING),
    }
    untrained = {"one_step": {**PHASE, "max_epochs": 0}}
    parts |= {"scratch": only(part, "NNTF_UH", untrained), "diagonal": only(part, "NNTF_UH")}
    remark = "part 'real' does not use what the search 'trial_gru' chose"
    artefacts = study_of(
        "learned_ukf",
        parts,
        titles=titles,
        absent=["curvature"],
        trials=gru_trials(),
        search_remarks=[remark],
    )
    document = documents(artefacts)["report"]
    write_document(document, tmp_path, page=False)
    text = (tmp_path / "report.md").read_text()
    assert figures_of(document).keys() == {
        *(f"figure_{number}_real" for number in (3, 4, 5, 6)),
        "figure_7",
        "friction_real",
        "loss_curves",
    }
    tables = tables_of(document)
    assert tables.keys() >= {
        "decided_claims",
        "overview",
        *(f"{name}_real" for name in ("consistency", "friction", "start", "coverage")),
        "minutes_of_data",
    }
    files = {"claims", "budgets_real", "sequence_length", "data"}
    files |= {f"{name}_real" for name in ("table_1", "table_2", "by_state", "budget")}
    assert set(document.data) >= files
    claims = document.data["claims"].set_index("id")
    decided = tables["decided_claims"]
    assert set(decided["verdict"]) <= set(DECIDED)
    assert len(decided) == claims["verdict"].isin(DECIDED).sum()
    content = claims_of("learned_ukf")
    assert set(claims.index) == {claim.id for claim in content.claims}
    assert set(claims["verdict"]) <= set(VERDICTS)
    assert claims.loc["nntf_uh_below_gru_tyre_a", "data"] == "simulated, tyre_a"
    assert claims.loc["nntf_uh_below_gru_tyre_a", "verdict"] != "not assessed"
    for measured in (
        "from_scratch_in_local_minima",
        "friction_settles_within_2_s",
        "friction_agrees_within_a_deviation_in_2_s",
        "friction_ends_near_nominal",
        "nnt_becomes_unstable",
    ):
        assert claims.loc[measured, "verdict"] != "not assessed"
    assert claims.loc["nntf_below_pc_tyre_a", "verdict"] == "not assessed"
    assert "no per-block errors of PC" in claims.loc["nntf_below_pc_tyre_a", "why"]
    template = (Path(documents.__code__.co_filename).parent / "report.md.j2").read_text()
    row = "| the authors' public code, NNTF_UH | 0.0158 | 0.0441 | 1 |"
    assert row in first_screen(text, template)
    assert "Not complete" not in text
    assert set(document.data) >= {
        f"{name}_real" for name in ("slip_density", "traces", "figure_5", "figure_6")
    }
    assert "SIMULATED data, A car" in text
    assert "Not in this report, since the recordings are missing: Curved tyres" in text
    assert "learned_ukf: through_filter" not in text
    assert "Recordings are made" in text
    assert f"P{remark[1:]}." in text
    blocks = document.data["blocks"]
    assert blocks.columns.tolist() == list(BlockRow.__dataclass_fields__)
    answer = text[text.index("**Answer.**") : text.index("**Recommendation.**")]
    errors = blocks[(blocks["part"] == "real") & (blocks["metric"] == "mse_weighted")]
    mse = errors.groupby(["candidate", "test_set"])["value"].mean()
    for rival, test in product(("GRU", "NNTF"), ("tyre_a", "tyre_d")):
        assert f" {mse['NNTF_UH', test] / mse[rival, test]:.2f} [" in answer, (rival, test)
    assert not blocks.duplicated(["part", "candidate", "seed", "test_set", "metric", "block"]).any()
    keys = ["candidate", "seed", "metric"]
    ours = blocks[(blocks["part"] == "real") & (blocks["test_set"] == "tyre_a")]
    ours = ours.groupby(keys)[["value", "size"]].sum()
    values = metric_values(part)
    for candidate, models in models_by_candidate(part).items():
        for model in models:
            for metric, power in (("mse_weighted", 1.0), ("rmse_vy", 0.5), ("rmse_sideslip", 0.5)):
                value, size = ours.loc[(candidate, model.seed, metric)]
                figure = values[model.estimator, model.variant, model.seed, "tyre_a", metric]
                assert (value / size) ** power == pytest.approx(figure, rel=1e-9)
    swaps = document.data["figure_6_real"].set_index(["test_set", "seed", "predicts", "observes"])[
        "mse"
    ]
    value, size = ours.loc[("NNTF_U predicting, NNTF observing", 1, "mse_weighted")]
    assert value / size == pytest.approx(swaps["tyre_a", 1, "NNTF_U", "NNTF"])
    assert size == ours.loc[("NNTF", 1, "mse_weighted"), "size"]
    single_step = document.data["figure_5_real"].set_index(["test_set", "seed", "task", "state"])
    value, size = ours.loc[("NNTF", 0, "one_step_rmse_wheel_speed")]
    assert value / size == pytest.approx(
        single_step.loc[("tyre_a", 0, "one_step", "rim_speed"), "before"]
    )
    measured = blocks[blocks["metric"] == "friction_settles_within_2_s"]
    assert (measured["size"] == 1).all()
    assert len(measured) == 6, "two seeds, three sequences"
    training = document.data["training"].set_index("candidate")
    assert training.loc["NNTF_UH", "epochs"] == "1000 + 1000"
    assert training.loc["NNTF_UH", "epochs_paper"] == "1000 + 1000"
    assert training.loc["NNTF", "epochs"] == "1000 + 1000 for the noise"
    assert training.loc["static_map", "training"] == "not applicable"
    trials = document.data["trials"]
    assert trials[["candidate", "step_size", "chosen"]].values.tolist() == [
        ["GRU", 0.001, ""],
        ["GRU", 0.002, "chosen"],
    ]


def gru_trials():
    """Two trials of a search, the better one second by its step size."""
    return [
        Trial(
            search="trial_gru",
            name=f"trial_gru_{number}",
            options=f"training.phase.learning_rate={rate}",
            estimator="velocity_gru",
            variant="velocity_gru",
            title="GRU",
            seed=9,
            training={"phase": {"learning_rate": rate}, "batch_size": 6},
            metric="mse_weighted",
            validation=error,
            origin="",
            evaluation="",
            chosen=error == 0.01,
        )
        for number, (rate, error) in enumerate(((0.002, 0.01), (0.001, 0.02)), start=1)
    ]


def only(part, candidate, training=None):
    """The part with one candidate, trained in another way."""
    retrained = [
        replace(model, training={**model.training, **(training or {})})
        for model in models_by_candidate(part)[candidate]
    ]
    return replace(part, models=retrained)


def cut_training(part, stop):
    """NNTF_UH of the part, as if trained on its training data up to a time [s]."""
    (span,) = part.split.train
    cut = replace(span, stop=stop)
    return replace(only(part, "NNTF_UH"), split=replace(part.split, train=(cut,)))


def test_errors_are_extrapolated_from_three_amounts_of_training_data_on(part):
    parts = {"real": part, "half_1": cut_training(part, HALF_OF_TRAINING)}
    parts |= {"quarter_1": cut_training(part, HALF_OF_TRAINING / 2.0)}
    blocks = blocks_of(block_errors.error_rows(parts))
    two, three = (
        data_table({name: parts[name] for name in names}, blocks, "X").frame
        for names in (("real", "half_1"), ("real", "half_1", "quarter_1"))
    )
    assert two["seed"].tolist() == ["0", "1", "0", "1"]
    assert three["seed"].tolist() == ["0", "1", "0", "1", "0", "1", "extrapolated"]
    assert three["minutes"].is_monotonic_increasing


def test_errors_extrapolate_along_a_power_law_with_the_interval_of_regression():
    minutes = np.array([0.5, 0.5, 1.0, 1.0, 1.9, 1.9])
    exact = extrapolated(minutes, 0.02 * minutes**-0.5, 7.3)
    assert exact.value == pytest.approx(0.02 * 7.3**-0.5)
    assert exact.high == pytest.approx(exact.low)
    errors = 0.02 * minutes**-0.5 * np.exp([0.1, -0.2, 0.05, 0.1, -0.1, 0.05])
    design = np.column_stack([np.ones(6), np.log(minutes)])
    inverse = np.linalg.inv(design.T @ design)
    line = inverse @ design.T @ np.log(errors)
    variance = np.square(np.log(errors) - design @ line).sum() / 4.0
    place = np.array([1.0, math.log(7.3)])
    half = 2.7764451 * math.sqrt(variance * place @ inverse @ place)  # t, 4 degrees of freedom
    figure = extrapolated(minutes, errors, 7.3)
    assert math.log(figure.value) == pytest.approx(place @ line)
    assert math.log(figure.high) == pytest.approx(place @ line + half)
    assert math.log(figure.low) == pytest.approx(place @ line - half)


def of_length(part, steps):
    return only(part, "NNTF_U", {"steps": steps, "batch_size": 2})


@pytest.mark.parametrize("candidate", ["NNT", "NNTF_U", "NNTF_UH", "NNTF_UH*"])
def test_filters_that_run_again_reproduce_the_evaluated_estimates(part, candidate):
    estimator = loaded(model(part, candidate))
    means = filtered(estimator, drives_of(part, estimator, "tyre_d")).steps.filtered.mean
    stored = read_estimate(model(part, candidate).evaluation_folder / "tyre_d" / "1.parquet")
    assert means.shape == (3, 100, 5)
    np.testing.assert_allclose(means[1, :, 1], stored["vy"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(means[1, :, 4], stored["friction"], rtol=0, atol=1e-6)


def test_swapping_a_model_for_itself_changes_nothing_and_for_another_both_halves(part):
    first, second = (loaded(model(part, "NNTF", seed)) for seed in (0, 1))
    drives = drives_of(part, first, "tyre_a")

    def means(result):
        return result.steps.filtered.mean

    unswapped = means(filtered(first, drives))
    assert torch.equal(means(swapped(first, first, drives)), unswapped)
    assert not torch.allclose(means(swapped(first, second, drives)), unswapped)
    assert not torch.allclose(
        means(swapped(second, first, drives)), means(filtered(second, drives))
    )


def test_lost_definiteness_is_counted_without_repair_and_repaired_with_it(part):
    estimator = loaded(model(part, "NNTF"))
    drives = drives_of(part, estimator, "tyre_a")
    assert lost_sequences(estimator, drives).tolist() == [False] * 3
    estimator.filter.initial_covariance = lambda: -torch.eye(5)
    assert lost_sequences(estimator, drives).tolist() == [True] * 3
    repaired = filtered(estimator, drives).repaired
    assert repaired.numel() == 300
    assert int(repaired.sum()) >= 3
    assert estimator.filter.repair


def test_single_step_error_of_a_model_on_its_simulated_motion_is_zero(part):
    estimator = loaded(model(part, "NNTF_U"))
    inputs = torch.tensor([[0.1, 10.0]], dtype=torch.float64).expand(6, 2)
    states = [torch.tensor([2.5, 0.1, 0.5, 2.6, 0.6], dtype=torch.float64)]
    with torch.no_grad():
        for k in range(5):
            states.append(estimator.filter.moved(states[-1][None], inputs[k : k + 1])[0])
    drives = Drive(torch.stack(states)[None], inputs[None], torch.zeros(1, 6, 4))
    assert one_step_squares(estimator, drives).max() == 0.0
    drives.states[0, -1, 1] += 0.5
    np.testing.assert_allclose(
        one_step_squares(estimator, drives), [[0.0, 0.05, 0.0, 0.0]], rtol=1e-5
    )


def test_validation_chooses_the_seed_and_tests_do_not(part):
    runs = runs_of(part)
    column = runs["candidate"] == "NNTF"
    runs.loc[column, "mse_weighted.validation"] = [2.0, 1.0]
    runs.loc[column, "mse_weighted.tyre_d"] = [0.1, 9.0]
    assert chosen(part, runs, "NNTF").seed == 1


def planted_blocks(test, **losses):
    """Weighted losses of candidates in sequences of 10 samples."""
    blocks = {}
    for name, sums in losses.items():
        sums = np.asarray(sums, dtype=float)
        names = [tuple(map(str, range(count))) for count in sums.shape]
        for metric in ("mse_weighted", "mae_weighted", "ae99_weighted"):
            errors = BlockErrors(names[0], names[1], 10.0 * sums, np.full(sums.shape[1], 10.0))
            blocks[Key("real", name, test, metric)] = errors
    return blocks


def test_tables_show_means_with_intervals_and_the_papers_figures():
    generator = np.random.default_rng(0)
    values = generator.uniform(1.0, 3.0, 12) * generator.uniform(0.9, 1.1, (3, 12))
    blocks = planted_blocks("tyre_a", NNTF_UH=values, zero=[np.full(12, 5.0)])
    frame = tables.accuracy(blocks, "real", "tyre_a").set_index("candidate")
    row = frame.loc["NNTF_UH"]
    assert (row["paper_mse"], row["n_seeds"]) == (0.0063, 3)
    assert row["mse_low"] < row["mse"] < row["mse_high"]
    assert row["mse"] == pytest.approx(values.mean())
    assert math.isnan(frame.loc["zero", "paper_mse"])


def tracks(mean, deviation=0.1):
    """Friction of one seed on one sequence, at 10 Hz."""
    mean = np.asarray(mean, dtype=float)[None, None]
    return friction.Tracks(mean, np.full(mean.shape, deviation), 10.0)


def test_starts_agree_as_soon_as_all_of_them_stay_within_the_limit():
    by_start = {
        0.3: tracks([0.3, 0.40, 0.45, 0.47, 0.5, 0.5]),
        0.6: tracks([0.6, 0.52, 0.50, 0.50, 0.5, 0.5]),
        0.9: tracks([0.9, 0.50, 0.52, 0.51, 0.5, 0.5]),
    }
    assert measures.agreement_times(by_start) == pytest.approx(np.array([[0.3]]))
    assert measures.agreement_times_in_deviations(by_start) == pytest.approx(np.array([[0.2]]))
    assert measures.final_deviations(by_start[0.3], 0.45) == pytest.approx(
        np.array([[abs(np.mean([0.3, 0.40, 0.45, 0.47, 0.5, 0.5]) - 0.45)]])
    )
    covered = tracks([0.9, 0.40, 0.50, 0.60, 0.44], deviation=0.1).covered(0.45, 0.1)
    assert covered == pytest.approx(np.array([[0.75]])), "three of the four after 0.1 s"
    persistent_tracks = {0.3: tracks([0.3] * 4), 0.6: tracks([0.6] * 4), 0.9: tracks([0.9] * 4)}
    assert measures.agreement_times(persistent_tracks) == pytest.approx(np.array([[0.4]])), "never"


def test_rise_is_compared_with_the_smallest_rise_without_friction():
    without = dict.fromkeys(measures.WITHOUT_FRICTION)
    trained = {name: [[1.0, 3.0]] for name in without} | {"NNTF_UH": [[1.0, 1.0], [2.0, 2.0]]}
    unseen = {name: [[9.0, 9.0, 9.0]] for name in without}
    unseen |= {"GRU": [[4.0, 5.0, 6.0]], "NNTF_UH": [[2.0, 1.0, 3.0], [3.0, 3.0, 3.0]]}
    blocks = planted_blocks("tyre_a", **trained) | planted_blocks("tyre_d", **unseen)
    values = measures.rise_over_least_rise_of_others(blocks, "real")
    assert values.mean() == pytest.approx(1.0 / 3.0)
    rises = np.array([[1.0, 0.0, 2.0], [1.0, 1.0, 1.0]])
    smallest_rises = np.array([2.0, 3.0, 4.0])
    np.testing.assert_allclose(values, 1.0 / 3.0 + (rises - smallest_rises / 3.0) / 3.0)
    del blocks[Key("real", "LSTM", "tyre_d", "mse_weighted")]
    assert measures.rise_over_least_rise_of_others(blocks, "real") is None


def test_validation_from_scratch_is_compared_with_the_worst_pre_trained_seed():
    pre_trained = np.array([[1.0, 1.0], [2.0, 4.0]])
    scratch = np.array([[6.0, 6.0], [3.0, 0.0]])
    values = measures.validation_over_worst_pre_trained(scratch, pre_trained)
    np.testing.assert_allclose(values.mean(axis=1), [2.0, 0.5])
    np.testing.assert_allclose(values[0], 2.0 + np.array([6.0 - 4.0, 6.0 - 8.0]) / 3.0)


def report_text(artefacts, folder):
    """Markdown of the study's report, in one line, which is written with its tables."""
    write_document(documents(artefacts)["report"], folder, page=False)
    return " ".join((folder / "report.md").read_text().split())


def test_report_counts_the_seeds_of_a_candidate_beside_the_main_part(part, tmp_path, monkeypatch):
    undrawn(monkeypatch)
    parts = {
        "real": only(part, "NNTF_UH"),
        "scratch": only(part, "NNTF_UH", {"one_step": {**PHASE, "max_epochs": 0}}),
    }
    not_trained = {"scratch": ["learned_ukf-nntf_uh-seed2"]}
    text = report_text(study_of("learned_ukf", parts, not_trained=not_trained), tmp_path)
    assert "where fewer than planned: NNTF_UH from scratch 2 of 3." in text


def test_report_is_drawn_with_a_single_candidate(part, tmp_path, monkeypatch):
    undrawn(monkeypatch)
    not_trained = {
        "real": [
            "learned_ukf-nntf_uh-seed0",
            "learned_ukf-nntf_u-seed1",
            "velocity_gru-states_64-seed2",
        ],
        "scratch": ["learned_ukf-nntf_uh-seed0"],
        "length_250": ["learned_ukf-nntf_u-seed0"],
        "doubled": ["learned_ukf-pc-seed0"],
    }
    parts = {"real": only(part, "GRU")}
    titles = dict.fromkeys(not_trained, "T")
    artefacts = study_of("learned_ukf", parts, titles=titles, not_trained=not_trained)
    text = report_text(artefacts, tmp_path)
    assert "**Not complete:** 6 planned trainings are not done." in text
    assert "where fewer than planned: GRU 2 of 3." in text
    assert (
        "not assessed: NNTF_UH; NNTF_U; NNTF_UH from scratch; NNTF_U, 250 steps, constant" in text
    )
    assert "3 parts of the pipeline have no training." in text
    claims = pd.read_csv(tmp_path / "tables" / "claims.csv").set_index("id")
    assert set(claims["verdict"]) == {"not assessed", "not testable"}
    assert claims.loc["nntf_uh_below_gru_tyre_a", "why"] == "NNTF_UH is not trained"
    assert claims.loc["nntf_uh_below_nntf_u_tyre_a", "why"] == "NNTF_UH and NNTF_U are not trained"
    blocks = pd.read_csv(tmp_path / "tables" / "blocks.csv")
    assert set(blocks["candidate"]) == {"GRU"}
    trained = read_training(tmp_path / "tables" / "training.csv")
    assert (trained["GRU"].state, trained["GRU"].seeds_planned) == ("not checked", 3)
    assert (trained["NNTF_UH"].state, trained["NNTF_UH"].seeds_planned) == ("not trained", 1)
    assert trained["zero"].state == "not applicable"
    assert "PC" not in trained, "twice the epochs are no candidate"


@pytest.mark.parametrize("name", ["learned_ukf", "cnn_ukf"])
def test_every_measure_that_the_claims_name_exists(name):
    for claim in claims_of(name).claims:
        if claim.measure is not None:
            module, _, function = claim.measure.partition(":")
            assert callable(getattr(importlib.import_module(module), function))


def test_baselines_take_their_other_velocities_from_measured_channels(part, tmp_path):
    gru_model = model(part, "GRU")
    for test in ("tyre_a",):
        for position in range(3):
            estimate = gru_model.estimate(test, position)
            channels = {
                "vy": np.zeros(len(estimate.channels["vy"])),
                "sideslip": np.zeros(len(estimate.channels["vy"])),
            }
            write_estimate(
                replace(estimate, channels=channels), tmp_path / test / f"{position}.parquet"
            )
    zero = EvaluatedModel("zero", "zero", "Zero", 0, tmp_path, tmp_path, {})
    scored = scored_of(part, zero, "tyre_a")
    reference = recording("a", seed=2)
    expected = reference["yaw_rate"][20:100] - reference["yaw_rate_ref"][20:100]
    np.testing.assert_allclose(scored[0].errors["yaw_rate"], expected, atol=1e-12)
    assert not scored[0].errors["vx"].any(), "the measured speed of the test is the true one"


def test_lengths_and_samples_are_those_of_trainings_through_the_filter(part):
    single_part = replace(part, models=[model(part, "NNTF_U")])
    (row,) = lengths({"length_500": single_part})
    assert (row.steps, row.epochs) == (500, 1000)
    (row,) = lengths({"length_50": of_length(part, 50)})
    assert (row.sequences, row.batches) == (6, 3), "a drive of 3.2 s"
    assert "was not trained through the filter" in refusal(
        lambda: lengths({"length_500": replace(part, models=[model(part, "GRU")])})
    )
    training = {
        "one_step": {**PHASE, "max_epochs": 10},
        "through": {**PHASE, "max_epochs": 3},
        "steps": 50,
    }
    single_part = only(part, "NNTF_UH", training)
    assert samples_trained_on(single_part, single_part.models[0]) == 10 * 319 + 3 * 300
    assert validation_losses(single_part, single_part.models).shape == (2,)
    alone = only(part, "NNTF", {**training, "noise": {**PHASE, "max_epochs": 5}})
    assert samples_trained_on(alone, alone.models[0]) == 10 * 319 + 5 * 300


def test_published_figures_agree_with_text_and_friction_and_slip_with_a_calculation():
    for name, gain in (("mse", 17), ("mae", 6), ("ae99", 33)):
        ours, gru = (
            paper.published("tyre_a", candidate, f"{name}_weighted")
            for candidate in ("NNTF_UH", "GRU")
        )
        assert round(100 * (1 - ours / gru)) == gain
    order = ["PC", "LSTM", "GRU", "NN_U", "NN", "PCR", "NNTF", "NNTF_U", "NNTF_UH", "NNTF_UH*"]
    errors = [paper.published("tyre_d", candidate, "mse_weighted") for candidate in order]
    assert errors == sorted(errors, reverse=True)
    outside = np.array([[True, True, False, True, False, False], [False] * 6, [False] * 5 + [True]])
    np.testing.assert_allclose(friction.settled(outside, 10.0), [0.4, 0.0, 0.6])
    states = {
        "vx_ref": [1.0, 1.0, 0.1],
        "vy_ref": [1.0, 0.0, 1.0],
        "yaw_rate_ref": [0.0, 10.0, 0.0],
    }
    slipping = Recording(
        "r", "car", 100.0, 0.0, {name: np.array(values) for name, values in states.items()}, "real"
    )
    np.testing.assert_allclose(rear_slip([slipping], 0.1), [45.0, -45.0])
    assert hardest([[np.array([1.0]), np.array([5.0])], [np.array([9.0]), np.array([2.0])]]) == 0


def test_published_report_counts_the_seeds_of_the_filters_and_not_of_single_steps():
    errors = pd.read_csv(RESULTS / "learned_ukf" / "tables" / "blocks.csv")
    errors = errors[(errors["part"] == "real") & (errors["metric"] == "mse_weighted")]
    n_seeds = errors.groupby("candidate")["seed"].nunique()
    text = (RESULTS / "learned_ukf" / "report.md").read_text(encoding="utf-8")
    table = text.split("| method | tyre A | tyre D | seeds |\n")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    counted = {row[0]: int(row[3]) for row in rows[1:] if row[0] in n_seeds}
    assert "NNTF" in counted
    assert counted == {name: n_seeds[name] for name in counted}


def test_losses_of_a_sequence_are_those_of_a_hand_calculation():
    rate = np.array([0.1, 0.3])
    other_states = {
        "vx": (np.array([1.0, 3.0]), np.array([1.0, 1.0])),
        "yaw_rate": (rate, rate - 0.1),
    }
    scored = Scored(
        time=np.array([0.0, 0.01]),
        vy=np.array([0.5, 0.0]),
        vy_ref=np.zeros(2),
        sideslip=np.radians([2.0, 179.0]),
        sideslip_ref=np.radians([0.0, -179.0]),
        ay=np.zeros(2),
        is_sideslip_scored=np.array([False, True]),
        other_states=other_states,
    )
    losses = {name: (value, size) for name, value, size in block_errors.losses_of(scored)}
    weighted = 0.2225 * 4.0 + 0.5064 * 0.25 + 0.1566 * 0.02
    assert losses["mse_weighted"] == pytest.approx((weighted, 2))
    assert losses["mae_weighted"] == pytest.approx((0.2225 * 2 + 0.5064 * 0.5 + 0.1566 * 0.2, 2))
    first, second = 0.5064 * 0.5 + 0.1566 * 0.1, 0.2225 * 2.0 + 0.1566 * 0.1
    assert losses["ae99_weighted"] == pytest.approx((2 * (first + 0.99 * (second - first)), 2))
    assert losses["rmse_vy"] == pytest.approx((0.25, 2))
    assert losses["rmse_vx"] == pytest.approx((4.0, 2))
    assert losses["rmse_sideslip"] == pytest.approx((4.0, 1)), "2 degrees, across the half turn"


@pytest.mark.parametrize(
    ("doubled", "state", "words"),
    [
        ({0: 0.97, 1: 1.94}, "sufficient", "by -3.0 %, 2 seeds"),
        ({0: 0.9, 1: 1.8}, "insufficient", "by -10.0 %, 2 seeds"),
        ({1: 2.2}, "sufficient", "by +10.0 %, 1 seed"),
        ({}, "not checked", "not trained with twice the epochs"),
    ],
)
def test_a_training_suffices_if_twice_the_epochs_improve_it_by_3_percent_at_most(
    doubled, state, words
):
    row = checked_training("GRU", "1000", "not stated", {0: 1.0, 1: 2.0, 2: 9.0}, doubled)
    assert (row.training, row.reason.endswith(words)) == (state, True)


def test_parts_and_candidates_have_the_names_of_the_claims():
    assert block_errors.part_name("tyre_a_fold_3") == "tyre_a_folds"
    assert block_errors.part_name("real") == "real"
    named = {
        ("length_500", "NNTF_U"): "NNTF_U, 500 steps",
        ("length_125", "NNTF_U"): "NNTF_U, 125 steps, constant batch",
        ("length_125_samples", "NNTF_U"): "NNTF_U, 125 steps, constant samples",
        ("real", "static map"): "static_map",
        ("real", "NNTF_U"): "NNTF_U",
    }
    assert {key: block_errors.candidate_name(*key) for key in named} == named


def test_twice_the_epochs_check_the_main_part_and_folds_form_a_single_part(part):
    def with_validation(factor):
        metrics = part.metrics.copy()
        rows = (metrics["test_set"] == VALIDATION) & (metrics["metric"] == "mse_weighted")
        metrics.loc[rows, "value"] *= factor
        return replace(part, metrics=metrics)

    parts = {"real": part, "doubled": only(with_validation(0.8), "NNTF_UH")}
    rows = {row.candidate: row for row in block_errors.training_rows(parts, "real", {})}
    assert rows["NNTF_UH"].training == "insufficient"
    assert "-20.0 %, 2 seeds" in rows["NNTF_UH"].reason
    assert rows["NNTF_UH*"].training == "insufficient", "the same networks"
    assert rows["NNT"].training == "not checked"
    moved = replace(part, split=replace(part.split, tests={"tyre_a": SPLIT.tests["tyre_d"]}))
    folds = {
        f"tyre_a_fold_{fold}": replace(fold_part, models=[model(part, "GRU")])
        for fold, fold_part in ((1, part), (2, moved))
    }
    fold_rows = block_errors.error_rows(folds)
    vy = [row for row in fold_rows if row.metric == "rmse_vy" and row.test_set == "tyre_a"]
    assert {row.part for row in vy} == {"tyre_a_folds"}
    assert [row.block for row in vy] == [f"{name} {k}.00 s" for name in "ad" for k in range(3)]


def test_order_of_retrained_methods_is_compared_with_the_published_order(tmp_path):
    published = tmp_path / "overview.csv"
    rows = ["candidate,ours_tyre_a,ours_tyre_d", "NNTF_UH,0.009,0.018", "PC,0.03,0.06"]
    published.write_text("\n".join([*rows, "zero,0.12,0.14"]) + "\n", encoding="utf-8")
    trained = [
        {"candidate": "NNTF_UH", "ours_tyre_a": 0.04, "ours_tyre_d": 0.05},
        {"candidate": "PC", "ours_tyre_a": 0.035, "ours_tyre_d": 0.07},
        {"candidate": "GRU", "ours_tyre_a": 0.01, "ours_tyre_d": 0.09},
    ]
    first, second = order_lines(trained, published)
    assert first.startswith("tyre A: GRU 0.0100 < PC 0.0350 < NNTF_UH 0.0400; another order of")
    assert "another order of NNTF_UH and PC as in" in first
    assert second.startswith("tyre D: NNTF_UH 0.0500 < PC 0.0700 < GRU 0.0900; same order")
    assert second.endswith("; not published: GRU")
