"""The report: headline, how it was made, Figures 3 and 5 to 11 and Table 3, then what the paper does not have."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from vehest.data.derived import SpeedFromWheels
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.model_files import load_model
from vehest.report.document import REPORT, Block, Column, Document, Table, as_code, as_text
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest_papers.heavy_ekf import (
    accuracy,
    block_errors,
    draws,
    laps,
    paper,
    tables,
    twin_report,
    tyres,
    vehicle,
    watching,
)
from vehest_papers.heavy_ekf.factorial import Factorial, every_cell, factorial
from vehest_papers.heavy_ekf.subjects import (
    TYRES,
    Filter,
    baseline_errors,
    curves_of,
    filters_of,
    rmse_of,
    titles_of,
    validation_drives,
    whole_drive,
)
from vehest_papers.kit import methods
from vehest_papers.kit.block_rows import (
    BASELINE_NAMES,
    BLOCKS,
    TRAINING,
    BlockRow,
    TrainingRow,
    frame,
)
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.reading import spans_in_words, words_of_kinds
from vehest_papers.kit.verdict_table import claims_table

TRUCK = "truck"
DRAWS = "seeds"
FERRARI = "ferrari"
WHEELED = "av21"
WHEELS = SpeedFromWheels(
    wheel_radius=0.48, track_front=2.08, track_rear=2.08
)  # as in conf/vehicle/heavy_truck.yaml
NOMINAL = "nominal_laps"


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises:
        DataError: the part ``truck``, one of its test sets or one of the paper's filters is missing.
    """
    if TRUCK not in artefacts.parts:
        raise DataError(f"study '{artefacts.study}' needs part '{TRUCK}'")
    truck = artefacts.parts[TRUCK]
    tests = [f"{kind}_{drive}" for kind in TYRES for drive in tables.DRIVES]
    if set(truck.split.tests) != set(tests):
        raise DataError(
            f"study '{artefacts.study}': the test sets of part '{TRUCK}' must be called {', '.join(tests)}"
        )
    filters = filters_of(truck)
    rmse = rmse_of(truck, filters)
    real = artefacts.parts.get(FERRARI)
    real_filters = filters_of(real) if real else {}
    real_rmse = rmse_of(real, real_filters) if real else {}
    drives = {test: whole_drive(truck, test) for test in tests}
    shown = {name: own for name, own in filters.items() if name in (*paper.ORDER, paper.HELD)}
    estimates = {
        test: {name: own.of(drive) for name, own in shown.items()} for test, drive in drives.items()
    }
    traces, of_ferrari = _ferrari(real, real_filters, real_rmse) if real else ([], [])
    errors = {**rmse, **baseline_errors(truck)}
    real_errors = {**real_rmse, **baseline_errors(real)} if real else {}
    twin = factorial()
    twin_front, twin_data, twin_appendix = twin_report.twin_blocks(twin)
    slowest = filters[paper.RATTE].fitted.settings.minimum_speed
    car = filters[paper.RATTE].fitted.settings.car
    rows = _error_rows(artefacts, twin)
    rows += block_errors.measured_rows(TRUCK, drives, _with_baselines(truck, estimates), slowest)
    trained = block_errors.training_rows()
    kinds = {name: words_of_kinds(part) for name, part in artefacts.parts.items()}
    warned = methods.warnings_in_words(
        {
            as_text(artefacts.titles[name]): part
            for name, part in artefacts.parts.items()
            if name not in (WHEELED, DRAWS)
        }
    )
    blocks: list[Block] = [
        *_asked(artefacts),
        claims_table(claims_of("heavy_ekf"), rows, trained, kinds),
        *traces,
        tables.overview(
            errors,
            real_errors,
            [
                *filters,
                *(title for title, test in baseline_errors(truck) if test == NOMINAL),
            ],
        ),
        *twin_front,
        *([f"## Appendix: what to mind\n\n{warned}"] if warned else []),
        *twin_appendix,
        *(
            draws.draws_blocks(artefacts.parts[DRAWS], float(car.cg_to_rear_axle))
            if DRAWS in artefacts.parts
            else []
        ),
        *_lap_by_lap(drives, estimates, slowest),
        "## Appendix: the vehicle",
        vehicle.table_2(car),
        vehicle.eigenvalues_table(car),
        *(vehicle.wheels_blocks(artefacts.parts[WHEELED]) if WHEELED in artefacts.parts else []),
        *_truck(truck, filters, rmse, drives, estimates),
        *of_ferrari,
        *_how_it_was_made(artefacts),
    ]
    data = {
        **twin_data,
        "twin_cells": every_cell(twin),
        BLOCKS: frame(rows, BlockRow),
        TRAINING: frame(trained, TrainingRow),
    }
    return {REPORT: Document(artefacts.title, blocks, data)}


