"""Composes configurations with Hydra; its errors become one line each.

command and overrides -> Hydra over ./conf, conf/, the papers' conf/ -> `Root` checks -> Config
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice, product
from pathlib import Path
from typing import Any, ClassVar, Literal

import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import Container, DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from vehest.configuration.files import GROUPS, choices, conf_folders, packaged
from vehest.data.errors import (
    ConfigurationError,
    VehestError,
    closest,
    printable,
    unknown_option,
)
from vehest.data.files import stamp_of
from vehest.data.limits import Limits, check_limit, current_limits, limits_from_config
from vehest.data.schema import FURTHER_KEYS, validated
from vehest.data.text_files import check_yaml_size, first_line, read_text, read_yaml
from vehest.data.transforms import Preparation

Config = dict[str, Any]  # composed configuration as plain values

OPTION_HINTS = {
    option: f"an option is written --{option}"
    for option in ("dry-run", "download", "force", "jobs", "json", "name", "out", "quiet")
} | {"model": "an option is written --model; vehest estimate takes the model before the file"}
"""Option of a command that is easily mistaken for a key of the configuration -> how to write it."""

# key of a configuration: the rates that overrides set, which are not lowered to the rate of the
# recordings, as a default is
OVERRIDDEN_RATES_KEY = "given"

RATES = ("estimator.rate_hz", "evaluation.rate_hz")  # keys of sampling rates [Hz]
LOCAL_SCHEME = "vehest"  # scheme of the entry for ./conf in Hydra's search path
# largest number of values of a file of ./conf, and of all to which references resolve; OmegaConf
# takes 0.1 ms for each
MAX_CONFIG_VALUES = 20_000
OPEN_GROUPS = {"estimate": "estimator"}
"""Command -> group to which overrides may add any key.

These are settings of a model that is opened later, which checks them.
"""
VALUES_PER_REFERENCE = 10  # number of values as which resolving one reference counts
CHARACTERS_PER_VALUE = 100  # number of characters of a long text that count as one value
# override that empties Hydra's search path; the first one counts, and a package named by another,
# in a file or an override, would be imported
NO_SEARCH_PATH = "hydra.searchpath=[]"


@dataclass(frozen=True)
class Tracking:
    """``tracking``: store of runs, and the experiment there.

    ``uri`` is that of a server or a store; None is a local store in the output root.
    """

    name: Literal["mlflow", "none"]  # kind of the store of runs
    uri: str | None = None  # address of the store; None: a local store in the output root
    experiment: str = "vehest"  # name of the experiment in the store


@dataclass(frozen=True)
class Named:
    """A group of options that the schema of its ``name`` checks further."""

    __pydantic_config__ = FURTHER_KEYS
    name: str  # chosen member of the group, by which its schema is found


@dataclass(frozen=True)
class Root:
    """Groups of every command's configuration; those that a command does not have are None."""

    __pydantic_config__ = FURTHER_KEYS
    output: str  # folder in which artefacts are written
    limits: dict[str, Any]  # upper bounds of the size of inputs
    downsample: Preparation  # options of the resampling to a lower rate
    root: str | None = None  # folder of a data set's raw files
    tracking: Tracking | None = None  # store of runs
    estimator: Named | None = None  # estimator and its options
    split: dict[str, Any] | None = None  # ranges for training, validation and tests
    dataset: dict[str, Any] | None = None  # data set and its options
    training: dict[str, Any] | None = None  # options of training
    evaluation: dict[str, Any] | None = None  # options of scoring

    def __post_init__(self) -> None:
        if not self.output or "\0" in self.output:
            raise ConfigurationError(f"output must name a folder, not {self.output!r}")


class _LocalFirst(SearchPathPlugin):  # type: ignore[misc]
    """Makes Hydra search ./conf before the packaged folder, and the papers' folder last."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Put ./conf before the packaged folder, and the papers' folder behind it."""
        *local, _, papers = conf_folders()
        for folder in local:
            # Hydra takes it literally, spaces too
            search_path.prepend("local", f"{LOCAL_SCHEME}://{folder.resolve()}")
        search_path.append("papers", f"file://{papers}")


