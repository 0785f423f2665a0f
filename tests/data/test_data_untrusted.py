"""What keeps files from asking for too much: limits, text, schemas, names."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refusal

from vehest.configuration.composition import compose_config
from vehest.data.errors import ConfigurationError, DataError, MissingError, printable
from vehest.data.files import file_name, regular_file
from vehest.data.limits import (
    Limits,
    check_limit,
    check_unpacked,
    current_limits,
    limits_from_config,
    use_limits,
)
from vehest.data.schema import FURTHER_KEYS, validated
from vehest.data.text_files import parse_json, parse_yaml, read_text, read_yaml


@dataclass(frozen=True)
class Inner:
    gain: float
    steps: int = 3


@dataclass(frozen=True)
class Kinds:
    names: Annotated[tuple[str, ...], "a list of names"] = ()
    inner: tuple[Inner | None, ...] = ()
    lists: tuple[tuple[int, ...], ...] | None = None
    pair: tuple[float, str] | None = None
    files: str | tuple[str, ...] = "*"
    values: dict[str, int | float | bool | str | None] | None = None
    rate: Annotated[float, "a number up to 5"] | None = None
    maps: dict[str, dict[str, Inner]] | None = None


def test_plain_values_become_dataclasses_that_may_take_further_keys():
    values = {
        "names": ["a"],
        "inner": [{"gain": 1}, None],
        "pair": [0, "b"],
        "maps": {"c": {"d": {"gain": 0.5, "steps": 4}}},
    }
    assert validated(Kinds, values, "'f'") == Kinds(
        ("a",), (Inner(1.0), None), pair=(0.0, "b"), maps={"c": {"d": Inner(0.5, 4)}}
    )

    @dataclass(frozen=True)
    class Loose:
        __pydantic_config__ = FURTHER_KEYS
        name: str

    assert validated(Loose, {"name": "a", "more": 1}, "") == Loose("a")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"names": "a"}, "it.names must be a list of names, not 'a'"),
        (
            {"inner": [{"gain": 1, "gian": 1}]},
            "it.inner.0.gian is not an option of it.inner.0; did you mean 'it.inner.0.gain'? "
            "options: gain, steps",
        ),
        ({"lists": [3]}, "it.lists.0 must be a list, not 3"),
        ({"pair": ["a", "b"]}, "it.pair.0 must be a number, not 'a'"),
        ({"files": 3}, "it.files must be text or a list, not 3"),
        (
            {"values": {"a": [1]}},
            "it.values.a must be a whole number or a number or true or false or text, not [1]",
        ),
        (
            {"maps": {"a": {"b": 3}}},
            "it.maps.a.b must be a group of options, not 3; options: gain, steps",
        ),
        ({"inner": [{"gain": float("nan")}]}, "'f': inner.0.gain must be a number, not nan"),
        (
            {"other": 1},
            "'f': unknown key 'other'; there are: names, inner, lists, pair, files, values, rate, "
            "maps",
        ),
        (
            {"names": {1, 2}},
            "'f': names is no plain value but a set, {1, 2}; put it in quotes if it is text",
        ),
    ],
)
def test_refusals_name_the_type_of_the_key_in_a_single_line(content, message):
    of_a_file = message.startswith("'f'")
    options = {} if of_a_file else {"error": ConfigurationError, "group": "it"}
    with pytest.raises(DataError if of_a_file else ConfigurationError) as caught:
        validated(Kinds, content, "'f'" if of_a_file else "", **options)
    assert str(caught.value) == message


def test_yaml_that_explodes_by_aliases_is_refused_at_once(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    file = tmp_path / "bomb.yaml"
    file.write_text("\n".join(lines))
    started = time.process_time()
    assert "bomb.yaml' nests deeper than 60 levels or holds more than 500000 values" in refusal(
        lambda: read_yaml(file)
    )
    assert time.process_time() - started < 5.0  # processor time of a bomb that would take hours


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [*a]", "holds more than 500000 values, repeated ones included"),
        ("[" * 100000, "nests deeper than 60 levels"),
        ("a: !!python/object/apply:os.system ['true']", "cannot be read as YAML"),
        ("a: !!timestamp soon", "a value is not what its tag"),
        ("a: *nothing", "cannot be read as YAML"),
    ],
)
def test_invalid_yaml_is_refused_in_a_single_line(text, message):
    with pytest.raises(DataError, match=message):
        parse_yaml(text, "'f'")


def test_yaml_with_anchors_is_read_and_invalid_json_is_refused():
    for text in ("[" * 100000, b"\xff\xfe"):
        assert "cannot be read as JSON" in refusal(lambda text=text: parse_json(text, "'f'"))
    assert parse_yaml("a: &a {x: 1}\nb: *a\nc: {<<: *a, y: 2}", "") == {
        "a": {"x": 1},
        "b": {"x": 1},
        "c": {"x": 1, "y": 2},
    }


def test_only_regular_files_of_utf8_and_bounded_length_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, message in (
        (tmp_path / "pipe", "a pipe"),
        (Path("/dev/zero"), "a device"),
        (tmp_path, "a folder"),
    ):
        with pytest.raises(DataError, match=message):
            regular_file(path)
    for path in (tmp_path / "none", tmp_path / "none" / "x"):
        with pytest.raises(MissingError):
            regular_file(path)
    with pytest.raises(DataError):
        regular_file(Path("a" * 5000))
    (tmp_path / "latin").write_bytes("ä".encode("latin-1"))
    (tmp_path / "long").write_text("x" * 100)
    assert "is not UTF-8 text" in refusal(lambda: read_text(tmp_path / "latin"))
    with (
        use_limits(Limits(text_bytes=50)),
        pytest.raises(
            DataError,
            match=r"long' is 100 bytes long, more than the limit of 50; .*limits.text_bytes",
        ),
    ):
        read_text(tmp_path / "long")


def test_limits_come_from_a_configuration_and_end_with_their_block():
    with use_limits(limits_from_config({"samples": 5})):
        assert current_limits().samples == 5
        assert "6 samples, more than the limit of 5" in refusal(
            lambda: check_limit("samples", 6, "'f' holds 6 samples")
        )
    assert current_limits() == Limits()
    for wrong in ({"values": 1}, {"samples": 0}, {"samples": "many"}, {"samples": True}):
        with pytest.raises(
            ConfigurationError,
            match=r"limits\.(samples must be a whole number|samples: input should be greater than "
            r"0|values is not an option .*samples)",
        ):
            limits_from_config(wrong)


def test_the_configuration_names_every_limit_and_a_file_may_not_unpack_to_more():
    assert limits_from_config(compose_config("ingest", ["dataset=tabular"])["limits"]) == Limits()
    assert Limits().samples > 3600 * 1000
    assert Limits().memory > 8 * 3600 * 1000 * 55
    with use_limits(Limits(memory=1000)):
        check_unpacked("f", 200, 3000)
        with pytest.raises(
            DataError,
            match=r"'f' unpacks to 3001 bytes, 1001 beyond ten times its size, "
            r".*limits\.memory=NUMBER",
        ):
            check_unpacked("f", 200, 3001)


@given(st.text(max_size=300))
def test_file_names_stay_a_single_path_component(name):
    escaped = file_name(name, ".csv")
    assert Path(escaped).name == escaped
    assert not escaped.startswith(".")
    assert len(escaped.encode()) < 140
    assert escaped == file_name(name, ".csv")


@given(st.text(max_size=40), st.text(max_size=40))
def test_different_names_stay_different(first, second):
    assert (file_name(first) == file_name(second)) == (first == second)


def test_plain_names_stay_and_terminal_escapes_are_printed():
    assert file_name("ksnn-linear_bias_p2-seed0", ".csv") == "ksnn-linear_bias_p2-seed0.csv"
    assert printable("a\x1b[31mb\r\n\u202e") == "a\\x1b[31mb\\r\\n\\u202e"
    assert printable("größe β °") == "größe β °"
    assert printable("\udcff") == "\\udcff"
