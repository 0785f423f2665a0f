"""Composing configurations with Hydra, and turning its errors into one line each."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import Any, Literal

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vehest.data.errors import ConfigurationError, printable
from vehest.data.limits import Limits, check_limit, current_limits, limits_from_config
from vehest.data.schema import FURTHER_KEYS, validated
from vehest.data.text_files import first_line, read_yaml
from vehest.data.transforms import Preparation
from vehest.run.config_files import GROUPS, choices, local_conf, packaged_conf, papers_conf

Config = dict[str, Any]

COMMAND_OPTIONS = ("dry-run", "download", "force", "jobs", "json", "model", "name", "out", "quiet")
"""Options of commands that are easily mistaken for keys of the configuration."""

GIVEN = "given"
"""Key of a configuration: rates that overrides chose, which nobody changes; a rate that is the default may be lowered to that of data."""

RATES = ("estimator.rate_hz", "evaluation.rate_hz")


@dataclass(frozen=True)
class Tracking:
    """``tracking``: where runs are logged.

    Args:
        name: ``mlflow`` or ``none``.
        uri: of the server or store; None is a local one in the output root.
        experiment: name that runs are kept under.
    """

    name: Literal["mlflow", "none"]
    uri: str | None = None
    experiment: str = "vehest"


@dataclass(frozen=True)
class Named:
    """A group of options whose ``name`` says by whose schema the others are read."""

    __pydantic_config__ = FURTHER_KEYS
    name: str


@dataclass(frozen=True)
class Root:
    """What every command's configuration has; groups that a command does not have are None."""

    __pydantic_config__ = FURTHER_KEYS
    output: str
    limits: dict[str, Any]
    downsample: Preparation
    root: str | None = None
    tracking: Tracking | None = None
    estimator: Named | None = None
    split: dict[str, Any] | None = None
    dataset: dict[str, Any] | None = None
    training: dict[str, Any] | None = None
    evaluation: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if not self.output or "\0" in self.output:
            raise ConfigurationError(f"output must name a folder, not {self.output!r}")


class _LocalFirst(SearchPathPlugin):  # type: ignore[misc]
    """Makes Hydra look into ./conf before the packaged folder, and into that of the papers' studies last."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        folder = local_conf()
        if folder is not None:
            search_path.prepend("local", folder.resolve().as_uri())
        search_path.append("papers", papers_conf().as_uri())


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
    _check_root_file(command)
    try:
        with initialize_config_dir(config_dir=str(packaged_conf()), version_base="1.3"):
            composed = compose(command, overrides=[override.input_line for override in parsed])
        resolved = OmegaConf.to_container(composed, resolve=True, throw_on_missing=False)
    except Exception as error:  # of a file that is no such configuration, Hydra raises nearly anything
        if isinstance(error, FileNotFoundError) and error.filename is None:
            raise  # no file that is missing but the working folder
        raise ConfigurationError(_one_line(error, command)) from None
    assert isinstance(resolved, dict)
    config = {str(key): value for key, value in resolved.items()}
    validated(Root, config, "", error=ConfigurationError)
    chosen = [key for key in RATES if any(override.key_or_group == key for override in parsed)]
    return {**config, GIVEN: chosen} if chosen else config


def parse(overrides: Sequence[str]) -> list[Override]:
    """Parse overrides in Hydra's grammar.

    Raises:
        ConfigurationError: bad syntax.
    """
    return [_parsed(text) for text in overrides]


def count(overrides: Sequence[str]) -> int:
    """How many combinations overrides with several values stand for; of one override, no more than ``limits.jobs`` and one are counted.

    Raises:
        ConfigurationError: bad syntax, or values that cannot be counted.
    """
    return math.prod(len(_values(override)) for override in parse(overrides))


def check_jobs(number: int, what: str) -> None:
    """See that a number of jobs stays within ``limits.jobs``.

    Raises:
        ConfigurationError: it does not.
    """
    check_limit("jobs", number, f"{what} for at least {number} jobs", ConfigurationError)


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """All combinations that overrides with several values stand for, the last one varying fastest.

    Raises:
        ConfigurationError: bad syntax, values that cannot be counted, or more combinations than ``limits.jobs``.
    """
    check_jobs(count(overrides), "these overrides stand")
    jobs: list[list[str]] = [[]]
    for override in parse(overrides):
        jobs = [[*job, value] for job in jobs for value in _values(override)]
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


def _shortened(text: str) -> str:
    return text if len(text) <= 100 else f"{text[:80]}…"


def _values(override: Override) -> list[str]:
    """An override once for each of its values, but for no more values than ``limits.jobs`` and one."""
    if not override.is_sweep_override():
        return [str(override.input_line)]
    text, value = _shortened(str(override.input_line)), override.value()
    if override.is_interval_sweep():
        raise ConfigurationError(f"'{text}': an interval cannot be counted; list values, or use range(…)")
    if isinstance(value, Glob) and override.key_or_group not in GROUPS:
        raise ConfigurationError(f"'{text}': glob is for {', '.join(GROUPS)}; list the values of an option")
    try:
        found = value.filter(choices(override.key_or_group)) if isinstance(value, Glob) else override.sweep_string_iterator()
        values = list(islice(found, current_limits().jobs + 1))
    except (HydraException, ValueError, ArithmeticError, TypeError) as error:
        raise ConfigurationError(f"override '{text}' cannot be read ({first_line(error)})") from None
    if not values:
        raise ConfigurationError(f"'{text}' stands for no value")
    return [f"{override.get_key_element()}={value}" for value in values]


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


def _check_root_file(command: str) -> None:
    """A root file of ./conf may not name Hydra's search path, which imports packages; Hydra takes it from nowhere else."""
    folder = local_conf()
    file = folder / f"{command}.yaml" if folder is not None else None
    if file is not None and file.is_file() and "hydra" in (read_yaml(file) or {}):
        raise ConfigurationError(f"'{file}' names options of Hydra itself, which vehest does not take from files; leave them out")


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