class _LimitedFiles(FileConfigSource):  # type: ignore[misc]
    """The files of ./conf, each read within the limits on text and values.

    The limits are checked before OmegaConf copies what the aliases of a file repeat.
    """

    with_defaults: ClassVar[list[Path]] = []  # files with a list of defaults, in their order

    @staticmethod
    def scheme() -> str:
        """Scheme of the entries in the search path that this source reads."""
        return LOCAL_SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a file after its size was checked, and note it if it has a list of defaults."""
        file = Path(os.path.relpath(self.path), self._normalize_file_name(config_path))
        check_yaml_size(read_text(file), f"'{file}'", MAX_CONFIG_VALUES)
        loaded = super().load_config(config_path)
        if isinstance(loaded.config, DictConfig) and "defaults" in loaded.config:
            self.with_defaults.append(file)
        return loaded


@contextmanager
def _limited_references() -> Iterator[None]:
    """Bound the number of values that references (``${…}``) of a configuration resolve to.

    A value counts as often as references repeat it.

    OmegaConf resolves a reference anew wherever it is met, so that a chain of n references to two
    each takes 2ⁿ steps, and has no bound itself; all of its ways to resolve one go through
    ``Container.resolve_parse_tree``.
    """
    resolve = Container.resolve_parse_tree
    sizes: dict[int, int] = {}  # of collections that references name
    total = 0

    def check() -> None:
        if total > MAX_CONFIG_VALUES:
            raise InterpolationResolutionError(
                f"the references (${{…}}) of the configuration stand for more than "
                f"{MAX_CONFIG_VALUES} values, "
                "repeated ones included; let them repeat each other less"
            )

    def counted(container: Container, *arguments: Any, **options: Any) -> Any:
        nonlocal total
        total += VALUES_PER_REFERENCE
        check()  # first, since OmegaConf drops some errors and resolves on
        resolved = resolve(container, *arguments, **options)
        if isinstance(resolved, str):
            total += len(resolved) // CHARACTERS_PER_VALUE
        elif isinstance(resolved, Container):
            if id(resolved) not in sizes:
                sizes[id(resolved)] = _count_values(OmegaConf.to_container(resolved))
            total += sizes[id(resolved)]
        check()
        return resolved

    Container.resolve_parse_tree = counted  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        Container.resolve_parse_tree = resolve  # type: ignore[method-assign]


def _count_values(content: Any) -> int:
    """Number of values in plain collections, the collections included."""
    if isinstance(content, dict):
        content = list(content.values())
    return 1 + sum(map(_count_values, content)) if isinstance(content, list) else 1


def compose_config(command: str, overrides: Sequence[str] = ()) -> Config:
    """The resolved configuration of a command.

    Parameters
    ----------
    command : str
        Name of a root file in conf/.
    overrides : sequence
        In Hydra's grammar, without sweeps.

    Returns
    -------
    dict
        Plain dicts, lists, strings and numbers; under `OVERRIDDEN_RATES_KEY` the rates that
        overrides set, if any.

    Raises
    ------
    ConfigurationError
        A key or choice is unknown, a value is wrong, or an override cannot be parsed.
    """
    read = [parsed(text) for text in overrides]
    for override in read:
        _check(override)
    of_groups = tuple(
        str(override.input_line) for override in read if _is_group(str(override.key_or_group))
    )
    values = [override for override in read if override.input_line not in of_groups]
    composed: DictConfig | None = None
    try:
        with _limited_references():
            composed = deepcopy(_composed(command, of_groups, stamp_of(*conf_folders())))
            if command in OPEN_GROUPS:
                OmegaConf.set_struct(composed[OPEN_GROUPS[command]], False)
            ConfigLoaderImpl._apply_overrides_to_config(values, composed)
            resolved: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=False)
    except VehestError as error:
        raise ConfigurationError(str(error)) from None
    except Exception as error:  # Hydra raises nearly anything for a file that is no configuration
        if isinstance(error, FileNotFoundError) and error.filename is None:
            raise  # the working folder is missing
        if isinstance(error, RecursionError) and (files := _LimitedFiles.with_defaults):
            names = " and ".join(f"'{file}'" for file in files)
            raise ConfigurationError(
                f"the defaults of {names} lead back to themselves; remove an entry of them"
            ) from None
        composed_keys = OmegaConf.to_container(composed) if composed is not None else {}
        raise ConfigurationError(_error_line(error, command, composed_keys)) from None
    validated(Root, resolved, "", error=ConfigurationError)
    chosen = [key for key in RATES if any(override.key_or_group == key for override in read)]
    return {str(key): value for key, value in resolved.items()} | (
        {OVERRIDDEN_RATES_KEY: chosen} if chosen else {}
    )


def _is_group(key: str) -> bool:
    """Whether a key names a folder of choices, as Hydra looks for one; a value is anything else."""
    return any(os.path.isdir(folder / key) for folder in conf_folders())


@lru_cache(maxsize=256)
def _composed(command: str, of_groups: tuple[str, ...], stamp: str) -> DictConfig:
    """A configuration as Hydra composes it from choices of groups, before any value is set.

    Hydra reads and merges the same files for all jobs with the same choices, which takes 0.1 s;
    values it sets afterwards, with `ConfigLoaderImpl._apply_overrides_to_config`. ``stamp`` is that
    of the files, so that changed files are read anew.
    """
    if _LocalFirst not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(_LocalFirst)
    SourcesRegistry.instance().register(_LimitedFiles)
    _LimitedFiles.with_defaults.clear()
    with initialize_config_dir(config_dir=str(packaged("conf")), version_base="1.3"):
        return compose(command, overrides=[NO_SEARCH_PATH, *of_groups])


def _check(override: Override) -> None:
    """Raise `ConfigurationError` for an override that Hydra would accept wrongly, or refuse with
    less help.
    """
    group = override.key_or_group
    text = _shortened(override.input_line)
    if override.is_sweep_override():
        raise ConfigurationError(
            f"'{text}' names several values; one is required here (pipelines and sweeps take "
            "several)"
        )
    if override.is_delete() and "." not in group:
        raise ConfigurationError(
            f"'{text}': only keys inside a group can be removed, for example "
            "~dataset.channels.steer"
        )
    if re.match(r"hydra\b", group):
        raise ConfigurationError(
            f"'{text}' is an option of Hydra itself, which vehest does not take"
        )
    if (
        group in GROUPS
        and not override.is_delete()
        and str(override.value()) not in (offered := choices(group))
    ):
        close = difflib.get_close_matches(str(override.value()), offered, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise ConfigurationError(
            f"{group}={override.value()} is not there; {hint}choices: {', '.join(offered)}"
        )


def _error_line(error: Exception, command: str, composed: Any) -> str:
    """An error of Hydra in one line, with the next step where it is known.

    ``composed``: the configuration before values were set.
    """
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return f"the configuration of '{command}' cannot be read ({first_line(error)})"
    text = str(error).strip()
    if unknown := re.search(r"Could not override '([^']+)'", text):
        group, _, option = unknown[1].partition(".")
        family = composed.get(group, {}).get("name") if isinstance(composed, dict) else None
        if group == "estimator" and family and option and "." not in option:
            message = unknown_option(str(family), option, _option_names())
            fitted = f"; +estimator.{option}=… gives a number that is otherwise fitted"
            return message if "did you mean" in message else message + fitted
        listing = f"'vehest config {command}' prints the options there are"
        meant = close_key(unknown[1], composed)
        hint = option_hint(unknown[1])
        if meant and not hint:
            hint = f"; did you mean '{meant}'? {listing}"
        return f"unknown option '{unknown[1]}'{hint or f'; {listing}; +{unknown[1]}=… adds one'}"
    if missing := re.search(r"You must specify '([^']+)'", text):
        return (
            f"{missing[1]} is not chosen; {missing[1]}=… (choices: "
            f"{', '.join(choices(missing[1]))})"
        )
    key = getattr(error, "full_key", None)
    return (
        f"{key}: {text.splitlines()[0]}"
        if key
        else " ".join(line.strip() for line in text.splitlines()[:2])
    )


def _option_names() -> dict[str, list[str]]:
    """Option names of each estimator by its file in conf/estimator, without ``estimator.``."""
    names: dict[str, list[str]] = {}
    for folder in conf_folders():
        for file in sorted((folder / "estimator").glob("*.yaml")):
            content: Any = None
            with suppress(VehestError):
                content = read_yaml(file)
            # a file that also chooses a training has its options under ``estimator``
            settings = content.get("estimator", content) if isinstance(content, dict) else None
            if isinstance(settings, dict):
                family = str(settings.get("name", file.stem))
                names.setdefault(family, [str(key) for key in settings if key != "name"])
    return names


@lru_cache(maxsize=4096)
def parsed(text: str) -> Override:
    """An override, read in Hydra's grammar; raises `ConfigurationError` for bad syntax.

    Parameters
    ----------
    text : str
        ``KEY=VALUE``, ``+KEY=VALUE``, ``++KEY=VALUE`` or ``~KEY``.
    """
    try:
        override = OverridesParser.create().parse_override(text)
        # a choice called nan or inf
        if override.key_or_group in GROUPS and isinstance(override.value(), float):
            return OverridesParser.create().parse_override(
                f"{override.get_key_element()}='{override.value()}'"
            )
        return override
    except (HydraException, ValueError, ArithmeticError, TypeError, RecursionError) as error:
        if isinstance(error, HydraException) and "=" not in text:
            raise ConfigurationError(
                f"'{text}' is not an override; write key=value, for example estimator=ksnn"
            ) from None
        raise ConfigurationError(
            f"override '{_shortened(text)}' cannot be read ({first_line(error)}); quote special "
            "characters"
        ) from None


def count(overrides: Sequence[str]) -> int:
    """Number of combinations that `expand` gives.

    Of one override at most ``limits.jobs`` + 1 values count.
    """
    return math.prod(map(len, map(_values, map(parsed, overrides))))


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """All combinations of overrides with several values, the last one varying fastest.

    `ConfigurationError` above ``limits.jobs``.

    Returns
    -------
    list of list of str
        Overrides with a single value each.
    """
    check_jobs(count(overrides), "these overrides stand")
    return [list(job) for job in product(*map(_values, map(parsed, overrides)))]


def _values(override: Override) -> list[str]:
    """The override once for each of its values, at most ``limits.jobs`` + 1 of them."""
    if not override.is_sweep_override():
        return [str(override.input_line)]
    text = _shortened(override.input_line)
    value = override.value()
    try:
        value_texts = (
            value.filter(choices(override.key_or_group))
            if isinstance(value, Glob)
            else override.sweep_string_iterator()
        )
        values = list(islice(value_texts, current_limits().jobs + 1))
    except (HydraException, ValueError, ArithmeticError, TypeError) as error:
        raise ConfigurationError(
            f"override '{text}' cannot be read ({first_line(error)})"
        ) from None
    if not values:
        raise ConfigurationError(f"'{text}' stands for no value")
    return [f"{override.get_key_element()}={value}" for value in values]


def check_jobs(number: int, subject: str) -> None:
    """Raise `ConfigurationError` for more jobs than ``limits.jobs``; ``subject`` begins the
    message, such as ``these overrides stand``.
    """
    check_limit("jobs", number, f"{subject} for at least {number} jobs", ConfigurationError)


def limits_of(overrides: Sequence[str]) -> Limits:
    """Limits of the size of inputs: those of conf/common.yaml, changed by overrides.

    Parameters
    ----------
    overrides : sequence of str
        Only those of ``limits`` count.
    """
    overrides_of_limits = list(
        dict.fromkeys(text for text in overrides if key_of(text).split(".")[0] == "limits")
    )
    return limits_from_config(compose_config("eval", overrides_of_limits)["limits"])


def value_of(override: str) -> Any:
    """The value that an override sets."""
    return parsed(override).value()


def key_of(override: str) -> str:
    """The key that an override sets, for example ``training.patience``."""
    return str(parsed(override).key_or_group)


def option_hint(key: str) -> str:
    """A hint for a key that is an option of the command, not of the configuration; else empty."""
    hint = OPTION_HINTS.get(key.replace("_", "-"), "")
    return hint and f"; {hint}"


def close_key(key: str, config: Any) -> str:
    """The dotted key of a configuration that is spelt most like an unknown one; empty if none.

    A key without its group, such as ``n_local``, is looked for in all groups.

    Parameters
    ----------
    key : str
        Dotted, as the user wrote it.
    config : Any
        Nested mappings; anything else has no keys.
    """
    group, _, subkey = key.partition(".")
    if not isinstance(config, dict):
        return ""
    names = [str(name) for name in config if name != OVERRIDDEN_RATES_KEY]
    name = group if group in names else closest(group, names)
    if name and not subkey:
        return name
    inner = close_key(subkey, config[name]) if name else ""
    if inner:
        return f"{name}.{inner}"
    dotted = (
        []
        if subkey
        else [f"{name}.{group}" for name in names if has_key(config, f"{name}.{group}")]
    )
    return next(iter(dotted), "")


def has_key(config: Config, key: str) -> bool:
    """Whether a dotted key is in a configuration."""
    first, _, subkey = key.partition(".")
    return (
        isinstance(config, dict)
        and first in config
        and (not subkey or has_key(config[first], subkey))
    )


def quoted(text: Any) -> str:
    """A value in quotes as Hydra's grammar reads it back.

    Only quotes, and backslashes before them, are escaped.
    """
    escaped = re.sub(
        r"(\\*)('|$)", lambda quote: quote[1] * 2 + ("\\'" if quote[2] else ""), str(text)
    )
    return f"'{escaped}'"


def as_yaml(config: Config) -> str:
    """A configuration as YAML, control characters as escapes."""
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True, width=120)
    return (
        text
        if printable(text, keep="\n") == text
        else yaml.safe_dump(config, sort_keys=False, allow_unicode=False, width=120)
    )


def positive_rate(value: Any, name: str) -> float:
    """A rate [Hz] of a configuration.

    Raises
    ------
    ConfigurationError
        It is no positive number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
        raise ConfigurationError(
            f"{name} must be a positive number [Hz], not {value!r}; for example {name}=20"
        )
    return float(value)


def dotted(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys of nested mappings with their values; ``prefix`` comes before each key."""
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def missing_keys(config: Mapping[str, Any]) -> list[str]:
    """Dotted keys that still hold ``???``."""
    return [key for key, value in dotted(config) if value == "???"]


def _shortened(text: Any) -> str:
    """A text, cut off after 80 characters where it is longer than 100."""
    return str(text) if len(str(text)) <= 100 else f"{text[:80]}…"
