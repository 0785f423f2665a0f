"""A finished study is recognised by what it was made from, and prints what a run in full would
print.
"""

import json
import os
import subprocess
import sys

import pytest

from vehest.data.files import stamp_of
from vehest.run.run_cache import RunCache

pytestmark = pytest.mark.apart

HEAVY = ("torch", "mlflow", "numba", "pandas", "scipy", "matplotlib", "hydra")
WORDS = ("small", "tracking=none")
SWEEP = (
    "estimator=luenberger",
    "training.grid=1",
    "training.max_evaluations=5,6",
    "split=mine",
    "tracking=none",
)


@pytest.fixture
def study(place):
    """A place with a small study that has just been run."""
    place.change(
        "pipelines/small.yaml",
        sweeps=[["estimator=luenberger", "training.grid=1", "training.max_evaluations=5"]],
    )
    place.once("run", *WORDS)
    assert place("run", *WORDS)[0] == 0  # a copy of the files has times of its own
    return place


def cached():
    return RunCache("run", WORDS[0], WORDS[1:]).load() is not None


def forget(place):
    for record in (place.folder / "outputs" / "finished").iterdir():
        record.unlink()


def test_finished_studies_print_the_output_of_a_full_run(study):
    for words in (
        *(("run", *WORDS, *options) for options in ((), ("--json",), ("--dry-run",), ("--quiet",))),
        ("report", *WORDS),
    ):
        assert cached()
        recognised = study(*words)
        forget(study)
        assert study(*words) == recognised, words
        assert recognised[0] == 0
        assert words[0] == "report" or ("reused  " in recognised[2]) == (words[-1] != "--quiet")
        study.done("run", *WORDS)  # dry runs and reports leave no record


def test_finished_studies_import_no_training_code(study):
    program = (
        "import sys\nfrom vehest.cli import main\ntry: main()\nfinally: print(*sys.modules, "
        "file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", program, "run", *WORDS, "--quiet"]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert "test set 'test'" in result.stdout
    assert not {name.split(".")[0] for name in result.stderr.split()} & set(HEAVY)


def test_finished_sweeps_print_the_output_of_a_full_run(place):
    first, _ = place.done("sweep", *SWEEP)
    assert RunCache("sweep", "", SWEEP).load() is not None
    recognised = place("sweep", *SWEEP)
    assert recognised[1] == first
    forget(place)
    assert (place("sweep", *SWEEP), place.told("sweep", *SWEEP)["skipped"]) == (recognised, True)


def test_a_published_copy_that_is_gone_is_published_again(study):
    study.change("pipelines/small.yaml", publish=True)
    study.done("run", *WORDS)
    published = study.folder / "results" / "small" / "metrics.csv"
    published.unlink()
    assert cached()
    out, err = study.done("run", *WORDS)
    assert (published.is_file(), "published: results/small" in out, "publish" in err) == (
        True,
        True,
        True,
    )


def test_whatever_differs_is_looked_at_anew(study, monkeypatch):
    def changed(file, content):
        former = file.read_bytes()
        about = file.stat()
        file.write_bytes(content)
        os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns))
        assert not cached(), file
        file.write_bytes(former)

    assert cached()
    for file in [
        study.folder / "conf" / "split" / "mine.yaml",
        study.folder / "pipelines" / "small.yaml",
    ]:
        changed(file, file.read_bytes() + b"\n# a comment\n")
    manifest = next((study.folder / "outputs" / "evaluate").glob("*/manifest.json"))
    changed(manifest, manifest.read_bytes().replace(b'"sha256": "', b'"sha256": "0', 1))
    key = json.loads(manifest.read_bytes())["key"]
    changed(manifest, manifest.read_bytes().replace(key.encode(), key[::-1].encode(), 1))
    estimate = next((study.folder / "outputs" / "evaluate").glob("*/test/0.parquet"))
    changed(estimate, b"")
    record = next((study.folder / "outputs" / "finished").glob("*.json"))
    changed(record, b'{"format": 1}')
    assert cached()
    with monkeypatch.context() as patch:
        patch.setenv("VEHEST_DATA", "/elsewhere")
        assert not cached()
    (study.folder / "raw" / "four.csv").write_text("Time\n")
    assert not cached()
    (study.folder / "raw" / "four.csv").unlink()
    assert cached()
    raw = study.folder / "raw" / "one.csv"
    changed(raw, raw.read_bytes().replace(b"1", b"2", 1))
    assert not cached()  # its time of change stays; only reading it shows that it is what it was
    assert study("run", *WORDS)[0] == 0
    assert cached()


def test_study_runs_anew_where_raw_files_changed_or_by_force(
    study,
):
    assert "reused" not in study.done("run", *WORDS, "--force")[1]
    assert cached()
    raw = study.folder / "raw" / "three.csv"
    raw.write_text("\n".join(raw.read_text().splitlines()[:-5]) + "\n")
    _, err = study.done("run", *WORDS)
    assert all(words in err for words in ("done    ingest", "done    report"))
    assert RunCache("run", "small", (*WORDS[1:], "seed=1")).load() is None
    assert RunCache("run", "small", ("output='a b'",)).file is None


def test_files_replaced_with_the_same_size_and_date_are_detected(tmp_path):
    (tmp_path / "again").symlink_to(tmp_path)  # walked once
    (tmp_path / "lap.csv").write_text("1")
    before = stamp_of(tmp_path)
    about = (tmp_path / "lap.csv").stat()
    (tmp_path / "new.csv").write_text("2")
    os.utime(tmp_path / "new.csv", ns=(about.st_atime_ns, about.st_mtime_ns))
    os.replace(tmp_path / "new.csv", tmp_path / "lap.csv")
    assert stamp_of(tmp_path) != before
