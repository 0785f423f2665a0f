"""Local links of a built site: every file is there, and every anchor in it.

`python docs/check_site.py build/site` names those that lead nowhere.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """What a page links to and what can be linked to in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note ids, and whatever the browser would fetch or follow."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.targets += [values[name] for name in ("href", "src") if values.get(name)]


def broken_links(site: Path) -> list[str]:
    """Links of all pages below a folder that lead to no file, outside the folder, or to no anchor: ``page: link``."""
    pages = {
        file.resolve(): _Page(file.read_text(encoding="utf-8"))
        for file in sorted(site.rglob("*.html"))
    }
    broken = []
    for file, page in pages.items():
        for target in dict.fromkeys(page.targets):
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            there = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            found = there.is_file() and there.is_relative_to(site.resolve())
            anchor = unquote(parts.fragment)
            if not found or (anchor and there in pages and anchor not in pages[there].anchors):
                broken.append(f"{file.relative_to(site.resolve())}: {target}")
    return broken


if __name__ == "__main__":
    found = broken_links(Path(sys.argv[1]))
    print("\n".join(found) or "every local link leads somewhere")
    sys.exit(bool(found))
