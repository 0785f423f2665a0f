"""What describes something, and is damaged, hostile or of another version, is one line.

And no name in it leads out of the output root.
"""

import json
import sys
import tempfile
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal
from safetensors.numpy import load_file, save_file
from safetensors.torch import save_file as save_tensors

from vehest.artefacts.artefact import StagePlan, find, make, read_artefact
from vehest.configuration.composition import Root, compose_config
from vehest.data.errors import ConfigurationError, MissingError, VehestError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.schema import check_format, validated
from vehest.data.store import (
    is_stored_recording,
    read_estimate,
    read_recording,
    write_estimate,
    write_recording,
)
from vehest.data.text_files import read_rows
from vehest.data.transforms import Preparation
from vehest.estimators.model_files import Description, load_model, read_description, save_model
from vehest.estimators.registry import estimator_class
from vehest.inference.models import preparation_of
from vehest.run.console import Messages
from vehest.run.downsample import write_downsample
from vehest.run.evaluate import protocol_from_config
from vehest.run.ingest import recording_file
from vehest.run.publishing import PROVENANCE, Publication, Published, publish_study, published_in
from vehest.run.study import read_study
from vehest.run.train import learnt_spans, read_fit_metrics, trained_rate
from vehest.studies.artefacts import read_frame
from vehest.training.checkpoints import Checkpoint, load_checkpoint, resume_epoch, save_checkpoint

HOSTILE = [
    "../../../evil",
    "/tmp/evil",
    "..",
    "a/b",
    "a\\b",
    "a\0b",
    "",
    ".hidden",
    "x" * 300,
    "ä" * 200,
    "a\nb",
]


def changed(content, /, **changes):
    return {key: value for key, value in {**content, **changes}.items() if value is not ...}


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    estimator = estimator_class("ksnn").from_config({})
    estimator.load_weights(
        {name: np.full_like(values, 0.5) for name, values in estimator.weights().items()}
    )
    save_model(
        estimator,
        folder,
        {
            "seed": 3,
            "datasets": ["d"],
            "downsample": {"method": "decimate", "transforms": []},
            "step": "any",
        },
    )
    return folder


def test_model_is_read_with_its_types_and_finite_numbers(model, tmp_path):
    described = read_description(model)
    assert isinstance(described, Description)
    assert (described.estimator, described.about.seed, described.about.datasets) == (
        "ksnn",
        3,
        ("d",),
    )
    assert (preparation_of(model), load_model(model).name) == (
        {"method": "decimate", "transforms": []},
        "ksnn",
    )
    weights = load_file(model / "model.safetensors")
    name = max(weights, key=lambda tensor: weights[tensor].size)
    weights[name].flat[:2] = [np.nan, np.inf]
    save_file(weights, model / "model.safetensors")
    message = (
        f"model.safetensors': 2 of the {weights[name].size} numbers of tensor '{name}' are not "
        f"finite"
    )
    assert message in refusal(lambda: load_model(model))
    estimator = estimator_class("kalman").from_config({})
    save_model(estimator, tmp_path)
    load_model(tmp_path)
    save_file(
        {name: np.array([np.inf]) for name in estimator.weights()}, tmp_path / "model.safetensors"
    )
    assert "1 of the 1 numbers of tensor" in refusal(lambda: load_model(tmp_path))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"format": 2}, "written by a newer vehest (format 2, this one knows 1)"),
        ({"format": 0}, "written by an older vehest (format 0"),
        ({"estimator": "os"}, "estimator 'os' is not one of"),
        ({"estimator": "vehest.estimators.ksnn"}, "is not one of"),
        ({"settings": {"window": "30"}}, "settings.window must be a whole number, not '30'"),
        ({"settings": {"rate_hz": float("nan")}}, "settings.rate_hz must be a number, not nan"),
        (
            {"settings": {"n_local": 10**9}},
            "settings.n_local is 1e+09, and model.safetensors holds",
        ),
        ({"settings": {"n_local": 4000}}, "which do not fit its settings"),
        (
            {"about": {"downsample": {"method": "magic"}}},
            "about.downsample.method 'magic' is not one of: polyphase, decimate",
        ),
        (
            {"about": {"downsample": {"transforms": [{"name": "low_pass"}]}}},
            "transform 'low_pass': cutoff_hz is missing",
        ),
        ({"evil": 1}, "unknown key 'evil'"),
        *(
            (text, "model.yaml")
            for text in (b"[]", b"3", b"null", b"2026-01-01", b"a: &a [*a]", b"{" * 100, b"\xff")
        ),
        (b"a: !!python/object:os {}", "model.yaml"),
    ],
    ids=str,
)
def test_invalid_descriptions_are_a_single_line_with_file_and_key(model, changes, says):
    path = model / "model.yaml"
    text = (
        changes
        if isinstance(changes, bytes)
        else yaml.safe_dump(changed(yaml.safe_load(path.read_text()), **changes)).encode()
    )
    path.write_bytes(text)
    message = refusal(lambda: load_model(model), VehestError)
    assert says in message
    assert "model.yaml" in message or "transform" in says or "fit its settings" in says


