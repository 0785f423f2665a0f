"""What the parent and the machines of a cluster tell each other while groups run; light, since it is a process of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class Board:
    """News of groups, until the parent takes them, and whether to stop."""

    def __init__(self) -> None:
        self._news: list[Any] = []
        self._stopping = False

    def exchange(self, news: Sequence[Any]) -> bool:
        """Take news from a machine; returns whether it is to stop."""
        self._news.extend(news)
        return self._stopping

    def drain(self, stopping: bool) -> list[Any]:
        """Hand the news to the parent, and hear from it whether to stop."""
        self._stopping = stopping
        news, self._news = self._news, []
        return news
