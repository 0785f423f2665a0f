"""Training a network through the filter behind it, and twenty networks together, against plain PyTorch in the same run.

Writes results/benchmarks/cnn_ukf.json. End to end: one training step over 32 sequences of 256 samples, forward and backward, by vehest
and by a filter that is a loop over samples in torch (this file); both from the same weights and sequences, without dropout, so that
losses and gradients can be compared. An epoch over two hours at 100 Hz is then timed as it is trained, with dropout and AdamW. The
ensemble: an epoch of twenty networks together, one after another by vehest, and one after another by PyTorch's own layers from memory.
Samples are of simulated drives of `sim_bmw`, many times over.

On one thread, as a job of a training runs (BENCH_THREADS for more), by turns, the best of two rounds. On a machine that does other things
too, look at the processor's seconds.
"""

from __future__ import annotations

import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "results" / "benchmarks" / "cnn_ukf.json"
THREADS = int(os.environ.get("BENCH_THREADS", "1"))
HOURS = 2.0
RATE = 100
STEPS = 256
BATCH = 32
MEMBERS = 20
MINUTES = 10.0
SAMPLES_A_STEP = 1024
FLOPS_A_SAMPLE = 2 * (
    3 * (17 * 250 + 250 * 125 + 125 * 2) - 17 * 250
)  # of matrix products: forwards, by the weights, by what is below
DRIVES = (
    "train_slalom_18_on_001",
    "train_j_turn_off_001",
    "train_lane_change_1_on_001",
    "train_random_steer_on_001",
)
LEAST_RATIO = 6.0
MOST_EPOCH = 240.0
LEAST_ENSEMBLE = 2.5  # 1, s, 1
MOST_DIFFERENCE = 1e-4  # relative, of losses and gradients, of a network in single precision
TYRES = {"cornering_stiffness": 1.2e5, "friction": 1.1, "reduction": 1e-3}
LEVELS = {
    "process_vy": 1e-3,
    "process_yaw_rate": 1e-3,
    "force_factor": 2.0,
    "ay": 0.1,
    "yaw_rate": 5e-3,
    "fy_front": 100.0,
    "fy_rear": 100.0,
}


def drives(seconds: float) -> list[Any]:
    """Simulated drives, over and over, of so many seconds in all."""
    from vehest.configuration.composition import compose_config
    from vehest.sources.base import open_source

    temporary = tempfile.gettempdir()
    config = compose_config(
        "ingest", ["dataset=sim_bmw", f"root={temporary}", f"output={temporary}"]
    )
    source = open_source(config["dataset"])
    own = [source.read(name).cut(2.0, 1e9) for name in DRIVES]
    found: list[Any] = []
    while sum(drive.duration for drive in found) < seconds:
        found.append(replace(own[len(found) % len(own)], id=f"{len(found)}"))
    return found


def end_to_end(recordings: list[Any], dropout: float) -> tuple[Any, Any]:
    """A network before its training, and its training through the filter."""
    from vehest.estimators.cnn_ukf import CnnUkf, EndToEnd, EndToEndSettings
    from vehest.estimators.networks.sample_network import learnt_samples

    tyres = {f"{name}_{axle}": value for axle in ("front", "rear") for name, value in TYRES.items()}
    estimator = CnnUkf.from_config({"tyres": tyres, "noise": LEVELS, "dropout": dropout})
    assert isinstance(estimator, CnnUkf)
    raw = learnt_samples(recordings, estimator.network_inputs, estimator.name)
    estimator.network.scale(*raw)
    estimator.network.reset([torch.Generator().manual_seed(0)])
    with torch.no_grad():
        estimator.network.get_parameter("bias_3")[0, 1:] = torch.tensor([-3.0, -6.5, -6.5])
    return estimator, EndToEnd(
        estimator,
        estimator.network.samples(*raw),
        recordings,
        EndToEndSettings(steps=STEPS, batch_size=BATCH),
    )


