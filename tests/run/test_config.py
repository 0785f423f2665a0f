"""Configuration: overrides, choices, sweeps, local files first, errors of one line, completion."""

import json
import re
from itertools import chain, pairwise
from pathlib import Path

import pytest
import yaml
from refusals import refusal

from place import run_vehest
from vehest.configuration import composition as config
from vehest.configuration.composition import compose_config, expand
from vehest.configuration.estimate_options import estimate_options
from vehest.configuration.files import GROUPS, choices, packaged
from vehest.data.errors import ConfigurationError, MissingError
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.inference.car_values import with_settings
from vehest.run import inspect_data
from vehest.run.setting_lines import config_as_commented_yaml
from vehest.run.study import jobs_of, read_study


def test_every_estimator_composes_with_any_split(
    elsewhere,
):
    estimators = choices("estimator")
    splits = choices("split")
    for at, estimator in enumerate(estimators):
        split = splits[at * len(splits) // len(estimators)]
        config = compose_config("eval", [f"estimator={estimator}", f"split={split}"])
        assert config["estimator"]["name"] == estimator
        assert config["split"]["name"].startswith(split), "some add the recordings' names"
    assert compose_config("train", ["estimator=luenberger"])["training"]["name"] == "nelder_mead"
    assert compose_config("train", ["estimator=gru"])["training"]["name"] == "supervised"
    assert (
        compose_config("train", ["estimator=luenberger", "training=supervised"])["training"]["name"]
        == "supervised"
    )


def test_local_configuration_precedes_and_extends_the_packaged_configuration(elsewhere):
    (elsewhere / "conf" / "estimator").mkdir(parents=True)
    (elsewhere / "conf" / "estimator" / "gru.yaml").write_text(
        "name: gru\nrate_hz: 20\nwindow: 10\nn_states: 3\n"
    )
    (elsewhere / "conf" / "estimator" / "mine.yaml").write_text(
        "# My own.\nname: ksnn\nn_local: 4\n"
    )
    assert compose_config("train", ["estimator=gru"])["estimator"]["window"] == 10
    assert compose_config("train", ["estimator=mine"])["estimator"]["n_local"] == 4
    assert compose_config("train", ["estimator=lstm"])["estimator"]["window"] == 30
    assert {"mine", "gru", "luenberger"} <= set(choices("estimator"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["estimator=ksn"],
            r"estimator=ksn is not there; did you mean ksnn\? choices: cnn_ukf, .*gru, kalman, "
            r"kinematic, ksnn, ",
        ),
        (["split=nowhere_at_all"], "split=nowhere_at_all is not there; choices: .*ferrari_drive"),
        (["estimator.n_locals=3"], "unknown option 'estimator.n_locals'"),
        (
            ["estimator=self_calibrating", "estimator.nlocal=3"],
            "unknown option 'estimator.nlocal' of self_calibrating; 'n_local' is an option of "
            "ksnn; "
            "'vehest config train estimator=self_calibrating' prints",
        ),
        (["seed=[1,"], r"override 'seed=\[1,' cannot be read"),
        (["quickly"], "'quickly' is not an override; write key=value"),
        (["seed=1,2"], "names several values"),
        ([], r"dataset is not chosen; dataset=… \(choices: .*tabular"),
    ],
)
def test_wrong_overrides_are_a_single_helpful_line(elsewhere, overrides, message):
    refused = refusal(
        lambda: compose_config("train" if overrides else "ingest", overrides), ConfigurationError
    )
    assert re.search(message, refused)
    assert "did you mean pipelines/quickstart.yaml?" in refusal(
        lambda: read_study("quikstart"), MissingError
    )


@pytest.mark.parametrize(
    ("override", "meant"),
    [
        ("estimator.nlocal=3", "estimator.n_local"),
        ("n_local=3", "estimator.n_local"),
        ("training.max_epoch=3", "training.max_epochs"),
        ("traning.max_epochs=3", "training.max_epochs"),
        ("evaluation.rate=3", "evaluation.rate_hz"),
        ("split.nam=x", "split.name"),
        ("sed=3", "seed"),
        ("limits.job=3", "limits.jobs"),
        ("estimatr=ksnn", "estimator"),
    ],
)
def test_misspelt_options_of_any_group_get_a_suggestion(elsewhere, override, meant):
    message = refusal(
        lambda: compose_config("eval", ["estimator=ksnn", "split=ferrari_drive", override]),
        ConfigurationError,
    )
    assert f"did you mean '{meant}'?" in message


def test_a_misspelt_option_of_a_data_set_a_nested_group_or_a_study_is_answered_too(elsewhere):
    for command, words, meant in (
        ("ingest", ["dataset=tabular", "dataset.clok=strict"], "dataset.clock"),
        (
            "train",
            ["estimator=kalman", "split=ferrari_drive", "estimator.car.mas=3"],
            "estimator.car.mass",
        ),
    ):
        message = refusal(
            lambda words=words, command=command: compose_config(command, words), ConfigurationError
        )
        assert f"did you mean '{meant}'?" in message
    message = refusal(
        lambda: jobs_of(read_study("quickstart"), ["estimator.nlocal=3"]), ConfigurationError
    )
    assert "did you mean 'estimator.n_local'?" in message
    assert "did you mean" not in refusal(
        lambda: compose_config("eval", ["estimator=ksnn", "split=ferrari_drive", "zzz=1"]),
        ConfigurationError,
    )


