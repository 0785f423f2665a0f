"""Training speed through the unscented filter: one step of NNTF_UH by vehest against a plain implementation, in the same run.

Writes results/benchmarks/ukf.json. A training step is forward and backward over sequences of 500 samples in float32 on two threads
(BENCH_THREADS). The plain implementation stands in this file, from the equations of Węgrzynowski et al. 2024: torchdiffeq's rk4,
torch.linalg.cholesky twice a sample, a loop over samples, autograd through it all. Both start from the same parameters (pre-trained
for a moment), noise and sequences, and their losses and gradients are compared; for that torchdiffeq takes its classical weights
instead of its default ones, of the 3/8 rule, at the same cost. Where jax is installed (`pip install 'vehest[bench]'`), its scan of the same
equations (ukf_jax.py) stands beside, compiled before it is timed.

Every case runs in a process of its own; a figure is the best of its repeats, by turns. On a machine that does other things too, look at
the processor's seconds on one thread: threads that wait for each other waste time. Memory is the peak beyond what imports, data and a
warm-up on three samples took. Compilation is timed once with an empty cache and once with the one it filled; step() of the online filter
over 10,000 samples on one thread. Sequences are of the F1TENTH recordings (VEHEST_DATA), else of the simulated tyre sets.
BENCH_BUSY=1 keeps a core busy (beside.py).
"""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from beside import result_file, spinning

ROOT = Path(__file__).parents[1]
RESULT = result_file("ukf")
STEPS = 500
ONLINE_STEPS = 10_000
THREADS = int(os.environ.get("BENCH_THREADS", "2"))
CASES = {
    28: (8.0, 3, 2),
    256: (4.0, 2, 2),
}  # sequences: ratio that is asked for, repeats within a process, rounds
TRAINED_ON = {
    "f1tenth": "iros",
    "sim_tyre_sets": "learn",
}  # how the names of training recordings begin
MOST_MEMORY = 0.5
MOST_DIFFERENCE = 1e-3
MOST_COMPILING = 90.0  # of the plain one's, relative, s
MEDIAN_STEP = 2.0
WORST_STEP = 10.0  # ms
FORCE_SIGN_STEEPNESS = 100.0
STILL = 1e-6
KAPPA = -2.0
GAP = 0.01
LEAST_ENTROPY = -9.0
FLOOR = 1e-7
SCALE = 0.01


class Problem(NamedTuple):
    """An estimator, and sequences with weights of the squared errors of the states."""

    estimator: Any
    drives: Any
    weights: Any


class Figures(NamedTuple):
    """Of one training step: seconds, those of the processor over all threads, memory [MB], loss, gradients by parameter."""

    seconds: float
    processor_seconds: float
    megabytes: float
    loss: float
    gradients: dict[str, Any]


def dataset() -> str:
    """Where the sequences come from."""
    return "f1tenth" if os.environ.get("VEHEST_DATA") else "sim_tyre_sets"


def recordings(prefix: str) -> list[Any]:
    """Recordings of the data set of which the names begin so."""
    from vehest.configuration.composition import compose_config
    from vehest.sources.base import open_source

    root = os.environ.get("VEHEST_DATA", tempfile.gettempdir())
    config = compose_config(
        "ingest", [f"dataset={dataset()}", f"root={root}", f"output={tempfile.gettempdir()}"]
    )
    source = open_source(config["dataset"])
    return [source.read(name) for name in source.ids() if name.startswith(prefix)]


def problem(
    sequences: int, steps: int = STEPS, dtype: str = "float32", weights: str = ""
) -> Problem:
    """NNTF_UH before training or as a file has it, noise started from residuals, sequences at random places of the training recordings."""
    import torch

    from vehest.estimators.filtering.car_fit import WEIGHTS, scale_network
    from vehest.estimators.learned_ukf import LearnedUkf
    from vehest.training.through_filter import Drive, placed

    torch.set_default_dtype(torch.float32)
    estimator = LearnedUkf.from_config({})
    train = [
        estimator.drive(recording, torch.float32) for recording in recordings(TRAINED_ON[dataset()])
    ]
    scale_network(estimator.filter, train, estimator.car.mass, estimator.rate_hz)
    generator = torch.Generator().manual_seed(0)
    estimator.filter.reset(generator)
    if weights:
        estimator.filter.load_state_dict(torch.load(weights, weights_only=True))
    else:
        estimator.filter.begin_noise(train, 0.0)
    drawn: list[Any] = []
    while sum(len(part.states) for part in drawn) < sequences:
        drawn.append(placed(train, steps, generator))
    torch.set_default_dtype(getattr(torch, dtype))
    estimator.filter.to(torch.get_default_dtype())
    drives = Drive(
        *(
            torch.cat(parts)[:sequences].to(torch.get_default_dtype())
            for parts in zip(*drawn, strict=True)
        )
    )
    return Problem(estimator, drives, torch.tensor([*WEIGHTS, 1.0]))


