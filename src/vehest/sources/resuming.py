"""Downloader for pooch that goes on where an earlier attempt broke off (RFC 9110, Sections 13.1.5
and 14).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vehest.data.errors import MissingError
from vehest.version import __version__

CHUNK = 1 << 15  # bytes
REMEDY = "correct download.url or put the file into the data set's folder by hand"
TIMEOUTS = (15.0, 60.0)  # s, to connect and between two chunks
ATTEMPTS = 5  # in a row that bring nothing new
PAUSE = 1.0  # s, before the second of them; then twice as long each
# statuses of an answer to a range that is of another version of the file
CHANGED = frozenset({206, 416})
# statuses that the next attempt may not meet
PASSING = CHANGED | {
    408,
    425,
    429,
    500,
    502,
    503,
    504,
}

# file, bytes received, bytes in all where the server states them
Progress = Callable[[str, int, int | None], None]


class ResumingDownloader:
    """Downloads one file into ``NAME.part``; ``NAME.part.version`` holds its address and its ETag
    or date.

    Args:
        part: where the file grows.
        progress: called with every chunk.
    """

    def __init__(self, part: Path, progress: Progress | None = None) -> None:
        self.part = part
        self.version = part.with_name(f"{part.name}.version")
        self.progress = progress
        self.resumed_at = 0

    def __call__(
        self, url: str, output_file: str, pooch: Any = None, check_only: bool = False
    ) -> None:
        """Download ``url`` into ``output_file``.

        Raises `MissingError`: the server refuses, or sends a web page. Raises
        `requests.RequestException`: it is out of reach; what has arrived is kept. Raises `OSError`:
        the disk is full or not writable.
        """
        from requests import exceptions

        failures = 0
        largest_size = -1
        while True:
            try:
                self._attempt(url)
                break
            except exceptions.SSLError:
                raise
            except (
                exceptions.ConnectionError,
                exceptions.Timeout,
                exceptions.ChunkedEncodingError,
            ):
                failures, largest_size = (
                    (failures + 1, largest_size)
                    if self._size() <= largest_size
                    else (1, self._size())
                )
                if failures == ATTEMPTS:
                    raise
                time.sleep(PAUSE * 2.0 ** (failures - 1))
        self.version.unlink()
        os.replace(self.part, output_file)

    def _attempt(self, url: str) -> None:
        import requests

        address, _, validator = (
            self.version.read_text(encoding="utf-8").partition("\n")
            if self.version.is_file()
            else ("", "", "")
        )
        have = self._size() if address == url and validator else 0
        headers = {
            "Accept-Encoding": "identity",
            "User-Agent": f"vehest/{__version__}",
        }  # offsets are those of the file itself
        headers |= {"Range": f"bytes={have}-", "If-Range": validator} if have else {}
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUTS) as response:
            status = response.status_code
            about = response.headers
            begins = status == 206 and about.get("Content-Range", "").startswith(f"bytes {have}-")
            resumed = begins and _validator(about) in ("", validator)
            if status in CHANGED and not resumed:
                self.part.unlink(missing_ok=True)
            if status in PASSING and not resumed:
                raise requests.ConnectionError(f"the server answers {status} {response.reason}")
            if status not in (200, 206):
                raise MissingError(
                    f"cannot fetch {url}: the server answers {status} {response.reason}; {REMEDY}"
                )
            if "html" in about.get("Content-Type", ""):
                raise MissingError(f"{url} is a web page, not a file; {REMEDY}")
            length = about.get("Content-Length", "")
            if not length.isdecimal() and not response.raw.chunked:
                raise MissingError(
                    f"cannot fetch {url}: the server does not state its length, so that a break "
                    f"would not show; {REMEDY}"
                )
            self.resumed_at = have = have if resumed else 0
            self.version.write_text(
                f"{url}\n{validator if resumed else _validator(about)}", encoding="utf-8"
            )
            with open(self.part, "ab" if resumed else "wb") as stream:
                for chunk in response.iter_content(CHUNK):  # a short answer is a ConnectionError
                    stream.write(chunk)
                    stream.flush()  # what has arrived survives a kill
                    if self.progress is not None:
                        self.progress(
                            self.part.stem,
                            stream.tell(),
                            have + int(length) if length.isdecimal() else None,
                        )

    def _size(self) -> int:
        return self.part.stat().st_size if self.part.is_file() else 0


def _validator(headers: Mapping[str, str]) -> str:
    """ETag of a file, unless it is a weak one, else its date.

    Empty where offsets are not those of the file itself.
    """
    etag = headers.get("ETag", "")
    return (
        ""
        if "Content-Encoding" in headers
        else etag
        if etag.startswith('"')
        else headers.get("Last-Modified", "")
    )