def with_header(header, length=None):
    text = json.dumps(header).encode()
    return (length or len(text)).to_bytes(8, "little") + text + bytes(16)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        *((kind, "not one of: F32, F64") for kind in ("f2", "i8", "u1", "?")),
        ("bfloat16", "is of type BF16"),
        (with_header({}, 2**62), ""),
        *(
            (with_header({"a": {"dtype": "F64", "shape": [size], "data_offsets": offsets}}), "")
            for size, offsets in ((10**12, [0, 8 * 10**12]), (-1, [0, 16]), (2, [-16, 0]))
        ),
    ],
)
def test_invalid_weights_are_a_single_line(model, kind, says):
    file = model / "model.safetensors"
    if isinstance(kind, bytes):
        file.write_bytes(kind)
    elif kind == "bfloat16":
        save_tensors({"a": torch.zeros(4, dtype=torch.bfloat16)}, file)
    else:
        save_file({name: values.astype(kind) for name, values in load_file(file).items()}, file)
    message = refusal(lambda: load_model(model))
    assert "model.safetensors" in message
    assert says in message


def plan(output, label="mine"):
    return StagePlan("stage", label, {"a": 1.0}, {"raw": "0"}, "code", output)


def new_artefact(output, label="mine"):
    return make(plan(output, label), lambda folder: (folder / "a.txt").write_text("a") and None)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"format": 2}, "written by a newer vehest"),
        ({"label": 3}, "label must be text"),
        ({"key": ...}, "key is missing"),
        ({"status": "done"}, "status 'done' is not one of: complete, interrupted"),
        ({"outputs": {"a.txt": {"sha256": "0" * 64}}}, "outputs.a.txt.bytes is missing"),
        (
            {"outputs": {"a.txt": {"sha256": "0", "bytes": 2}}},
            "outputs.a.txt.sha256: string should match pattern",
        ),
        ({"outputs": {"a.txt": {"sha256": "0" * 64, "bytes": 2}}}, "is gone or truncated"),
        *[({"outputs": {name: {"sha256": "0" * 64, "bytes": 1}}}, "") for name in HOSTILE],
        *((text, "") for text in ("", "[]", "[" * 100_000, '{"format": 1', "NaN")),
        ("link", "or is a link"),
    ],
)
def test_invalid_manifests_are_a_single_line_and_their_artefact_is_absent(tmp_path, changes, says):
    artefact = new_artefact(tmp_path)
    path = artefact.folder / "manifest.json"
    content = json.loads(path.read_text())
    assert (content["format"], artefact.config) == (1, {"a": 1.0})
    path.write_text(json.dumps(changed(content, format=...)))
    assert read_artefact(artefact.folder).outputs == artefact.outputs, (
        "one without a format is read too"
    )
    if changes == "link":
        path.write_text(json.dumps(content))
        (artefact.folder / "a.txt").rename(tmp_path / "elsewhere")
        (artefact.folder / "a.txt").symlink_to(tmp_path / "elsewhere")
    else:
        path.write_text(
            changes if isinstance(changes, str) else json.dumps(changed(content, **changes))
        )
    assert says in refusal(lambda: read_artefact(artefact.folder))
    assert find(plan(tmp_path)) is None


def test_models_without_ranges_in_their_manifest_are_a_single_line(tmp_path):
    artefact = new_artefact(tmp_path)
    entry = {"dataset": "d", "recording": "r", "start": "-inf", "stop": "late"}
    without_ranges = replace(
        artefact, config={"estimator": {"rate_hz": 20}, "train": [entry], "validation": []}
    )
    assert trained_rate(without_ranges) == 20.0
    for model_artefact in (artefact, without_ranges):
        assert "manifest.json': config describes no training" in refusal(
            lambda model_artefact=model_artefact: learnt_spans(model_artefact)
        )
    model_artefact = plan(tmp_path, "ksnn-linear_bias_p2-seed0-on-ferrari_drive")
    assert (
        model_artefact.folder
        == tmp_path / "stage" / f"{model_artefact.label}-{model_artefact.key[:12]}"
    )
    assert (
        model_artefact.checkpoint_folder
        == tmp_path / "checkpoints" / f"{model_artefact.label}-{model_artefact.key[:12]}"
    )