def plain(estimator: Any, training: Any, batch: Any) -> Any:
    """The loss as one would write it down: layers of torch, then a filter that loops over samples."""
    from vehest.estimators.cnn_ukf import START
    from vehest.estimators.network_ukf import MIN_VARIANCE

    parameters = dict(estimator.network.named_parameters())
    hidden = batch.inputs
    for layer in (1, 2, 3):
        hidden = hidden @ parameters[f"weight_{layer}"][0] + parameters[f"bias_{layer}"][0]
        hidden = torch.relu(hidden) if layer < 3 else hidden.double()
    angle = hidden[..., 0] * estimator.network.unit.double()
    shares = torch.sigmoid(hidden[..., 1:])
    process = torch.diag_embed(shares[..., 1:].square())
    of_sensors = training.sensors[batch.trusted.long()].diagonal(dim1=-2, dim2=-1)
    sensors = torch.diag_embed(torch.cat([of_sensors, shares[..., :1].square() + MIN_VARIANCE], -1))
    measured = torch.cat([batch.measured, angle.unsqueeze(-1)], -1)
    track = training.filter.track
    n = 2
    total = 3.0
    weights = torch.tensor([1.0 / total, *[0.5 / total] * (2 * n)], dtype=torch.float64)

    def points(mean: Any, covariance: Any) -> Any:
        offsets = total**0.5 * torch.linalg.cholesky(covariance).mT
        centre = mean.unsqueeze(-2)
        return torch.cat([centre, centre + offsets, centre - offsets], -2)

    mean = batch.start
    covariance = (
        torch.tensor(START, dtype=torch.float64).square().diag().expand(len(batch.start), n, n)
    )
    means = []
    for k in range(batch.sideslip.shape[1]):
        now = batch.driven[:, k, None]
        if k:
            after = track.transition(
                points(mean, covariance), batch.driven[:, k - 1, None].expand(-1, 5, -1)
            )
            mean = weights @ after
            deviation = after - mean.unsqueeze(-2)
            covariance = (weights[:, None] * deviation).mT @ deviation + process[:, k - 1]
        at = points(mean, covariance)
        expected = track.observation(at, now.expand(-1, 5, -1))
        predicted = weights @ expected
        deviation = expected - predicted.unsqueeze(-2)
        own = (weights[:, None] * deviation).mT @ deviation + sensors[:, k]
        gain = torch.linalg.solve(
            own, (weights[:, None] * deviation).mT @ (at - mean.unsqueeze(-2))
        ).mT
        mean = mean + (gain @ (measured[:, k] - predicted).unsqueeze(-1)).squeeze(-1)
        covariance = covariance - gain @ own @ gain.mT
        covariance = 0.5 * (covariance + covariance.mT)
        means.append(mean)
    filtered = torch.atan2(torch.stack(means, 1)[..., 0], batch.driven[..., 0])
    return (batch.sideslip - angle).square().mean() + (batch.sideslip - filtered).square().mean()


