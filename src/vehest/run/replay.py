"""Runs a model online on the frames of a log, as ``vehest replay`` asks for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.bus.mapping import BusSignals, from_dataset, from_names
from vehest.bus.outputs import check_output, open_output, write_dbc
from vehest.bus.replay import Bus, replay, survey
from vehest.bus.view import standard_view
from vehest.data.errors import ConfigurationError
from vehest.data.limits import limits_from_config, use_limits
from vehest.estimators.base import Estimator
from vehest.run.config import compose_config
from vehest.run.estimate import PRETRAINED, open_model, pretrained_note
from vehest.trust.contract import GuardedStepper

SAME_RATE = 1e-6


@dataclass(frozen=True)
class ReplayWords:
    """Options of ``vehest replay``."""

    log: Path
    model: str = PRETRAINED
    dbc: Path | None = None
    dataset: str | None = None
    signals: str = ""
    speed: str = "1"
    bus_rate: float | None = None
    interface: str = "virtual"
    channel: str = "vehest"
    identifier: str = "0x6F0"
    out: Path | None = None
    write_dbc: Path | None = None
    quiet: bool = True


def replay_log(
    words: ReplayWords,
    overrides: Sequence[str] = (),
    stopped: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Replay a log and let a model estimate; returns its figures.

    Raises:
        ConfigurationError: words that make no sense together.
        MissingError: log, DBC, model, bus or a package is not there.
        DataError: log or DBC cannot be used.
    """
    bus = Bus(words.interface, words.channel, _speed(words.speed), _identifier(words.identifier))
    for path in (words.out, words.write_dbc):
        if path is not None and any(path.resolve() == other.resolve() for other in (words.log, words.dbc) if other is not None):
            raise ConfigurationError(f"'{path}' is an input; name another file")
    if words.out is not None:
        check_output(words.out)
    config = compose_config("estimate", [*([f"dataset={words.dataset}"] if words.dataset else []), *overrides])
    folder, model, trust = open_model(words.model, Path(config["output"]), say)
    with use_limits(limits_from_config(config["limits"])):
        signals = _signals(words, config["dataset"], model)
        found = survey(words.log, signals, words.bus_rate)
        faster = found.timing.rate_hz if abs(found.timing.rate_hz / model.settings.rate_hz - 1.0) > SAME_RATE else None
        if words.write_dbc is not None:
            write_dbc(words.write_dbc, bus.first_id)
        figures, output = replay(
            words.log,
            signals,
            found,
            lambda: GuardedStepper(model, trust, faster),
            bus,
            lambda names: open_output(words.out, names, bus.first_id),
            standard_view(f"{words.log.name} on {bus.interface} {bus.channel}", quiet=words.quiet),
            stopped,
        )
    delay_ms = round(1e3 * GuardedStepper(model, trust, faster).delay, 3)
    is_pretrained = words.model == PRETRAINED
    return {
        "log": str(words.log),
        "model": PRETRAINED if is_pretrained else str(folder),
        "samples_hz": found.timing.rate_hz,
        "estimates_hz": model.settings.rate_hz,
        "delay_ms": delay_ms,
        **figures.plain(),
        "stopped": stopped(),
        "written": [str(file) for file in (*output.files, *([words.write_dbc] if words.write_dbc else []))],
        **({"note": pretrained_note()} if is_pretrained else {}),
    }


def _signals(words: ReplayWords, dataset: dict[str, Any], model: Estimator) -> BusSignals:
    named = [word for word in words.signals.split(",") if word.strip()]
    if words.dataset is not None:
        if named:
            raise ConfigurationError("--dataset and --signals both name the channels; leave one out")
        return from_dataset(dataset, model.channels, model.skippable, words.dbc)
    if words.dbc is None:
        raise ConfigurationError("nothing describes the bus; add --dbc car.dbc, or --dataset NAME")
    return from_names(words.dbc, model.channels, model.skippable, named)


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(f"--speed must be a positive number or max, not '{text}'") from None


def _identifier(text: str) -> int:
    with suppress(ValueError):
        if int(text, 0) > 0:
            return int(text, 0)
    raise ConfigurationError(f"--id must be an identifier such as 0x6F0, not '{text}'")
