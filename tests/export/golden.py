"""Golden files: the C of models with weights set by hand.

`python tests/export/golden.py` writes them anew after a wanted change.
"""

import re
import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1] / part) for part in (".", "estimators", "export")]

import numpy as np
from c_build import method_files, write
from exports import LARGEST, WEIGHTS, model

from vehest.data.channels import CHANNELS
from vehest.export.program import program_files
from vehest.trust.bands import Bands, Quantity
from vehest.trust.contract import GuardedStepper
from vehest.trust.guard import ChannelLimits, GuardLimits
from vehest.trust.health import HealthModel
from vehest.trust.record import About, Trust
from vehest.trust.relations import Relation

FOLDER = Path(__file__).parent / "golden"
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.\d*|\d+)(?:[eE][+-]?\d+)?f?(?![\w.])")


def by_hand(name):
    """Twentieths for weights, so that no training has a say."""
    shapes = model(name)
    twin = type(shapes)(shapes.settings)
    twin.preparation = shapes.preparation
    weights = {}
    for key, values in shapes.weights().items():
        twentieths = (7 * np.arange(values.size) + 3 + len(key)) % 11 + 1
        weights[key] = (twentieths / 20).reshape(values.shape).astype(values.dtype)
        if key.endswith("covariance"):
            weights[key] = weights[key] @ weights[key].T
    twin.load_weights(weights)
    return twin


def trust_by_hand():
    """Limits, health and bands of three channels: one lag, one relation."""
    channels = ("vx", "yaw_rate", "ay")
    health = HealthModel(
        channels=channels,
        rate_hz=100.0,
        relations=(Relation("ay", "yaw_rate", {"1": 0.05, "u r": 1.0}, True),),
        constant=(0.1, 0.0, 0.01),
        coefficients=(((0.99, 0.0, 0.0), (0.0, 0.9, 0.0), (0.0, 0.1, 0.8)),),
        precision=((400.0, 0.0, 0.0), (0.0, 1e4, 10.0), (0.0, 10.0, 25.0)),
        deviation=(0.05, 0.01, 0.2),
        usual=(20.0, 0.0, 0.0),
        largest=(40.0, 0.6, 9.0),
        longest_gap=(0.0, 0.0, 0.02),
        standstill=(2.0, 0.05, 0.5),
        spin=(0.8, 12.0),
        speeds=(5.0, 10.0, 20.0, 30.0, 40.0),
        levels=(
            (0.5, 0.5, 0.5),
            (0.8, 0.8, 0.8),
            (1.0, 1.0, 1.0),
            (1.2, 1.2, 1.2),
            (1.5, 1.5, 1.5),
        ),
        healthy=((0.01, 0.0, 0.02),),
        heaviest=((10.0, 20.0, 30.0),),
        limits=tuple(4.0 + 0.25 * number for number in range(22)),
    )
    channel_limits = {
        name: ChannelLimits(max(-size, CHANNELS[name].low), size, size / 4.0, 0.5)
        for name, size in zip(channels, (120.0, 4.0, 40.0), strict=True)
    }
    v, angle = (
        Quantity(WEIGHTS, floor, (0.5, 1.0, 1.75, 2.5), (False,) * 4, 10.0)
        for floor in (0.02, 0.001)
    )
    bands = Bands(
        ("car",), ("set",), ("a",), ("b",), "range", 10, 100.0, channels, 0, LARGEST, v, angle
    )
    return Trust(About("kinematic"), bands, GuardLimits(channel_limits, 120.0, 1.0), health)


def methods(families):
    """Name of a file -> the C of a family's method."""
    return {
        f"{name}/{file}": text
        for name in families
        for file, text in method_files(by_hand(name), "double").items()
    }


def contract():
    """Name of a file -> the C around a method."""
    stepper = GuardedStepper(by_hand("kinematic"), trust_by_hand(), 500.0)
    files = program_files(stepper, "float", "Kinematic integration, weights set by hand")
    return {f"contract/{name}": text for name, text in files.items() if "method" not in name}


def sources():
    """Name of a golden file -> what it should hold today: a filter, a network and the contract.

    The comparison with Python holds the other families.
    """
    return methods(("dugoff_ukf", "ksnn")) | contract()


def differences(text, golden):
    """Where a text is another than the golden one.

    Numbers may differ in their last digits, as they do between machines.
    """
    ours = text.splitlines()
    theirs = golden.splitlines()
    if len(ours) != len(theirs):
        return [f"{len(ours)} lines instead of {len(theirs)}"]
    return [
        f"line {at}: {ours_line} instead of {golden_line}"
        for at, (ours_line, golden_line) in enumerate(zip(ours, theirs, strict=True), 1)
        if not _lines_agree(ours_line, golden_line)
    ]


def _lines_agree(ours_line, golden_line):
    """Whether two lines are equal but for the last digits of their numbers."""
    if NUMBER.sub("#", ours_line) != NUMBER.sub("#", golden_line):
        return False
    numbers = [
        [float(number.rstrip("f")) for number in NUMBER.findall(line)]
        for line in (ours_line, golden_line)
    ]
    return bool(np.allclose(*numbers, rtol=1e-9, atol=1e-12))


if __name__ == "__main__":
    write(sources(), FOLDER)
