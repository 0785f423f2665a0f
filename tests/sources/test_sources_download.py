"""Fetching files from a server on loopback that breaks off, forgets, changes its mind, stalls or serves other bytes."""

from __future__ import annotations

import fcntl
import gzip
import hashlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pooch
import pytest
import yaml

from place import run_vehest
from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.store import read_recording
from vehest.sources import resuming
from vehest.sources.base import open_source
from vehest.sources.download import CHECKSUMS, UNDER_WAY, Download, Outcome, download_of
from vehest.sources.resuming import CHUNK, Patience

SIZE = 300_000
BYTES = np.random.default_rng(0).integers(0, 256, SIZE, dtype=np.uint8).tobytes()


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves bytes by name, in the ways of good and bad servers, and remembers what it was asked for and what it sent."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.contents: dict[str, bytes] = {"a.csv": BYTES}
        self.etag: str | None = '"one"'
        self.modified: str | None = None
        self.ranges = True  # whether it knows them
        self.told_again = True  # whether an answer with a range tells the ETag
        self.breaks: list[int] = []  # after how many bytes the next answers break off
        self.statuses: list[int] = []  # of the next answers
        self.headers: dict[str, str] = {"Content-Type": "text/csv"}
        self.length = True  # whether it tells the length
        self.stall = threading.Event()  # set: an answer that breaks off hangs instead
        self.stalled, self.go_on = threading.Event(), threading.Event()
        self.redirect: dict[str, str] = {}
        self.asked: list[tuple[str, str | None, str | None]] = []  # path, Range, If-Range
        self.sent: list[int] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that was killed is nothing to tell."""


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        server = self.server
        name = unquote(self.path.rsplit("/", 1)[-1])
        asked = self.headers.get("Range")
        server.asked.append((self.path, asked, self.headers.get("If-Range")))
        assert self.headers.get("Accept-Encoding") == "identity"
        if name in server.redirect:
            self.plain(302, {"Location": server.redirect[name]})
            return
        status = server.statuses.pop(0) if server.statuses else 200
        if name not in server.contents:
            status = 404
        if status != 200:
            self.plain(status, {})
            return
        whole, start = server.contents[name], 0
        same = self.headers.get("If-Range") in (None, server.etag, server.modified)
        if asked and server.ranges and same:
            start = int(asked.removeprefix("bytes=").rstrip("-"))
            if start >= len(whole):
                self.plain(416, {"Content-Range": f"bytes */{len(whole)}"})
                return
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(whole) - 1}/{len(whole)}")
        if server.etag and (server.told_again or not start):
            self.send_header("ETag", server.etag)
        if server.modified:
            self.send_header("Last-Modified", server.modified)
        if server.length:
            self.send_header("Content-Length", str(len(whole) - start))
        for key, value in server.headers.items():
            self.send_header(key, value)
        self.end_headers()
        stop = server.breaks.pop(0) if server.breaks else len(whole) - start
        body = whole[start : start + stop]
        server.sent.append(len(body))  # before the client can have it and ask for more
        self.wfile.write(body)
        if stop < len(whole) - start and server.stall.is_set():
            server.stalled.set()
            server.go_on.wait(30)
        self.close_connection = True

    def plain(self, status: int, headers: dict[str, str]) -> None:
        self.server.sent.append(0)
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing on standard error."""


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    made = Server()
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield made
    made.go_on.set()
    made.shutdown()
    thread.join()
    made.server_close()


