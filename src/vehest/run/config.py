"""Composing configurations with Hydra, and turning its errors into one line each."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Sequence
from decimal import ROUND_CEILING, Decimal
from functools import lru_cache
from itertools import islice
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vehest.data.errors import ConfigurationError, printable
from vehest.data.limits import Limits, check_limit, limits_from_config
from vehest.data.text_files import first_line
from vehest.run.config_checks import check_local_files, check_references, check_shape
from vehest.run.config_files import GROUPS, choices, local_conf, packaged_conf

Config = dict[str, Any]

MOST_OVERRIDES = 1_000
LONGEST_OVERRIDE = 20_000
MOST_ELEMENTS = 2_000
"""Bounds on what Hydra's parser is given: its time grows with the square of an override's elements."""

COMMAND_OPTIONS = ("dry-run", "download", "force", "jobs", "json", "model", "name", "out", "quiet")
"""Options of commands that are easily mistaken for keys of the configuration."""

GIVEN = "given"
"""Key of a configuration: rates that overrides chose, which nobody changes; a rate that is the default may be lowered to that of data."""

RATES = ("estimator.rate_hz", "evaluation.rate_hz")

_QUOTED_OR_ESCAPED = re.compile(r"""\\.|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'""", re.DOTALL)


class _LocalFirst(SearchPathPlugin):  # type: ignore[misc]
    """Makes Hydra look into ./conf before the packaged folder."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        folder = local_conf()
        if folder is not None:
            search_path.prepend("local", folder.resolve().as_uri())


def compose_config(command: str, overrides: Sequence[str] = ()) -> Config:
    """The resolved configuration of a command.

    Args:
        command: name of a root file in conf/, for example ``train``.
        overrides: in Hydra's grammar, for example ``estimator=gru`` or ``training.patience=10``; no sweeps.

    Returns:
        Plain dicts, lists, strings and numbers; and under `GIVEN`, if overrides name a rate of an estimator or of the evaluation, which.

    Raises:
        ConfigurationError: an unknown key or choice, a wrong value, or bad syntax.
    """
    parsed = parse(overrides)
    for override in parsed:
        if override.is_sweep_override():
            raise ConfigurationError(
                f"'{_shortened(override.input_line)}' names several values; one is wanted here (pipelines and sweeps take several)"
            )
        if override.is_delete() and "." not in override.key_or_group:
            raise ConfigurationError(
                f"'{override.input_line}': only keys inside a group can be taken away, for example ~dataset.channels.steer"
            )
        _check_choice(override)
    _register_plugin()
    check_local_files()
    try:
        with initialize_config_dir(config_dir=str(packaged_conf()), version_base="1.3"):
            composed = compose(command, overrides=[override.input_line for override in parsed])
        check_references(OmegaConf.to_container(composed, resolve=False))
        resolved = OmegaConf.to_container(composed, resolve=True, throw_on_missing=False)
    except (HydraException, OmegaConfBaseException, yaml.YAMLError, ValueError, TypeError, RecursionError, OSError) as error:
        if isinstance(error, FileNotFoundError) and error.filename is None:
            raise  # no file that is missing but the working folder
        raise ConfigurationError(_one_line(error, command)) from None
    assert isinstance(resolved, dict)
    config = {str(key): value for key, value in resolved.items()}
    check_shape(config, command)
    chosen = [key for key in RATES if any(override.key_or_group == key for override in parsed)]
    return {**config, GIVEN: chosen} if chosen else config


def parse(overrides: Sequence[str]) -> list[Override]:
    """Parse overrides in Hydra's grammar.

    Raises:
        ConfigurationError: bad syntax, or more than the parser can read in reasonable time.
    """
    if len(overrides) > MOST_OVERRIDES:
        raise ConfigurationError(f"{len(overrides)} overrides are more than {MOST_OVERRIDES}; write them to a file in conf/ instead")
    return [_parsed(text) for text in overrides]


def count(overrides: Sequence[str]) -> int:
    """How many combinations overrides with several values stand for; nothing is expanded.

    Raises:
        ConfigurationError: bad syntax, or values that cannot be counted.
    """
    return math.prod(_count(override) for override in parse(overrides))


def check_jobs(number: int, what: str) -> None:
    """See that a number of jobs stays within ``limits.jobs``.

    Raises:
        ConfigurationError: it does not.
    """
    shown = str(number) if number < 10**12 else f"{Decimal(number):.1e}"
    check_limit("jobs", number, f"{what} for {shown} jobs", ConfigurationError)


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """All combinations that overrides with several values stand for, the last one varying fastest.

    Raises:
        ConfigurationError: bad syntax, values that cannot be counted, or more combinations than ``limits.jobs``.
    """
    check_jobs(count(overrides), "these overrides stand")
    jobs: list[list[str]] = [[]]
    for override in parse(overrides):
        values = [f"{override.get_key_element()}={value}" for value in _values(override)] if override.is_sweep_override() else []
        jobs = [[*job, value] for job in jobs for value in values or [override.input_line]]
    return jobs


def limits_of(overrides: Sequence[str]) -> Limits:
    """The limits that overrides ask for; what they do not name is as in conf/common.yaml.

    Raises:
        ConfigurationError: bad syntax, an unknown limit, or a value that is none.
    """
    own = list(dict.fromkeys(text for text in overrides if key_of(text).split(".")[0] == "limits"))
    return limits_from_config(compose_config("eval", own)["limits"])


def value_of(override: str) -> Any:
    """The value that an override sets."""
    return _parsed(override).value()


def option_hint(key: str) -> str:
    """What to write where a key is none of the configuration but an option of the command; else nothing."""
    option = key.replace("_", "-")
    return f"; an option is written --{option}" if option in COMMAND_OPTIONS else ""


def key_of(override: str) -> str:
    """The key that an override sets, for example ``training.patience``."""
    return str(_parsed(override).key_or_group)


def has_key(config: Config, key: str) -> bool:
    """Whether a dotted key is in a configuration."""
    node: Any = config
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return False
        node = node[part]
    return True


def as_yaml(config: Config) -> str:
    """A configuration as people read it."""
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True, width=120)
    if printable(text, keep="\n") == text:
        return text
    return yaml.safe_dump(config, sort_keys=False, allow_unicode=False, width=120)


def positive_rate(value: Any, name: str) -> float:
    """A rate [Hz] of a configuration.

    Raises:
        ConfigurationError: it is no positive number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
        raise ConfigurationError(f"{name} must be a positive number [Hz], not {value!r}; for example {name}=20")
    return float(value)


