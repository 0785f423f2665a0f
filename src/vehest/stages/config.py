"""Composing configurations with Hydra, and turning its errors into one line each."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vehest.data.errors import ConfigurationError
from vehest.stages.config_files import GROUPS, choices, local_conf, packaged_conf

Config = dict[str, Any]


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
        Plain dicts, lists, strings and numbers.

    Raises:
        ConfigurationError: an unknown key or choice, a wrong value, or bad syntax.
    """
    parsed = parse(overrides)
    for override in parsed:
        if override.is_sweep_override():
            raise ConfigurationError(
                f"'{override.input_line}' names several values; one is wanted here (pipelines and sweeps take several)"
            )
        _check_choice(override)
    _register_plugin()
    try:
        with initialize_config_dir(config_dir=str(packaged_conf()), version_base="1.3"):
            composed = compose(command, overrides=list(overrides))
        resolved = OmegaConf.to_container(composed, resolve=True, throw_on_missing=False)
    except (HydraException, OmegaConfBaseException, yaml.YAMLError) as error:
        raise ConfigurationError(_one_line(error, command)) from None
    assert isinstance(resolved, dict)
    return {str(key): value for key, value in resolved.items()}


def parse(overrides: Sequence[str]) -> list[Override]:
    """Parse overrides in Hydra's grammar.

    Raises:
        ConfigurationError: bad syntax.
    """
    parser = OverridesParser.create()
    parsed = []
    for text in overrides:
        try:
            parsed.append(parser.parse_override(text))
        except HydraException as error:
            if "=" not in text:
                raise ConfigurationError(f"'{text}' is not an override; write key=value, for example estimator=ksnn") from None
            raise ConfigurationError(f"override '{text}' cannot be read ({str(error).splitlines()[0]}); quote special characters") from None
    return parsed


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """All combinations that overrides with several values stand for, the last one varying fastest.

    Raises:
        ConfigurationError: bad syntax.
    """
    jobs: list[list[str]] = [[]]
    for override in parse(overrides):
        key = override.get_key_element()
        several = override.is_sweep_override()
        values = [f"{key}={value}" for value in override.sweep_string_iterator()] if several else [override.input_line]
        jobs = [[*job, value] for job in jobs for value in values]
    return jobs


def key_of(override: str) -> str:
    """The key that an override sets, for example ``training.patience``."""
    return str(parse([override])[0].key_or_group)


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
    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True, width=120)


def missing_keys(config: Any, prefix: str = "") -> list[str]:
    """Dotted keys that still hold ``???``."""
    if isinstance(config, dict):
        return [found for key, value in config.items() for found in missing_keys(value, f"{prefix}{key}.")]
    return [prefix.rstrip(".")] if config == "???" else []


def _check_choice(override: Override) -> None:
    group = override.key_or_group
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
    text = str(error).strip()
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        name = unknown.group(1)
        return f"unknown option '{name}'; 'vehest config {command}' prints the options there are; +{name}=… adds one"
    missing = re.search(r"You must specify '([^']+)'", text)
    if missing:
        return f"say which {missing.group(1)}: {missing.group(1)}=… (choices: {', '.join(choices(missing.group(1)))})"
    variable = re.search(r"Environment variable '([^']+)' not found", text)
    if variable:
        return f"environment variable {variable.group(1)} is not set"
    key = getattr(error, "full_key", None)
    return f"{key}: {text.splitlines()[0]}" if key else " ".join(line.strip() for line in text.splitlines()[:2])
