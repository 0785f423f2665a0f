"""Adam by torch's own function, without the classes of `torch.optim`.

The first optimiser that is made of those classes imports torch's compiler: 78 MB and a second or
more in every training process.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import torch
from torch import Tensor
from torch.optim.adamw import adamw


class Adam:
    """Steps of `torch.optim.AdamW`, or without weight decay of `torch.optim.Adam`, bit by bit.

    Parameters
    ----------
    parameters : Iterable[Tensor]
        Leaf tensors that are trained, in place.
    learning_rate : float
        Step size; may be changed between steps.
    weight_decay : float, default 0.0
        Decoupled weight decay λ.

    Attributes
    ----------
    state
        Values of each parameter that was stepped: ``step`` (), and the moments ``exp_avg`` and
        ``exp_avg_sq`` in its shape.

    Source: Kingma & Ba, Adam, 2015; Loshchilov & Hutter, Decoupled weight decay regularization,
    2019.
    """

    def __init__(
        self, parameters: Iterable[Tensor], learning_rate: float, weight_decay: float = 0.0
    ) -> None:
        self.parameters = list(parameters)
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)

    def zero_grad(self) -> None:
        """Set the gradient of every parameter to None, so that `step` skips those that receive
        none.
        """
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Step all parameters that have a gradient.

            m = β₁ m + (1 - β₁) g,   v = β₂ v + (1 - β₂) g²
            θ = (1 - η λ) θ - η (m/(1 - β₁ᵗ))/(√(v/(1 - β₂ᵗ)) + ε)

        with the step size η, the weight decay λ, β₁ = 0.9, β₂ = 0.999, ε = 1e-8, and the number t
        of steps that the parameter has had. Moments begin at 0 with a parameter's first step.
        """
        learning = [parameter for parameter in self.parameters if parameter.grad is not None]
        for parameter in learning:
            if not self.state[parameter]:
                moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                self.state[parameter] = {"step": torch.tensor(0.0), **moments}
        states = [self.state[parameter] for parameter in learning]
        adamw(
            learning,
            [parameter.grad for parameter in learning if parameter.grad is not None],
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            [state["step"] for state in states],
            foreach=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.learning_rate,
            weight_decay=self.weight_decay,
            eps=1e-8,
            maximize=False,
        )
