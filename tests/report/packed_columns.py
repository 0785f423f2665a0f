"""Reads the packed columns of an explorer as the page does."""

import base64
import zlib

import numpy as np

from vehest.report.explorer import GAP


def unpacked(content):
    """Columns of what `explorer_json` says, as the page reads them."""
    n = content["length"]
    raw = (
        np.frombuffer(zlib.decompress(base64.b64decode(content["data"])), np.uint8)
        .reshape(-1, 2, n)
        .astype(np.uint16)
    )
    codes = np.cumsum(raw[:, 0] + (raw[:, 1] << 8), axis=1, dtype=np.uint16)
    return {
        name: np.where(
            codes_of_column == GAP, np.nan, low + scale * codes_of_column.astype(np.float64)
        )
        for codes_of_column, (name, (low, scale)) in zip(
            codes, content["columns"].items(), strict=True
        )
    }
