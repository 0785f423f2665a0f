"""A training step of the learned UKF over thousands of sequences: compiled on all cores of a processor against torch.compile on a GPU.

    python benchmarks/ukf_gpu.py write problem.pt     # where vehest is installed: parameters and training drives
    python benchmarks/ukf_gpu.py run problem.pt       # on the machine with the GPU; needs torch, numpy, scipy, numba, pydantic, safetensors

Forward and backward over sequences of 500 samples in float32, the same parameters and sequences on both; writes
results/benchmarks/ukf_gpu.json. The GPU's filter stands here, from the equations of Węgrzynowski et al. 2024: Cholesky and solve are
written out, so that a step is a few fused kernels. A step keeps its inputs alone and is computed again in the backward pass, for memory's
sake; all of it is also recorded once as a CUDA graph and replayed.
"""

from __future__ import annotations

import json
import math
import os
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

ROOT = Path(__file__).parents[1]
RESULT = Path(os.environ.get("OUT", ROOT / "results" / "benchmarks")) / "ukf_gpu.json"
STEPS = 500
SEQUENCES = (4096, 256)
REPEATS = 3
STEEPNESS = 100.0
STILL = 1e-6
KAPPA = -2.0
GAP = 0.01
LEAST_ENTROPY = -9.0
FLOOR = 1e-7
SCALE = 0.01


def write(file: str) -> None:
    """Parameters after a few epochs as a one-step predictor, and the training drives."""
    import tempfile

    import ukf

    with tempfile.TemporaryDirectory() as folder:
        ukf.pretrain(str(Path(folder) / "weights.pt"))
        task = ukf.problem(1, STEPS, weights=str(Path(folder) / "weights.pt"))
    drives = [
        tuple(task.estimator.drive(recording, torch.float32))
        for recording in ukf.recordings(ukf.TRAINED_ON[ukf.dataset()])
    ]
    torch.save(
        {"weights": task.estimator.filter.state_dict(), "drives": drives, "dataset": ukf.dataset()},
        file,
    )


def drawn_sequences(drives: list[tuple[Tensor, ...]], count: int) -> list[Tensor]:
    """States, inputs and measurements at random places, (count, STEPS, ...)."""
    generator = torch.Generator().manual_seed(0)
    parts = []
    drives = [drive for drive in drives if len(drive[0]) >= STEPS]
    for _ in range(count):
        drive = drives[int(torch.randint(len(drives), (), generator=generator))]
        first = int(torch.randint(len(drive[0]) - STEPS + 1, (), generator=generator))
        parts.append([part[first : first + STEPS] for part in drive])
    return [torch.stack(part) for part in zip(*parts, strict=True)]


