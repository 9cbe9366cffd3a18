"""The two networks of the decomposition and their loss (paper, section 2.2).

``V_θ(x) = η_v Ṽ(y)`` with ``Ṽ(y) = V^NN(y) + |y|²`` and ``g_θ(x) = η_g g^NN(y)``, where ``y = (x - μ)/σ``.

Every tensor has a leading *run* axis: independent runs are trained side by side by batched products, one
run on a CPU, many on a GPU, and never see each other. The gradient of the tanh network is written out as
the chain of products that it is, so that training needs first-order automatic differentiation only.

The loss (paper, Eq. loss) is that of the dynamics plus λ times that of orthogonality. The former compares the
mean velocity over a pair that an integrator predicts with the observed ``(Xh - X0)/h`` (`mean_velocity`,
`dynamics_loss`); the latter penalises the angle between ∇V and g (`orthogonality_loss`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from siq.errors import Fault, needs_extra
from siq.networks.decomposition import MatchingRule, Order, TrainedNetworks

with needs_extra("networks"):
    import torch
    from torch import Tensor

Layer = tuple[Tensor, Tensor]
"""Weights, shape ``(runs, inputs, outputs)``, and biases, shape ``(runs, 1, outputs)``."""


@dataclass(frozen=True)
class Networks:
    """An orthogonal decomposition ``f = -D∇V + g`` given by two tanh networks, for one or more runs."""

    potential: tuple[Layer, ...]  #: layers of V^NN, from d inputs to one output
    circulatory: tuple[Layer, ...]  #: layers of g^NN, from d inputs to d outputs
    #: μ and σ, shape ``(runs, 1, d)``, in the units of the states; constant during training.
    mean: Tensor
    scale: Tensor
    #: η_v and η_g, shape ``(runs, 1, 1)``; constant during training.
    potential_scale: Tensor
    circulatory_scale: Tensor
    diffusion: Tensor  #: D, shape ``(d, d)``

    @property
    def runs(self) -> int:
        """Number of independent runs."""
        return self.mean.shape[0]

    def of_run(self, run: int) -> Networks:
        """The networks of one of the runs, as networks with a single run."""
        return replace(self, **_mapped(lambda tensor: tensor[run : run + 1], self))

    def parameters(self) -> list[Tensor]:
        """Everything that training changes: weights and biases of both networks."""
        return [tensor for layer in (*self.potential, *self.circulatory) for tensor in layer]


def initial_layers(
    sizes: Sequence[int], *, generators: Sequence[np.random.Generator], dtype: torch.dtype
) -> tuple[Layer, ...]:
    """Random layers, uniform in ±1/√inputs, each run drawn from its own generator.

    The sizes are numbers of neurons, inputs and outputs included: ``(3, 50, 50, 50, 1)``. A run's networks do
    not depend on which runs train beside it.
    """
    layers = []
    for inputs, outputs in itertools.pairwise(sizes):
        bound = inputs**-0.5
        weights = np.stack([draw.uniform(-bound, bound, (inputs, outputs)) for draw in generators])
        biases = np.stack([draw.uniform(-bound, bound, (1, outputs)) for draw in generators])
        layers.append((torch.from_numpy(weights).to(dtype), torch.from_numpy(biases).to(dtype)))
    return tuple(layers)


def evaluate(networks: Networks, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """V ``(runs, n)``, ∇V, g and f = -D∇V + g ``(runs, n, d)`` at points ``(runs, n, d)``.

    All are in the units of the states: ∇V is the gradient with respect to x, not to the normalised y.
    """
    y = (x - networks.mean) / networks.scale
    value, gradient = _value_and_gradient(networks.potential, y)
    potential = networks.potential_scale * (value + (y * y).sum(dim=-1, keepdim=True))
    gradient = networks.potential_scale / networks.scale * (gradient + 2 * y)
    circulatory = networks.circulatory_scale * _hidden(networks.circulatory, y)[-1]
    return potential.squeeze(-1), gradient, circulatory, circulatory - gradient @ networks.diffusion


def _mapped(function: Callable[..., Any], *sources: Networks | TrainedNetworks) -> dict[str, Any]:
    """All parts that have an axis of runs, each a function of those of some networks."""

    def layers(*of: Any) -> tuple[Any, ...]:
        return tuple(
            tuple(function(*parts) for parts in zip(*layer, strict=True)) for layer in zip(*of, strict=True)
        )

    stacks, numbers = ("potential", "circulatory"), ("mean", "scale", "potential_scale", "circulatory_scale")
    mapped = {name: layers(*(getattr(one, name) for one in sources)) for name in stacks}
    return mapped | {name: function(*(getattr(one, name) for one in sources)) for name in numbers}


def at_rest(networks: Networks, run: int) -> TrainedNetworks:
    """One of the runs as arrays that share no memory with the training."""
    parts = _mapped(lambda tensor: tensor[run].detach().cpu().numpy().copy(), networks)
    return TrainedNetworks(**parts, diffusion=networks.diffusion.detach().cpu().numpy().copy())


def side_by_side(runs: Sequence[TrainedNetworks]) -> Networks:
    """Networks of several runs to be trained together; the inverse of `at_rest`."""
    parts = _mapped(lambda *arrays: torch.from_numpy(np.stack(arrays)), *runs)
    return Networks(**parts, diffusion=torch.from_numpy(runs[0].diffusion.copy()))


def move(networks: Networks, device: torch.device | str) -> Networks:
    """A copy of the networks on another device, detached from any gradient."""

    def there(tensor: Tensor) -> Tensor:
        return tensor.detach().to(device, copy=True)

    return replace(networks, **_mapped(there, networks), diffusion=there(networks.diffusion))


def _hidden(layers: tuple[Layer, ...], y: Tensor) -> list[Tensor]:
    """Activations of the hidden layers, and the output behind them."""
    found = []
    for weights, biases in layers[:-1]:
        y = torch.tanh(torch.baddbmm(biases, y, weights))
        found.append(y)
    weights, biases = layers[-1]
    return [*found, torch.baddbmm(biases, y, weights)]


def _value_and_gradient(layers: tuple[Layer, ...], y: Tensor) -> tuple[Tensor, Tensor]:
    """Value of a scalar tanh network, and its gradient with respect to its input."""
    # With h_k = tanh(h_{k-1} W_k + b_k) backwards δ_k = (δ_{k+1} W_{k+1}ᵀ) (1 - h_k²), from the last weights.
    *hidden, value = _hidden(layers, y)
    delta = layers[-1][0].mT
    for (weights, _), activation in zip(reversed(layers[:-1]), reversed(hidden), strict=True):
        delta = (delta * (1 - activation * activation)) @ weights.mT
    return value, delta


def dynamics_loss(
    predicted: Tensor, observed: Tensor, precision: Tensor, *, slow: Tensor | None = None
) -> Tensor:
    """Mean square of the mismatch of velocities ``(runs, n, d)`` in the metric of the noise: ``(runs,)``.

    Parameters
    ----------
    predicted, observed
        Velocities.
    precision
        D⁻¹, shape ``(d, d)``; the paper has D = 1.
    slow
        Square of the speed, shape ``(runs, 1)``, below which a pair counts as slow. If given, every mismatch
        is divided by the square of its observed speed plus this; the paper does not.
    """
    mismatch = predicted - observed
    square = ((mismatch @ precision) * mismatch).sum(dim=-1)
    if slow is not None:
        square = square / (((observed @ precision) * observed).sum(dim=-1) + slow)
    return square.mean(dim=-1)


def orthogonality_loss(
    gradient: Tensor, circulatory: Tensor, diffusion: Tensor, precision: Tensor, *, asymmetry: float
) -> Tensor:
    """Mean of w(z, δ), z being the cosine of the angle between ∇V and g: shape ``(runs,)``.

    The angle is taken in the metric of the noise: ``z = ∇V·g / sqrt(∇V·D∇V  g·D⁻¹g)``, which does not
    change when the states change their units. ``w(z, δ) = z²`` for z ≥ 0 and ``δ z²`` for z < 0.

    Parameters
    ----------
    gradient, circulatory
        ∇V and g at the representative points, shape ``(runs, n, d)``.
    diffusion, precision
        D and D⁻¹, shape ``(d, d)``.
    asymmetry
        δ.
    """
    product = (gradient * circulatory).sum(dim=-1)
    downhill_square = ((gradient @ diffusion) * gradient).sum(dim=-1)
    circulatory_square = ((circulatory @ precision) * circulatory).sum(dim=-1)
    # Both vectors may vanish (g does everywhere in a gradient system): no angle, no penalty.
    # The roots are taken apart, for the product of the squares would underflow in single precision.
    tiny = torch.finfo(product.dtype).tiny
    lengths = downhill_square.clamp_min(tiny).sqrt() * circulatory_square.clamp_min(tiny).sqrt()
    cosine = product / lengths
    return (torch.where(cosine < 0, asymmetry * cosine, cosine) * cosine).mean(dim=-1)


def mean_velocity(
    vector_field: Callable[[Tensor], Tensor], x0: Tensor, xh: Tensor, h: Tensor, *, kind: MatchingRule,
    order: Order,
) -> Tensor:  # fmt: skip
    """Mean velocity over the pair that the vector field predicts, to be compared with (Xh - X0)/h.

    A rule of order p has a bias of O(h^p) in f:

    ===========  =====  ===========  ==========================================================
    kind         order  evaluations  when to use it
    ===========  =====  ===========  ==========================================================
    explicit     2      2            the paper's rule (Runge's midpoint); noisy pairs, since only X0 enters f
    explicit     4      4            the classical Runge–Kutta rule; noisy pairs with a large h
    symmetric    2      1            implicit midpoint ``f((X0 + Xh)/2)``: cheapest, noise-free pairs only
    symmetric    4      3            Hermite–Simpson: noise-free pairs, unbiased to O(h⁴)
    ===========  =====  ===========  ==========================================================

    The symmetric rules put Xh into f: with noise in Xh that correlates the regressor with its error and
    biases f by as much as the noise is strong.

    Parameters
    ----------
    vector_field
        f at points of shape ``(..., d)``.
    x0, xh
        The two snapshots, shape ``(..., d)``.
    h
        Time between them, shape ``(..., 1)``.
    kind, order
        The rule, see the table above.

    Returns
    -------
    torch.Tensor
        Shape ``(..., d)``.
    """
    match kind, order:
        case "explicit", 2:
            return vector_field(x0 + h / 2 * vector_field(x0))
        case "explicit", 4:
            k1 = vector_field(x0)
            k2 = vector_field(x0 + h / 2 * k1)
            k3 = vector_field(x0 + h / 2 * k2)
            return (k1 + 2 * (k2 + k3) + vector_field(x0 + h * k3)) / 6
        case "symmetric", 2:
            return vector_field((x0 + xh) / 2)
        case "symmetric", 4:
            start, end = vector_field(x0), vector_field(xh)
            return (start + 4 * vector_field((x0 + xh) / 2 + h / 8 * (start - end)) + end) / 6
    raise Fault(f"there is no {kind} matching rule of order {order}", "use order 2 or 4")