def recording(name="lap", n=20):
    provenance = {"mass": 1000.0}
    return Recording(
        name, "car", 10.0, 0.0, {"vx": np.ones(n), "vy_ref": np.zeros(n)}, provenance=provenance
    )


def redescribed(path, change):
    table = pq.read_table(path)
    content = change(json.loads(table.schema.metadata[b"vehest"]))
    described = content if isinstance(content, bytes) else json.dumps(content).encode()
    pq.write_table(table.replace_schema_metadata({b"vehest": described}), path)


def refusal_message(path, change, read):
    """How a recording or an estimate is refused whose description was changed."""
    redescribed(path, change)
    message = refusal(lambda: read(path))
    assert str(path) in message
    return message


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"format": 2}, "written by a newer vehest"),
        ({"format": 0}, "written by an older vehest"),
        ({"id": ...}, "id is missing"),
        ({"rate_hz": -1.0}, "the sampling rate must lie between"),
        ({"rate_hz": float("nan")}, "rate_hz must be a number"),
        ({"kind": "dreamt"}, "kind 'dreamt' is not one of"),
        ({"gappy": "vx"}, "gappy"),
        ({"content": "estimate"}, "not a recording that vehest wrote"),
        *((text, "JSON") for text in (b"\xff", b"{")),
        (b"[" * 100_000, ""),
    ],
)
def test_metadata_of_recordings_are_checked(tmp_path, changes, says):
    path = tmp_path / "lap.parquet"
    write_recording(recording(), path)
    for read in (read_recording, is_stored_recording)[: 1 + isinstance(changes, bytes)]:
        assert says in refusal_message(
            path,
            lambda content: changes if isinstance(changes, bytes) else changed(content, **changes),
            read,
        )
        write_recording(recording(), path)
    table = pq.read_table(path)
    pq.write_table(
        table.set_column(0, "vx", [["1"] * 20]).replace_schema_metadata(table.schema.metadata), path
    )
    assert "column 'vx' is there twice, or of type string, not double" in refusal(
        lambda: read_recording(path)
    )


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"n_states": 10**9}, "n_states is 1000000000, and there are 4 columns"),
        ({"n_states": -2}, "n_states is -2"),
        ({"n_states": 3}, "n_states is 3"),
        *(
            ({"covariance_of": case}, "covariance_of name n quantities, not (5, 2, 2) and (vy")
            for case in (["vy"], ["vy", "luck"])
        ),
        ({"mode": "psychic"}, "mode 'psychic' is not one of"),
    ],
)
def test_sizes_of_an_estimate_are_checked_against_its_columns(tmp_path, changes, says):
    path = tmp_path / "estimate.parquet"
    channels = {"vy": np.zeros(5), "sideslip": np.zeros(5)}
    covariance = np.tile(np.eye(2), (5, 1, 1))
    write_estimate(
        Estimate("lap", "kalman", 10.0, 0.0, channels, "causal", covariance, ("vy", "yaw_rate")),
        path,
    )
    assert read_estimate(path).covariance is not None
    assert says in refusal_message(path, lambda content: changed(content, **changes), read_estimate)


def test_damaged_tables_are_a_single_line(tmp_path):
    path = tmp_path / "fit.csv"
    for text in (
        b"metric\n1\n",
        b"metric,value\nepochs,many\n",
        b'metric,value\n"open,1\n',
        b"metric,value\n\xff,1\n",
    ):
        path.write_bytes(text)
        assert ("UTF-8" if b"\xff" in text else "fit.csv") in refusal(
            lambda: read_fit_metrics(tmp_path)
        )
    refusal(lambda: read_fit_metrics(tmp_path / "none"), MissingError)
    for text, says in (
        ("", "cannot be read as CSV"),
        ("a\n1\n", "no column 'value'"),
        ("value\nmany\n", "holds text"),
    ):
        path.write_text(text)
        assert says in refusal(lambda: read_frame(path, ("value",), numbers=("value",)))
    path.write_text("metric,value\nepochs,7\n")
    (tmp_path / "timings.csv").write_text("metric,value\ntrain_seconds,1.5\n")
    assert read_fit_metrics(tmp_path) == {"epochs": 7.0, "train_seconds": 1.5}
    assert read_rows(path)[0] == {"metric": "epochs", "value": "7"}