def pretrain(file: str) -> None:
    """Write the weights with which training through the filter begins, near enough: a few epochs as a one-step predictor."""
    import torch

    from vehest.training.context import FitContext
    from vehest.training.sequences import PhaseSettings, train_phases
    from vehest.training.through_filter import ThroughFilterSettings, Weights, one_step_phase

    torch.set_num_threads(1)
    task = problem(1)
    model = task.estimator.filter
    counted = Weights(*[task.weights * task.weights.new_tensor([1.0] * 4 + [0.0])] * 3)
    train = [
        task.estimator.drive(recording, torch.float32)
        for recording in recordings(TRAINED_ON[dataset()])
    ]
    how = PhaseSettings(learning_rate=2e-3, max_epochs=40, validate_every=40, schedule="cosine")
    settings = ThroughFilterSettings(one_step=how)
    phase = one_step_phase(
        model, train, train[:1], counted, settings, lambda name: name.startswith("dynamics.")
    )
    train_phases([phase], 0, FitContext())
    model.begin_noise(train, 0.0)
    torch.save(model.state_dict(), file)


def ours(task: Problem) -> Any:
    """The loss by vehest."""
    estimated, _ = task.estimator.filter.estimated(task.drives, task.drives.states[:, 0], None)
    return ((estimated - task.drives.states).square() @ task.weights).mean()


