"""Every trained model in C against Python, over whole drives: digits, time, bytes. Writes results/export/metrics.csv and report.md.

Models are those in the output root's train/ that learnt on the real Ferrari, the F1TENTH or, if on
neither, the SIMULATED BMW, one a variant, and the self-calibrating filter that comes with vehest;
drives are the Ferrari's test range, 550 to 700 s, a test run of the F1TENTH and a test drive of the
BMW. All run under the contract with limits, health and bands. Python computes the same in float64
for the differences; its time is that of the model as it is. One core, the least of some passes over
the whole drive in C, one pass in Python and in onnxruntime, all in the same run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "export"))
VERSION = "1"
"""Raised when the numbers of its tables move."""
PASSES = 3
DRIVES = {
    "ferrari_250lm": ("20140222_01_01_03_250lm", 550.0, 700.0),
    "f1tenth": ("hoons_all_test_run_4", 0.0, 150.0),
    "sim_bmw": ("test_slalom*", 0.0, 150.0),  # the first of them in the store
}
GOALS = {
    "ksnn-linear": 0.5,
    "ksnn-nonlinear": 4.0,
    "gru": 7.0,
    "rational_ekf": 5.0,
    "learned_ukf": 150.0,
}
"""Start of family-variant -> microseconds a step of the method in double that were asked for."""
FLAGS = ["-std=c99", "-O2", "-ffp-contract=off"]


def models(output: Path) -> list[tuple[str, Path]]:
    """Data set and folder of one model of each family and variant on each of `DRIVES`; one that learns nothing goes with the Ferrari."""
    from vehest.data.errors import VehestError
    from vehest.estimators.model_files import read_description
    from vehest.export.program import exportable
    from vehest.inference.models import SELF_CALIBRATING, pretrained_folder, trust_of

    found: dict[tuple[str, str, str], Path] = {}
    for folder in sorted((output / "train").glob("[!.]*")):
        try:
            own = read_description(folder)
            for dataset in own.about.datasets or ("ferrari_250lm",):
                key = (dataset, own.estimator, own.variant)
                if (
                    own.estimator in exportable()
                    and dataset in DRIVES
                    and len(own.about.datasets) < 2
                    and key not in found
                    and trust_of(folder, output) is not None
                ):
                    found[key] = folder
        except VehestError:
            continue
    real = {key[1:] for key in found if key[0] != "sim_bmw"}
    kept = {
        key: folder for key, folder in found.items() if key[0] != "sim_bmw" or key[1:] not in real
    }
    kept["ferrari_250lm", SELF_CALIBRATING, SELF_CALIBRATING] = pretrained_folder(SELF_CALIBRATING)
    return [
        (dataset, folder)
        for (dataset, _, _), folder in sorted(kept.items(), key=lambda entry: entry[0])
    ]


def onnx_time(model: Any, samples: dict[str, np.ndarray]) -> float:
    """Nanoseconds a step in onnxruntime, on one thread; NaN for what is no network."""
    from vehest.data.errors import ConfigurationError
    from vehest.export.onnx_model import write_onnx

    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / "model.onnx"
        try:
            write_onnx(model, file)
        except ConfigurationError:
            return float("nan")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
    kind = np.float64 if session.get_inputs()[0].type == "tensor(double)" else np.float32
    starts = {
        name.removeprefix("start_"): text
        for name, text in session.get_modelmeta().custom_metadata_map.items()
        if "start_" in name
    }
    state = {f"state_{name}": np.array(json.loads(text), kind) for name, text in starts.items()}
    rows = np.ascontiguousarray(np.stack([samples[name] for name in model.channels], axis=1), kind)
    names = [output.name for output in session.get_outputs()]
    begun = time.process_time()
    for row in rows:
        said = dict(zip(names, session.run(None, {"sample": row, **state}), strict=True))
        state = {name: said[f"next_{name.removeprefix('state_')}"] for name in state}
    return 1e9 * (time.process_time() - begun) / len(rows)


def python_time(stepper: Any, samples: dict[str, np.ndarray]) -> float:
    """Nanoseconds a step in Python."""
    rows = [
        dict(zip(samples, row, strict=True))
        for row in zip(*(values.tolist() for values in samples.values()), strict=True)
    ]
    begun = time.process_time()
    for row in rows:
        stepper.step(row)
    return 1e9 * (time.process_time() - begun) / len(rows)


def c_times(place: Path, sources: list[str]) -> list[float]:
    """Nanoseconds a step of the program in a folder, and of its method alone."""
    program = ["-I.", str(ROOT / "benchmarks/export_time.c"), *sources, "-lm", "-o", "timed"]
    subprocess.run(["gcc", *FLAGS, *program], cwd=place, check=True)
    command = ["./timed", "rows.bin", str(PASSES)]
    printed = subprocess.run(command, cwd=place, check=True, capture_output=True, text=True)
    return [float(value) for value in printed.stdout.split()[:2]]


def rows_of(
    model: Any, folder: Path, dataset: str, root: str, output: Path
) -> dict[str, np.ndarray]:
    """The drive's channels at the model's rate."""
    from vehest.configuration.composition import compose_config
    from vehest.data.store import read_recording
    from vehest.inference.estimation import prepared_recording
    from vehest.inference.models import preparation_of
    from vehest.sources.base import open_source

    name, first, last = DRIVES[dataset]
    if "*" in name:
        recording = read_recording(
            sorted((output / "ingest").glob(f"{dataset}-*/{name}.parquet"))[0]
        ).without_references()
    else:
        source = open_source(
            compose_config("ingest", [f"dataset={dataset}", f"root={root}"])["dataset"]
        )
        recording = source.read(name).without_references()
    cut = recording.cut(
        max(first, recording.start_time), min(last, recording.start_time + recording.duration)
    )
    model.preparation = preparation_of(folder)
    return dict(prepared_recording(model, cut).channels)


def sizes(files: dict[str, str], target: Any, folder: Path, prefix: str) -> dict[str, int]:
    """Bytes that an export takes on a target, and those of the method's instructions alone; none where its compiler is missing."""
    from footprint import STRICT, footprint

    own = footprint(files, target)
    if own is None:
        return {}
    subprocess.run(
        [target.compiler, *STRICT, *target.options, "-c", "vehest_method.c"], cwd=folder, check=True
    )
    said = subprocess.run(
        [f"{target.prefix}size", "-A", "vehest_method.o"],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    method = sum(int(line.split()[1]) for line in said.splitlines() if line.startswith(".text"))
    kinds = {
        "state": own.state,
        "method_code": method,
        "code": own.code,
        "tables": own.tables,
        "stack": own.stack,
    }
    return {f"{prefix}{kind}_bytes": size for kind, size in kinds.items()}


def measured(
    dataset: str, folder: Path, output: Path, root: str, with_times: bool
) -> list[dict[str, Any]]:
    """A row for each precision; its times are NaN where none are measured."""
    from footprint import CORTEX_M4F, HOST

    from vehest.data.errors import ConfigurationError
    from vehest.estimators.model_files import load_model
    from vehest.export.folder import refuse_unresolved
    from vehest.export.program import program_files
    from vehest.export.vectors import COLUMNS, in_float64, replayed, table_text
    from vehest.inference.models import trust_of
    from vehest.trust.contract import GuardedStepper

    model = load_model(folder)
    trust = trust_of(folder, output)
    samples = {
        name: values
        for name, values in rows_of(model, folder, dataset, root, output).items()
        if name in model.channels
    }
    samples = {name: samples[name] for name in model.channels}
    steps = len(next(iter(samples.values())))
    wanted = replayed(GuardedStepper(in_float64(model), trust), np.full(steps, np.nan), samples)
    python = python_time(GuardedStepper(model, trust), samples) if with_times else float("nan")
    onnx = onnx_time(model, samples) if with_times else float("nan")
    rows = []
    for precision in ("double", "float"):
        try:
            refuse_unresolved(trust if precision == "float" else None)
        except ConfigurationError as error:
            print(f"{folder.name}: {error}")
            continue
        files = program_files(GuardedStepper(model, trust), precision, model.full_title)  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory() as temporary:
            place = Path(temporary)
            for name, text in files.items():
                (place / name).write_text(text)
            np.column_stack(list(samples.values())).astype(np.float64).tofile(place / "rows.bin")
            (place / "in.csv").write_text(
                table_text(tuple(samples), np.column_stack(list(samples.values())))
            )
            sources = sorted(
                name for name in files if name.startswith("vehest_") and name.endswith(".c")
            )
            subprocess.run(
                ["gcc", *FLAGS, "main.c", *sources, "-lm", "-o", "main"], cwd=place, check=True
            )
            subprocess.run(
                ["./main", "in.csv", "out.csv"], cwd=place, check=True, capture_output=True
            )
            c_time, c_method = c_times(place, sources) if with_times else (float("nan"),) * 2
            own = np.genfromtxt(place / "out.csv", delimiter=",", skip_header=1)
            bytes_taken = sizes(files, HOST, place, "") | sizes(files, CORTEX_M4F, place, "m4f_")
        assert own.shape[1] == len(COLUMNS)
        difference = np.abs(own[:, 0] - wanted[:, 0])
        rows.append(
            {
                "family": model.name,
                "variant": model.variant,
                "drive": dataset,
                "precision": precision,
                "steps": steps,
                "largest_difference_vy": float(np.nanmax(difference)),
                "other_health_rows": int((own[:, 4] != wanted[:, 4]).sum()),
                "c_ns": c_time,
                "c_method_ns": c_method,
                "python_ns": python,
                "python_over_c": python / c_time,
                "onnxruntime_ns": onnx,
                **bytes_taken,
            }
        )
        print(rows[-1], flush=True)
    return rows


def report(table: pd.DataFrame) -> str:
    """The page: verdicts, then differences and times of each model, then bytes."""
    double, single = (table[table["precision"] == kind] for kind in ("double", "float"))
    lines = ["# Models in C against Python", ""]
    ratio = double["python_over_c"]
    for rows, limit, words in ((double, 1e-9, "double"), (single, 1e-4, "float")):
        good = rows["largest_difference_vy"] <= limit
        beyond = ", ".join(
            f"{_name(row)} {row.largest_difference_vy:.1e} on {row.drive}"
            for row in rows[~good].itertuples()
        )
        lines.append(
            f"- {words}: {int(good.sum())} of {len(rows)} within {limit:.0e} m/s of Python in float64"
            + (f"; beyond: {beyond}." if beyond else ".")
        )
    other_health = "; ".join(
        f"{_name(row)}, {row.precision}, on {row.drive}: {row.other_health_rows} of {row.steps}"
        for row in table[table["other_health_rows"] > 0].itertuples()
    )
    lines.append(f"- Samples whose health differs from Python's: {other_health or 'none'}.")
    lines.append(
        f"- C is {ratio.min():.3g} to {ratio.max():.3g} times as fast as Python, with guard, health and bands."
    )
    known = double[double["onnxruntime_ns"].notna()]
    if len(known):
        times = known["onnxruntime_ns"] / known["c_method_ns"]
        lines.append(
            f"- Networks: C's method is {times.min():.3g} to {times.max():.3g} times as fast as onnxruntime's step, one thread each."
        )
    for start, goal in GOALS.items():
        named = (double["family"] + "-" + double["variant"]).str.startswith(start)
        if double[named]["c_method_ns"].notna().any():
            lines.append(
                f"- {start}: {double[named]['c_method_ns'].max() / 1e3:.3g} µs a step of the method; asked for were {goal:g} µs."
            )
    lines += [
        "",
        "Every number, sizes on this machine included: [CSV](metrics.csv).",
        "",
        "## Difference and time of a step",
        "",
        "Largest difference of v from Python in float64, and microseconds a step in C, with guard, health and bands and of the",
        "method alone, in Python and in onnxruntime. A dash: float is refused for the model, or onnxruntime has no network of it.",
        "",
        *_pipes(_times(double, single)),
        "",
        f"gcc {' '.join(FLAGS)}; {platform.machine()}, one core; times are those of this run and machine, their ratios travel better.",
        "",
    ]
    if "m4f_code_bytes" in table:
        lines += [
            "## Bytes on a Cortex-M4F",
            "",
            "Flash: code and tables. RAM: state and the worst case of the stack, without what the C library takes. In kB; of a model",
            "on several drives, the most.",
            "",
            *_pipes(_bytes(table)),
            "",
        ]
    return "\n".join(lines)


def _name(row: Any) -> str:
    """Family and variant of a row."""
    return row.family if row.family == row.variant else f"{row.family} {row.variant}"


def _times(double: pd.DataFrame, single: pd.DataFrame) -> pd.DataFrame:
    """Cells of a model on a drive: differences and times in both precisions."""
    both = double.merge(single, "left", ["family", "variant", "drive"], suffixes=("", "_float"))
    differences = ("largest_difference_vy", "largest_difference_vy_float")
    times = ("c_ns", "c_method_ns", "c_ns_float", "c_method_ns_float", "python_ns")
    cells = [
        [
            _name(row),
            row.drive,
            *(_cell(getattr(row, name), "{:.2g}") for name in differences),
            *(_cell(getattr(row, name) / 1e3) for name in times),
            _cell(row.python_over_c),
            _cell(row.onnxruntime_ns / 1e3),
        ]
        for row in both.itertuples()
    ]
    heads = [
        "model",
        "drive",
        "double [m/s]",
        "float [m/s]",
        "C, double [µs]",
        "method, double [µs]",
    ]
    heads += ["C, float [µs]", "method, float [µs]", "Python [µs]", "Python / C, double"]
    return pd.DataFrame(cells, columns=[*heads, "onnxruntime [µs]"])


def _bytes(table: pd.DataFrame) -> pd.DataFrame:
    """Cells of a model: flash and RAM on a Cortex-M4F in both precisions [kB]."""
    sizes = pd.DataFrame(
        {
            "model": [_name(row) for row in table.itertuples()],
            "precision": table["precision"],
            "flash": (table["m4f_code_bytes"] + table["m4f_tables_bytes"]) / 1e3,
            "RAM": (table["m4f_state_bytes"] + table["m4f_stack_bytes"]) / 1e3,
        }
    )
    wide = sizes.pivot_table(
        index="model", columns="precision", values=["flash", "RAM"], aggfunc="max"
    )
    columns = [(kind, precision) for kind in ("flash", "RAM") for precision in ("double", "float")]
    cells = [
        [model, *(_cell(row.get(column, np.nan), "{:.1f}") for column in columns)]
        for model, row in wide.iterrows()
    ]
    return pd.DataFrame(cells, columns=["model", *(", ".join(column) for column in columns)])


def _cell(value: float, form: str = "") -> str:
    """A number in a form, else with three significant digits; a dash where there is none."""
    from vehest.report.style import significant

    if not np.isfinite(value):
        return "–"
    return form.format(value) if form else significant(value, 3)


def _pipes(cells: pd.DataFrame) -> list[str]:
    """Lines of a Markdown table, numbers to the right."""
    is_text_column = [name in ("model", "drive") for name in cells.columns]
    lines = [list(cells.columns), [":--" if is_text else "--:" for is_text in is_text_column]]
    return [f"| {' | '.join(line)} |" for line in [*lines, *cells.values.tolist()]]


def redraw(out: Path) -> None:
    """Draw report.md from the metrics.csv beside it; what its numbers follow from stays recorded."""
    from vehest.run.table_records import RowKeys, record_tables

    table = pd.read_csv(out / "metrics.csv")
    (out / "report.md").write_text(report(table), encoding="utf-8")
    record_tables(
        [out / "report.md"],
        "make export_all",
        determined_by(table),
        rows=RowKeys(
            {}, {family: f"calibrate {family}" for family in sorted(set(table["family"]))}
        ),
    )


def determined_by(table: pd.DataFrame) -> list[str]:
    """What all numbers follow from, as in the names of keys."""
    return [
        "script benchmarks/export.py",
        *(f"data {drive}" for drive in sorted(set(table["drive"]))),
    ]


def main() -> None:
    """Measure, write, print."""
    from vehest.estimators.model_files import read_description
    from vehest.run.table_records import RowKeys, record_tables

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "export")
    parser.add_argument("--only", help="one family; rows of the others stay as they are in --out")
    parser.add_argument(
        "--without-times", action="store_true", help="leave times empty, on a busy machine"
    )
    parser.add_argument(
        "--redraw",
        action="store_true",
        help="measure nothing; draw the page from the table in --out",
    )
    words = parser.parse_args()
    if words.redraw:
        if not (words.out / "metrics.csv").is_file():
            parser.error(f"'{words.out}' has no metrics.csv; measure first, without --redraw")
        redraw(words.out)
        return
    root = os.environ.get("VEHEST_DATA")
    output = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    found = [
        (dataset, folder)
        for dataset, folder in models(output)
        if words.only in (None, read_description(folder).estimator)
    ]
    if root is None or not found:
        sys.exit(
            "export_all needs VEHEST_DATA and models that learnt on real cars: make ferrari_drive, make real_cars, make learned_ukf"
        )
    torch.set_num_threads(1)
    rows = []
    for dataset, folder in found:
        try:
            rows += measured(dataset, folder, output, root, not words.without_times)
        except Exception as error:  # one model that cannot be measured hides no other
            print(f"{folder.name} on {dataset}: {type(error).__name__}: {error}", file=sys.stderr)
    table = pd.DataFrame(rows)
    former_families: list[str] = []
    if words.only and (words.out / "metrics.csv").is_file():
        former = pd.read_csv(words.out / "metrics.csv")
        former = former[former["family"] != words.only]
        former_families = sorted(set(former["family"]))
        table = pd.concat([former, table])
        table = table.sort_values(["drive", "family", "variant", "precision"], ignore_index=True)
    words.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(words.out / "metrics.csv", index=False, float_format="%.6g")
    (words.out / "report.md").write_text(report(table), encoding="utf-8")
    record_tables(
        [words.out / "metrics.csv", words.out / "report.md"],
        "make export_all",
        determined_by(table),
        rows=RowKeys(
            {family: f"calibrate {family}" for family in sorted({row["family"] for row in rows})},
            {family: f"calibrate {family}" for family in former_families},
        ),
    )
    print(report(table))


if __name__ == "__main__":
    main()
