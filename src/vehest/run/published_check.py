"""Which published results are not those of today's code, configuration and data; neither models nor an output root are needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vehest.data.errors import ConfigurationError, MissingError, VehestError
from vehest.run.config import Config
from vehest.run.config_files import find_pipeline, pipeline_names
from vehest.run.console import Messages
from vehest.run.ingest import plan_ingest
from vehest.run.pipeline import Configs, Pipeline, content_overrides, pipeline_configs, read_pipeline
from vehest.run.publishing import PROVENANCE, RESULTS, Published, published_in
from vehest.run.signals import StopSignals
from vehest.run.study_keys import CODE, CONFIGURATION, DATA, Keys, keys_of_study
from vehest.run.workshop import Workshop

State = Literal["up to date", "stale", "not known"]
CAUSES = (CODE, CONFIGURATION, DATA)
MOST_NAMED = 6


@dataclass(frozen=True)
class Change:
    """Something that is not as it was when results were published.

    Args:
        what: is made of it, for example ``train ksnn``.
        cause: ``code``, ``configuration`` or ``data``.
    """

    what: str
    cause: str


@dataclass(frozen=True)
class Verdict:
    """What is known of a published study.

    Args:
        study: its name.
        state: of its results.
        changes: why they are stale.
        note: what could not be compared, or why nothing is known; may be empty.
    """

    study: str
    state: State
    changes: tuple[Change, ...] = ()
    note: str = ""

    def in_words(self) -> str:
        """One line."""
        words = []
        for cause in CAUSES:
            named = [change.what for change in self.changes if change.cause == cause]
            if named:
                more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
                words.append(f"{cause} ({', '.join(named[:MOST_NAMED])}{more})")
        why = [*([", ".join(words)] if words else []), *([self.note] if self.note else [])]
        return ": ".join([self.study, self.state, *(["; ".join(why)] if why else [])])


def check_published(names: Sequence[str], overrides: Sequence[str] = ()) -> list[Verdict]:
    """Compare what is recorded of published studies with what it would be today.

    Args:
        names: of studies, or pipelines by name or path; all that are published in ./results if there are none.
        overrides: ``root=FOLDER``, where raw files lie elsewhere than ``VEHEST_DATA`` says.

    Raises:
        ConfigurationError: an override that would change what comes out.
        MissingError: a name is neither a pipeline's nor that of a published study; or nothing is published.
    """
    if content_overrides(overrides):
        raise ConfigurationError(f"'{content_overrides(overrides)[0]}' changes what comes out, and what is published was made without it")
    pipelines: dict[str, Pipeline | None] = {}
    for name in names:
        if find_pipeline(name) is None and (RESULTS / name / PROVENANCE).is_file():
            pipelines[name] = _pipeline_of(name)
        else:
            pipeline = read_pipeline(name)
            pipelines[pipeline.study] = pipeline
    if not names:
        studies = sorted(file.parent.name for file in RESULTS.glob(f"*/{PROVENANCE}"))
        pipelines = {study: _pipeline_of(study) for study in studies}
    if not pipelines:
        raise MissingError(f"no study is published in '{RESULTS}'; run one whose pipeline says publish: true")
    return [_verdict(study, pipeline, overrides) for study, pipeline in pipelines.items()]


def _pipeline_of(study: str) -> Pipeline | None:
    """The pipeline whose outcome goes to results/STUDY; the one of the same name first."""
    for name in sorted(pipeline_names(), key=lambda name: name != study):
        try:
            pipeline = read_pipeline(name)
        except VehestError:
            continue
        if pipeline.study == study and pipeline.publish:
            return pipeline
    return None


def _verdict(study: str, pipeline: Pipeline | None, overrides: Sequence[str]) -> Verdict:
    published = published_in(RESULTS / study)
    if published is None:
        return Verdict(study, "not known", note=f"there is nothing in '{RESULTS / study}' that vehest published")
    if not published.keys:
        return Verdict(study, "not known", note="published before keys were recorded; run it again")
    if pipeline is None:
        return Verdict(study, "not known", note=f"there is no pipeline that publishes '{study}'")
    try:
        return _compared(pipeline, pipeline_configs(pipeline, overrides), published)
    except ConfigurationError as error:
        return Verdict(study, "stale", (Change("pipeline", CONFIGURATION),), f"today it cannot be run ({error})")


def _compared(pipeline: Pipeline, configs: Configs, published: Published) -> Verdict:
    first = next(iter(configs.values()))[0]
    workshop = Workshop(Path(str(first["output"])), Messages(silent=True), StopSignals())
    elsewhere: list[str] = []

    def inputs_of(config: Config) -> Mapping[str, str] | None:
        try:
            return plan_ingest(config).inputs
        except MissingError:
            elsewhere.append(str(config["dataset"]["name"]))
            return None

    today = keys_of_study(pipeline, configs, published.absent, workshop.dataset_config, inputs_of)
    changes = [*_changes(published.keys, today), *_found_since(pipeline, configs, published, workshop)]
    note = f"raw files not here, not compared: {', '.join(elsewhere)}" if elsewhere else ""
    return Verdict(pipeline.study, "stale" if changes else "up to date", tuple(changes), note)


def _changes(then: Mapping[str, Mapping[str, str]], today: Keys) -> list[Change]:
    changes = [Change(what, cause) for what in then if what in today for cause in CAUSES if _differs(then[what], today[what], cause)]
    changes += [Change(f"{what} added", CONFIGURATION) for what in today if what not in then]
    return changes + [Change(f"{what} removed", CONFIGURATION) for what in then if what not in today]


def _differs(then: Mapping[str, str], today: Mapping[str, str], cause: str) -> bool:
    if cause == DATA and DATA not in today:  # the raw files are not here
        return False
    return then.get(cause) != today.get(cause)


def _found_since(pipeline: Pipeline, configs: Configs, published: Published, workshop: Workshop) -> list[Change]:
    """What a study had to go on without and could show today."""
    wanted = {part.name: configs[part.name][0] for part in pipeline.parts if part.name in published.absent}
    if pipeline.datasets:
        wanted = {str(config["dataset"]["name"]): config for config in configs[""] if config["dataset"]["name"] in published.absent}
    found = []
    for name, config in wanted.items():
        try:
            if pipeline.datasets:
                plan_ingest(config)
            else:
                workshop.look_for_files(config)
        except MissingError:
            continue
        found.append(Change(f"{name}, which was not here", DATA))
    return found
