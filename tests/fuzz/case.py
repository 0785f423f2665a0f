"""What a generator is given and what it returns, and the register of all generators."""

import importlib
import os
import pkgutil
import random
import shutil
from collections import namedtuple
from dataclasses import dataclass
from pathlib import Path

import numpy as np

CANARY = "EXECUTED"
"""Name of the file that every payload tries to make."""
PLANTED = "planted"
"""Family of the commands that misbehave on purpose."""

# so deep that some steps upwards still end inside the case's own folder, where they are noticed
_DEPTH = ("up", "up", "up", "place")


@dataclass(frozen=True)
class Command:
    """A command line to try: words after ``vehest``, and files and folders, beside the output root,
    that it may write.
    """

    argv: tuple[str | bytes, ...]
    targets: tuple[str, ...] = ("out.csv",)


@dataclass(frozen=True)
class Case:
    """One input to make, in a folder of its own; nothing above it may be touched."""

    folder: Path
    templates: Path  # honest files made once, by the name of their template; to be copied
    rng: random.Random  # of everything that is drawn
    honest: bool  # the input is left as it should be, so that the command must succeed
    visit: int  # how often its generator has been called before, to go through a list of ideas
    seconds: float = 20.0  # that its command may take

    @property
    def place(self):
        """Working folder of the command."""
        return self.folder.joinpath(*_DEPTH)

    @property
    def numbers(self):
        """Random numbers by the array."""
        return np.random.default_rng(self.rng.getrandbits(63))

    def copy(self, template, to="."):
        """Copy a template's folder into the place, and say where."""
        return Path(
            shutil.copytree(
                self.templates / template, self.place / to, symlinks=True, dirs_exist_ok=True
            )
        )

    def write(self, name, content):
        """Write a file into the place."""
        path = self.place / os.fsdecode(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(
            content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
        )
        return path

    def spoil(self, file, spoil):
        """Replace the content of a file by what ``spoil`` makes of it, unless the case is honest.

        Returns whether that was done.
        """
        if not self.honest:
            file.write_bytes(spoil(file.read_bytes(), self.rng))
        return not self.honest

    def idea(self, number):
        """One of several ideas: all of them in turn, visit after visit; -1 in an honest case."""
        return -1 if self.honest else self.visit % number


Generator = namedtuple("Generator", "family name build needs weight")
"""A way to make inputs: a function that writes the files of a case and returns the command,
templates, and its turns in a round.
"""
GENERATORS = []
TEMPLATES = {}


def generator(*needs, weight=1):
    """Register a generator with the templates that it copies from."""

    def register(build):
        GENERATORS.append(
            Generator(build.__module__.rpartition(".")[2], build.__name__, build, needs, weight)
        )
        return build

    return register


def template(build):
    """Register what fills a template's folder, under the function's name."""
    TEMPLATES[build.__name__] = build
    return build


def load_families():
    """Import every module of `fuzz.families`, which registers its generators."""
    from fuzz import families

    for module in sorted(
        pkgutil.iter_modules(families.__path__), key=lambda module_info: module_info.name
    ):
        importlib.import_module(f"{families.__name__}.{module.name}")


def schedule(chosen):
    """The generators in the order in which they take turns.

    Heavier ones come more than once a round.
    """
    return [
        generator
        for turn in range(max(generator.weight for generator in chosen))
        for generator in chosen
        if generator.weight > turn
    ]


def is_honest(generator, position, visit):
    """Whether a visit makes the honest variant: the first visits of an eighth of the generators,
    then each in its turn.
    """
    return generator.family != PLANTED and (visit + position) % 8 == 0