def _error_rows(artefacts: StudyArtefacts, twin: Factorial) -> list[BlockRow]:
    """Errors by block of all parts and of the twin."""
    parts = artefacts.parts
    rows = [*block_errors.drive_rows(TRUCK, parts[TRUCK]), *block_errors.twin_rows(twin)]
    if FERRARI in parts:
        rows += block_errors.drive_rows(FERRARI, parts[FERRARI])
    if DRAWS in parts:
        rows += block_errors.draw_rows(DRAWS, parts[DRAWS])
    if WHEELED in parts:
        rows += block_errors.wheel_rows(WHEELED, parts[WHEELED])
    return rows


def _with_baselines(
    truck: PartArtefacts, estimates: Mapping[str, Mapping[str, Estimate]]
) -> dict[str, dict[str, Estimate]]:
    """Estimates on the nominal laps with those of the baselines that claims name."""
    found = {test: dict(own) for test, own in estimates.items()}
    seen = whole_drive(truck, NOMINAL).without_references()
    titles = titles_of(truck)
    for model in truck.models:
        if titles[model.name] in BASELINE_NAMES:
            found[NOMINAL][titles[model.name]] = load_model(model.model_folder).estimate([seen])[0]
    return found


def _lap_by_lap(
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
    slowest: float,
) -> list[Block]:
    """Errors a lap, underestimation and the stop."""
    return [
        "## Appendix: lap by lap, underestimation, and the stop",
        accuracy.per_lap_table(drives, estimates, paper.ORDER, slowest),
        accuracy.underestimation_table(drives, estimates, paper.ORDER),
        accuracy.stop_table(drives, estimates, paper.ORDER),
    ]


def _asked(artefacts: StudyArtefacts) -> list[Block]:
    kinds = methods.kinds_of_parts(artefacts, artefacts.parts)
    absent = methods.absent_parts(artefacts)
    return [
        f"{kinds}. The paper's recordings are real, of another vehicle, and not public.{absent}",
        artefacts.about,
    ]


def _how_it_was_made(artefacts: StudyArtefacts) -> list[Block]:
    lines = [
        f"Command: {as_code(artefacts.command)}",
        methods.scoring(artefacts.parts[TRUCK]),
        "RMSE(β) is over β = atan2(v, u) with the measured u, Equation 65; of the truck at 2 m/s and more, since below "
        "β means little and the paper's sensor diverges as well.",
        "Axle curves are fitted by least squares to training drives, the truck's to those on nominal tyres; levels of noise are those with "
        "the smallest error on all training drives, the truck's on nominal and on worn tyres, since a filter that is to adapt has to be "
        "tuned where there is something to adapt to. The tests are other drives, and choose nothing.",
        _limits_in_words(artefacts),
        *methods.facts_of(artefacts.parts.values()),
    ]
    departures = (
        "Where we differ from the paper: tyre parameters are states as logarithms over their fitted values, so that they stay positive and "
        "the filter is well conditioned, and are kept within a factor of three, or three of their deviations at the start; beyond 0.5 rad "
        "of sideslip the filter begins anew, tyres included; axle forces for the fit come from accelerations instead of TRICK, and where "
        "they leave c1 open, a largest force at slip angles of about 9° (6 to 13°) is taken as known; levels of noise are tuned, since "
        f"there is no data sheet; vertical loads are those at rest. {paper.HELD}, {paper.UNSCENTED} and RATT with friction are not in the "
        "paper; the unscented filter takes the levels that were found through the extended one."
    )
    ranges = methods.ranges_table(artefacts, "ranges", "What was used for what.", {})
    return [methods.how_it_was_made(lines), departures, ranges]


def _limits_in_words(artefacts: StudyArtefacts) -> str:
    """Which searches for levels of noise ended on a limit of their box."""
    found = [
        f"{artefacts.titles[name]}, {paper.VARIANTS.get(model.variant, model.variant)} ({model.fit_metrics()['levels_at_limits']:g} level)"
        for name, part in artefacts.parts.items()
        for model in part.models
        if model.fit_metrics().get("levels_at_limits", 0.0) > 0.0
    ]
    return f"Searches for levels of noise that ended on a limit of their box, six to nine decades wide: {'; '.join(found) or 'none'}."