def timed(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Seconds, those of the processor over all threads, and what came of it."""
    started = time.perf_counter()
    began = time.process_time()
    outcome = work()
    return time.perf_counter() - started, time.process_time() - began, outcome


def stepped(loss: Callable[[], Any], network: Any) -> tuple[float, list[Any]]:
    """A training step's loss and gradients."""
    network.zero_grad()
    value = loss()
    value.backward()
    return value.item(), [parameter.grad.double() for parameter in network.parameters()]


def through_the_filter(recordings: list[Any]) -> list[dict[str, Any]]:
    """One step by both ways, and an epoch."""
    from vehest.training.context import FitContext
    from vehest.training.sequences import Phase, PhaseSettings, train_phases

    estimator, training = end_to_end(recordings[: len(DRIVES)], 0.0)
    firsts = 300 + 200 * torch.arange(BATCH)
    batch = training.cut(firsts, torch.zeros(1, dtype=torch.int64))
    ways: dict[str, Callable[[], Any]] = {
        "plain": lambda: plain(estimator, training, batch),
        "ours": lambda: training.loss(batch),
    }
    stepped(ways["ours"], estimator.network)  # compiles
    seconds: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
    outcomes = {}
    for _ in range(2):
        for way, loss in ways.items():
            *times, outcomes[way] = timed(lambda loss=loss: stepped(loss, estimator.network))
            seconds[way].append((times[0], times[1]))
    best = {
        way: tuple(min(column) for column in zip(*rows, strict=True))
        for way, rows in seconds.items()
    }
    off = [
        float((one - other).norm())
        for one, other in zip(outcomes["ours"][1], outcomes["plain"][1], strict=True)
    ]
    size = sum(float(gradient.norm()) ** 2 for gradient in outcomes["plain"][1]) ** 0.5
    step = {
        "case": f"CNN-UKF, {BATCH} sequences of {STEPS} samples: one training step, a filter in a loop in torch against vehest",
        "baseline_seconds": round(best["plain"][0], 3),
        "ours_seconds": round(best["ours"][0], 4),
        "ratio": round(best["plain"][0] / best["ours"][0], 1),
        "least_ratio": LEAST_RATIO,
        "baseline_processor_seconds": round(best["plain"][1], 3),
        "ours_processor_seconds": round(best["ours"][1], 4),
        "relative_difference_of_losses": float(
            f"{abs(outcomes['ours'][0] / outcomes['plain'][0] - 1.0):.1e}"
        ),
        "relative_difference_of_gradients": float(
            f"{sum(value**2 for value in off) ** 0.5 / size:.1e}"
        ),
    }
    estimator, training = end_to_end(recordings, 0.2)
    phase = Phase(
        "end_to_end",
        PhaseSettings(8e-4, max_epochs=1),
        estimator.network,
        training.batches,
        training.loss,
        lambda: 0.0,
    )
    wall, busy, _ = timed(lambda: train_phases([phase], 0, FitContext()))
    epoch = {
        "case": f"CNN-UKF: one epoch over {HOURS:g} hours at {RATE} Hz, sequences of {STEPS} samples, {BATCH} a batch",
        "ours_seconds": round(wall, 1),
        "most_seconds": MOST_EPOCH,
        "ours_processor_seconds": round(busy, 1),
    }
    return [step, epoch]


def ensemble(recordings: list[Any]) -> dict[str, Any]:
    """An epoch of twenty networks trained together, one after another, and one after another in plain PyTorch."""
    from vehest.estimators.kernels.sample_network import gaussian_likelihood
    from vehest.estimators.networks.sample_network import INPUTS, SampleNetwork, learnt_samples
    from vehest.training.context import FitContext
    from vehest.training.samples import Draw, sample_phase
    from vehest.training.sequences import PhaseSettings, train_phases

    raw = learnt_samples(recordings, INPUTS["full"], "benchmark")

    def network(members: int) -> Any:
        made = SampleNetwork(len(INPUTS["full"]), (250, 125), 2, members)
        made.scale(*raw)
        made.reset([torch.Generator().manual_seed(member) for member in range(members)])
        return made

    samples = network(1).samples(*raw)
    count = len(samples.targets)

    def by_vehest(members: int) -> Callable[[], None]:
        def work() -> None:
            for place in range(MEMBERS // members):
                own = network(members)
                phase = sample_phase(
                    "samples",
                    own,
                    PhaseSettings(8e-4, max_epochs=1),
                    SAMPLES_A_STEP,
                    count,
                    members,
                    lambda draw, own=own: own.losses(samples, draw, 0.2, gaussian_likelihood),
                    lambda: torch.zeros(members),
                )
                train_phases([phase], place, FitContext())

        return work

    def by_torch() -> None:
        nn = torch.nn
        generator = torch.Generator().manual_seed(0)
        for _ in range(MEMBERS):
            own = nn.Sequential(
                nn.Linear(17, 250),
                nn.ReLU(),
                nn.Dropout(0.2),
                nn.Linear(250, 125),
                nn.ReLU(),
                nn.Dropout(0.2),
                nn.Linear(125, 2),
            )
            adam = torch.optim.AdamW(own.parameters(), lr=8e-4, weight_decay=0.0)
            for rows in torch.randperm(count, generator=generator).split(SAMPLES_A_STEP):
                adam.zero_grad()
                out = own(samples.inputs[rows])
                variance = nn.functional.softplus(out[:, 1]) + 1e-6
                nn.functional.gaussian_nll_loss(
                    out[:, 0], samples.targets[rows], variance
                ).backward()
                adam.step()

    ways = {"together": by_vehest(MEMBERS), "one after another": by_vehest(1), "plain": by_torch}
    first = Draw(torch.arange(SAMPLES_A_STEP).unsqueeze(0), torch.zeros(1, dtype=torch.int64))
    network(1).losses(samples, first, 0.2, gaussian_likelihood)  # compiles
    rounds: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
    for _ in range(2):
        for way, work in ways.items():
            wall, busy, _ = timed(work)
            rounds[way].append((wall, busy))
    best = {way: [min(column) for column in zip(*own, strict=True)] for way, own in rounds.items()}
    return {
        "case": f"{MEMBERS} networks, one epoch over {MINUTES:g} minutes at {RATE} Hz: one after another in torch against together",
        "baseline_seconds": round(best["plain"][0], 1),
        "alone_seconds": round(best["one after another"][0], 1),
        "ours_seconds": round(best["together"][0], 1),
        "ratio": round(best["plain"][0] / best["together"][0], 2),
        "least_ratio": LEAST_ENSEMBLE,
        "ratio_to_alone": round(best["one after another"][0] / best["together"][0], 2),
        "baseline_processor_seconds": round(best["plain"][1], 1),
        "alone_processor_seconds": round(best["one after another"][1], 1),
        "ours_processor_seconds": round(best["together"][1], 1),
        "gigaflops": round(FLOPS_A_SAMPLE * MEMBERS * count / best["together"][1] / 1e9, 1),
    }


def tell(what: str, details: str, *, met: bool) -> None:
    """Print a row, and whether it is what was asked for."""
    print(f"{what}  ({details}; target {'met' if met else 'MISSED'})", flush=True)


def main() -> None:
    """Measure, write, print."""
    from vehest.estimators.kernels.blas import single_blas_thread

    torch.set_num_threads(THREADS)
    with single_blas_thread():  # as a group of jobs has it; torch has matrix products of its own
        measure()


def measure() -> None:
    """Measure, write, print, on as many threads as torch is allowed."""
    from vehest.artefacts.artefact import library_versions

    recordings = drives(HOURS * 3600)
    step, epoch = through_the_filter(recordings)
    same = (
        max(step["relative_difference_of_losses"], step["relative_difference_of_gradients"])
        <= MOST_DIFFERENCE
    )
    tell(
        f"{step['ratio']:6.1f} x (at least {LEAST_RATIO:g})  {step['case']}",
        f"{step['baseline_seconds']:.2f} s -> {step['ours_seconds']:.3f} s, processor {step['baseline_processor_seconds']:.2f} s -> "
        f"{step['ours_processor_seconds']:.3f} s, gradients differ by {step['relative_difference_of_gradients']:.0e}",
        met=step["ratio"] >= LEAST_RATIO and same,
    )
    met = epoch["ours_seconds"] <= MOST_EPOCH
    details = f"processor {epoch['ours_processor_seconds']:.0f} s"
    tell(
        f"{epoch['ours_seconds']:6.0f} s (at most {MOST_EPOCH:.0f})  {epoch['case']}",
        details,
        met=met,
    )
    row = ensemble(drives(MINUTES * 60))
    tell(
        f"{row['ratio']:6.1f} x (at least {LEAST_ENSEMBLE:g})  {row['case']}",
        f"{row['baseline_seconds']} s in torch, {row['alone_seconds']} s one after another by vehest -> {row['ours_seconds']} s; processor "
        f"{row['baseline_processor_seconds']} s, {row['alone_processor_seconds']} s -> {row['ours_processor_seconds']} s, "
        f"{row['gigaflops']} Gflop/s",
        met=row["ratio"] >= LEAST_ENSEMBLE,
    )
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": THREADS,
    }
    machine |= {
        "cores": os.cpu_count() or 1,
        "load": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps(
            {"cases": [step, epoch, row], "versions": library_versions(), "machine": machine},
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