def test_sweeps_expand_to_every_combination_that_of_the_ferrari_to_35_jobs(elsewhere):
    jobs = expand(
        ["estimator=ksnn", "estimator.n_local=2,3", "estimator.bias=true,false", "seed=range(3)"]
    )
    assert (len(jobs), jobs[0]) == (
        12,
        ["estimator=ksnn", "estimator.n_local=2", "estimator.bias=True", "seed=0"],
    )
    assert len({tuple(job) for job in jobs}) == 12
    configs = [job.config for job in jobs_of(read_study("ferrari_drive"), [])[""]]
    names = [config["estimator"]["name"] for config in configs]
    baselines = {"zero": 1, "kinematic": 1, "data_sheet": 1, "static_map": 1}
    assert {name: names.count(name) for name in set(names)} == {
        **baselines,
        "luenberger": 1,
        "ksnn": 20,
        "gru": 5,
        "lstm": 5,
    }
    assert all(config["evaluation"]["rate_hz"] == 20 for config in configs)
    assert [span["start"] for span in configs[0]["split"]["train"]] == [150]


SHIPPED = {file.stem for file in (Path(__file__).parents[2] / "pipelines").glob("*.yaml")}
COMPOSED = set()


@pytest.mark.parametrize("name", sorted(SHIPPED - {"ksnn", "ksnn_revs"}))  # these two: test_parts
def test_every_split_and_every_set_of_keys_of_shipped_pipelines_composes(elsewhere, name):
    """Jobs that differ in numbers alone compose alike."""
    pipeline = read_study(name)
    if pipeline.datasets:
        assert jobs_of(pipeline, [])
    for part in pipeline.parts.values():
        assert part.split in choices("split")
        for job in chain(*map(expand, part.sweeps)):
            words = [
                word
                for word in [*part.overrides, *job]
                if not word.lstrip("+").startswith("split.")
            ]
            keys = frozenset(
                word if (key := word.partition("=")[0]) in GROUPS else key for word in words
            )
            if keys not in COMPOSED:
                compose_config("eval", words)
                COMPOSED.add(keys)


def test_pipeline_overrides_reach_the_sweeps_that_have_the_key(elsewhere):
    configs = [
        job.config for job in jobs_of(read_study("quickstart"), ["training.learning_rate=0.01"])[""]
    ]
    rates = {
        config["estimator"]["name"]: config["training"].get("learning_rate") for config in configs
    }
    fitted_otherwise = dict.fromkeys(
        ("zero", "kinematic", "data_sheet", "static_map", "luenberger")
    )
    assert rates == {**fitted_otherwise, "ksnn": 0.01, "gru": 0.01, "lstm": 0.01}
    seeds = [job.config["seed"] for job in jobs_of(read_study("quickstart"), ["seed=7"])[""]]
    assert set(seeds) == {7}
    assert "matches no sweep" in refusal(
        lambda: jobs_of(read_study("quickstart"), ["training.momentum=0.9"]), ConfigurationError
    )


@pytest.mark.parametrize(
    ("words", "position", "offered"),
    [
        ("vehest train est", 2, {"estimator=ksnn"}),
        ("vehest run ferr", 2, {"ferrari_drive"}),
        ("vehest estimate pre", 2, {"pretrained"}),
        ("vehest tr", 1, {"train"}),
        ("vehest ingest sim", 2, {"sim_quickstart"}),
        ("vehest report --ch", 2, {"--check"}),
        ("vehest report --check fer", 3, {"ferrari_drive"}),
    ],
)
def test_commands_options_choices_and_studies_are_completed(
    elsewhere, monkeypatch, capsys, words, position, offered
):
    for name, value in (
        ("COMP_WORDS", words),
        ("COMP_CWORD", str(position)),
        ("_VEHEST_COMPLETE", "complete_bash"),
    ):
        monkeypatch.setenv(name, value)
    assert offered <= set(run_vehest(capsys)[1].split())


def repeated(levels, form):
    """Keys k0 to k``levels``, each of which stands twice for the one before."""
    return {"k0": "x", **{f"k{n + 1}": form.format(n) * 2 for n in range(levels)}}


def bad_file(folder, text):
    file = folder / "conf" / "dataset" / "bad.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"name: bad\nsource: tabular\n{text}\n", encoding="utf-8")