def plain(task: Problem) -> Any:
    """The same as one would write it down."""
    import torch
    from torch.nn import functional
    from torchdiffeq import odeint
    from torchdiffeq._impl import fixed_grid, rk_common

    fixed_grid.rk4_alt_step_func = rk_common.rk4_step_func
    car_filter = task.estimator.filter
    drives = task.drives
    car = car_filter.dynamics.car.learnt
    chassis = car_filter.dynamics.car
    network = car_filter.dynamics.network
    p = {name.removeprefix("log_"): logarithm.exp() for name, logarithm in car.named_parameters()}
    rear = p["cg_to_rear_axle"]
    front = chassis.wheelbase - rear
    lower = torch.tensor(car_filter.lower)

    def motion(x: Any, u: Any) -> tuple[Any, Any, Any, Any]:
        vx, vy, yaw_rate, rim, friction = x.unbind(-1)
        steer, current = (part.expand(vx.shape) for part in u.unbind(-1))
        along = vx + STILL
        slip_front = torch.atan((vy + front * yaw_rate) / along) - steer
        slip_rear = torch.atan((vy - rear * yaw_rate) / along)
        seen = torch.stack(
            [vx, vy, yaw_rate, rim, friction, steer, slip_front, slip_rear, (rim - vx) / along], -1
        )
        hidden = torch.sigmoid(network[0](seen / network.input_scale))
        out = network[4](torch.sigmoid(network[2](hidden))) * network.output_scale
        rear_x = friction * out[..., 0]
        front_x = friction * out[..., 1]
        rear_y = (
            -friction
            * functional.softplus(out[..., 2])
            * torch.tanh(FORCE_SIGN_STEEPNESS * slip_rear)
        )
        front_y = (
            -friction
            * functional.softplus(out[..., 3])
            * torch.tanh(FORCE_SIGN_STEEPNESS * slip_front)
        )
        drag = (
            p["drag_constant"] * torch.sign(vx)
            + p["drag_linear"] * vx
            + p["drag_quadratic"] * vx**2
        )
        ax = (
            rear_x + front_x * torch.cos(steer) - front_y * torch.sin(steer) - drag
        ) / chassis.mass
        sideways = front_x * torch.sin(steer) + front_y * torch.cos(steer)
        ay = (sideways + rear_y) / chassis.mass
        lost = p["friction_viscous"] * rim + p["friction_coulomb"] * torch.sign(rim)
        torque = p["torque_constant"] * current - chassis.wheel_radius * (front_x + rear_x) - lost
        turning = (sideways * front - rear_y * rear) / p["yaw_inertia"]
        spinning = chassis.wheel_radius / p["powertrain_inertia"] * torque
        return ax, ay, turning, spinning

    def moved(x: Any, u: Any) -> Any:
        def rates(_: Any, x: Any) -> Any:
            ax, ay, turning, spinning = motion(x, u)
            vy_yaw = x[..., 1] * x[..., 2]
            vx_yaw = x[..., 0] * x[..., 2]
            return torch.stack(
                [ax + vy_yaw, ay - vx_yaw, turning, spinning, torch.zeros_like(ax)], -1
            )

        return odeint(rates, x, torch.tensor([0.0, GAP]), method="rk4")[-1]

    def observed(x: Any, u: Any) -> Any:
        ax, ay, _, _ = motion(x, u)
        return torch.stack([ax, ay, x[..., 2], x[..., 3]], -1)

    n = drives.states.shape[-1]
    total = n + KAPPA
    weights = torch.tensor([KAPPA / total, *[0.5 / total] * (2 * n)])

    def points(mean: Any, covariance: Any) -> Any:
        offsets = total**0.5 * torch.linalg.cholesky(covariance).mT
        centre = mean.unsqueeze(-2)
        return torch.maximum(torch.cat([centre, centre + offsets, centre - offsets], -2), lower)

    def product(left: Any, right: Any) -> Any:
        return (weights[:, None] * left).mT @ right

    process = _noise(car_filter.process_noise, drives.states, LEAST_ENTROPY)
    observation = _noise(car_filter.observation_noise, drives.states)
    initial = _factor(car_filter.initial_noise.factor, car_filter.initial_noise.unit)
    mean = drives.states[:, 0]
    covariance = (initial @ initial.mT + FLOOR * torch.eye(n)).expand(len(mean), n, n)
    means = []
    for k in range(drives.states.shape[1]):
        if k:
            after = moved(points(mean, covariance), drives.inputs[:, k - 1, None])
            mean = weights @ after
            deviation = after - mean.unsqueeze(-2)
            covariance = product(deviation, deviation) + process[:, k - 1]
            mean = torch.maximum(mean, lower)
        at = points(mean, covariance)
        expected = observed(at, drives.inputs[:, k, None])
        predicted = weights @ expected
        deviation = expected - predicted.unsqueeze(-2)
        innovation_covariance = product(deviation, deviation) + observation[:, k]
        cross = product(at - mean.unsqueeze(-2), deviation)
        gain = torch.linalg.solve(innovation_covariance, cross.mT).mT
        mean = torch.maximum(
            mean + (gain @ (drives.measurements[:, k] - predicted).unsqueeze(-1)).squeeze(-1), lower
        )
        covariance = covariance - gain @ innovation_covariance @ gain.mT
        covariance = 0.5 * (covariance + covariance.mT)
        means.append(mean)
    return ((torch.stack(means, 1) - drives.states).square() @ task.weights).mean()


def _factor(entries: Any, unit: Any) -> Any:
    """Lower triangular matrices of their entries row by row, (..., n (n + 1) / 2) -> (..., n, n)."""
    import torch

    n = len(unit)
    rows, columns = torch.tril_indices(n, n)
    lower = entries.new_zeros(*entries.shape[:-1], n, n)
    lower[..., rows, columns] = entries * unit[rows]
    return lower


def _noise(noise: Any, states: Any, least_entropy: float | None = None) -> Any:
    """Covariances that depend on states, (B, T, n, n), with a floor for their entropy."""
    import math

    import torch

    constant = _factor(noise.constant.factor, noise.constant.unit)
    varying = _factor(
        torch.nn.functional.linear(states / noise.state_unit, noise.weight, noise.offset),
        noise.unit,
    )
    n = len(noise.unit)
    covariance = constant @ constant.mT + FLOOR * torch.eye(n) + SCALE * varying @ varying.mT
    if least_entropy is None:
        return covariance
    entropy = 0.5 * (n * math.log(2.0 * math.pi * math.e) + torch.logdet(covariance))
    return (
        torch.exp(2.0 / n * (least_entropy - entropy).clamp(min=0.0))[..., None, None] * covariance
    )


def scanned(task: Problem) -> Any:
    """The same by JAX."""
    from ukf_jax import loss_of

    return loss_of(task)


