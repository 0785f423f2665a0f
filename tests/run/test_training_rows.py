"""Errors on the training ranges are left out where a reference has gaps, and not where a recording
cannot be read.
"""

from types import SimpleNamespace

import pytest

from vehest.data.errors import DataError
from vehest.data.splits import Span
from vehest.run import evaluate


def test_gaps_leave_training_rows_out_and_a_damaged_recording_is_an_error(monkeypatch):
    def damaged(span):
        raise DataError("'one.parquet' is truncated or damaged")

    def gappy(*_):
        raise DataError("the reference has gaps")

    monkeypatch.setattr(evaluate, "learnt_spans", lambda *_: [Span("mine", "one")])
    monkeypatch.setattr(evaluate, "_estimates", gappy)
    monkeypatch.setattr(evaluate, "sequences", gappy)
    readable = {"reference": lambda span: None, "measured": lambda span: None}
    for spoilt in ({}, {"reference": damaged}, {"measured": damaged}):
        settings = SimpleNamespace(data={"mine": None}, protocol=None, **{**readable, **spoilt})
        if spoilt:
            with pytest.raises(DataError, match="truncated or damaged"):
                evaluate.training_rows(settings, None, None)
        else:
            assert evaluate.training_rows(settings, None, None) == []