def test_damaged_checkpoint_counts_as_none(tmp_path):
    for values in ({"epoch": "three"}, {}, {"epoch": 3, "finished": "no"}):
        save_checkpoint(tmp_path, Checkpoint({"a": torch.zeros(2)}, values))
        assert (load_checkpoint(tmp_path), resume_epoch(tmp_path)) == (None, 0)
    save_checkpoint(
        tmp_path,
        Checkpoint({"a": torch.zeros(2)}, {"epoch": 3, "finished": False, "losses": [1.0]}),
    )
    assert resume_epoch(tmp_path) == 3
    assert published_in(tmp_path) is None
    for text in ("[]", "{", '{"kinds": [1]}', "[" * 100_000):
        (tmp_path / PROVENANCE).write_text(text)
        assert str(tmp_path / PROVENANCE) in refusal(lambda: published_in(tmp_path))
    (tmp_path / PROVENANCE).write_text('{"kinds": {"a": "real"}, "parts": ["b"], "command": "x"}')
    assert published_in(tmp_path) == Published(kinds={"a": "real"}, parts=("b",))


@pytest.mark.parametrize("link", ["results", "results/study"])
def test_nothing_is_published_through_a_link(elsewhere, link):
    report = new_artefact(elsewhere / "out")
    Path("target").mkdir()
    Path(link).parent.mkdir(exist_ok=True)
    Path(link).symlink_to(elsewhere / "target")
    with pytest.raises(ConfigurationError, match="through a link"):
        publish_study(Publication("study", {}, {}), report, Messages(quiet=True))
    assert not list(Path("target").iterdir())


PIPELINE = {
    "study": "mine",
    "report": "drive",
    "split": "quickstart",
    "sweeps": [["estimator=luenberger"]],
}
BOMB = "\n".join(
    [
        "a0: &a0 [x, x, x, x, x, x, x, x, x]",
        *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)),
    ]
)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"study": 3}, "study must be text, not 3"),
        ({"study": "../evil"}, "must be made of letters"),
        *(({"report": name}, "there is no study module") for name in ("../../evil", "drive.os")),
        (
            {"sweeps": "estimator=gru"},
            "sweeps must be a list of lists of overrides, not 'estimator=gru'",
        ),
        ({"sweeps": ["estimator=gru"]}, "sweeps.0 must be a list of overrides, not 'est"),
        ({"sweeps": []}, "sweeps must be a list of lists"),
        ({"evaluation": {"rate_hz": [1]}}, "evaluation.rate_hz"),
        ({"title": date(2026, 1, 1)}, "title is no plain value but a date"),
        ({"unknown": 1}, "unknown key 'unknown'"),
        ({"split": ...}, "it needs split and sweeps"),
        ({"report": ...}, "it needs study, report and one of: split and sweeps"),
        *(
            (text, "")
            for text in (
                BOMB.encode(),
                b"[" * 200,
                b"[1, 2",
                b"\xff",
                b"3",
                b"- a",
                b"a: &a {b: *a}",
            )
        ),
    ],
    ids=lambda case: str(case)[:40],
)
def test_invalid_pipelines_are_a_single_line(tmp_path, changes, says):
    path = tmp_path / "mine.yaml"
    path.write_bytes(
        changes
        if isinstance(changes, bytes)
        else yaml.safe_dump(changed(PIPELINE, **changes)).encode()
    )
    message = refusal(lambda: read_study(str(path)), ConfigurationError)
    assert says in message
    assert "mine.yaml" in message


@pytest.fixture
def conf(elsewhere):
    (elsewhere / "conf" / "dataset").mkdir(parents=True)
    return elsewhere / "conf"


@pytest.mark.parametrize(
    "text",
    [
        "hydra:\n  searchpath: [pkg://antigravity]",
        "a: &a {hydra: {searchpath: [pkg://antigravity]}}\n<<: *a",
    ],
)
def test_no_root_file_in_conf_reaches_hydras_search_path(conf, text):
    (conf / "ingest.yaml").write_text(f"{text}\ndefaults: [dataset: tabular, common, _self_]")
    assert compose_config("ingest", ["dataset=sim_small"])["dataset"]["name"] == "sim_small"
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"a: !!timestamp soon", "the configuration of 'ingest' cannot be read"),
        (b"a: " + b"[" * 2000 + b"]" * 2000, "nests deeper than 60 levels"),
        (b"a: \xff", "is not UTF-8 text (byte 3)"),
        (b"a: ${b}", "dataset.a: Interpolation key 'b' not found"),
        (
            b"# @package hydra\nsearchpath: [pkg://antigravity]",
            "only supported from the primary config",
        ),
        (
            b"defaults:\n  - /hydra/launcher@_global_: antigravity",
            "Could not find 'hydra/launcher/antigravity'",
        ),
        (b"defaults:\n  - ../../elsewhere", "Could not load 'dataset/../../elsewhere'"),
    ],
)
def test_invalid_files_in_conf_are_a_single_line(conf, text, says):
    (conf / "dataset" / "mine.yaml").write_bytes(text)
    assert says in refusal(lambda: compose_config("ingest", ["dataset=mine"]), ConfigurationError)