class Waiting:
    """Patience that remembers how long it would have waited, and waits not at all."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def __call__(self, seconds: float) -> None:
        self.seconds.append(seconds)


def download(server: Server, folder: Path, *names: str, known: dict[str, str] | None = None, read: float = 5.0) -> Download:
    return Download("mine", folder, server.url, names or ("a.csv",), known or {}, Patience(connect=5.0, read=read, pause=Waiting()))


def fetch(what: Download) -> list[Outcome]:
    return list(what.fetch())


def refusal(what: Download, kind: type[VehestError]) -> str:
    with pytest.raises(kind) as error:
        fetch(what)
    assert type(error.value) is kind
    assert "\n" not in str(error.value)
    return str(error.value)


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def assert_only(folder: Path, content: bytes = BYTES) -> None:
    """The file, its checksum, and nothing else."""
    assert files(folder) == {"a.csv": content, CHECKSUMS: f"a.csv {sha256(content)}\n".encode()}
    assert sorted(entry.name for entry in folder.iterdir()) == ["a.csv", CHECKSUMS]


# --- the plain way -----------------------------------------------------------------------------------------------------------------


def test_a_file_arrives_byte_for_byte_and_is_recorded_as_pooch_and_sha256sum_would(server: Server, tmp_path: Path) -> None:
    (outcome,) = fetch(download(server, tmp_path / "new" / "folder"))
    assert outcome == Outcome("a.csv", "fetched", sha256(BYTES), SIZE)
    assert_only(tmp_path / "new" / "folder")
    registry = pooch.create(tmp_path, "")
    registry.load_registry(tmp_path / "new" / "folder" / CHECKSUMS)
    assert registry.registry == {"a.csv": pooch.file_hash(str(tmp_path / "new" / "folder" / "a.csv"))}
    assert server.asked == [("/a.csv", None, None)]


def test_what_is_there_is_not_fetched_again_and_the_record_stays_as_it_is(server: Server, tmp_path: Path) -> None:
    fetch(download(server, tmp_path))
    before = (tmp_path / CHECKSUMS).stat().st_mtime_ns, (tmp_path / "a.csv").stat().st_mtime_ns
    assert [outcome.what for outcome in fetch(download(server, tmp_path))] == ["matched"]
    assert before == ((tmp_path / CHECKSUMS).stat().st_mtime_ns, (tmp_path / "a.csv").stat().st_mtime_ns)
    assert len(server.asked) == 1


def test_what_lies_there_unrecorded_is_recorded_on_first_sight(server: Server, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"by hand")
    assert fetch(download(server, tmp_path)) == [Outcome("a.csv", "recorded", sha256(b"by hand"), 7)]
    assert_only(tmp_path, b"by hand")
    assert server.asked == []


def test_several_files_share_a_record_that_keeps_its_other_lines(server: Server, tmp_path: Path) -> None:
    other = f"# made by hand\nold.csv {'A' * 64}"
    (tmp_path / CHECKSUMS).write_text(other)
    server.contents["b drive.csv"] = b"second"
    fetch(download(server, tmp_path, "a.csv", "b drive.csv"))
    assert (tmp_path / CHECKSUMS).read_text() == f"{other}\na.csv {sha256(BYTES)}\n'b drive.csv' {sha256(b'second')}\n"
    assert (tmp_path / "b drive.csv").read_bytes() == b"second"
    assert server.asked[1][0] == "/b%20drive.csv"
    assert [outcome.what for outcome in fetch(download(server, tmp_path, "a.csv", "b drive.csv"))] == ["matched", "matched"]


def test_a_file_is_recorded_when_it_is_complete_though_a_later_one_fails(server: Server, tmp_path: Path) -> None:
    refusal(download(server, tmp_path, "a.csv", "absent.csv"), MissingError)
    assert_only(tmp_path)


def test_a_redirect_is_followed(server: Server, tmp_path: Path) -> None:
    server.redirect["a.csv"] = "/elsewhere/b.csv"
    server.contents["b.csv"] = BYTES
    fetch(download(server, tmp_path))
    assert_only(tmp_path)


def test_an_empty_file_is_no_data(server: Server, tmp_path: Path) -> None:
    server.contents["a.csv"] = b""
    assert "sends an empty file" in refusal(download(server, tmp_path), MissingError)
    (tmp_path / "a.csv").touch()
    server.contents["a.csv"] = BYTES
    fetch(download(server, tmp_path))
    assert_only(tmp_path)


def test_progress_is_told_from_where_it_goes_on_to_the_end(server: Server, tmp_path: Path) -> None:
    server.breaks = [4 * CHUNK]
    told: list[tuple[str, int, int | None]] = []
    list(download(server, tmp_path).fetch(lambda name, done, total: told.append((name, done, total))))
    assert {(name, total) for name, _, total in told} == {("a.csv", SIZE)}
    assert [done for _, done, _ in told] == [*range(CHUNK, SIZE, CHUNK), SIZE]


# --- breaks ------------------------------------------------------------------------------------------------------------------------


def asked_range(server: Server, position: int) -> int:
    asked = server.asked[position][1]
    assert asked is not None
    found = re.fullmatch(r"bytes=(\d+)-", asked)
    assert found
    return int(found[1])


def test_after_a_break_exactly_the_missing_bytes_are_asked_for(server: Server, tmp_path: Path) -> None:
    server.breaks = [200_000]
    what = download(server, tmp_path)
    (outcome,) = fetch(what)
    assert_only(tmp_path)
    start = asked_range(server, 1)
    assert 200_000 - CHUNK < start <= 200_000  # of a chunk that was not whole, nothing is kept
    assert outcome.resumed_at == start
    assert server.asked[1][2] == '"one"'
    assert server.sent == [200_000, SIZE - start]
    assert what.patience.pause.seconds == [1.0]  # type: ignore[attr-defined]


def test_a_server_that_breaks_off_again_and_again_is_asked_on_as_long_as_bytes_come(server: Server, tmp_path: Path) -> None:
    server.breaks = [2 * CHUNK + 7] * 8  # more breaks than attempts that may bring nothing
    what = download(server, tmp_path)
    assert Patience().attempts < 8
    fetch(what)
    assert_only(tmp_path)
    assert [asked_range(server, k) for k in range(1, 5)] == [2 * CHUNK * k for k in range(1, 5)]
    assert sum(server.sent) == SIZE + 4 * 7
    assert what.patience.pause.seconds == [1.0] * 4  # type: ignore[attr-defined]


def test_a_server_that_brings_nothing_new_is_given_up_and_the_next_run_goes_on(server: Server, tmp_path: Path) -> None:
    server.breaks = [4 * CHUNK, 0, 0, 0, 0, 0]
    what = download(server, tmp_path)
    message = refusal(what, MissingError)
    assert f"cannot fetch {server.url}/a.csv: the connection broke" in message
    assert "5 times in a row; the same command goes on after the 0.1 MB that are here" in message
    assert what.patience.pause.seconds == [1.0, 2.0, 4.0, 8.0]  # type: ignore[attr-defined]
    assert files(tmp_path)[f"{UNDER_WAY}/a.csv.part"] == BYTES[: 4 * CHUNK]
    assert not (tmp_path / "a.csv").exists()
    assert not (tmp_path / CHECKSUMS).exists()
    asked = len(server.asked)
    server.breaks = []
    (outcome,) = fetch(download(server, tmp_path))
    assert outcome.resumed_at == asked_range(server, asked) == 4 * CHUNK
    assert_only(tmp_path)


def test_a_break_after_the_last_byte_needs_no_more_bytes(server: Server, tmp_path: Path) -> None:
    server.breaks = [4 * CHUNK] + [0] * 5
    refusal(download(server, tmp_path), MissingError)
    with open(tmp_path / UNDER_WAY / "a.csv.part", "ab") as part:
        part.write(BYTES[4 * CHUNK :])
    server.breaks = []
    fetch(download(server, tmp_path))
    assert server.sent[-1] == 0  # 416
    assert_only(tmp_path)


def test_a_part_longer_than_the_file_is_dropped(server: Server, tmp_path: Path) -> None:
    server.breaks = [4 * CHUNK] + [0] * 5
    refusal(download(server, tmp_path), MissingError)
    with open(tmp_path / UNDER_WAY / "a.csv.part", "ab") as part:
        part.write(BYTES)
    server.breaks = []
    (outcome,) = fetch(download(server, tmp_path))
    assert outcome.resumed_at == 0
    assert_only(tmp_path)


@pytest.mark.parametrize("modified", [None, "Sat, 22 Feb 2014 10:00:00 GMT"])
def test_a_server_without_ranges_starts_over(server: Server, tmp_path: Path, modified: str | None) -> None:
    server.ranges, server.etag, server.modified = False, None, modified
    server.breaks = [200_000]
    (outcome,) = fetch(download(server, tmp_path))
    assert outcome.resumed_at == 0
    assert server.sent == [200_000, SIZE]
    assert (server.asked[1][1] is None) == (modified is None)
    assert_only(tmp_path)


def test_without_a_strong_etag_the_date_says_whether_the_file_is_the_same(server: Server, tmp_path: Path) -> None:
    server.etag, server.modified = 'W/"weak"', "Sat, 22 Feb 2014 10:00:00 GMT"
    server.breaks = [4 * CHUNK]
    fetch(download(server, tmp_path))
    assert server.asked[1] == ("/a.csv", f"bytes={4 * CHUNK}-", server.modified)
    assert_only(tmp_path)


def test_an_answer_with_a_range_need_not_repeat_the_etag(server: Server, tmp_path: Path) -> None:
    server.told_again = False
    server.breaks = [4 * CHUNK]
    (outcome,) = fetch(download(server, tmp_path))
    assert outcome.resumed_at == 4 * CHUNK
    assert_only(tmp_path)


class Fickle(Waiting):
    """While the client waits, the publisher changes the file."""

    def __init__(self, server: Server, content: bytes) -> None:
        super().__init__()
        self.server, self.content = server, content

    def __call__(self, seconds: float) -> None:
        super().__call__(seconds)
        self.server.contents["a.csv"], self.server.etag = self.content, '"two"'


@pytest.mark.parametrize("size", [SIZE, 250_000, 100_000, 1000])
def test_a_file_that_changes_between_attempts_is_never_mixed(server: Server, tmp_path: Path, size: int) -> None:
    other = BYTES[::-1][:size]
    server.breaks = [200_000]
    fetch(Download("mine", tmp_path, server.url, ("a.csv",), {}, Patience(pause=Fickle(server, other))))
    assert_only(tmp_path, other)
    assert server.asked[1][2] == '"one"'


def test_a_changed_file_of_a_server_that_ignores_if_range_is_never_mixed(server: Server, tmp_path: Path) -> None:
    class Careless(Fickle):
        def __call__(self, seconds: float) -> None:
            super().__call__(seconds)
            self.server.modified = '"one"'  # takes the old version's mark for its own

    other = BYTES[::-1]
    server.breaks = [200_000]
    fetch(Download("mine", tmp_path, server.url, ("a.csv",), {}, Patience(pause=Careless(server, other))))
    assert_only(tmp_path, other)
    ranges = [asked_range for _, asked_range, _ in server.asked]
    assert ranges[1] is not None, "the rest of the file, as the server sent it of the other one"
    assert ranges[2:] == [None], "which was thrown away, and the whole file asked for"


def test_a_part_from_another_address_is_not_gone_on_with(server: Server, tmp_path: Path) -> None:
    server.breaks = [4 * CHUNK] + [0] * 5
    refusal(download(server, tmp_path), MissingError)
    server.breaks = []
    elsewhere = Download("mine", tmp_path, f"{server.url}/mirror/", ("a.csv",))
    fetch(elsewhere)
    assert server.asked[-1] == ("/mirror/a.csv", None, None)
    assert_only(tmp_path)


def test_a_connection_that_falls_silent_is_given_up_and_gone_on_with(server: Server, tmp_path: Path) -> None:
    server.stall.set()
    server.breaks = [4 * CHUNK]
    (outcome,) = fetch(download(server, tmp_path, read=0.2))
    assert outcome.resumed_at == asked_range(server, 1) == 4 * CHUNK
    assert_only(tmp_path)


def test_a_server_that_never_answers_is_said_in_one_line(server: Server, tmp_path: Path) -> None:
    server.stall.set()
    server.breaks = [0] * 5
    assert "read timed out, 5 times in a row; try" in refusal(download(server, tmp_path, read=0.1), MissingError).lower().replace(")", "")


def test_a_server_that_is_not_there_is_said_in_one_line(tmp_path: Path, server: Server) -> None:
    server.shutdown()
    server.server_close()
    message = refusal(download(server, tmp_path), MissingError)
    assert "the connection broke (Connection refused), 5 times in a row; try the same command later" in message


def test_a_killed_download_goes_on_where_it_was(server: Server, tmp_path: Path) -> None:
    content = np.random.default_rng(1).integers(0, 256, 40_000_000, dtype=np.uint8).tobytes()
    half = 30_000_000  # far beyond what sockets hold: much of it has been written when the server has sent it
    server.contents["a.csv"] = content
    server.stall.set()
    server.breaks = [half]
    script = (
        "import sys; from pathlib import Path; from vehest.sources.download import Download; "
        "print(*Download('mine', Path(sys.argv[1]), sys.argv[2], ('a.csv',)).fetch())"
    )
    command = [sys.executable, "-c", script, str(tmp_path), server.url]
    killed = subprocess.Popen(command)
    assert server.stalled.wait(30)
    killed.kill()
    killed.wait()
    kept = (tmp_path / UNDER_WAY / "a.csv.part").stat().st_size
    assert half / 2 < kept <= half
    assert not (tmp_path / "a.csv").exists()
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    assert f"resumed_at={kept}" in ended.stdout
    assert ended.stderr == ""  # pooch would tell the checksum
    assert asked_range(server, 1) == kept
    assert server.sent == [half, len(content) - kept]
    assert_only(tmp_path, content)


def test_what_a_process_killed_between_the_last_byte_and_the_name_left_is_taken_over(server: Server, tmp_path: Path) -> None:
    (tmp_path / UNDER_WAY).mkdir()
    (tmp_path / UNDER_WAY / "a.csv").write_bytes(BYTES)
    for name in ("tmpabcd1234", ".writing-0-a.csv.part.json"):
        (tmp_path / UNDER_WAY / name).touch()
    fetch(download(server, tmp_path))
    assert server.asked == []
    assert_only(tmp_path)


def test_two_processes_do_not_fetch_into_one_folder(server: Server, tmp_path: Path) -> None:
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert "another process is fetching into" in refusal(download(server, tmp_path), MissingError)
    os.close(descriptor)
    fetch(download(server, tmp_path))
    assert_only(tmp_path)


# --- wrong bytes -------------------------------------------------------------------------------------------------------------------


def test_a_server_of_other_bytes_is_refused_and_leaves_nothing_under_the_name(server: Server, tmp_path: Path) -> None:
    fetch(download(server, tmp_path))
    (tmp_path / "a.csv").unlink()
    server.contents["a.csv"], server.etag = BYTES[:-1] + b"?", '"two"'
    message = refusal(download(server, tmp_path), DataError)
    for part in (str(tmp_path / "a.csv"), sha256(BYTES), sha256(server.contents["a.csv"]), CHECKSUMS, "remove its line"):
        assert part in message
    assert files(tmp_path) == {CHECKSUMS: f"a.csv {sha256(BYTES)}\n".encode()}
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [CHECKSUMS]


def test_other_bytes_than_declared_beforehand_are_refused(server: Server, tmp_path: Path) -> None:
    message = refusal(download(server, tmp_path, known={"a.csv": sha256(b"other")}), DataError)
    assert f"expected is {sha256(b'other')} (download.sha256 of data set 'mine')" in message
    assert files(tmp_path) == {}
    fetch(download(server, tmp_path, known={"a.csv": sha256(BYTES)}))
    assert_only(tmp_path)


def test_a_file_that_was_changed_on_disk_is_reported_and_not_touched(server: Server, tmp_path: Path) -> None:
    fetch(download(server, tmp_path))
    (tmp_path / "a.csv").write_bytes(b"changed")
    message = refusal(download(server, tmp_path), DataError)
    for part in (
        sha256(b"changed"),
        sha256(BYTES),
        "changed or is damaged; remove the file to fetch it again",
    ):
        assert part in message
    assert (tmp_path / "a.csv").read_bytes() == b"changed"
    with pytest.raises(DataError, match="changed or is damaged"):
        download(server, tmp_path).missing()


def test_a_record_that_contradicts_the_declaration_is_refused(server: Server, tmp_path: Path) -> None:
    (tmp_path / CHECKSUMS).write_text(f"a.csv {'a' * 64}\n")
    assert "remove the one that is wrong" in refusal(download(server, tmp_path, known={"a.csv": "b" * 64}), DataError)


@pytest.mark.parametrize("text", ["a.csv", "a.csv 123\n", "a.csv 'open\n", "one two three four\n", b"\xff\xfe\x00"])
def test_a_damaged_record_is_refused(server: Server, tmp_path: Path, text: str | bytes) -> None:
    (tmp_path / CHECKSUMS).write_bytes(text if isinstance(text, bytes) else text.encode())
    assert CHECKSUMS in refusal(download(server, tmp_path), DataError)
    assert server.asked == []


@pytest.mark.parametrize("told", [True, False])
def test_a_login_page_is_not_taken_for_data(server: Server, tmp_path: Path, told: bool) -> None:
    server.contents["a.csv"] = b"\n<!DOCTYPE html><html><body>Log in</body></html>"
    server.headers = {"Content-Type": "text/html; charset=utf-8"} if told else {}
    assert "answers with a web page instead of 'a.csv'" in refusal(download(server, tmp_path), MissingError)
    assert files(tmp_path) == {}


def test_compressed_answers_are_refused(server: Server, tmp_path: Path) -> None:
    server.contents["a.csv"] = gzip.compress(BYTES)
    server.headers["Content-Encoding"] = "gzip"
    assert "sends it as gzip" in refusal(download(server, tmp_path), MissingError)
    assert files(tmp_path) == {}


def test_without_a_length_only_a_checksum_tells_the_end(server: Server, tmp_path: Path) -> None:
    server.length = False
    assert "does not say how long it is" in refusal(download(server, tmp_path), MissingError)
    assert files(tmp_path) == {}
    server.breaks = [200_000]
    assert "expected is" in refusal(download(server, tmp_path, known={"a.csv": sha256(BYTES)}), DataError)
    fetch(download(server, tmp_path, known={"a.csv": sha256(BYTES)}))
    assert_only(tmp_path)


@pytest.mark.parametrize(("status", "said"), [(404, "404 Not Found"), (403, "403 Forbidden"), (401, "401 Unauthorized"), (410, "410 Gone")])
def test_a_refusal_of_the_server_is_one_line_and_not_tried_again(server: Server, tmp_path: Path, status: int, said: str) -> None:
    server.statuses = [status]
    assert refusal(download(server, tmp_path), MissingError) == (
        f"cannot fetch {server.url}/a.csv: the server answers {said}; is the address right?"
    )
    assert len(server.asked) == 1
    assert files(tmp_path) == {}


@pytest.mark.parametrize(("status", "said"), [(500, "500 Internal Server Error"), (503, "503 Service Unavailable"), (429, "429 Too Many")])
def test_a_trouble_of_the_server_is_waited_out(server: Server, tmp_path: Path, status: int, said: str) -> None:
    server.statuses = [status] * 5
    assert said in refusal(download(server, tmp_path), MissingError)
    server.statuses = [status, status]
    fetch(download(server, tmp_path))
    assert_only(tmp_path)


def test_a_full_disk_is_one_line_and_the_next_run_goes_on(server: Server, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))  # files may not grow beyond
    try:
        assert "no room left to write" in refusal(download(server, tmp_path), MissingError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert files(tmp_path)[f"{UNDER_WAY}/a.csv.part"] == BYTES[:200_000]
    (outcome,) = fetch(download(server, tmp_path))
    assert outcome.resumed_at == 200_000
    assert_only(tmp_path)


def test_a_folder_that_cannot_be_written_to_is_one_line(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "cannot write" in refusal(download(server, tmp_path / "file"), MissingError)
    (tmp_path / "a.csv").mkdir()
    assert "is a folder where a file belongs" in refusal(download(server, tmp_path), DataError)


# --- what a data set may say -------------------------------------------------------------------------------------------------------

TABULAR = {"name": "mine", "source": "tabular", "path": "there", "rate_hz": 10, "time": None}
ENTRY = {"url": "https://example.org/folder", "files": ["a.csv"]}


def test_an_entry_says_address_files_and_checksums() -> None:
    entry = {"url": "https://example.org/folder/", "files": ["a.csv", "b 1.csv"], "sha256": {"a.csv": "AB" * 32}}
    what = download_of(open_source({**TABULAR, "download": entry}))
    assert (what.dataset, what.folder, what.files, what.sha256) == ("mine", Path("there"), ("a.csv", "b 1.csv"), {"a.csv": "ab" * 32})
    assert what.address("b 1.csv") == "https://example.org/folder/b%201.csv"


def test_without_a_list_the_source_says_what_its_recordings_need(monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source({**TABULAR, "download": {"url": "https://example.org"}})
    with pytest.raises(ConfigurationError, match="files must list the names of files"):
        download_of(source)
    monkeypatch.setattr(source, "file_names", lambda: ["x.csv"])
    assert download_of(source).files == ("x.csv",)


@pytest.mark.parametrize(
    ("name", "first", "last"),
    [
        ("revs_targa_2013", "yf219gg2055/20130222_01_01_03_grandsport.csv", "yf219gg2055/grandsport.csv"),
        ("revs_targa_2014", "hd122pw0365/20140221_03_02_03_250lm.csv", "hd122pw0365/250lm.csv"),
    ],
)
def test_the_revs_data_sets_that_are_shipped_name_their_files_in_the_repository(name: str, first: str, last: str) -> None:
    conf = Path(__file__).parents[2] / "conf" / "dataset" / f"{name}.yaml"
    what = download_of(open_source(yaml.safe_load(conf.read_text(encoding="utf-8").replace("${root}", "data"))))
    addresses = [what.address(file).removeprefix("https://stacks.stanford.edu/file/") for file in what.files]
    assert (addresses[0], addresses[-1], len(addresses), what.folder) == (first, last, 6, Path("data/revs"))


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"url": "https://example.org"}, "files must list"),
        ({"files": ["a.csv"]}, "must say url"),
        ("https://example.org", "must be a mapping of url and, if need be, files and sha256, not 'https://example.org'"),
        ({**ENTRY, "md5": {}}, "must say url"),
        ({**ENTRY, "url": "file:///etc/passwd"}, "url must be an address"),
        ({**ENTRY, "url": "example.org"}, "url must be an address"),
        ({**ENTRY, "url": "https://[example.org"}, "url must be an address"),
        ({**ENTRY, "files": "a.csv"}, "files must list"),
        ({**ENTRY, "files": []}, "files must list"),
        ({**ENTRY, "files": ["a.csv", "a.csv"]}, "names 'a.csv' twice"),
        *(
            ({**ENTRY, "files": [name]}, "is not the name of a file in one folder")
            for name in ("../a.csv", "..", "a/b.csv", "/etc/passwd", "a\\b.csv", ".hidden", "", " ", CHECKSUMS, 3, "a\n.csv", "c:a.csv")
        ),
        ({**ENTRY, "sha256": {"a.csv": "123"}}, "must be 64 hexadecimal digits, not '123'"),
        ({**ENTRY, "sha256": {"../a.csv": "a" * 64}}, "is not the name of a file"),
        ({**ENTRY, "sha256": ["a"]}, "sha256 must map"),
    ],
)
def test_an_entry_that_makes_no_sense_is_refused_in_one_line(entry: object, said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        download_of(open_source({**TABULAR, "download": entry}))
    assert said in str(error.value)
    assert str(error.value).startswith(("data set 'mine': download", "data set 'mine': dataset.download"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", [None, "None/revs", "null", ""])
def test_without_a_root_nothing_is_fetched(path: str | None) -> None:
    with pytest.raises(MissingError, match="no data root is set; give root=FOLDER"):
        download_of(open_source({**TABULAR, "path": path, "download": ENTRY}))


# --- from the command line ---------------------------------------------------------------------------------------------------------

DRIVE = "time,vx,yaw_rate,ay,ax\n" + "".join(
    f"{k / 100:.2f},{20 + np.sin(k / 90):.6f},{0.3 * np.sin(k / 70):.6f},{6 * np.sin(k / 70):.5f},{np.cos(k / 90) / 9:.5f}\n"
    for k in range(900)
)


class Place:
    """A working folder with one data set, fetched from the server."""

    def __init__(self, folder: Path, server: Server, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self.server, self._capsys = folder, server, capsys
        server.contents = {"one.csv": DRIVE.encode(), "two.csv": DRIVE.replace("20.", "21.").encode()}
        self.configure(files=["one.csv", "two.csv"])

    def configure(self, **download: object) -> None:
        dataset = {"name": "mine", "source": "tabular", "path": "${root}/mine", "time": {"column": "time", "unit": "s"}}
        (self.folder / "conf" / "dataset").mkdir(parents=True, exist_ok=True)
        for name, entry in (("mine", {"url": f"{self.server.url}/files", **download}), ("own", None)):
            text = yaml.safe_dump({**dataset, "name": name, **({"download": entry} if entry else {})})
            (self.folder / "conf" / "dataset" / f"{name}.yaml").write_text(text)

    def __call__(self, *arguments: str) -> tuple[int, str, str]:
        return run_vehest(self._capsys, *arguments)


@pytest.fixture
def place(tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Place:
    monkeypatch.chdir(tmp_path)
    for name in ("VEHEST_DATA", "VEHEST_OUTPUT"):
        monkeypatch.delenv(name, raising=False)
    return Place(tmp_path, server, capsys)


def lines(err: str) -> list[tuple[str, ...]]:
    return [tuple(line.split()[:3]) for line in err.splitlines()]


def test_ingest_fetches_what_is_missing_then_ingests(place: Place) -> None:
    code, out, err = place("ingest", "mine", "--download", "root=data")
    assert code == 0, err
    assert lines(err) == [("done", "download", "one.csv"), ("done", "download", "two.csv"), ("done", "ingest", "mine")]
    assert sha256(place.server.contents["one.csv"]) in err
    (stored,) = (place.folder / "outputs" / "ingest").glob("mine-*/two.parquet")
    assert read_recording(stored)["vx"][0] == 21.0
    assert {path for path, _, _ in place.server.asked} == {"/files/one.csv", "/files/two.csv"}
    made = files(place.folder)

    code, again, err = place("ingest", "mine", "--download", "root=data")
    assert (code, again.replace("True", "False")) == (0, out)
    assert lines(err) == [("skipped", "download", "one.csv"), ("skipped", "download", "two.csv"), ("skipped", "ingest", "mine")]
    assert len(place.server.asked) == 2
    assert files(place.folder) == made


def test_where_files_come_from_is_no_part_of_the_recordings_key(place: Place) -> None:
    place("ingest", "mine", "--download", "root=data")
    place.configure(files=["one.csv"], sha256={"one.csv": sha256(place.server.contents["one.csv"])})
    code, _, err = place("ingest", "mine", "root=data")
    assert (code, lines(err)) == (0, [("skipped", "ingest", "mine")])


def test_a_dry_run_says_what_it_would_fetch_and_fetches_nothing(place: Place) -> None:
    (place.folder / "data" / "mine").mkdir(parents=True)
    (place.folder / "data" / "mine" / "one.csv").write_text(DRIVE)
    before = files(place.folder)
    code, _, err = place("ingest", "mine", "--download", "root=data", "--dry-run")
    assert code == 0
    assert lines(err) == [("would", "download", "two.csv"), ("would", "ingest", "mine")]
    assert f"from {place.server.url}/files/two.csv into data/mine" in err
    assert (files(place.folder), place.server.asked) == (before, [])


def test_what_was_there_is_said_to_be_recorded(place: Place) -> None:
    (place.folder / "data" / "mine").mkdir(parents=True)
    (place.folder / "data" / "mine" / "one.csv").write_text(DRIVE)
    _, _, err = place("ingest", "mine", "--download", "root=data")
    assert f"done    download   one.csv was there; its checksum is now recorded: sha256 {sha256(DRIVE.encode())}" in err


def test_quiet_says_nothing_and_json_stays_json(place: Place) -> None:
    code, out, err = place("ingest", "mine", "--download", "root=data", "--quiet", "--json")
    assert (code, err) == (0, "")
    assert yaml.safe_load(out)["recordings"] == ["one", "two"]


def test_a_download_that_fails_is_one_line_and_makes_no_artefact(place: Place) -> None:
    del place.server.contents["two.csv"]
    code, out, err = place("ingest", "mine", "--download", "root=data")
    assert (code, out) == (4, "")
    assert err.splitlines()[-1].startswith(f"error: cannot fetch {place.server.url}/files/two.csv: the server answers 404 Not Found")
    assert not (place.folder / "outputs").exists()

    place.configure(files=["one.csv"], sha256={"one.csv": "0" * 64})
    shutil.rmtree(place.folder / "data")
    code, _, err = place("ingest", "mine", "--download", "root=data")
    assert code == 3
    assert len(err.splitlines()) == 1
    assert not (place.folder / "data" / "mine" / "one.csv").exists()


def test_a_data_set_that_cannot_be_fetched_names_those_that_can(place: Place) -> None:
    code, _, err = place("ingest", "own", "--download", "root=data")
    assert code == 2
    (line,) = err.splitlines()
    assert line.startswith("error: data set 'own' does not say where its files can be fetched from (download); data sets that do: mine")


def test_ctrl_c_keeps_what_has_arrived_and_the_same_command_goes_on(place: Place) -> None:
    server = place.server
    server.contents["one.csv"] = BYTES * 100  # 30 MB: half of it is more than sockets hold
    half = len(server.contents["one.csv"]) // 2
    server.stall.set()
    server.breaks = [half]

    def interrupt() -> None:
        if server.stalled.wait(10):
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    code, _, err = place("ingest", "mine", "--download", "root=data")
    thread.join()
    assert code == 130
    assert err == "error: stopped by SIGINT; finished artefacts are kept, the same command goes on\n"
    under_way = place.folder / "data" / "mine" / UNDER_WAY
    assert sorted(file.name for file in under_way.iterdir()) == ["one.csv.part", "one.csv.part.json"]
    kept = (under_way / "one.csv.part").stat().st_size
    assert 0 < kept <= half
    code, _, err = place("ingest", "mine", "--download", "root=data", "+dataset.files=two.csv")  # the other one is no table
    assert (code, lines(err)[-1]) == (0, ("done", "ingest", "mine"))
    assert asked_range(server, 1) == kept
    assert (place.folder / "data" / "mine" / "one.csv").read_bytes() == server.contents["one.csv"]
    assert not under_way.exists()


def test_without_a_root_the_command_says_what_to_give(place: Place) -> None:
    code, _, err = place("ingest", "mine", "--download")
    assert (code, len(err.splitlines())) == (4, 1)
    assert "no data root is set; give root=FOLDER or set VEHEST_DATA" in err


@pytest.mark.parametrize("told", [True, False])
def test_a_file_longer_than_the_limit_is_not_kept(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: bool) -> None:
    server.length = told
    monkeypatch.setattr(resuming, "MOST_BYTES", SIZE - 1)
    assert "bytes or more; at most 299999 are fetched" in refusal(download(server, tmp_path, known={"a.csv": sha256(BYTES)}), DataError)
    assert files(tmp_path) == {}


@pytest.mark.parametrize("length", ["²", "9" * 5000, "-1", "1e3"])
def test_a_length_that_is_no_number_is_none(server: Server, tmp_path: Path, length: str) -> None:
    assert resuming._whole_number(length) is None
    assert resuming._range(f"bytes {length}-5/{length}") == (None, None)


def test_a_record_of_checksums_that_is_none_is_refused(server: Server, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / CHECKSUMS)
    assert "is a pipe, not a file" in refusal(download(server, tmp_path), DataError)
