"""Writes an estimate back into the log that it was made of, as channels of their own, for the
viewer that the log came from.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import QUANTITIES, Estimate
from vehest.data.files import written_aside
from vehest.data.recording import Recording
from vehest.sources.limited import read_limited
from vehest.trust.health import reason_in_words

PREFIX = "vehest_"  # start of the names of the channels that are added to a log
HEALTH = ("valid", "degraded", "invalid")  # texts of the codes 0, 1 and 2 of health


def check_log_name(log: Path, out: Path) -> None:
    """Raise `ConfigurationError` where a log cannot be written in the format that a name requires.

    Parameters
    ----------
    log : Path
        The recording.
    out : Path
        What is to be written; .mf4 needs a log in MDF.
    """
    if out.suffix.lower() == ".mf4" != log.suffix.lower():
        raise ConfigurationError(
            f"'{out}' would be '{log}' with further channels, which is no .mf4; name a .mat, .csv "
            "or .parquet file"
        )


def write_log(estimate: Estimate, recording: Recording, log: Path, out: Path) -> None:
    """Write a log with the estimate in it: ``vehest_vy`` [m/s], ``vehest_sideslip`` [rad], their
    bands, health and its reason.

    As MDF 4, the log as it is with one group more, on the estimate's clock. As MAT 5, the channels
    of the recording in SI units and the estimate, held, on the clock ``time`` of the recording.

    Parameters
    ----------
    estimate : Estimate
        Of the recording.
    recording : Recording
        As it was read from the log.
    log : Path
        Its file.
    out : Path
        `LOG_SUFFIXES`; see `check_log_name`.

    Raises
    ------
    DataError
        The log is of an older version of MDF.
    MissingError
        There is no room, or a folder cannot be written to.
    """
    if out.suffix.lower() == ".mat":
        from scipy.io import savemat

        quantities = {
            f"{PREFIX}{name}": estimate.held_at(recording.time, name) for name in estimate.channels
        }
        with written_aside(out) as aside, open(aside, "wb") as stream:
            savemat(
                stream,
                {"time": recording.time, **recording.channels, **quantities},
                oned_as="column",
                do_compression=True,
            )
        return
    signals = []
    for name, values in estimate.channels.items():
        about = CHANNELS[name].meaning if name in CHANNELS else name.replace("_", " ")
        signals.append(
            (
                f"{PREFIX}{name}",
                values.tolist(),
                QUANTITIES[name],
                f"estimated by {estimate.estimator}: {about}",
                _texts(name, values),
            )
        )
    content = read_limited(
        "vehest.sources.readers.mdf:with_signals",
        log,
        seconds=estimate.time.tolist(),
        signals=signals,
    ).arrays["content"]
    with written_aside(out) as aside:
        aside.write_bytes(content.tobytes())


def _texts(name: str, values: FloatArray) -> dict[int, str]:
    """Code -> text, for the codes of health or of its reason that occur in ``values``."""
    if name == "health":
        return dict(enumerate(HEALTH))
    return (
        {int(code): reason_in_words(code) or "-" for code in np.unique(values)}
        if name == "health_reason"
        else {}
    )