ROOT = {
    "output": "o",
    "limits": {},
    "downsample": {"method": "decimate"},
    "tracking": {"name": "none"},
    "seed": 0,
}


def test_shared_groups_are_read_with_their_types():
    def read(configuration):
        return validated(Root, configuration, "", error=ConfigurationError)

    read(ROOT)
    for changes, says in (
        ({"output": ""}, "output must name a folder"),
        (
            {"downsample": {"method": "magic"}},
            "downsample.method 'magic' is not one of: polyphase, decimate",
        ),
        ({"tracking": {"name": "mlflow", "uri": 3}}, "tracking.uri must be text"),
        ({"estimator": {}}, "estimator.name is missing"),
    ):
        assert says in refusal(lambda changes=changes: read(ROOT | changes), ConfigurationError)
    for changes, says in (
        ({"rate_hz": "20"}, "rate_hz must be a number"),
        ({"rate_hz": float("inf")}, "rate_hz must be a number"),
        ({"initial_state": 1}, "initial_state must be true or false"),
        ({"rate": 20}, "rate is not an option"),
    ):
        message = refusal(
            lambda changes=changes: protocol_from_config({"rate_hz": 20} | changes),
            ConfigurationError,
        )
        assert message.startswith(f"evaluation.{says}")


def test_integers_stay_integers_where_any_type_is_allowed():
    assert protocol_from_config({"rate_hz": 20}).rate_hz == 20.0
    low_pass = {"name": "low_pass", "cutoff_hz": 5.0}
    assert Preparation(transforms=(low_pass,)).as_plain()["transforms"] == [low_pass]
    described = validated(
        Description, {"format": 1, "estimator": "a", "settings": {"x": 5.0, "y": [2.0]}}, "'f'"
    )
    assert (type(described.settings["x"]), type(described.settings["y"][0])) == (float, float)
    assert "format must be a whole number, not 1.0" in refusal(
        lambda: validated(Description, {"format": 1.0, "estimator": "a"}, "'f'")
    )
    assert check_format(1, 2, "'f'") == 1
    for wrong in (0, 3, True, 1.5, None, "1"):
        assert "'f'" in refusal(lambda wrong=wrong: check_format(wrong, 2, "'f'"))


@pytest.mark.parametrize(
    "override",
    [
        "hydra.searchpath=[pkg://antigravity]",
        "++hydra.searchpath=[pkg://antigravity]",
        "+hydra/launcher=evil",
    ],
)
def test_no_override_reaches_hydra_itself(override):
    assert "is an option of Hydra itself" in refusal(
        lambda: compose_config("train", [override]), ConfigurationError
    )
    assert "antigravity" not in sys.modules


def tree(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


names = st.one_of(
    st.sampled_from(HOSTILE), st.text(max_size=40), st.text(alphabet="./\\~ \0ab", max_size=12)
)


@settings(max_examples=25, deadline=None)
@given(label=names, stage=names, output=names, recording_id=names)
def test_no_name_inside_a_file_leads_out_of_the_output_root(label, stage, output, recording_id):
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        inside = root / "a" / "b" / "out"
        inside.mkdir(parents=True)
        before = tree(root)
        attempts = [
            lambda: make(StagePlan(stage, label, {}, {}, "", inside), lambda folder: None),
            lambda: save_checkpoint(
                plan(inside, label).checkpoint_folder, Checkpoint({}, {"epoch": 1})
            ),
            lambda: write_recording(recording(recording_id), inside / recording_file(recording_id)),
            lambda: _downsampled_from(inside, output),
        ]
        for attempt in attempts:
            try:
                attempt()
            except VehestError:
                continue
        assert all(name.startswith("a/b/out/") for name in tree(root) - before)


def _downsampled_from(inside, output):
    """Downsample what a manifest names that somebody else has written."""
    ingested = make(
        plan(inside, "ingested"),
        lambda folder: write_recording(recording(), folder / "lap.parquet"),
    )
    path = ingested.folder / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(
        json.dumps(changed(content, outputs={output: content["outputs"]["lap.parquet"]}))
    )
    target = plan(inside, "target").folder
    target.mkdir(parents=True, exist_ok=True)
    write_downsample(
        read_artefact(ingested.folder),
        {"rate_hz": 10.0, "method": "decimate", "transforms": []},
        target,
    )