def missing_keys(config: Any, prefix: str = "") -> list[str]:
    """Dotted keys that still hold ``???``."""
    if isinstance(config, dict):
        return [found for key, value in config.items() for found in missing_keys(value, f"{prefix}{key}.")]
    return [prefix.rstrip(".")] if config == "???" else []


@lru_cache(maxsize=4096)
def _parsed(text: str) -> Override:
    _check_readable(text)
    try:
        override = OverridesParser.create().parse_override(text)
        if override.key_or_group in GROUPS and isinstance(override.value(), float):  # a choice called nan or inf
            return OverridesParser.create().parse_override(f"{override.get_key_element()}='{override.value()}'")
        return override
    except HydraException as error:
        if "=" not in text:
            raise ConfigurationError(f"'{text}' is not an override; write key=value, for example estimator=ksnn") from None
        raise ConfigurationError(
            f"override '{_shortened(text)}' cannot be read ({_shortened(str(error).splitlines()[0])}); quote special characters"
        ) from None
    except (ValueError, ArithmeticError, TypeError, RecursionError) as error:
        raise ConfigurationError(f"override '{_shortened(text)}' cannot be read ({_shortened(str(error))})") from None


def _check_readable(text: str) -> None:
    """Refuse what Hydra's parser would take minutes for, and characters that no name or path holds."""
    if "\0" in text or "\n" in text or "\r" in text:
        raise ConfigurationError(f"override '{_shortened(text)}' holds a line break or a null character; write it on one line")
    if len(text) > LONGEST_OVERRIDE:
        raise ConfigurationError(
            f"override '{_shortened(text)}' has {len(text)} characters, more than {LONGEST_OVERRIDE}; write it to a file in conf/ instead"
        )
    plain = _QUOTED_OR_ESCAPED.sub("", text)
    if plain.count(",") > MOST_ELEMENTS:
        raise ConfigurationError(
            f"override '{_shortened(text)}' lists more than {MOST_ELEMENTS} values; use range(…), or write it to a file in conf/"
        )
    nesting = max(_depth(plain), plain.partition("=")[0].count("."), text.count("${"))
    check_limit("depth", nesting, f"override '{_shortened(text)}' nests {nesting} levels deep", ConfigurationError)