ALIASES = "title: [&a [x,x,x,x,x,x,x,x,x]" + "".join(
    f",&{name} [{','.join([f'*{before}'] * 9)}]" for before, name in pairwise("abcdef")
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ALIASES + "]", r"'conf/dataset/bad.yaml' nests deeper than .* or holds more than 20000"),
        (yaml.safe_dump(repeated(40, "${{dataset.k{}}}")), "stand for more than 20000 values"),
        (yaml.safe_dump(repeated(40, "${{.k{}}}")), "stand for more than 20000 values"),
        (yaml.safe_dump(repeated(40, "${{oc.select:dataset.k{}}}")), "more than 20000 values"),
        (
            yaml.safe_dump(
                {"m0": ["x"] * 10} | {f"m{n + 1}": [f"${{dataset.m{n}}}"] * 10 for n in range(9)}
            ),
            "stand for more than 20000 values",
        ),
        (
            yaml.safe_dump(
                dict(reversed(repeated(40, "${{dataset.k{}}}").items())), sort_keys=False
            ),
            "stand for more than 20000 values",
        ),
        ("title: [", r"'conf/dataset/bad.yaml' cannot be read as YAML"),
    ],
)
def test_a_file_of_conf_that_explodes_is_refused(elsewhere, text, says):
    bad_file(elsewhere, text)
    with pytest.raises(ConfigurationError, match=says):
        compose_config("ingest", ["dataset=bad"])


def test_a_file_of_conf_that_explodes_is_named_and_the_others_are_listed(place, monkeypatch):
    monkeypatch.setattr(inspect_data, "choices", lambda _: ["bad", "mine"])
    bad_file(place.folder, yaml.safe_dump(repeated(40, "${{dataset.k{}}}")))
    code, out, err = place("data", "list", "--json")
    assert code == 2
    assert err.startswith("error: data set 'bad': ")
    assert err.count("\n") == 1
    assert "mine" in {row["dataset"] for row in json.loads(out)}
    assert place("data", "show", "mine")[0] == 0


def test_jobs_with_the_same_choices_share_compositions_but_no_values(elsewhere, monkeypatch):
    composed = []
    compose = config.compose
    monkeypatch.setattr(config, "compose", lambda *a, **k: composed.append(a) or compose(*a, **k))
    split = elsewhere / "conf" / "split" / "mine.yaml"
    split.parent.mkdir(parents=True)
    split.write_text("name: first\n")
    with_value = compose_config("train", ["split=mine", "training.patience=3", "+split.more=1"])
    assert (with_value["training"]["patience"], with_value["split"]["more"]) == (3, 1)
    default = compose_config("train", ["split=mine"])
    assert (default["training"]["patience"], default["split"]) == (25, {"name": "first"})
    assert len(composed) == 1
    with_value["split"]["name"] = "changed"
    assert compose_config("train", ["split=mine"]) == default
    split.write_text("name: third\n")
    assert compose_config("train", ["split=mine"])["split"] == {"name": "third"}
    assert len(composed) == 2


def test_estimate_takes_settings_of_the_filter_by_the_same_grammar_as_other_options(elsewhere):
    options = estimate_options(
        ["estimator.wheelbase=2.9", "+estimator.grips=[4.5,9]", "dataset.rate_hz=20"]
    )
    assert options.settings == {"wheelbase": 2.9, "grips": [4.5, 9]}
    assert options.dataset["rate_hz"] == 20
    assert estimate_options([]).settings == {}
    with pytest.raises(ConfigurationError, match=r"unknown option 'dataset\.wheelbase'"):
        estimate_options(["dataset.wheelbase=2.9"])


def test_references_of_an_override_are_bounded_too(elsewhere):
    words = [f"++k{n}={value}" for n, value in enumerate(repeated(40, "${{k{}}}").values())]
    with pytest.raises(ConfigurationError, match="stand for more than 20000 values"):
        compose_config("ingest", ["dataset=ferrari_250lm", *words])


@pytest.mark.parametrize("estimator", choices("estimator"))
def test_config_prints_the_composed_configuration_with_comments(elsewhere, estimator):
    config = compose_config("train", [f"estimator={estimator}", "seed=3"])
    assert yaml.safe_load(config_as_commented_yaml(config)) == config


def test_config_prints_settings_with_the_comments_of_their_files(elsewhere, capsys):
    words = ["config", "train", "estimator=gru", "estimator.n_states=3", "training.patience=7"]
    code, out, _ = run_vehest(capsys, *words)
    assert code == 0
    printed = set(out.splitlines())
    estimator = (packaged("conf") / "estimator" / "gru.yaml").read_text(encoding="utf-8")
    training = (packaged("conf") / "training" / "supervised.yaml").read_text(encoding="utf-8")
    settings = estimator[estimator.index("rate_hz") :].splitlines()
    settings += training[training.index("learning_rate") :].splitlines()
    for line in settings:
        key_and_value, _, comment = line.partition(" # ")
        key, _, value = key_and_value.strip().partition(": ")
        value = {"n_states": "3", "patience": "7"}.get(key, value.strip())
        assert f"{f'  {key}: {value}':<44} # {comment}" in printed


def test_an_unknown_option_of_the_shipped_filter_names_the_families_that_have_it():
    message = refusal(
        lambda: with_settings(SelfCalibrating(SelfCalibrating.settings_type()), {"nlocal": 3}),
        ConfigurationError,
    )
    assert message.startswith(
        "unknown option 'estimator.nlocal' of self_calibrating; 'n_local' is an option of ksnn; "
    )
