"""Before the first stage: fetches a data set's files into its folder."""

from __future__ import annotations

from vehest.data.errors import ConfigurationError
from vehest.run.config import Config, compose_config
from vehest.run.config_files import choices
from vehest.run.runner import Runner
from vehest.run.signals import DryRunStop
from vehest.sources.base import open_source
from vehest.sources.download import Outcome, download_of


def download_files(config: Config, runner: Runner) -> None:
    """Fetch missing files of a data set, and record or compare the checksums of the others; errors as of `Download.fetch`.

    Raises:
        ConfigurationError: the data set names no source of its files.
        DryRunStop: in a dry run, if a file would have to be fetched.
    """
    source = open_source(config["dataset"])
    if source.dataset.get("download") is None:
        known = [name for name in choices("dataset") if compose_config("ingest", [f"dataset={name}"])["dataset"].get("download")]
        raise ConfigurationError(
            f"data set '{source.name}' does not say where its files can be fetched from (download); "
            f"data sets that do: {', '.join(known) or 'none'}"
        )
    download = download_of(source)
    if runner.dry_run:
        for name in download.missing():
            runner.messages.line("plan", "download", name, f"from {download.address(name)} into {download.folder}")
        if download.missing():
            runner.messages.line("plan", "ingest", source.name, "then")
            raise DryRunStop
        return
    with runner.messages.bars() as bars:

        def progress(name: str, done: int, total: int | None) -> None:
            bars.step(f"download {name}", done // 1000, (total or done) // 1000, "kB")

        for outcome in download.fetch(progress):
            bars.close(f"download {outcome.name}")
            runner.messages.line("skip" if outcome.what == "matched" else "done", "download", outcome.name, _in_words(outcome))


def _in_words(outcome: Outcome) -> str:
    if outcome.what == "matched":
        return "is there, with the recorded checksum"
    if outcome.what == "recorded":
        return f"was there; its checksum is now recorded: sha256 {outcome.sha256}"
    went_on = f", went on after {outcome.resumed_at / 1e6:.1f} MB" if outcome.resumed_at else ""
    return f"{outcome.size / 1e6:.1f} MB{went_on}, sha256 {outcome.sha256}"
