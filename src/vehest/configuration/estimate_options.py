"""Options of `vehest estimate` and of other commands that open a model for a car.

conf/estimate.yaml and overrides -> `compose_config` -> `EstimateOptions`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.configuration.composition import compose_config, key_of
from vehest.data.errors import ConfigurationError
from vehest.data.limits import Limits, limits_from_config


@dataclass(frozen=True)
class EstimateOptions:
    """Options by which a recording is read, and by which the model is changed."""

    output: Path  # root in which models are looked for by name
    dataset: dict[str, Any]  # options of the recording's data set
    names_dataset: bool  # whether an override chooses the data set
    limits: Limits  # upper bounds of the size of inputs
    # settings of the self-calibrating filter that overrides set, name -> value
    settings: dict[str, Any]
    # the user's word on whether it is the car of the training; None: decided by names and values of
    # the cars
    same_vehicle: bool | None
    # resampling that overrides set; None: that of the model's training
    preparation: dict[str, Any] | None


def estimate_options(overrides: Sequence[str]) -> EstimateOptions:
    """Compose conf/estimate.yaml with overrides.

    Parameters
    ----------
    overrides : sequence of str
        Of the command; those of ``estimator`` are settings of a model that is opened later.

    Raises
    ------
    ConfigurationError
        An override, or a value, is wrong.
    """
    config = compose_config("estimate", overrides)
    same_vehicle = config["same_vehicle"]
    if same_vehicle is not None and not isinstance(same_vehicle, bool):
        raise ConfigurationError(f"same_vehicle must be true, false or null, not {same_vehicle!r}")
    keys = [key_of(override) for override in overrides]
    changes_preparation = any(key.split(".")[0] == "downsample" for key in keys)
    return EstimateOptions(
        output=Path(config["output"]),
        dataset=config["dataset"],
        names_dataset="dataset" in keys,
        limits=limits_from_config(config["limits"]),
        settings={key: value for key, value in config["estimator"].items() if key != "name"},
        same_vehicle=same_vehicle,
        preparation=config["downsample"] if changes_preparation else None,
    )