def _depth(text: str) -> int:
    depth = deepest = 0
    for character in text:
        depth += (character in "([{") - (character in ")]}")
        deepest = max(deepest, depth)
    return deepest


def _shortened(text: str) -> str:
    return text if len(text) <= 100 else f"{text[:80]}…"


def _count(override: Override) -> int:
    """How many values an override has; 1 where it is no sweep."""
    if not override.is_sweep_override():
        return 1
    text, value = _shortened(override.input_line or ""), override.value()
    if override.is_interval_sweep():
        raise ConfigurationError(f"'{text}': an interval cannot be counted; list values, or use range(…)")
    number = _count_range(value, text) if isinstance(value, RangeSweep) else len(list(_values(override)))
    if number == 0:
        raise ConfigurationError(f"'{text}' stands for no value")
    return number


def _count_range(value: RangeSweep, text: str) -> int:
    start, stop, step = (Decimal(number or 0) for number in (value.start, value.stop, value.step))
    if not (start.is_finite() and stop.is_finite() and step.is_finite()) or step == 0:
        raise ConfigurationError(f"'{text}': a range needs numbers from and to, and a step that is not zero")
    return max(0, int(((stop - start) / step).to_integral_value(ROUND_CEILING)))


def _values(override: Override) -> Iterator[str]:
    """The values of a sweep as text; of a range no more than were counted."""
    value = override.value()
    if isinstance(value, Glob):
        if override.key_or_group not in GROUPS:
            raise ConfigurationError(f"'{override.input_line}': glob is for {', '.join(GROUPS)}; list the values of an option")
        return iter(value.filter(choices(override.key_or_group)))
    most = _count_range(value, override.input_line or "") if isinstance(value, RangeSweep) else None
    return islice(override.sweep_string_iterator(), most)


def _check_choice(override: Override) -> None:
    group = override.key_or_group
    if re.search(r"(^|\W)hydra(\W|$)|\.\.", f"{group}@{override.package or ''}"):
        raise ConfigurationError(f"'{override.input_line}' sets an option of Hydra itself, or leaves conf/; vehest takes neither")
    if group not in GROUPS or override.is_delete():
        return
    value, known = str(override.value()), choices(group)
    if value not in known:
        close = difflib.get_close_matches(value, known, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise ConfigurationError(f"{group}={value} is not there; {hint}choices: {', '.join(known)}")


def _register_plugin() -> None:
    plugins = Plugins.instance()
    if _LocalFirst not in plugins.discover(SearchPathPlugin):
        plugins.register(_LocalFirst)


def _one_line(error: Exception, command: str) -> str:
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return f"the configuration of '{command}' cannot be read ({first_line(error)})"
    text = str(error).strip()
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        name = unknown.group(1)
        hint = option_hint(name) or f"; 'vehest config {command}' prints the options there are; +{name}=… adds one"
        return f"unknown option '{name}'{hint}"
    missing = re.search(r"You must specify '([^']+)'", text)
    if missing:
        return f"say which {missing.group(1)}: {missing.group(1)}=… (choices: {', '.join(choices(missing.group(1)))})"
    variable = re.search(r"Environment variable '([^']+)' not found", text)
    if variable:
        return f"environment variable {variable.group(1)} is not set"
    key = getattr(error, "full_key", None)
    return f"{key}: {text.splitlines()[0]}" if key else " ".join(line.strip() for line in text.splitlines()[:2])