def _truck(
    part: PartArtefacts,
    filters: Mapping[str, Filter],
    rmse: tables.Rmse,
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
) -> list[Block]:
    data = words_of_kinds(part).upper()
    settings = filters[paper.RATTE].fitted.settings
    car = settings.car
    slowest = settings.minimum_speed
    sound = validation_drives(part)
    own = {
        kind: tyres.OwnCurves.of(
            [drives[f"{kind}_{drive}"] for drive in tables.DRIVES], car, slowest
        )
        for kind in TYRES
    }
    three = drives[NOMINAL]
    fast = drives["nominal_fast"]
    fit = curves_of(
        filters[paper.RATTE].fitted, [drive for drive in sound if drive.vehicle == three.vehicle]
    )
    by_tyres = {kind: drives[f"{kind}_laps"] for kind in TYRES}
    adaptive = [name for name in (paper.LINT, paper.RATTE, paper.HELD) if name in filters]
    errors = tables.errors_table(
        drives, estimates, [name for name in (*paper.ORDER, paper.HELD) if name in filters], slowest
    )
    blocks: list[Block] = [
        "## Appendix: tyres",
        tyres.figure_3(fit, own["nominal"], "figure_3", data),
        tyres.table_1(fit, own["nominal"], "table_1", data),
        "## Appendix: speed from the wheels",
        laps.figure_5(three, WHEELS, data),
        "## Appendix: three laps",
        laps.figure_6(three, laps.drawn(estimates[NOMINAL]), slowest, data),
        laps.speed_and_acceleration(three, 7, "three laps at constant speed", data),
        tables.table_3(rmse, list(filters), data),
        tables.gains_table(rmse),
        errors,
        tables.order_in_words(
            rmse, errors.frame, fit, own, drives, filters[paper.RATTE].fitted.values["tyres"]
        ),
        "## Appendix: tyre parameters over time",
    ]
    for name, number in ((paper.LINT, 8), (paper.RATTE, 9)):
        what = (
            "Cornering stiffness values" if name == paper.LINT else "Rational tyre model parameters"
        )
        caption = (
            f"{what}, {name} filter (Figure {number} of the paper), three laps, {data}. Dashed: what fits the plant's own tyre forces on "
            "these tyres; left out where it lies far off the axis."
        )
        of = {kind: estimates[f"{kind}_laps"][name] for kind in TYRES}
        blocks.append(tyres.parameters_figure(by_tyres, of, own, name, f"figure_{number}", caption))
    if paper.HELD in filters:
        above = filters[paper.HELD].fitted.settings.adapt_above
        caption = f"The same of {paper.HELD}: parameters are held while |u r| is below {above:g} m/s², three laps, {data}. Dashed as above."
        of = {kind: estimates[f"{kind}_laps"][paper.HELD] for kind in TYRES}
        blocks.append(
            tyres.parameters_figure(by_tyres, of, own, paper.HELD, "figure_9_held", caption)
        )
    caption = f"Measured and estimated sideslip angle during a high-speed lap (Figure 10 of the paper), {data}, '{fast.id}'."
    blocks += [
        tyres.convergence_table(drives, estimates, own, adaptive),
        "## Appendix: the fast lap",
        laps.sideslip_figure(
            fast, laps.drawn(estimates["nominal_fast"]), slowest, "figure_10", caption
        ),
        laps.speed_and_acceleration(fast, 11, "the high-speed lap", data),
    ]
    watched = {name: filters[name] for name in reversed(paper.ORDER)}
    blocks += [
        "## Appendix: where the parameters can move",
        *watching.observability_blocks(watched, three, slowest, data),
    ]
    blocks += [
        "## Appendix: bad input",
        *watching.bad_input_table(watched, three, sound, WHEELS, slowest, data),
    ]
    return blocks


def _ferrari(
    part: PartArtefacts, filters: Mapping[str, Filter], rmse: tables.Rmse
) -> tuple[list[Block], list[Block]]:
    """The sideslip angle, which stands on the first page, and an appendix."""
    data = words_of_kinds(part).upper()
    span = part.split.tests["test"][0]
    drive = whole_drive(part, "test").cut(span.start - part.protocol.warm_up_seconds, span.stop)
    estimates = {name: own.of(drive) for name, own in filters.items()}
    fit = curves_of(filters[paper.RATTE].fitted, validation_drives(part))
    rows = pd.DataFrame(
        [
            {"filter": name, "rmse": rmse[name, "test"], "validation": rmse[name, "validation"]}
            for name in filters
        ]
    )
    columns = {"filter": Column("filter"), "rmse": Column("RMSE(β), test [deg]", decimals=3)}
    columns["validation"] = Column("RMSE(β), validation [deg]", decimals=3)
    learnt = spans_in_words(part.split.train)
    tested = spans_in_words(part.split.tests["test"])
    caption = f"The real Ferrari at 20 Hz, {data}: learnt on {learnt}, tested on {tested}."
    trace = f"Measured and estimated sideslip angle on the test range and the seconds before it, {data}, '{drive.id}'."
    wander = f"Rational tyre model parameters, RATTE filter, on the same range, {data}; what is true of these tyres is not known."
    slowest = filters[paper.RATTE].fitted.settings.minimum_speed
    return [
        laps.sideslip_figure(drive, laps.drawn(estimates), slowest, "sideslip_ferrari", trace)
    ], [
        "## Appendix: the same filters on a real car",
        "The filters need steering, yaw rate, lateral acceleration and speed only, so they run on a car as well; the first page "
        "compares them and shows the sideslip angle.",
        Table("ferrari", caption, rows, columns),
        tyres.figure_3(fit, None, "figure_3_ferrari", data),
        tyres.table_1(fit, None, "table_1_ferrari", data),
        tyres.parameters_figure(
            {"as it is": drive},
            {"as it is": estimates[paper.RATTE]},
            {},
            paper.RATTE,
            "parameters_ferrari",
            wander,
        ),
    ]
