"""Downloads from a server on loopback that breaks off, changes its file, stalls or sends other
bytes.
"""

import fcntl
import hashlib
import os
import resource
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import yaml
from refusals import refusal

from place import run_vehest
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.store import read_recording
from vehest.sources.base import open_source
from vehest.sources.download import CHECKSUMS, Download, Outcome, download_of

SIZE = 300_000
BYTES = np.random.default_rng(0).integers(0, 256, SIZE, dtype=np.uint8).tobytes()


def sha256(content):
    return hashlib.sha256(content).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves bytes by name, well or badly, and keeps requests and what it sent."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.contents = {"a.csv": BYTES}
        self.breaks = []  # after how many bytes the next answers break off
        self.statuses = []  # of the next answers
        self.headers = {"Content-Type": "text/csv"}
        self.length = True  # whether it tells the length
        self.asked = []  # paths
        self.sent = []

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self):
        server = self.server
        name = unquote(self.path.rsplit("/", 1)[-1])
        server.asked.append(self.path)
        assert self.headers.get("Accept-Encoding") == "identity"
        status = server.statuses.pop(0) if server.statuses else 200
        if name not in server.contents:
            status = 404
        if status != 200:
            self.send_response(status)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        full_content = server.contents[name]
        self.send_response(200)
        length = {"Content-Length": str(len(full_content))} if server.length else {}
        for key, value in {**length, **server.headers}.items():
            self.send_header(key, value)
        self.end_headers()
        body = full_content[: server.breaks.pop(0)] if server.breaks else full_content
        server.sent.append(len(body))  # before the client can have it and ask for more
        self.wfile.write(body)
        self.close_connection = True

    def log_message(self, format, *args):
        """Nothing on standard error."""


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    server = Server()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def download(server, folder, checksums=None):
    return Download(folder, server.url, ("a.csv",), checksums or {})


def refused(declared, kind=MissingError):
    return refusal(lambda: list(declared.fetch()), kind)


def files(folder):
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def assert_only(folder):
    assert files(folder) == {"a.csv": BYTES, CHECKSUMS: f"a.csv {sha256(BYTES)}\n".encode()}


def test_a_file_arrives_byte_for_byte_and_is_recorded(server, tmp_path):
    (outcome,) = download(server, tmp_path / "new" / "folder").fetch()
    assert outcome == Outcome("a.csv", "fetched", sha256(BYTES), SIZE)
    assert_only(tmp_path / "new" / "folder")
    assert server.asked == ["/a.csv"]


def test_a_download_that_breaks_off_is_one_line_and_leaves_nothing(server, tmp_path):
    server.breaks = [200_000]
    message = refused(download(server, tmp_path))
    assert message.startswith(f"cannot fetch {server.url}/a.csv: ")
    assert message.endswith("put the file into the data set's folder by hand")
    assert files(tmp_path) == {}
    list(download(server, tmp_path).fetch())
    assert_only(tmp_path)
    assert server.sent == [200_000, SIZE]


def test_two_processes_do_not_fetch_into_one_folder(server, tmp_path):
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert "another process is fetching into" in refused(download(server, tmp_path))
    os.close(descriptor)
    list(download(server, tmp_path).fetch())
    assert_only(tmp_path)


def test_other_bytes_than_recorded_or_declared_are_refused_and_leave_nothing(server, tmp_path):
    message = refused(download(server, tmp_path, checksums={"a.csv": sha256(b"other")}), DataError)
    assert all(
        part in message
        for part in (
            f"{server.url}/a.csv",
            sha256(b"other"),
            sha256(BYTES),
            "known by download.sha256",
        )
    )
    assert files(tmp_path) == {}
    list(download(server, tmp_path, checksums={"a.csv": sha256(BYTES)}).fetch())
    (tmp_path / "a.csv").write_bytes(b"changed")
    message = refused(download(server, tmp_path), DataError)
    assert all(
        part in message
        for part in (sha256(b"changed"), sha256(BYTES), "remove the file to fetch it again")
    )
    assert (tmp_path / "a.csv").read_bytes() == b"changed"
    (tmp_path / "a.csv").unlink()
    server.contents["a.csv"] = BYTES[:-1] + b"?"
    assert f"or {tmp_path / CHECKSUMS}" in refused(download(server, tmp_path), DataError)
    assert files(tmp_path) == {CHECKSUMS: f"a.csv {sha256(BYTES)}\n".encode()}