def factor(matrix: Tensor, n: int) -> Tensor:
    """Cholesky factor, (B, n, n), written out."""
    rows: list[list[Any]] = [[None] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            left = matrix[:, i, j]
            for k in range(j):
                left = left - rows[i][k] * rows[j][k]
            rows[i][j] = torch.sqrt(left.clamp(min=1e-12)) if i == j else left / rows[j][j]
    zero = torch.zeros_like(matrix[:, 0, 0])
    return torch.stack(
        [
            torch.stack([row[j] if j <= i else zero for j in range(n)], -1)
            for i, row in enumerate(rows)
        ],
        -2,
    )


def solved(lower: Tensor, right: Tensor, n: int) -> Tensor:
    """X with L Lᵀ X = right, (B, n, k)."""
    y: list[Tensor] = []
    for i in range(n):
        left = right[:, i]
        for k in range(i):
            left = left - lower[:, i, k, None] * y[k]
        y.append(left / lower[:, i, i, None])
    x: list[Any] = [None] * n
    for i in reversed(range(n)):
        left = y[i]
        for k in range(i + 1, n):
            left = left - lower[:, k, i, None] * x[k]
        x[i] = left / lower[:, i, i, None]
    return torch.stack(x, 1)


class Filter(torch.nn.Module):
    """The learned UKF's filter, NNTF_UH, in plain tensors."""

    def __init__(self, filter_: Any) -> None:
        super().__init__()
        self.own = filter_
        n = 5
        self.total = n + KAPPA
        self.register_buffer(
            "shares", torch.tensor([KAPPA / self.total, *[0.5 / self.total] * (2 * n)])
        )
        self.register_buffer("lower", torch.tensor(filter_.lower))

    def parts(self) -> list[Tensor]:
        """Tensors of the parameters that a step needs."""
        car = self.own.dynamics.car.learnt
        network = self.own.dynamics.network
        learnt = {name.removeprefix("log_"): value.exp() for name, value in car.named_parameters()}
        names = (
            "cg_to_rear_axle",
            "drag_constant",
            "drag_linear",
            "drag_quadratic",
            "friction_viscous",
            "friction_coulomb",
        )
        names += ("torque_constant", "yaw_inertia", "powertrain_inertia")
        layers = [part for at in (0, 2, 4) for part in (network[at].weight, network[at].bias)]
        return [
            torch.stack([learnt[name] for name in names]),
            *layers,
            network.input_scale,
            network.output_scale,
        ]

    def motion(self, x: Tensor, u: Tensor, parts: list[Tensor]) -> tuple[Tensor, ...]:
        """ax, ay, yaw and rim acceleration, (B, P) each."""
        chassis = self.own.dynamics.car
        numbers, w1, b1, w2, b2, w3, b3, in_scale, out_scale = parts
        (
            rear,
            drag_0,
            drag_1,
            drag_2,
            viscous,
            coulomb,
            torque_constant,
            yaw_inertia,
            power_inertia,
        ) = numbers.unbind()
        front = chassis.wheelbase - rear
        vx, vy, yaw_rate, rim, friction = x.unbind(-1)
        steer, current = (part[:, None].expand(vx.shape) for part in u.unbind(-1))
        along = vx + STILL
        slip_front = torch.atan((vy + front * yaw_rate) / along) - steer
        slip_rear = torch.atan((vy - rear * yaw_rate) / along)
        seen = (
            torch.stack(
                [vx, vy, yaw_rate, rim, friction, steer, slip_front, slip_rear, (rim - vx) / along],
                -1,
            )
            / in_scale
        )
        hidden = torch.sigmoid(
            functional.linear(torch.sigmoid(functional.linear(seen, w1, b1)), w2, b2)
        )
        out = functional.linear(hidden, w3, b3) * out_scale
        rear_x = friction * out[..., 0]
        front_x = friction * out[..., 1]
        rear_y = -friction * functional.softplus(out[..., 2]) * torch.tanh(STEEPNESS * slip_rear)
        front_y = -friction * functional.softplus(out[..., 3]) * torch.tanh(STEEPNESS * slip_front)
        drag = drag_0 * torch.sign(vx) + drag_1 * vx + drag_2 * vx**2
        ax = (
            rear_x + front_x * torch.cos(steer) - front_y * torch.sin(steer) - drag
        ) / chassis.mass
        sideways = front_x * torch.sin(steer) + front_y * torch.cos(steer)
        lost = viscous * rim + coulomb * torch.sign(rim)
        torque = torque_constant * current - chassis.wheel_radius * (front_x + rear_x) - lost
        turning = (sideways * front - rear_y * rear) / yaw_inertia
        return (
            ax,
            (sideways + rear_y) / chassis.mass,
            turning,
            chassis.wheel_radius / power_inertia * torque,
        )

    def rates(self, x: Tensor, u: Tensor, parts: list[Tensor]) -> Tensor:
        """Derivatives of the states, (B, P, 5)."""
        ax, ay, turning, spinning = self.motion(x, u, parts)
        return torch.stack(
            [
                ax + x[..., 1] * x[..., 2],
                ay - x[..., 0] * x[..., 2],
                turning,
                spinning,
                torch.zeros_like(ax),
            ],
            -1,
        )

    def points(self, mean: Tensor, covariance: Tensor) -> Tensor:
        """Sigma points, (B, 11, 5)."""
        offsets = self.total**0.5 * factor(covariance, 5).mT
        centre = mean[:, None]
        return torch.maximum(
            torch.cat([centre, centre + offsets, centre - offsets], -2), self.lower
        )

    def forward(
        self,
        mean: Tensor,
        covariance: Tensor,
        before: Tensor,
        u: Tensor,
        z: Tensor,
        q: Tensor,
        r: Tensor,
        *parts: Tensor,
    ) -> Any:
        """Predict with the input before, update with the measurement: mean (B, 5) and covariance."""
        own = list(parts)
        x = self.points(mean, covariance)
        k1 = self.rates(x, before, own)
        k2 = self.rates(x + 0.5 * GAP * k1, before, own)
        k3 = self.rates(x + 0.5 * GAP * k2, before, own)
        after = x + GAP / 6.0 * (k1 + 2.0 * (k2 + k3) + self.rates(x + GAP * k3, before, own))
        mean = (self.shares[:, None] * after).sum(1)
        off = after - mean[:, None]
        covariance = (self.shares[:, None] * off).mT @ off + q
        return self.update(torch.maximum(mean, self.lower), covariance, u, z, r, *parts)

    def update(
        self, mean: Tensor, covariance: Tensor, u: Tensor, z: Tensor, r: Tensor, *parts: Tensor
    ) -> Any:
        """Take a measurement."""
        at = self.points(mean, covariance)
        ax, ay, _, _ = self.motion(at, u, list(parts))
        expected = torch.stack([ax, ay, at[..., 2], at[..., 3]], -1)
        predicted = (self.shares[:, None] * expected).sum(1)
        deviation = expected - predicted[:, None]
        weighted = (self.shares[:, None] * deviation).mT
        innovation = weighted @ deviation + r
        cross = weighted @ (at - mean[:, None])
        gain = solved(factor(innovation, 4), cross, 4).mT
        mean = torch.maximum(mean + (gain @ (z - predicted)[..., None])[..., 0], self.lower)
        covariance = covariance - gain @ innovation @ gain.mT
        return mean, 0.5 * (covariance + covariance.mT)

    def noises(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Process and observation noise at the true states, (B, T, n, n)."""
        found = []
        for noise in (self.own.process_noise, self.own.observation_noise):
            n = noise.constant.n
            rows = torch.tril_indices(n, n, device=states.device)[0]
            varying = (
                functional.linear(states / noise.state_unit, noise.weight, noise.offset)
                * noise.unit[rows]
            )
            constant = product(
                noise.constant.factor * noise.constant.unit[rows], n
            ) + FLOOR * torch.eye(n, device=states.device)
            found.append(constant + SCALE * product(varying, n))
        n = found[0].shape[-1]
        diagonal = (
            factor(found[0].flatten(0, 1), n)
            .diagonal(dim1=-2, dim2=-1)
            .reshape(*states.shape[:2], n)
        )
        entropy = 0.5 * n * math.log(2.0 * math.pi * math.e) + diagonal.log().sum(-1)
        return torch.exp(2.0 / n * (LEAST_ENTROPY - entropy).clamp(min=0.0))[
            ..., None, None
        ] * found[0], found[1]

    def initial(self, count: int) -> Tensor:
        """Covariance at the start, (count, 5, 5)."""
        noise = self.own.initial_noise
        entries = noise.factor * noise.unit[torch.tril_indices(5, 5, device=noise.factor.device)[0]]
        return (product(entries, 5) + FLOOR * torch.eye(5, device=entries.device)).expand(
            count, 5, 5
        )


def product(entries: Tensor, n: int) -> Tensor:
    """L Lᵀ of the entries of L row by row, (..., n (n + 1) / 2) -> (..., n, n)."""
    zero = torch.zeros_like(entries[..., 0])
    rows = [
        torch.stack([entries[..., i * (i + 1) // 2 + j] if j <= i else zero for j in range(n)], -1)
        for i in range(n)
    ]
    lower = torch.stack(rows, -2)
    return lower @ lower.mT


def gpu_loss(model: Filter, first: Any, step: Any, drives: list[Tensor], weights: Tensor) -> Tensor:
    """Mean squared error of the states through the filter."""
    states, inputs, measured = drives
    process, observation = model.noises(states)
    parts = model.parts()
    mean, covariance = first(
        states[:, 0],
        model.initial(len(states)),
        inputs[:, 0],
        measured[:, 0],
        observation[:, 0],
        *parts,
    )
    means = [mean]
    for k in range(1, states.shape[1]):
        given = (
            mean,
            covariance,
            inputs[:, k - 1],
            inputs[:, k],
            measured[:, k],
            process[:, k - 1],
            observation[:, k],
            *parts,
        )
        mean, covariance = checkpoint(step, *given, use_reentrant=False, preserve_rng_state=False)
        means.append(mean)
    return ((torch.stack(means, 1) - states).square() @ weights).mean()


def model_of(held: dict[str, Any]) -> Any:
    """NNTF_UH with the parameters of the file."""
    from vehest.estimators.learned_ukf import LearnedUkf

    estimator = LearnedUkf.from_config({})
    estimator.filter.load_state_dict(held["weights"])
    return estimator.filter


def gradients_of(filter_: Any) -> Tensor:
    """All in one, in double precision."""
    return torch.cat(
        [
            parameter.grad.double().cpu().flatten()
            for _, parameter in sorted(filter_.named_parameters())
        ]
    )


def timed(work: Any, filter_: Any, repeats: int, wait: Any) -> tuple[float, float, Tensor]:
    """Median seconds of forward and backward, loss and gradients."""
    seconds = []
    value = 0.0
    for _ in range(repeats):
        for parameter in filter_.parameters():
            parameter.grad = None
        wait()
        started = time.perf_counter()
        loss = work()
        loss.backward()
        wait()
        seconds.append(time.perf_counter() - started)
        value = float(loss.detach())
        del loss
    return statistics.median(seconds), value, gradients_of(filter_)


def run(file: str) -> None:
    """Measure, write, print."""
    from vehest.estimators.filtering.car_fit import WEIGHTS
    from vehest.training.through_filter import Drive

    held = torch.load(file, weights_only=True)
    cores = os.cpu_count() or 1
    torch.set_num_threads(cores)
    weights = torch.tensor([*WEIGHTS, 1.0])
    rows = []
    cpu = model_of(held)
    gpu = model_of(held).cuda() if torch.cuda.is_available() else None
    for count in SEQUENCES:
        drives = drawn_sequences(held["drives"], count)

        def on_cores(drives: list[Tensor] = drives) -> Tensor:
            estimated, _ = cpu.estimated(Drive(*drives), drives[0][:, 0], None)
            return ((estimated - drives[0]).square() @ weights).mean()

        on_cores().backward()
        seconds, loss, gradients = timed(on_cores, cpu, REPEATS, lambda: None)
        row = {
            "sequences": count,
            "steps": STEPS,
            "cores": cores,
            "cores_seconds": round(seconds, 4),
        }
        print(json.dumps(row), flush=True)
        if gpu is not None:
            row |= on_gpu(
                gpu, [part.cuda() for part in drives], weights.cuda(), loss, gradients, seconds
            )
        rows.append(row)
        print(json.dumps(row), flush=True)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    device = torch.cuda.get_device_name() if gpu is not None else None
    machine = {"gpu": device, "cores": cores, "torch": torch.__version__}
    RESULT.write_text(
        json.dumps({"cases": rows, "dataset": held["dataset"], "machine": machine}, indent=1) + "\n"
    )


def on_gpu(
    filter_: Any,
    drives: list[Tensor],
    weights: Tensor,
    loss: float,
    gradients: Tensor,
    seconds: float,
) -> dict[str, Any]:
    """One row's part of the GPU: eager, compiled, and compiled steps replayed from one graph."""
    torch.compiler.reset()
    model = Filter(filter_).cuda()
    wait = torch.cuda.synchronize
    found: dict[str, Any] = {}
    ways = {
        "eager": (model.update, model.forward),
        "compiled": (
            torch.compile(model.update, dynamic=False),
            torch.compile(model.forward, dynamic=False),
        ),
    }
    for name, (first, step) in ways.items():
        started = time.perf_counter()
        short = [part[:, :4] for part in drives]
        gpu_loss(model, first, step, short, weights).backward()
        wait()
        warm = time.perf_counter() - started
        torch.cuda.reset_peak_memory_stats()

        def work(first: Any = first, step: Any = step) -> Tensor:
            return gpu_loss(model, first, step, drives, weights)

        own, value, gradient = timed(work, filter_, 1 if name == "eager" else REPEATS, wait)
        found |= {
            f"{name}_seconds": round(own, 4),
            f"{name}_first_seconds": round(warm, 1),
            f"cores_over_{name}": round(seconds / own, 1),
        }
        found |= {f"{name}_mb": round(torch.cuda.max_memory_allocated() / 1e6)}
        found |= {f"{name}_loss_differs": float(f"{abs(value - loss) / loss:.1e}")}
        found |= {
            f"{name}_gradient_differs": float(
                f"{float((gradient - gradients).norm() / gradients.norm()):.1e}"
            )
        }
        print(name, found, flush=True)
    return found | replayed(model, ways["compiled"], drives, weights, filter_, seconds)


def replayed(
    model: Filter, way: Any, drives: list[Tensor], weights: Tensor, filter_: Any, seconds: float
) -> dict[str, Any]:
    """Forward and backward of all samples recorded as one CUDA graph."""
    for parameter in filter_.parameters():
        parameter.grad = None
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    started = time.perf_counter()
    with torch.cuda.stream(stream):
        gpu_loss(model, *way, drives, weights).backward()
    torch.cuda.current_stream().wait_stream(stream)
    for parameter in filter_.parameters():
        parameter.grad = None
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        gpu_loss(model, *way, drives, weights).backward()
    torch.cuda.synchronize()
    recording = time.perf_counter() - started
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        graph.replay()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - started)
    own = statistics.median(times)
    return {
        "graph_seconds": round(own, 4),
        "graph_recording_seconds": round(recording, 1),
        "cores_over_graph": round(seconds / own, 1),
    }


if __name__ == "__main__":
    {"write": write, "run": run}[sys.argv[1]](sys.argv[2])
