"""Versions of what stages run, which are part of keys (docs/how_it_is_built.md#keys)."""

from __future__ import annotations

from vehest.estimators.base import Estimator
from vehest.estimators.registry import estimator_class
from vehest.sources.base import source_class
from vehest.studies.registry import study_module

VERSIONS = {
    "ingest": "1",
    "downsample": "1",
    "train": "1",
    "calibrate": "3",
    "evaluate": "2",
    "report": "1",
    "sweep": "2",
}
"""Stage -> its version, which is raised when its results change."""
FAULTS = "3"  # version of the evaluation under faults, which is raised when its results change
# version of the calibration of estimators with a tyre check, which is raised when its results
# change
TYRE_CHECK = "1"


def _checks_tyres(name: str) -> bool:
    """Whether an estimator's bands have a tyre check, so that a calibration has a further
    version.
    """
    return estimator_class(name).training_friction is not Estimator.training_friction


def code_of(stage: str, name: str = "", *, faults: bool = False) -> str:
    """Version of a stage with that of its source, estimator or study, and of ``faults``, such as
    ``train=1 ksnn=1 training=1``.

    Parameters
    ----------
    stage : str
        One of `VERSIONS`.
    name : str
        Of the source (``ingest``), study (``report``) or estimator (other stages); empty for a
        stage without.
    faults : bool
        Whether an evaluation has faults.

    Raises
    ------
    ConfigurationError
        The name is unknown.
    """
    code = f"{stage}={VERSIONS[stage]}"
    if stage == "ingest":
        code += f" {name}={source_class({'source': name}).version}"
    elif stage == "report":
        code += f" {name}={getattr(study_module(name), 'VERSION', '1')}"
    elif name:
        code += f" {name}={estimator_class(name).version}"
    if stage == "calibrate" and name and _checks_tyres(name):
        code += f" tyre_check={TYRE_CHECK}"
    if stage == "train":
        code += f" training={getattr(estimator_class(name).training_type, 'version', '1')}"
    return f"{code} faults={FAULTS}" if faults else code


def is_of_other_stages(code: str) -> bool:
    """Whether a recorded version names another version of a stage than today's.

    Versions of classes are not compared.
    """
    versions = (pair.partition("=") for pair in code.split())
    return any(VERSIONS.get(name, version) != version for name, _, version in versions)