WAYS = {"plain": plain, "ours": ours} | ({"jax": scanned} if find_spec("jax") else {})


def training_step(
    way: str, sequences: int, repeats: int, weights: str, dtype: str = "float32"
) -> Figures:
    """Forward and backward; the best of repeats."""
    import torch

    torch.set_num_threads(THREADS)
    task = problem(sequences, STEPS, dtype, weights)
    warm = problem(2, 3, dtype)
    WAYS[way](task if way == "jax" else warm).backward()  # JAX compiles for every shape
    before = _peak()
    seconds = []
    busy = []
    for _ in range(repeats):
        task.estimator.filter.zero_grad()
        started = time.perf_counter()
        began = time.process_time()
        loss = WAYS[way](task)
        loss.backward()
        seconds.append(time.perf_counter() - started)
        busy.append(time.process_time() - began)
        value = float(loss.detach())
        del loss
    gradients = {
        name: parameter.grad.double().numpy()
        for name, parameter in task.estimator.filter.named_parameters()
    }
    return Figures(min(seconds), min(busy), _peak() - before, value, gradients)


def online_steps() -> tuple[float, float]:
    """Median and worst time of one step of the online filter [ms]."""
    import torch

    torch.set_num_threads(1)
    estimator = problem(1, 3).estimator
    stepper = estimator.online()
    samples = []
    for recording in recordings(""):
        rows = {name: recording[name].tolist() for name in estimator.channels}
        samples += [
            dict(zip(rows, values, strict=True)) for values in zip(*rows.values(), strict=True)
        ]
    while len(samples) < ONLINE_STEPS + 100:
        samples += samples
    times = []
    for sample in samples[: ONLINE_STEPS + 100]:
        started = time.perf_counter()
        stepper.step(sample)
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times[100:]), max(times[100:])


def first_steps() -> float:
    """Seconds that the first training step of a process takes longer than its second."""
    task = problem(2, 3)
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        ours(task).backward()
        seconds.append(time.perf_counter() - started)
    return seconds[0] - seconds[1]


