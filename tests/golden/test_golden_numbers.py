"""Numbers stay as recorded unless a version is raised.

On another machine within the tolerance of golden_numbers.py.
"""

import json
from functools import cache

import pytest
from golden_numbers import FILE, LEARNT, moved, subjects, this_machine

RECORDED = json.loads(FILE.read_text(encoding="utf-8"))
SUBJECTS = subjects()


@cache
def now(name):
    return SUBJECTS[name].record()


def test_every_family_source_and_stage_is_recorded():
    assert set(RECORDED["subjects"]) == set(SUBJECTS), "run `make golden`"


@pytest.mark.parametrize("name", SUBJECTS)
def test_numbers_are_those_recorded(name):
    is_recording_machine = RECORDED["machine"] == this_machine()
    complaint = moved(
        name,
        RECORDED["subjects"][name],
        now(name),
        None if is_recording_machine else SUBJECTS[name].tolerance,
    )
    assert not complaint, complaint


@pytest.mark.parametrize("tolerance", [None, LEARNT])
def test_numbers_that_move_name_the_version_to_raise(tolerance, monkeypatch):
    from vehest.estimators import luenberger

    former = luenberger.Luenberger.estimate_recording
    unshifted = now("luenberger")  # before its estimates are shifted: `now` keeps them

    def shifted(self, recording, state):
        estimate = former(self, recording, state)
        estimate.channels["vy"][:] *= 1.01
        return estimate

    monkeypatch.setattr(luenberger.Luenberger, "estimate_recording", shifted)
    complaint = moved("luenberger", unshifted, SUBJECTS["luenberger"].record(), tolerance)
    assert complaint.startswith(
        "estimates of luenberger moved: raise Luenberger.version if that is meant"
    )


def test_raised_versions_need_new_records_and_other_machines_have_a_tolerance():
    raised = now("luenberger") | {"versions": {"Luenberger.version": "2"}}
    message = "a version of luenberger was raised: record its numbers with `make golden`"
    assert moved("luenberger", now("luenberger"), raised, None) == message
    for name in ("luenberger", "source tabular"):
        assert not moved(name, RECORDED["subjects"][name], now(name), SUBJECTS[name].tolerance)
