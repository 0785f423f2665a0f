"""Runs a trained model on a new recording that has no reference channels.

model, recording -> checks -> the model's rate -> estimate with bands and health -> table, figures
and a verdict
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.checks import checks_of_recording, merged_findings, refuse_errors
from vehest.alignment.findings import Finding
from vehest.configuration.estimate_options import EstimateOptions, estimate_options
from vehest.configuration.files import is_file_name
from vehest.constants import GRAVITY
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import QUANTITIES, Estimate
from vehest.data.limits import use_limits
from vehest.data.recording import Recording, joined
from vehest.data.resampling import resampled_parts
from vehest.estimators.base import Estimator
from vehest.estimators.kernels.compiling import has_to_compile
from vehest.evaluation.metrics import min_sideslip_speed, moves_forward
from vehest.inference.car_values import (
    adapted,
    read_car,
    settings_for_channels,
    stated_wheelbase,
)
from vehest.inference.estimation import estimate_parts, too_short_error
from vehest.inference.models import (
    SELF_CALIBRATING,
    SHIPPED_NOTES,
    WITH_VEHEST,
    is_training_recording,
    open_model,
)
from vehest.inference.reading import vehicle_of, without_references
from vehest.inference.tables import LOG_SUFFIXES, check_table_name, write_estimate_table
from vehest.run.estimate_log import check_log_name, write_log
from vehest.run.estimate_summary import point_of_estimate
from vehest.run.printing import complain, describe_finding, note
from vehest.sources.base import car_of, source_of_file
from vehest.trust.contract import GuardedRun
from vehest.trust.health import SLOW_KERNEL, domain_verdict, outside_domain, reason_in_words
from vehest.trust.record import Trust, describe_band, is_other_vehicle

# Hz, smallest rate of a log that is brought to a faster model; a slower one misses the motion
MIN_LOG_RATE_HZ = 5.0
MAX_WHEELBASE_OVER_RADIUS = (
    0.8  # wheelbase over radius that a tenth of a drive may exceed; 0.42 on real cars that drift
)
# vx² over gravity and wheelbase that a hundredth of a drive may exceed before the wheelbase is
# doubted; 170 on real race cars
MAX_FROUDE_NUMBER = 400.0
CONTRADICTIONS = ("sign", "unit")  # names of the checks that compare channels with each other


def estimate_file(
    words: Sequence[str], out: Path, *, strict: bool = False, car: Path | None = None
) -> dict[str, Any]:
    """Run a model on a recording and write the estimate to ``out``; returns its figures and a
    verdict.

    Parameters
    ----------
    words : Sequence[str]
        A model, which may be left out, a recording and overrides of conf/estimate.yaml.
    out : Path
        Table to write, or the log with further channels (`estimate_log`).
    strict : bool
        Whether findings in the channels are an error; else they are printed as warnings.
    car : Path or None
        Record of `vehest identify` to start from.

    Returns
    -------
    dict
        Figures of `_Report.summary`, with file, model, point of the car, band, verdict and
        findings. The table appears complete or not at all.

    Raises
    ------
    VehestError
        Model, recording or table cannot be used.
    """
    n_names = 2 if len(words) > 1 and is_file_name(words[1]) else 1
    name = words[0] if n_names == 2 else SELF_CALIBRATING
    file = Path(words[n_names - 1])
    if n_names == 1 and file.is_dir():
        raise ConfigurationError(
            f"'{file}' is a folder; a recording is a file, and comes after the model: vehest "
            "estimate MODEL lap.csv"
        )
    writes_log = out.suffix.lower() in LOG_SUFFIXES
    _check_output(out, file)
    options = estimate_options(words[n_names:])
    settings = options.settings
    folder, model, trust = open_model(name, options.output, note)
    with use_limits(options.limits):
        dataset = without_references(options.dataset)
        accepted = dataset.get("accept") or ()
        source = source_of_file(dataset, file)
        parts = (
            (part, refuse_errors(part, accepted, f"'{file}'")) for part in source.file_parts(file)
        )
        first, first_findings = next(parts)
        remarks: list[str] = []
        if name == SELF_CALIBRATING and "measured_ax" not in settings:
            settings |= settings_for_channels(model, first)
            if "measured_ax" in settings:
                remarks.append(
                    "no longitudinal acceleration ax is measured: estimator.measured_ax=false; "
                    "with a measured ax large sideslip has about half the error, and samples have "
                    "a health"
                )
        record = None if car is None else read_car(car)
        model, trust, of_car = adapted(model, trust, first.car, settings, record)
        remarks += of_car
        missing = [channel for channel in model.channels if channel not in first]
        if missing:
            raise DataError(
                f"recording '{first.id}' has no channel '{missing[0]}', which '{name}' needs (it "
                f"has {', '.join(first.channels)}); declare its column in the data set, or take an "
                "estimator that 'vehest data usable' lists as usable"
            )
        if is_training_recording(folder, first.id):
            remarks.append(
                f"'{name}' was trained on this recording: its errors here are no test of it"
            )
        if has_to_compile(model.slow_kernel) or (trust is not None and has_to_compile(SLOW_KERNEL)):
            note("compiling once, about 20 s")
        if options.preparation is not None:
            model.preparation = options.preparation
        band = describe_band(trust, first.vehicle, options.same_vehicle, first.car)
        elsewhere = is_other_vehicle(trust, first.vehicle, options.same_vehicle, first.car)
        if MIN_LOG_RATE_HZ <= first.rate_hz < (1.0 - 1e-9) * model.settings.rate_hz:
            remarks.append(
                f"the recording is sampled at {first.rate_hz:g} Hz and brought to the "
                f"{model.settings.rate_hz:g} Hz of '{name}'; nothing faster than it is in the "
                "estimate"
            )
        run = GuardedRun(model, trust, elsewhere=elsewhere)
        min_speed = min_sideslip_speed(stated_wheelbase(first.car, settings))
        report = _Report(model, trust, accepted, min_speed, f"'{file}'" if strict else None)
        drive = report.checked(chain([(first, first_findings)], parts))
        if writes_log or not run.takes_parts:
            first = joined(list(drive))
            drive = iter([first])
        resampled_drive = resampled_parts(
            (part.select(model.channels) for part in drive),
            model.settings.rate_hz,
            model.preparation,
            slowest_hz=MIN_LOG_RATE_HZ,
        )
        estimates = report.counted(estimate_parts(run, resampled_drive))
        if writes_log:
            (estimate,) = estimates
            write_log(estimate, first, file, out)
        else:
            del first  # a part that is done needs no memory
            write_estimate_table(estimates, out, band)
    for remark in remarks:
        note(remark)
    findings = [describe_finding(finding) for finding in merged_findings(report.findings)]
    for finding in findings:
        complain(f"warning: {finding}")
    return {
        "out": str(out),
        "model": name if name in WITH_VEHEST else str(folder),
        **({"car": str(car)} if car is not None else {}),
        **report.summary(),
        "point": point_of_estimate(model, folder),
        **({"band": band} if band else {}),
        "verdict": report.verdict(),
        "findings": findings,
        **({"note": SHIPPED_NOTES[name]} if name in SHIPPED_NOTES else {}),
    }


def _check_output(out: Path, recording: Path) -> None:
    """Raise `ConfigurationError` where an estimate cannot be written to a path, before anything is
    computed.
    """
    if out.suffix.lower() in LOG_SUFFIXES:
        check_log_name(recording, out)
    else:
        check_table_name(out)
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file")
    if out.exists() and recording.exists() and out.samefile(recording):
        raise ConfigurationError(f"'{out}' is the recording itself; name another file")


def model_for_car(
    name: str, options: EstimateOptions, say: Callable[[str], None]
) -> tuple[Path, Estimator, Trust | None, bool]:
    """A model as `open_model` finds it, for the car of a data set, without a recording.

    Parameters
    ----------
    name : str
        Of a model that comes with vehest, a folder, or the start of a folder's name.
    options : EstimateOptions
        With the data set and settings of the car.
    say : callable
        Takes remarks, one line each.

    Returns
    -------
    tuple
        Folder, model, calibration, and whether bands are for another car: by the answer
            ``same_vehicle``,
        by values of the car, and by its name where a data set is named.

    Raises
    ------
    VehestError
        The model is not there, is damaged, or does not take the settings.
    """
    folder, model, trust = open_model(name, options.output, say)
    car = car_of(options.dataset)
    is_other = False
    if options.names_dataset or options.same_vehicle is not None:
        vehicle = vehicle_of(options.dataset)
        is_other = is_other_vehicle(trust, vehicle, options.same_vehicle, car)
    elif trust is not None and trust.bands is not None:
        is_other = bool(trust.bands.difference_to(car))
    model, trust, remarks = adapted(model, trust, car, options.settings)
    for remark in remarks:
        say(remark)
    return folder, model, trust, is_other


def findings_of(
    recording: Recording,
    model: Estimator,
    accepted: Sequence[str],
    of_all_channels: Sequence[Finding] | None = None,
) -> list[Finding]:
    """Findings in the channels that a model reads, given those of all channels, if they are known.

    Parameters
    ----------
    recording : Recording
        The recording, or a part of it.
    model : Estimator
        Its channels are checked, and its wheelbase, where it has one.
    accepted : sequence of str
        Checks whose contradictions are accepted.
    of_all_channels : sequence of Finding or None
        Findings of a check of all channels, which saves a second one.

    Returns
    -------
    list of Finding
        Without notes.

    Raises
    ------
    DataError
        Channels contradict each other.
    """
    read = [name for name in model.channels if name in recording]
    if of_all_channels is not None and (
        set(read) == set(recording.channels)
        or all(finding.level == "note" for finding in of_all_channels)
    ):
        findings = list(of_all_channels)
    else:
        findings = checks_of_recording(recording.select(read)) if read else []
    findings = [finding for finding in findings if finding.level != "note"]
    for finding in findings:
        if finding.check in CONTRADICTIONS and finding.check not in accepted:
            problem = f"channels contradict each other: {finding.message}"
            raise DataError(
                f"recording '{recording.id}': {problem} (or dataset.accept=[{finding.check}])"
            )
    return findings + wheelbase_findings(recording, getattr(model.settings, "wheelbase", None))


def wheelbase_findings(recording: Recording, wheelbase: float | None) -> list[Finding]:
    """Check a wheelbase against a drive: a finding where the car, above 1 m/s, turns too sharply or
    is too fast for any car of that wheelbase.

    Parameters
    ----------
    recording : Recording
        Without ``vx`` or ``yaw_rate`` there is nothing to compare.
    wheelbase : float or None
        [m].

    Returns
    -------
    list of Finding
        One warning at most; thresholds are MAX_WHEELBASE_OVER_RADIUS and MAX_FROUDE_NUMBER.
    """
    if wheelbase is None or not {"vx", "yaw_rate"} <= set(recording.channels):
        return []
    speed = recording["vx"]
    yaw_rate = np.abs(recording["yaw_rate"])
    moving = (speed > 1.0) & np.isfinite(yaw_rate)
    if not moving.any():
        return []
    speed, turn = speed[moving], float(np.quantile(yaw_rate[moving] / speed[moving], 0.9))
    problem = f"the drive does not fit a wheelbase of {wheelbase:g} m: a car of that size"
    remedy = "give estimator.wheelbase"
    if wheelbase * turn > MAX_WHEELBASE_OVER_RADIUS:
        return [
            Finding(
                "warning",
                "wheelbase",
                "",
                f"{problem} does not turn within {1.0 / turn:.2g} m, as in a tenth of it; {remedy}",
            )
        ]
    fast = float(np.quantile(speed, 0.99))
    if fast**2 > MAX_FROUDE_NUMBER * GRAVITY * wheelbase:
        return [
            Finding(
                "warning", "wheelbase", "", f"{problem} does not reach {fast:.0f} m/s; {remedy}"
            )
        ]
    return []


class _Report:
    """Findings, figures and verdict of a drive that is checked and estimated in parts.

    Parameters
    ----------
    model, trust : Estimator, Trust or None
        That estimate it.
    accepted : Sequence[str]
        Checks whose contradictions do not count.
    min_sideslip_speed : float
        Speed from which on the range of β is stated [m/s].
    strict : str or None
        Name of the file if findings are an error.
    """

    def __init__(
        self,
        model: Estimator,
        trust: Trust | None,
        accepted: Sequence[str],
        min_sideslip_speed: float,
        strict: str | None,
    ) -> None:
        self.model = model
        self.accepted = accepted
        self.min_sideslip_speed = min_sideslip_speed
        self.strict = strict
        self.health = trust.health if trust is not None else None
        self.has_calibrated_bands = trust is not None and trust.bands is not None
        self.findings: list[list[Finding]] = []
        self.outside: Any = 0
        self.seconds = 0.0
        self.samples = self.estimated = self.invalid = 0
        self.extremes: list[float] = []
        self.half = array("f")  # widths of the band
        self.reasons: Counter[float] = Counter()

    def checked(self, parts: Iterable[tuple[Recording, list[Finding]]]) -> Iterator[Recording]:
        """Pass on the parts of a drive after their findings have been collected.

        Raises `DataError` as `findings_of` does, and where it is strict.

        Parameters
        ----------
        parts : iterable of (Recording, list of Finding)
            Parts of the drive in order, with findings in all of their channels.
        """
        for part, of_all_channels in parts:
            findings = findings_of(part, self.model, self.accepted, of_all_channels)
            if self.strict and findings:
                raise DataError(f"{self.strict}: {describe_finding(findings[0])}")
            self.findings.append(findings)
            self.seconds += part.duration
            if self.health is not None:
                self.outside = self.outside + outside_domain(
                    self.health, {name: part[name] for name in self.health.channels}
                )
            yield part

    def counted(self, parts: Iterable[Estimate]) -> Iterator[Estimate]:
        """Pass on the parts of the estimate after they have been counted for the figures; raises
        `DataError` where all are empty.

        Parameters
        ----------
        parts : iterable of Estimate
            Parts of the estimate in order, each yielded again unchanged.
        """
        for part in parts:
            self.last = part
            is_estimated = ~np.isnan(part["vy"])
            is_stated = moves_forward(part["vy"], part["sideslip"], self.min_sideslip_speed)
            if is_stated.any():
                degrees = np.degrees(part["sideslip"][is_stated])
                self.extremes += [float(degrees.min()), float(degrees.max())]
            self.samples, self.estimated = (
                self.samples + len(part),
                self.estimated + int(is_estimated.sum()),
            )
            if "band_sideslip" in part.channels:
                self.half.frombytes(
                    part["band_sideslip"][~np.isnan(part["band_sideslip"])]
                    .astype(np.float32)
                    .tobytes()
                )
            status = part["health"][is_estimated]
            reasons = part["health_reason"][is_estimated]
            self.invalid += int((status > 0).sum())
            codes, counts = np.unique(reasons[(status > 0) & (reasons > 0)], return_counts=True)
            self.reasons.update(dict(zip(codes.tolist(), counts.tolist(), strict=True)))
            yield part
        if not self.estimated:
            raise too_short_error(self.model, self.last.recording_id, self.seconds)

    def summary(self) -> dict[str, Any]:
        """Figures of the estimate, for the terminal and for JSON.

        Returns
        -------
        dict
            Angles in degrees; the range of β is None where the car was too slow throughout.
        """
        last = self.last
        figures: dict[str, Any] = {
            "recording": last.recording_id,
            "estimator": last.estimator,
            "rate_hz": last.rate_hz,
            "samples": self.samples,
            "estimated": self.estimated,
            "seconds": self.seconds,
            "valid_percent": self.valid_percent,
            "invalid_reasons": self.invalid_reasons,
            "outside_training": self.outside_training,
            "has_calibration": self.health is not None,
            "quantities": {name: QUANTITIES[name] for name in last.channels},
            "min_sideslip_speed": self.min_sideslip_speed,
            "sideslip_deg": {
                end: round(take(self.extremes), 3) if self.extremes else None
                for end, take in (("min", min), ("max", max))
            },
        }
        if "band_sideslip" in last.channels:
            half = np.frombuffer(self.half, np.float32)
            np.degrees(half, out=half)
            middle = float(np.median(half, overwrite_input=True)) if len(half) else 0.0
            band = (
                {"median": round(middle, 3), "largest": round(float(half.max()), 3)}
                if len(half)
                else {}
            )
            figures["band_sideslip_deg"] = band
        return figures

    @property
    def valid_percent(self) -> float:
        """Share of the estimated samples whose health is valid [%]."""
        return 100.0 * (1.0 - self.invalid / self.estimated)

    @property
    def invalid_reasons(self) -> list[str]:
        """The two most frequent reasons for samples that are not valid."""
        counts = sorted(self.reasons.items(), key=lambda reason: -reason[1])
        return [reason_in_words(code) for code, _ in counts[:2]]

    @property
    def outside_training(self) -> str:
        """Text on the share of the drive outside the range of the training, with the channels;
        empty if there is none.
        """
        return domain_verdict(self.health, self.outside) if self.health is not None else ""

    def verdict(self) -> str:
        """One line on the share of valid samples and on what makes others invalid."""
        if self.health is None:
            if self.has_calibrated_bands:
                return "health is from gaps and speeds alone: not calibrated for these channels"
            bands = "its bands are its own" if "band_vy" in self.last.channels else "no band"
            return f"this model has no calibration: {bands}, and health from gaps and speeds alone"
        reasons = self.invalid_reasons
        valid = f"valid in {self.valid_percent:.3g} % of the drive" + (
            f"; otherwise: {', '.join(reasons)}" if reasons else ""
        )
        return "; ".join(filter(None, (self.outside_training, valid)))
