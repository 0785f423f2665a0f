"""Fetching one file by HTTP so that a break costs nothing: what has arrived is kept, the next attempt asks for the rest."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError, MissingError, VehestError
from vehest.data.files import remove, sha256_of, written_aside
from vehest.data.schema import validated
from vehest.data.text_files import read_json
from vehest.version import __version__

MOST_BYTES = 8 * 2**30  # of one file
CHUNK = 1 << 15  # bytes; at most this much is received twice after a break
PASSING = frozenset({408, 425, 429, 500, 502, 503, 504})  # statuses that may be gone at the next attempt

Progress = Callable[[str, int, int | None], None]  # file, bytes that are here, bytes in all where the server tells


@dataclass(frozen=True)
class Patience:
    """How long to wait for a server, and how often to come back.

    Args:
        connect: until a connection stands [s].
        read: until the next bytes arrive [s].
        attempts: in a row that may bring nothing new.
        pause: waits so many seconds; 1, 2, 4, … between attempts.
    """

    connect: float = 15.0
    read: float = 60.0
    attempts: int = 5
    pause: Callable[[float], None] = time.sleep


@dataclass(frozen=True)
class _About:
    """What a part that has arrived is a part of."""

    url: str
    validator: str


class _Broken(Exception):
    """An attempt failed; another may succeed."""


class ResumingDownloader:
    """What pooch calls to fetch a file: goes on where an earlier attempt broke off, as long as the file is the same.

    A range is asked for with the ``If-Range`` of the first answer (a strong ETag, else Last-Modified), so that a file that has changed
    in between comes whole (RFC 9110, Sections 13.1.5 and 14). Without either of them, or without ranges, it starts over.

    Args:
        name: of the file.
        folder: where it grows, as ``NAME.part`` beside a ``NAME.part.json`` that says what it is a part of.
        checked: whether a checksum will tell a truncated file.
        patience: with the server.
        progress: is told how far it is.
    """

    def __init__(self, name: str, folder: Path, checked: bool, patience: Patience, progress: Progress | None = None) -> None:
        self.name, self.checked, self.patience, self.progress = name, checked, patience, progress
        self.part, self.about = folder / f"{name}.part", folder / f"{name}.part.json"
        self.resumed_at = 0
        self.sha256 = ""

    def __call__(self, url: str, output_file: str, pooch: Any = None, check_only: bool = False) -> None:
        """Fetch ``url`` into ``output_file``.

        Raises:
            MissingError: the server does not have it or is out of reach; what has arrived is kept.
            DataError: it is longer than the limit; nothing of it is kept.
            OSError: the disk is full or not writable.
        """
        most, failures = -1, 0
        while True:
            try:
                self._attempt(url)
                break
            except _Broken as broken:
                failures = 1 if self._size() > most else failures + 1
                most = max(most, self._size())
                if failures >= self.patience.attempts:
                    raise MissingError(f"cannot fetch {url}: {broken}, {failures} times in a row; {self._kept(url)}") from None
                self.patience.pause(2.0 ** (failures - 1))
        self.sha256 = sha256_of(self.part)
        os.replace(self.part, output_file)
        self.about.unlink(missing_ok=True)

    def _attempt(self, url: str) -> None:
        import requests

        headers = {"Accept-Encoding": "identity", "User-Agent": f"vehest/{__version__}"}  # offsets must be those of the file itself
        about = self._about(url)
        have = self._size() if about else 0
        if have:
            headers |= {"Range": f"bytes={have}-", "If-Range": about["validator"]}
        try:
            with requests.get(url, headers=headers, stream=True, timeout=(self.patience.connect, self.patience.read)) as response:
                self._receive(url, response, have, about)
        except requests.exceptions.SSLError as error:
            raise MissingError(f"cannot fetch {url}: no trusted connection ({_reason(error)})") from None
        except requests.exceptions.Timeout:
            raise _Broken("the server does not answer in time") from None
        except (requests.exceptions.ConnectionError, requests.exceptions.ChunkedEncodingError) as error:
            raise _Broken(f"the connection broke ({_reason(error)})") from None
        except requests.exceptions.RequestException as error:
            raise MissingError(f"cannot fetch {url}: {_reason(error)}") from None

    def _receive(self, url: str, response: Any, have: int, about: Mapping[str, str]) -> None:
        if response.status_code == 416 and have:
            if response.headers.get("Content-Range", "").strip() == f"bytes */{have}":
                return  # it broke off after the last byte
            self._drop()
            raise _Broken("the server does not have the part that is missing")
        if response.status_code in PASSING:
            raise _Broken(f"the server answers {response.status_code} {response.reason}")
        if response.status_code != 200 and not (response.status_code == 206 and have):
            raise MissingError(f"cannot fetch {url}: the server answers {response.status_code} {response.reason}; is the address right?")
        self._refuse_unusable(url, response)
        if response.status_code == 206:
            start, total = _range(response.headers.get("Content-Range", ""))
            if start != have or _is_other(about["validator"], response.headers):
                self._drop()
                raise _Broken("the file has changed on the server")
            self.resumed_at = self.resumed_at or have
        else:
            have, total = 0, _whole_number(response.headers.get("Content-Length"))
            self.resumed_at = 0
        if total is None and not self.checked and response.headers.get("Transfer-Encoding", "").lower() != "chunked":
            raise MissingError(
                f"cannot fetch {url}: the server does not say how long it is, so that a break would not show; "
                f"give its checksum in download.sha256"
            )
        chunks = response.iter_content(CHUNK)
        first = next(chunks, b"")
        self._refuse_too_much(total or 0)
        if not have:
            self._begin(url, response, first)
        self._append(first, chunks, total)
        if total is not None and self._size() != total:
            size = self._size()
            if size > total:
                self._drop()
            raise _Broken(f"the connection broke after {size} of {total} bytes")

    def _append(self, first: bytes, chunks: Iterator[bytes], total: int | None) -> None:
        with open(self.part, "ab", buffering=0) as stream:  # unbuffered: what has arrived survives a kill
            while first:
                self._refuse_too_much(stream.tell() + len(first))
                while first:
                    first = first[stream.write(first) :]
                if self.progress is not None:
                    self.progress(self.name, stream.tell(), total)
                first = next(chunks, b"")
            os.fsync(stream.fileno())

    def _refuse_too_much(self, size: int) -> None:
        """Stop where a file is longer than it may be, and keep nothing of it."""
        if size > MOST_BYTES:
            self._drop()
            raise DataError(f"what is sent as '{self.name}' has {size} bytes or more; at most {MOST_BYTES} are fetched")

    def _begin(self, url: str, response: Any, first: bytes) -> None:
        """Start over: forget an earlier part, remember which version of the file this one is of."""
        if not first:
            raise MissingError(f"cannot fetch {url}: the server sends an empty file")
        if first.lstrip()[:15].lower().startswith((b"<!doctype html", b"<html")):
            raise _web_page(url, self.name)
        self._drop()
        validators = _validators(response.headers)
        if validators:
            with written_aside(self.about) as aside:
                aside.write_text(json.dumps({"url": url, "validator": validators[0]}), encoding="utf-8")

    def _refuse_unusable(self, url: str, response: Any) -> None:
        encoding = response.headers.get("Content-Encoding", "identity").lower()
        if encoding not in ("identity", ""):
            raise MissingError(f"cannot fetch {url}: the server sends it as {encoding} although asked for the plain file")
        kind = response.headers.get("Content-Type", "").split(";")[0].strip().lower()
        if kind in ("text/html", "application/xhtml+xml") and self.part.with_suffix("").suffix.lower() not in (".html", ".htm", ".xhtml"):
            raise _web_page(url, self.name)

    def _about(self, url: str) -> dict[str, str]:
        """Which version of the file the part is of; empty where that is not known."""
        try:
            about = validated(_About, read_json(self.about), f"'{self.about}'")
        except VehestError:
            return {}
        return {"validator": about.validator} if about.url == url and about.validator.isprintable() else {}

    def _kept(self, url: str) -> str:
        kept = self._size() if self._about(url) else 0
        return f"the same command goes on after the {kept / 1e6:.1f} MB that are here" if kept else "try the same command later"

    def _size(self) -> int:
        return self.part.stat().st_size if self.part.is_file() else 0

    def _drop(self) -> None:
        remove(self.part)
        remove(self.about)


def _web_page(url: str, name: str) -> MissingError:
    return MissingError(
        f"{url} answers with a web page instead of '{name}': it may want a login or have moved; "
        f"open it in a browser and put the file into the data set's folder by hand"
    )


def _validators(headers: Mapping[str, str]) -> list[str]:
    """What tells this version of a file from others, the best first; a weak ETag does not."""
    etag, modified = headers.get("ETag", ""), headers.get("Last-Modified", "")
    return [text for text in (etag if etag.startswith('"') else "", modified) if text]


def _is_other(validator: str, headers: Mapping[str, str]) -> bool:
    """Whether an answer is of another version of the file; one may leave out Last-Modified."""
    return headers.get("ETag" if validator.startswith('"') else "Last-Modified", validator) != validator


def _range(text: str) -> tuple[int | None, int | None]:
    """First byte and length of the whole, of a Content-Range."""
    found = re.fullmatch(r"bytes ([0-9]{1,18})-[0-9]{1,18}/([0-9]{1,18}|\*)", text.strip())
    return (int(found[1]), _whole_number(found[2])) if found else (None, None)


def _whole_number(text: str | None) -> int | None:
    return int(text) if text is not None and re.fullmatch(r"[0-9]{1,18}", text.strip()) else None


_TOLD = (r"\[Errno -?\d+\] ([^'\")]+)", r"(\d+ bytes read, \d+ more expected)", r"([Rr]ead timed out)", r"([Rr]emote end closed [a-z ]+)")


def _reason(error: Exception) -> str:
    """The heart of what requests says."""
    found = next(filter(None, (re.search(pattern, str(error)) for pattern in _TOLD)), None)
    return found[1] if found else " ".join(str(error).split())[:160] or type(error).__name__