def compiling() -> tuple[float, float]:
    """Seconds of compilation with an empty cache, and with what it left there."""
    with tempfile.TemporaryDirectory(prefix="vehest-bench-") as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, __file__, "first_steps"]
        runs = [
            subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
            for _ in range(2)
        ]
    return float(runs[0].stdout), float(runs[1].stdout)


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def in_own_process(work: Any, *arguments: object) -> Any:
    """Run in a fresh process, so that peak memory is its own; this one stays small, for a child's peak begins at its parent's size."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def versions() -> dict[str, str]:
    """Versions of the libraries; in a process of its own."""
    from importlib.metadata import version

    from vehest.artefacts.artefact import library_versions

    return {**library_versions(), "torchdiffeq": version("torchdiffeq")}


def differences(one: Figures, other: Figures) -> dict[str, float]:
    """Of losses, of whole gradients and of the gradient of the parameter where it is largest, all relative and the latter as lengths."""
    import numpy as np

    off = {
        name: float(np.linalg.norm(one.gradients[name] - values))
        for name, values in other.gradients.items()
    }
    size = {name: float(np.linalg.norm(values)) for name, values in other.gradients.items()}
    whole = (
        sum(value**2 for value in off.values()) / sum(value**2 for value in size.values())
    ) ** 0.5
    figures = {
        "relative_difference_of_losses": abs(one.loss - other.loss) / other.loss,
        "relative_difference_of_gradients": whole,
        "relative_difference_of_one_parameters_gradient": max(
            off[name] / size[name] for name in off
        ),
    }
    return {name: float(f"{value:.1e}") for name, value in figures.items()}


def exactness(weights: str) -> dict[str, float]:
    """Differences in double precision, over a few sequences."""
    return differences(
        *(in_own_process(training_step, way, 4, 1, weights, "float64") for way in ("ours", "plain"))
    )


def row_of(sequences: int, weights: str) -> dict[str, Any]:
    """One row of the result file."""
    least, repeats, rounds = CASES[sequences]
    runs: dict[str, list[Figures]] = {way: [] for way in WAYS}
    for _ in range(rounds):
        for way in WAYS:
            runs[way].append(
                in_own_process(
                    training_step, way, sequences, 1 if way == "plain" else repeats, weights
                )
            )
    best = {way: min(figures.seconds for figures in own) for way, own in runs.items()}
    busy = {way: min(figures.processor_seconds for figures in own) for way, own in runs.items()}
    memory = {
        way: statistics.median(figures.megabytes for figures in own) for way, own in runs.items()
    }
    beside: dict[str, Any] = {}
    if "jax" in WAYS:
        beside = {
            "jax_seconds": round(best["jax"], 3),
            "jax_processor_seconds": round(busy["jax"], 3),
        }
        beside |= {"ratio_to_jax": round(best["jax"] / best["ours"], 2)}
        beside |= {
            f"jax_{name}": value
            for name, value in differences(runs["jax"][0], runs["plain"][0]).items()
        }
    return {
        "case": f"NNTF_UH, {sequences} sequences of {STEPS} samples of {dataset()}: one training step, plain PyTorch against vehest",
        "baseline_seconds": round(best["plain"], 3),
        "ours_seconds": round(best["ours"], 3),
        "ratio": round(best["plain"] / best["ours"], 2),
        "least_ratio": least,
        "baseline_processor_seconds": round(busy["plain"], 3),
        "ours_processor_seconds": round(busy["ours"], 3),
        "baseline_mb": round(memory["plain"], 1),
        "ours_mb": round(memory["ours"], 1),
        **differences(runs["ours"][0], runs["plain"][0]),
        **beside,
    }


def tell(row: dict[str, Any]) -> None:
    """Print a row, and whether it is what was asked for."""
    jax = f"; JAX {row['jax_seconds']:.2f} s" if "jax_seconds" in row else ""
    met = (
        row["ratio"] >= row["least_ratio"]
        and row["ours_mb"] <= MOST_MEMORY * row["baseline_mb"]
        and max(row["relative_difference_of_losses"], row["relative_difference_of_gradients"])
        <= MOST_DIFFERENCE
    )
    print(
        f"{row['ratio']:6.1f} x (at least {row['least_ratio']:.0f})  {row['case']}  ({row['baseline_seconds']:.2f} s -> "
        f"{row['ours_seconds']:.2f} s, processor {row['baseline_processor_seconds']:.2f} s -> {row['ours_processor_seconds']:.2f} s; "
        f"{row['baseline_mb']:.0f} MB -> {row['ours_mb']:.0f} MB; losses differ by {row['relative_difference_of_losses']:.1e}, "
        f"gradients by {row['relative_difference_of_gradients']:.1e}{jax}; target {'met' if met else 'MISSED'})",
        flush=True,
    )


def main() -> None:
    """Measure, write, print the ratios."""
    if "jax" not in WAYS:
        print("jax is not installed, its scan is left out: pip install 'vehest[bench]'", flush=True)
    print("compiling once with an empty cache (up to a minute or two) ...", flush=True)
    compilation, loading = compiling()
    rows = []
    with tempfile.TemporaryDirectory(prefix="vehest-bench-") as folder:
        weights = str(Path(folder) / "weights.pt")
        in_own_process(pretrain, weights)
        exact = exactness(weights)
        for sequences in CASES:
            rows.append(row_of(sequences, weights))
            tell(rows[-1])
    print(
        f"in double precision losses differ by {exact['relative_difference_of_losses']:.1e}, "
        f"gradients by {exact['relative_difference_of_gradients']:.1e}"
    )
    median, worst = in_own_process(online_steps)
    print(
        f"compilation: {compilation:.1f} s with an empty cache (at most {MOST_COMPILING:.0f}), {loading:.1f} s with a filled one"
    )
    print(
        f"step(): {median:.2f} ms at the median (below {MEDIAN_STEP:g}), {worst:.2f} ms at worst (below {WORST_STEP:g}) of {ONLINE_STEPS}"
    )
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": THREADS,
    }
    machine["cores"] = os.cpu_count() or 1
    machine["load"] = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
    once = {
        "double_precision": exact,
        "compilation": {
            "seconds_with_empty_cache": round(compilation, 1),
            "seconds_with_filled_cache": round(loading, 1),
        },
        "online": {
            "steps": ONLINE_STEPS,
            "median_ms": round(median, 3),
            "worst_ms": round(worst, 3),
            "threads": 1,
        },
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps(
            {"cases": rows, **once, "versions": in_own_process(versions), "machine": machine},
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    if sys.argv[1:] == ["first_steps"]:
        print(first_steps())
    else:
        with spinning():
            main()
