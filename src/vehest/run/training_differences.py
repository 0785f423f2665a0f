"""Options that distinguish trainings of one variant and one seed, which the variant's name does not
say.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from vehest.configuration.composition import dotted
from vehest.data.errors import ConfigurationError
from vehest.estimators.registry import new_estimator
from vehest.run.train import TrainJob

START = "start_from"  # option of the model that a training starts from

Differences = Mapping[str, str]  # option, without its group -> value


def differences_of(trainings: Iterable[TrainJob]) -> dict[str, Differences]:
    """Find the options in which trainings of one estimator, variant and seed differ.

    Parameters
    ----------
    trainings : iterable of TrainJob
        Trainings of one comparison; a training may occur more than once.

    Returns
    -------
    dict
        Key of a training -> its values of the options in which trainings of its variant differ;
        without those of variants that have one training a seed.

    Raises
    ------
    ConfigurationError
        Two trainings differ in none of the estimator's and the training's options.
    """
    variants: dict[tuple[str, str], dict[str, TrainJob]] = {}
    for training in trainings:
        estimator = new_estimator(training.estimator)
        name = (estimator.name, estimator.variant)
        variants.setdefault(name, {})[training.plan.key] = training
    differences: dict[str, Differences] = {}
    for variant in variants.values():
        if max(Counter(training.seed for training in variant.values()).values()) > 1:
            differences |= _differences_of_variant(variant)
    return differences


def difference_text(differences: Differences) -> str:
    """Suffix of a title, such as ``, learning_rate 0.003``, without the option ``start_from``,
    which has a text of its own there.
    """
    return "".join(
        f", {option} {value}" for option, value in differences.items() if option != START
    )


def difference_suffix(differences: Differences) -> str:
    """Suffix of a variant's name, such as ``_learning_rate_0.003``."""
    return "".join(f"_{option}_{value}" for option, value in differences.items())


def _differences_of_variant(trainings: Mapping[str, TrainJob]) -> dict[str, Differences]:
    """Differing options of trainings of one variant; raises `ConfigurationError` where two of one
    seed have the same.
    """
    options = {key: _options_of(training) for key, training in trainings.items()}
    names = dict.fromkeys(name for values in options.values() for name in values)
    differing = [
        name for name in names if len({values.get(name) for values in options.values()}) > 1
    ]
    differences: dict[str, Differences] = {
        key: {name.partition(".")[2]: values.get(name, "none") for name in differing}
        for key, values in options.items()
    }
    labels: dict[tuple[object, ...], str] = {}
    for key, training in trainings.items():
        label = (training.seed, *differences[key].values())
        if labels.setdefault(label, key) != key:
            raise ConfigurationError(
                f"two jobs are both called {training.plan.label} and have the same options of "
                "estimator and training; compare them in pipelines of their own"
            )
    return differences


def _options_of(training: TrainJob) -> dict[str, str]:
    """Options with their groups, ``training.learning_rate``, and their values as text; a model to
    start from by its name.
    """
    options = dict(dotted({"training": training.training, "estimator": training.estimator}))
    if start := options.get(f"training.{START}"):
        options[f"training.{START}"] = Path(str(start)).name
    return {name: "none" if value is None else str(value) for name, value in options.items()}
