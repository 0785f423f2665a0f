"""Runs a model online on the frames of a log, as ``vehest replay`` asks for it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.bus.mapping import BusSignals, from_dataset, from_names
from vehest.bus.messages import EstimateFrames
from vehest.bus.outputs import output_files
from vehest.bus.outputs import write_dbc as write_dbc_file
from vehest.bus.replay import Bus, Replay, survey
from vehest.bus.view import View
from vehest.configuration.estimate_options import estimate_options
from vehest.data.car import UNKNOWN_CAR
from vehest.data.errors import ConfigurationError
from vehest.data.files import without_links
from vehest.data.limits import use_limits
from vehest.estimators.base import Estimator
from vehest.inference.car_values import adapted
from vehest.inference.models import PRETRAINED, SHIPPED_NOTES, WITH_VEHEST, open_model
from vehest.inference.reading import vehicle_of
from vehest.sources.base import car_of
from vehest.sources.can.logs import read_frames
from vehest.trust.contract import GuardedStepper
from vehest.trust.record import describe_band, is_other_vehicle

# relative difference between the bus's and the model's rate, beyond which samples are low-passed
# and resampled
MAX_RATE_DIFFERENCE = 1e-6


def replay_log(
    log: Path,
    overrides: Sequence[str] = (),
    stopped: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda _: None,
    *,
    model: str = PRETRAINED,
    dbc: Path | None = None,
    dataset: str | None = None,
    signals: str = "",
    speed: str = "1",
    bus_rate: float | None = None,
    interface: str = "virtual",
    channel: str = "vehest",
    identifier: str = "0x6F0",
    out: Path | None = None,
    write_dbc: Path | None = None,
    quiet: bool = True,
) -> dict[str, Any]:
    """Replay a log of a CAN bus and run a model on it online, as ``vehest replay`` does; returns
    the figures that it prints. Raises `VehestError`.

    Parameters
    ----------
    log : Path
        Log of a CAN bus.
    overrides : sequence of str
        Of conf/estimate.yaml.
    stopped : callable
        Asked while frames are sent; true ends the replay.
    say : callable
        Takes remarks, one line each.
    model : str
        As `open_model` finds it.
    dbc : Path or None
        Describes the bus, unless a data set does.
    dataset : str or None
        Name of a data set in conf/dataset.
    signals : str
        ``CHANNEL=MESSAGE.SIGNAL`` pairs, separated by commas, where names do not decide.
    speed : str
        Factor of the log's time, or ``max`` on the virtual bus.
    bus_rate : float or None
        Rate of samples [Hz]; None: that of the fastest channel, rounded to a plain rate.
    interface, channel : str
        Of python-can.
    identifier : str
        Of the first frame of estimates, decimal or hexadecimal.
    out : Path or None
        Where estimates go.
    write_dbc : Path or None
        Where a DBC of the frames of estimates goes.
    quiet : bool
        Draw nothing while it runs.
    """
    bus = Bus(interface, channel, _speed(speed))
    estimates = EstimateFrames(_identifier(identifier))
    if bus.speed is None and interface != "virtual":
        raise ConfigurationError(
            f"--speed max needs the virtual bus, not '{interface}'; give --speed 1"
        )
    written = output_files(out) + ([write_dbc] if write_dbc else [])
    for path in written:
        inputs = [without_links(file) for file in (log, dbc) if file is not None]
        if without_links(path) in inputs:
            raise ConfigurationError(f"'{path}' is an input; name another file")
    options = estimate_options([*([f"dataset={dataset}"] if dataset else []), *overrides])
    folder, fitted, trust = open_model(model, options.output, say)
    car = car_of(options.dataset) if dataset else UNKNOWN_CAR
    fitted, trust, remarks = adapted(fitted, trust, car, options.settings)
    for remark in remarks:
        say(remark)
    vehicle = vehicle_of(options.dataset)
    elsewhere = is_other_vehicle(trust, vehicle, options.same_vehicle, car)
    band = describe_band(trust, vehicle, options.same_vehicle, car)
    with use_limits(options.limits):
        bus_signals = _signals(options.dataset if dataset else None, dbc, signals, fitted)
        frames = read_frames(log)
        if frames.cut_end:
            say(f"not read: {frames.cut_end}")
        timing = survey(frames, bus_signals, bus_rate)
        faster = (
            timing.rate_hz
            if abs(timing.rate_hz / fitted.settings.rate_hz - 1.0) > MAX_RATE_DIFFERENCE
            else None
        )
        if write_dbc is not None:
            write_dbc_file(write_dbc, estimates.identifiers[0])
        view = View(None if quiet else sys.stderr)
        figures = Replay(frames, bus_signals, timing, bus, estimates, stopped).run(
            lambda clock: GuardedStepper(fitted, trust, faster, elsewhere=elsewhere, clock=clock),
            out,
            view,
        )
    return {
        "log": str(log),
        "model": model if model in WITH_VEHEST else str(folder),
        "samples_hz": timing.rate_hz,
        "estimates_hz": fitted.settings.rate_hz,
        "delay_ms": round(1e3 * GuardedStepper(fitted, trust, faster).delay, 3),
        **figures.plain(),
        **({"band": band} if band else {}),
        "stopped": stopped(),
        "written": [str(file) for file in written],
        **({"note": SHIPPED_NOTES[model]} if model in SHIPPED_NOTES else {}),
    }


def _signals(
    described: Mapping[str, Any] | None, dbc: Path | None, signals: str, model: Estimator
) -> BusSignals:
    """The signals of a model's channels on the bus: from the configuration of a data set, if there
    is one, else by their names in a DBC.
    """
    named = [word for word in signals.split(",") if word.strip()]
    if described is not None:
        if named:
            raise ConfigurationError(
                "--dataset and --signals both name the channels; leave one out"
            )
        return from_dataset(described, model.channels, model.skippable, dbc)
    if dbc is None:
        raise ConfigurationError("nothing describes the bus; add --dbc car.dbc, or --dataset NAME")
    return from_names(dbc, model.channels, model.skippable, named)


def _speed(text: str) -> float | None:
    """Factor of the log's time from text, None for ``max``; raises `ConfigurationError`
    otherwise.
    """
    with suppress(ValueError):
        if text == "max" or 0 < float(text) < math.inf:
            return None if text == "max" else float(text)
    raise ConfigurationError(f"--speed must be a positive number or max, not '{text}'")


def _identifier(text: str) -> int:
    """A CAN identifier from decimal or hexadecimal text; raises `ConfigurationError` otherwise."""
    with suppress(ValueError):
        if int(text, 0) > 0:
            return int(text, 0)
    raise ConfigurationError(f"--id must be an identifier such as 0x6F0, not '{text}'")
