"""Batched flow nets: one small ReLU net a cluster, all evaluated in one tensor program.

Each cluster's parameters, loss and optimiser state are its own, so a batch gives what single fits give.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

ADAM_BETA_1, ADAM_BETA_2, ADAM_EPSILON = 0.9, 0.999, 1e-8


@dataclass(slots=True, eq=False)
class NetBatch:
    """Fully connected ReLU nets R^3 -> R^3. ``layers`` alternates weights (B, in, out) and biases (B, 1, out)."""

    layers: list[Tensor]

    def __call__(self, points: Tensor) -> Tensor:
        """Evaluate (B, P, 3) points, each row of the batch by its own net."""
        values = points
        for k in range(0, len(self.layers), 2):
            values = torch.baddbmm(self.layers[k + 1], values, self.layers[k])
            if k + 2 < len(self.layers):
                values = torch.relu(values)
        return values

    def select(self, rows: Tensor) -> "NetBatch":
        """Return the nets of the given batch rows."""
        return NetBatch([layer[rows] for layer in self.layers])

    def copy_rows(self, other: "NetBatch", rows: Tensor, other_rows: Tensor) -> None:
        """Overwrite ``rows`` with the nets of ``other_rows`` of another batch."""
        for mine, theirs in zip(self.layers, other.layers, strict=True):
            mine[rows] = theirs[other_rows]


def make_nets(
    rngs: list[np.random.Generator],
    hidden_layers: int,
    hidden_units: int,
    device: torch.device,
    *,
    is_zero_at_start: bool,
) -> NetBatch:
    """Return one net a generator, uniform in +-1/sqrt(fan in); ``is_zero_at_start`` zeroes the last layer."""
    sizes = [3, *[hidden_units] * hidden_layers, 3]
    layers: list[Tensor] = []
    for k, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        is_last = k == len(sizes) - 2
        bound = 0.0 if is_last and is_zero_at_start else fan_in**-0.5
        for shape in ((fan_in, fan_out), (1, fan_out)):
            values = np.stack([rng.uniform(-bound, bound, size=shape) for rng in rngs]).astype(np.float32)
            layers.append(torch.from_numpy(values).to(device))
    return NetBatch(layers)


class BatchedAdam:
    """Adam whose state can be thinned row by row, so that finished clusters leave the batch."""

    def __init__(self, parameters: list[Tensor], learning_rate: float) -> None:
        self.parameters = parameters
        self._learning_rate = learning_rate
        self._mean = [torch.zeros_like(p) for p in parameters]
        self._square = [torch.zeros_like(p) for p in parameters]
        self._num_steps = 0

    def step(self, gradients: tuple[Tensor, ...]) -> None:
        """Update the parameters in place."""
        self._num_steps += 1
        scale = self._learning_rate * (1 - ADAM_BETA_2**self._num_steps) ** 0.5 / (1 - ADAM_BETA_1**self._num_steps)
        for parameter, gradient, mean, square in zip(self.parameters, gradients, self._mean, self._square, strict=True):
            mean.lerp_(gradient, 1 - ADAM_BETA_1)
            square.mul_(ADAM_BETA_2).addcmul_(gradient, gradient, value=1 - ADAM_BETA_2)
            parameter.data.addcdiv_(mean, square.sqrt().add_(ADAM_EPSILON), value=-scale)

    def keep(self, rows: Tensor) -> None:
        """Keep only the given batch rows."""
        self.parameters = [p.detach()[rows].requires_grad_() for p in self.parameters]
        self._mean = [m[rows] for m in self._mean]
        self._square = [s[rows] for s in self._square]
