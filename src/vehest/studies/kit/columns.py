"""Columns of a table of text and of numbers with fixed decimals."""

from __future__ import annotations

from vehest.report.document import Column


def columns_of(**headers: str | tuple[str, int]) -> dict[str, Column]:
    """Columns of a table, in their order.

    Parameters
    ----------
    **headers
        Column of the frame = header, unit included; or header and decimals of every value.
    """
    return {
        name: Column(header) if isinstance(header, str) else Column(header[0], decimals=header[1])
        for name, header in headers.items()
    }
