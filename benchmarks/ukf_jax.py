"""The training step of ukf.py as a `jax.lax.scan` with the same equations, in float32; of the extra `bench`."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

STILL = 1e-6
STEEPNESS = 100.0
KAPPA = -2.0
GAP = 0.01
LEAST_ENTROPY = -9.0
FLOOR = 1e-7
SCALE = 0.01  # as in ukf.py


def loss_of(task: Any) -> torch.Tensor:
    """The loss of a `Problem` as a tensor, whose gradients go to the parameters of its filter."""
    named = dict(task.estimator.filter.named_parameters())
    loss: torch.Tensor = _Loss.apply(task, list(named), *named.values())  # type: ignore[no-untyped-call]
    return loss


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, task: Any, names: list[str], *values: torch.Tensor) -> torch.Tensor:
        parameters = {
            name: jnp.asarray(value.detach().numpy())
            for name, value in zip(names, values, strict=True)
        }
        car = task.estimator.filter.dynamics.car
        known = {
            name: jnp.asarray(value.numpy())
            for name, value in task.estimator.filter.named_buffers()
        }
        noise = task.estimator.filter
        fixed = (
            car.mass,
            car.wheelbase,
            car.wheel_radius,
            FLOOR,
            FLOOR,
            FLOOR,
            SCALE,
            *noise.lower,
        )
        data = [
            jnp.asarray(part.numpy())
            for part in (
                task.drives.states,
                task.drives.inputs,
                task.drives.measurements,
                task.weights,
            )
        ]
        loss, gradients = _compiled(fixed)(parameters, known, *data)
        ctx.gradients = [torch.from_numpy(np.array(gradients[name])) for name in names]
        return torch.tensor(float(loss))

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor) -> tuple[Any, ...]:
        return (None, None, *(upstream[0] * gradient for gradient in ctx.gradients))


@cache
def _compiled(fixed: tuple[float, ...]) -> Any:
    mass, wheelbase, radius, process_floor, observation_floor, initial_floor, scale, *least = fixed
    lower = jnp.array(least)

    def loss(
        own: dict[str, Any],
        known: dict[str, Any],
        states: Any,
        inputs: Any,
        measurements: Any,
        weighting: Any,
    ) -> Any:
        p = {
            name.removeprefix("dynamics.car.learnt.log_"): jnp.exp(value)
            for name, value in own.items()
            if ".log_" in name
        }
        rear = p["cg_to_rear_axle"]
        front = wheelbase - rear
        layers = [
            (own[f"dynamics.network.{k}.weight"].T, own[f"dynamics.network.{k}.bias"])
            for k in (0, 2, 4)
        ]

        def motion(x: Any, u: Any) -> tuple[Any, ...]:
            vx, vy, yaw_rate, rim, friction = (x[..., i] for i in range(5))
            steer, current = (jnp.broadcast_to(u[..., i], vx.shape) for i in range(2))
            along = vx + STILL
            slip_front = jnp.arctan((vy + front * yaw_rate) / along) - steer
            slip_rear = jnp.arctan((vy - rear * yaw_rate) / along)
            seen = jnp.stack(
                [vx, vy, yaw_rate, rim, friction, steer, slip_front, slip_rear, (rim - vx) / along],
                -1,
            )
            hidden = seen / known["dynamics.network.input_scale"]
            for weight, offset in layers[:2]:
                hidden = jax.nn.sigmoid(hidden @ weight + offset)
            out = (hidden @ layers[2][0] + layers[2][1]) * known["dynamics.network.output_scale"]
            rear_x = friction * out[..., 0]
            front_x = friction * out[..., 1]
            rear_y = -friction * jax.nn.softplus(out[..., 2]) * jnp.tanh(STEEPNESS * slip_rear)
            front_y = -friction * jax.nn.softplus(out[..., 3]) * jnp.tanh(STEEPNESS * slip_front)
            drag = (
                p["drag_constant"] * jnp.sign(vx)
                + p["drag_linear"] * vx
                + p["drag_quadratic"] * vx**2
            )
            sideways = front_x * jnp.sin(steer) + front_y * jnp.cos(steer)
            lost = p["friction_viscous"] * rim + p["friction_coulomb"] * jnp.sign(rim)
            torque = p["torque_constant"] * current - radius * (front_x + rear_x) - lost
            return (
                (rear_x + front_x * jnp.cos(steer) - front_y * jnp.sin(steer) - drag) / mass,
                (sideways + rear_y) / mass,
                (sideways * front - rear_y * rear) / p["yaw_inertia"],
                radius / p["powertrain_inertia"] * torque,
            )

        def rates(x: Any, u: Any) -> Any:
            ax, ay, turning, spinning = motion(x, u)
            return jnp.stack(
                [
                    ax + x[..., 1] * x[..., 2],
                    ay - x[..., 0] * x[..., 2],
                    turning,
                    spinning,
                    jnp.zeros_like(ax),
                ],
                -1,
            )

        def moved(x: Any, u: Any) -> Any:
            k1 = rates(x, u)
            k2 = rates(x + 0.5 * GAP * k1, u)
            k3 = rates(x + 0.5 * GAP * k2, u)
            return x + GAP / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(x + GAP * k3, u))

        n = states.shape[-1]
        total = n + KAPPA
        weights = jnp.array([KAPPA / total, *[0.5 / total] * (2 * n)])

        def points(mean: Any, covariance: Any) -> Any:
            offsets = total**0.5 * jnp.linalg.cholesky(covariance, symmetrize_input=False).mT
            centre = mean[:, None]
            return jnp.maximum(
                jnp.concatenate([centre, centre + offsets, centre - offsets], -2), lower
            )

        def product(left: Any, right: Any) -> Any:
            return (weights[:, None] * left).mT @ right

        def noise(name: str, floor: float) -> Any:
            constant = _factor(own[f"{name}.constant.factor"], known[f"{name}.constant.unit"])
            entries = (
                states / known[f"{name}.state_unit"] @ own[f"{name}.weight"].T
                + own[f"{name}.offset"]
            )
            varying = _factor(entries, known[f"{name}.unit"])
            return (
                constant @ constant.mT
                + floor * jnp.eye(len(constant))
                + scale * varying @ varying.mT
            )

        process = noise("process_noise", process_floor)
        observation = noise("observation_noise", observation_floor)
        entropy = 0.5 * (n * math.log(2.0 * math.pi * math.e) + jnp.linalg.slogdet(process)[1])
        process = (
            jnp.exp(2.0 / n * jnp.maximum(LEAST_ENTROPY - entropy, 0.0))[..., None, None] * process
        )

        def updated(mean: Any, covariance: Any, u: Any, y: Any, spread: Any) -> Any:
            at = points(mean, covariance)
            ax, ay, _, _ = motion(at, u[:, None])
            expected = jnp.stack([ax, ay, at[..., 2], at[..., 3]], -1)
            predicted = weights @ expected
            deviation = expected - predicted[:, None]
            innovation = product(deviation, deviation) + spread
            gain = jnp.linalg.solve(innovation, product(at - mean[:, None], deviation).mT).mT
            mean = jnp.maximum(mean + (gain @ (y - predicted)[..., None])[..., 0], lower)
            covariance = covariance - gain @ innovation @ gain.mT
            return mean, 0.5 * (covariance + covariance.mT)

        def step(carry: Any, now: Any) -> Any:
            before, added, u, y, spread = now
            after = moved(points(*carry), before[:, None])
            mean = weights @ after
            deviation = after - mean[:, None]
            new = updated(
                jnp.maximum(mean, lower), product(deviation, deviation) + added, u, y, spread
            )
            return new, new[0]

        def by_time(values: Any) -> Any:
            return jnp.swapaxes(values, 0, 1)

        initial = _factor(own["initial_noise.factor"], known["initial_noise.unit"])
        start = jnp.broadcast_to(
            initial @ initial.mT + initial_floor * jnp.eye(n), (len(states), n, n)
        )
        u, y, q, r = (by_time(values) for values in (inputs, measurements, process, observation))
        first = updated(states[:, 0], start, u[0], y[0], r[0])
        _, means = jax.lax.scan(step, first, (u[:-1], q[:-1], u[1:], y[1:], r[1:]))
        estimated = by_time(jnp.concatenate([first[0][None], means]))
        return ((estimated - states) ** 2 @ weighting).mean()

    return jax.jit(jax.value_and_grad(loss))


def _factor(entries: Any, unit: Any) -> Any:
    """Lower triangular matrices of their entries row by row, (..., n (n + 1) / 2) -> (..., n, n)."""
    n = len(unit)
    rows, columns = np.tril_indices(n)
    return (
        jnp.zeros((*entries.shape[:-1], n, n), entries.dtype)
        .at[..., rows, columns]
        .set(entries * unit[rows])
    )
