"""The pages of the study: an index, and one a vehicle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Block, Column, Document, Figure, Table, as_code, as_text
from vehest.report.style import fixed, significant
from vehest.studies.artefacts import AbsentDataset, StoredDataset, StudyArtefacts
from vehest_papers.proving_ground import drawing, gates, noise
from vehest_papers.proving_ground.index import index_document
from vehest_papers.proving_ground.noise_reading import NOISE_ABOVE
from vehest_papers.proving_ground.papers import Profile, profile_of
from vehest_papers.proving_ground.tables import (
    COLUMNS,
    QUANTITIES,
    accidents,
    flagged_table,
    how_to_get,
    row_of,
)
from vehest_papers.proving_ground.tally import MOVING, Tally
from vehest_papers.proving_ground.vehicles import ALL, DatasetTally, VehiclePage, survey

MOST_SETS = 10
MOST_FLAGGED = 12


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """Name of the file -> document; ``report`` is the index, its first table the ``overview``.

    Raises:
        DataError: a recording lacks a channel that is shown.
    """
    names = {own.name for own in artefacts.datasets}
    pages = survey(
        [own for own in artefacts.datasets if own.name != gates.BEFORE or gates.AFTER not in names]
    )
    return {
        "report": index_document(artefacts, pages),
        **{name: _page(artefacts, page) for name, page in pages.items()},
    }


def _page(artefacts: StudyArtefacts, page: VehiclePage) -> Document:
    profile = profile_of(page.name)
    blocks: list[Block] = [
        _what_it_is(page),
        *_drives(page),
        *_traces(page),
        *_handling(page),
        *_distributions(page, profile),
    ]
    blocks += _beside_paper(page, profile)
    if profile.counterpart is not None:
        blocks += _beside_real(
            page,
            profile,
            [
                dataset
                for dataset in artefacts.absent_datasets
                if dataset.name == profile.counterpart
            ],
        )
    blocks.append("[All vehicles](report.md)")
    return Document(profile.title, blocks)


def _what_it_is(page: VehiclePage) -> str:
    if not page.simulated:
        return "**Real data:** every number on this page comes from real recordings."
    except_for = (
        "; the real recording beside is called real wherever it stands" if page.real else ""
    )
    return (
        f"**SIMULATED:** what stands on this page comes from a simulation of such a vehicle, not from a real one{except_for}. "
        f"Plant: CommonRoad's multi-body model with the parameters of `conf/vehicle/{page.name}.yaml`, each with its source or the word "
        f"assumed. Data {'sets' if len(page.simulated) > 1 else 'set'}: {', '.join(f'`{name}`' for name in page.simulated)}."
    )


def _drives(page: VehiclePage) -> list[Block]:
    own = next(iter((page.simulated or page.real).values()))
    names = _shown_sets(own)
    rows = [{"set": name.removeprefix("manoeuvre:"), **row_of(own.tallies[name])} for name in names]
    what = "manoeuvre" if names[0].startswith("manoeuvre:") else "set"
    table = Table(
        f"{page.name}_drives",
        f"Drives of `{own.dataset.name}` ({own.dataset.kind}), a row a {what}.",
        pd.DataFrame(rows),
        {"set": Column(what), **COLUMNS},
    )
    blocks: list[Block] = ["## Drives", table]
    if page.simulated:
        blocks.append(accidents(page.flagged, page.merged("simulated").drives))
    if 0 < len(page.flagged) <= MOST_FLAGGED:
        blocks.append(flagged_table(f"{page.name}_flagged", page.flagged))
    elif page.flagged:
        blocks.append("Each of them: [flagged.csv](tables/flagged.csv).")
    return blocks


def _shown_sets(own: DatasetTally) -> list[str]:
    """The entries of the data set, or the manoeuvres where there are many entries; all together last."""
    manoeuvres = [name for name in own.tallies if name.startswith("manoeuvre:")]
    entries = [name for name in own.tallies if name != ALL and name not in manoeuvres]
    return [*(entries if len(entries) <= MOST_SETS else manoeuvres), ALL]


def _traces(page: VehiclePage) -> list[Block]:
    if not page.stretches:
        return []
    stretches = drawing.shown_stretches(page.stretches)
    drives = ", ".join(f"{as_code(stretch.recording)}" for stretch in stretches)
    each = "of each manoeuvre " if len(stretches) > 1 else ""
    caption = (
        f"Traces (simulated) as the sensors show them, β from the reference, {profile_of(page.name).preparation}: of the drives that went "
        f"as planned {each}the stretch with the largest mean square of ay ({drives})."
    )
    return ["## Traces", Figure(f"{page.name}_traces", caption, drawing.traces(stretches))]


def _handling(page: VehiclePage) -> list[Block]:
    if page.handling is None:
        return []
    speeds = sorted({own.speed for own in page.characteristics})
    real = " and of the real recording" if page.real_handling is not None else ""
    caption = (
        f"Handling diagram (simulated): steering angle beyond what the curvature needs without slip, over speed times yaw rate. Grey: all "
        f"samples above 5 m/s. Symbols: medians of the quasi-steady turns (|ax| and |ay − speed × yaw rate| < 1 m/s², |change of yaw "
        f"rate| < 0.1 rad/s²) of the simulated recordings{real}. Lines: the plant in a slow ramp of the steering at "
        f"{' and '.join(f'{speed:.3g}' for speed in speeds)} m/s up to its limit, and the slope of the linear single track with the tyres' "
        f"cornering stiffness at static load."
    )
    return ["## Handling", Figure(f"{page.name}_handling", caption, drawing.handling(page))]


def _distributions(page: VehiclePage, profile: Profile) -> list[Block]:
    kinds = " and ".join(
        [*(["simulated"] if page.simulated else []), *(["real"] if page.real else [])]
    )
    marks = f" Dotted: {profile.limit_label}." if profile.limit_label else ""
    how = profile.preparation
    caption = (
        f"Distribution of sideslip angle and lateral acceleration ({kinds}) in bins of 1° and 1 m/s², on a logarithmic scale as in Figure "
        f"4 of Bertipaglia et al. 2024; samples above {MOVING:g} m/s, {how}.{marks}"
    )
    blocks: list[Block] = [
        "## Distributions",
        Figure(f"{page.name}_distributions", caption, drawing.distributions(page, profile)),
    ]
    if profile.sideslip_limit is not None and profile.ay_limit is not None:
        blocks.append(
            _spread_in_words(page.merged("simulated"), profile.ay_limit, profile.sideslip_limit)
        )
    return blocks


def _spread_in_words(tally: Tally, ay_limit: float, sideslip_limit: float) -> str:
    edges, counts = tally.histogram("ay", 1.0)
    inside = counts[(edges[:-1] >= -ay_limit) & (edges[1:] <= ay_limit)]
    ratio = (
        f"{significant(inside.max() / inside.min(), 2)} times as many samples as"
        if inside.min() > 0
        else "more than"
    )
    return (
        f"Simulated: {fixed(100 * tally.share_within('ay', ay_limit), 1)} % of the samples lie within ±{ay_limit:g} m/s², where the "
        f"fullest bin holds {ratio} the emptiest; {fixed(100 * tally.share_within('sideslip', sideslip_limit), 1)} % lie within "
        f"±{sideslip_limit:g}°, and one in a thousand beyond {fixed(tally.quantile('sideslip', 0.999, absolute=True), 1)}°."
    )


def _beside_paper(page: VehiclePage, profile: Profile) -> list[Block]:
    if not page.simulated or not profile.source:
        return []
    rows = []
    for own in page.simulated.values():
        units = {name: unit for name, (_, unit) in own.all.values().items()}
        for paper in profile.sets:
            if paper.drives in own.tallies:
                ours = {
                    name: value for name, (value, _) in own.tallies[paper.drives].values().items()
                }
                for name, value in paper.values.items():
                    about = {
                        "set": paper.name,
                        "drives": paper.drives,
                        "quantity": QUANTITIES[name],
                        "unit": units[name],
                    }
                    rows.append(
                        about
                        | {"paper": value, "simulated": ours[name], "ratio": ours[name] / value}
                    )
    blocks: list[Block] = ["## Beside the paper", profile.prose]
    if rows:
        table = Table(
            f"{page.name}_beside_paper",
            f"{profile.source}, real, beside the simulated drives; {profile.preparation}.",
            pd.DataFrame(rows),
            {
                "set": Column("set"),
                "drives": Column("drives"),
                "quantity": Column("quantity"),
                "unit": Column("unit"),
                "paper": Column("paper (real)", each=True),
                "simulated": Column("simulated", each=True),
                "ratio": Column("simulated / paper", decimals=2),
            },
        )
        blocks.append(table)
    return blocks


def _how_alike(simulated: Tally, real: Tally) -> str:
    ratio = {
        name: simulated.quantile(name, 0.99, absolute=True)
        / real.quantile(name, 0.99, absolute=True)
        for name in ("sideslip", "ay")
    }
    size = "smaller" if ratio["sideslip"] < 1.0 else "larger"
    return (
        f"The 99 % quantile of |β| is {fixed(ratio['sideslip'], 2)} times the real one, that of |ay| {fixed(ratio['ay'], 2)} times: what "
        f"an estimator has to find is that much {size} here than on the real car. The parameters were not fitted to the recording."
    )


def _beside_real(
    page: VehiclePage, profile: Profile, absent: Sequence[AbsentDataset]
) -> list[Block]:
    heading = "## Beside the real recording"
    if not page.real or not page.simulated:
        how = " ".join(how_to_get(dataset) for dataset in absent)
        return [
            f"{heading}\n\nThe real recording of data set `{profile.counterpart}` is absent from this report. {how}".strip()
        ]
    real = next(iter(page.real.values()))
    simulated = page.merged("simulated").values()
    measured = real.all.values()
    rows = [
        {"quantity": QUANTITIES[name], "unit": unit, "real": measured[name][0], "simulated": value}
        for name, (value, unit) in simulated.items()
        if name in QUANTITIES and name != "drives"
    ]
    blocks: list[Block] = [
        f"{heading}\n\nReal: {_recordings_in_words(real.dataset)}. Simulated: all drives of this page. Both {profile.preparation}.",
        Table(
            f"{page.name}_beside_real",
            "Statistics, real and simulated.",
            pd.DataFrame(rows),
            _REAL_AND_SIMULATED,
        ),
        _how_alike(page.merged("simulated"), real.all),
    ]
    if not noise.comparable(page.samples):
        return [
            *blocks,
            "The two have not the same rate or channels, or are too short for spectra.",
        ]
    samples = noise.same_length(page.samples)
    lengths = f"`{samples['simulated'].id}` (simulated) and `{samples['real'].id}` (real), {samples['real'].duration:.0f} s each"
    return [
        *blocks,
        "The levels of the simulated sensors (`race`) were read off this very recording, by the same reading as here: that the two agree "
        "is how they were made, not a proof. Above 10 Hz a recording does not tell engine, road and sensor apart; the plant has neither "
        "engine nor rough road, so that its sensors stand for all three as white noise, and lines in the real spectrum have no "
        "counterpart.",
        Figure(
            f"{page.name}_spectra",
            f"Spectra, real and simulated: amplitude densities of {lengths}, as recorded at {samples['real'].rate_hz:g} Hz. Dotted: "
            f"{NOISE_ABOVE:g} Hz, above which the densities are read as noise.",
            drawing.noise_spectra(samples),
        ),
        Table(
            f"{page.name}_noise",
            "Levels of sensor errors as they are read from either recording.",
            noise.levels(samples),
            _REAL_AND_SIMULATED,
        ),
    ]


_REAL_AND_SIMULATED: Mapping[str, Column] = {
    "quantity": Column("quantity"),
    "unit": Column("unit"),
    "real": Column("real", each=True),
    "simulated": Column("simulated", each=True),
}


def _recordings_in_words(dataset: StoredDataset) -> str:
    names = list(dataset.files)
    shown = ", ".join(f"`{name}`" for name in names[:3]) + (", …" if len(names) > 3 else "")
    return f"{shown} of data set `{dataset.name}` ({as_text(dataset.title)})"