def test_web_pages_answers_without_a_length_refusals_and_damaged_records_are_one_line(
    server, tmp_path
):
    server.headers = {"Content-Type": "text/html; charset=utf-8"}
    assert "a.csv: it is a web page, not a file" in refused(download(server, tmp_path))
    server.headers = {}
    server.length = False
    assert "does not state its length" in refused(download(server, tmp_path))
    server.asked = []
    server.statuses = [404]
    message = refused(download(server, tmp_path))
    assert message == (
        f"cannot fetch {server.url}/a.csv: the server answers 404 Not Found; "
        "correct download.url or put the file into the data set's folder by hand"
    )
    assert (len(server.asked), files(tmp_path)) == (1, {})
    (tmp_path / CHECKSUMS).write_bytes(b"a.csv")
    assert CHECKSUMS in refused(download(server, tmp_path), DataError)
    assert len(server.asked) == 1


def test_a_full_disk_is_one_line_and_leaves_nothing(server, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))  # files may not grow beyond
    try:
        assert "no room left to write" in refused(download(server, tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert files(tmp_path) == {}
    list(download(server, tmp_path).fetch())
    assert_only(tmp_path)


TABULAR = {"name": "mine", "source": "tabular", "path": "there", "rate_hz": 10, "time": None}


def test_an_entry_says_address_files_and_checksums_or_is_refused_in_one_line():
    entry = {
        "url": "https://example.org/folder/",
        "files": ["a.csv", "b 1.csv"],
        "sha256": {"a.csv": "AB" * 32},
    }
    declared = download_of(open_source({**TABULAR, "download": entry}))
    assert (declared.folder, declared.files, declared.sha256) == (
        Path("there"),
        ("a.csv", "b 1.csv"),
        {"a.csv": "ab" * 32},
    )
    assert declared.address("b 1.csv") == "https://example.org/folder/b%201.csv"
    for changes, message in (
        ({"url": "file:///etc/passwd"}, "dataset.download.url: string should match pattern"),
        ({"files": ["a.csv", "a.csv"]}, "each once, not ['a.csv', 'a.csv']"),
        *(
            ({"files": [name]}, "is not the name of a file in one folder")
            for name in ("../a.csv", CHECKSUMS, "a\n.csv")
        ),
    ):
        wrong = TABULAR | {
            "download": {"url": "https://example.org/folder", "files": ["a.csv"]} | changes
        }
        assert message in refusal(
            lambda wrong=wrong: download_of(open_source(wrong)), ConfigurationError
        )


DRIVE = "time,vx,yaw_rate,ay,ax\n" + "".join(
    f"{k / 100:.2f},{20 + np.sin(k / 90):.6f},{0.3 * np.sin(k / 70):.6f},"
    f"{6 * np.sin(k / 70):.5f},{np.cos(k / 90) / 9:.5f}\n"
    for k in range(900)
)


def test_ingest_fetches_what_is_missing_then_ingests(server, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    server.contents = {"one.csv": DRIVE.encode(), "two.csv": DRIVE.replace("20.", "21.").encode()}
    entry = {"url": f"{server.url}/files", "files": ["one.csv", "two.csv"]}
    dataset = {
        "name": "mine",
        "source": "tabular",
        "path": "${root}/mine",
        "time": {"column": "time", "unit": "s"},
        "download": entry,
    }
    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    (tmp_path / "conf" / "dataset" / "mine.yaml").write_text(yaml.safe_dump(dataset))
    for fetched, ingested in (("done", "done"), ("note", "reused")):
        code, _, err = run_vehest(
            capsys, "ingest", "mine", "--download", "root=data", "output=outputs"
        )
        assert code == 0, err
        lines = [tuple(line.split()[:3]) for line in err.splitlines()]
        assert lines == [
            (fetched, "download", "one.csv"),
            (fetched, "download", "two.csv"),
            (ingested, "ingest", "mine"),
        ]
        assert server.asked == ["/files/one.csv", "/files/two.csv"]
    (stored,) = (tmp_path / "outputs" / "ingest").glob("mine-*/two.parquet")
    assert read_recording(stored)["vx"][0] == 21.0


def test_without_an_address_the_remedy_names_the_data_sets_that_have_one_past_a_bad_file(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "conf" / "dataset"
    folder.mkdir(parents=True)
    dataset = {"name": "mine", "source": "tabular", "path": "${root}", "rate_hz": 100}
    address = {"url": "https://example.org/files", "files": ["one.csv"]}
    (folder / "mine.yaml").write_text(yaml.safe_dump(dataset))
    (folder / "other.yaml").write_text(
        yaml.safe_dump(dataset | {"name": "other", "download": address})
    )
    (folder / "bad.yaml").write_text("{{: [")
    monkeypatch.setattr("vehest.run.ingest.choices", lambda group: ["bad", "mine", "other"])
    code, _, err = run_vehest(capsys, "ingest", "mine", "--download", "root=data", "output=outputs")
    assert code == 2
    (line,) = err.splitlines()
    assert "'mine' does not say where its files can be fetched from" in line
    assert line.endswith(
        "put them into its folder by hand, or declare download in its file; data sets that do: "
        "other"
    )
