"""The decomposition ``f = -D∇V + g`` of one run after training, its files, and the options of a training.

What comes after training needs V_θ, g and f at points and no gradient by a weight, so that it does without
torch, which takes longer to import than such an evaluation does to run. Networks are stored as plain arrays.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass
from scipy.spatial import cKDTree

from siq.errors import InputError
from siq.numerics.files import whole_file

CHUNK = 81_920  # activations of a layer worked out together: few enough to stay in the processor's cache
LARGEST_EXPONENT = 700  # numerical: of e, in double precision
MatchingRule = Literal["explicit", "symmetric"]
Order = Literal[2, 4]


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CheckOptions:
    """When a training may end before its last step: as soon as output weights follow from where it is."""

    #: Steps before the first check, and between checks
    first: Annotated[int, Field(ge=1)] = 300
    #: Steps before the first check, and between checks
    every: Annotated[int, Field(ge=1)] = 300
    #: Trainings from fresh networks, if a training ends without having passed; every second one in another
    #: way, see `TrainingOptions.attempt`
    attempts: Annotated[int, Field(ge=1)] = 4


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TrainingOptions:
    """How the networks are trained; every one of these changes the result.

    The defaults are those of a short training, seconds on one core, that only has to find the right branch of
    the Hamilton–Jacobi equation. The paper's own are spelled out in the studies ``*-published``.
    """

    #: Neurons in the hidden layers of both networks
    widths: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (20, 20)
    #: Steps of Adam, at most
    steps: Annotated[int, Field(ge=1)] = 900
    #: When a training may end earlier; None takes all its steps, and leaves the networks as they are then
    check: CheckOptions | None = CheckOptions()
    #: Number of random tanh units whose output weights the check solves for, from where the networks have
    #: come; what it finds replaces them (`siq.quasipotential.output_weights`). Without a check it has no
    #: meaning.
    output_weights: Annotated[int, Field(ge=10)] = 400
    #: Pairs in the first term of the loss, and representative points in the second, per step
    batch_size: Annotated[int, Field(ge=1)] = 1000
    #: Share of the pairs of a batch that are drawn from the representative ones, the rest from all. The paper
    #: has 0; above it the loss weighs the region away from the attractors more, where pairs are few and fast.
    representative_share: Annotated[float, Field(ge=0, le=1)] = 1.0
    #: The rate is ``learning_rate * decay_rate ** (step / decay_steps)``
    learning_rate: Annotated[float, Field(gt=0)] = 6e-3
    #: The rate is ``learning_rate * decay_rate ** (step / decay_steps)``
    decay_rate: Annotated[float, Field(gt=0, le=1)] = 0.95
    #: The rate is ``learning_rate * decay_rate ** (step / decay_steps)``
    decay_steps: Annotated[float, Field(gt=0)] = 90.0
    #: λ
    orthogonality_weight: Annotated[float, Field(ge=0)] = 1.0
    #: δ of w(z, δ)
    asymmetry: Annotated[float, Field(ge=0)] = 0.1
    #: The pair-matching rule, see `siq.networks.networks.mean_velocity`
    matching: MatchingRule = "explicit"
    #: The pair-matching rule, see `siq.networks.networks.mean_velocity`
    matching_order: Order = 2
    #: Divide the first term of the loss by the mean square of the observed velocities, so that λ means the
    #: same for every system and in any units. The paper does not.
    relative_dynamics: bool = True
    #: Judge the mismatch of every pair by its own speed, or by this share of the root mean square speed where
    #: it is slower. Left out: by the same measure everywhere, as the paper does, and the fastest region
    #: rules. For pairs without noise only, which would add to the speed.
    slow_speed: Annotated[float, Field(gt=0)] | None = None
    #: r, the distance between representative points, in the units of the states. Left out: a tenth of each
    #: state's standard deviation, whatever the units.
    thinning_distance: Annotated[float, Field(gt=0)] | None = None
    #: The points from which μ, σ, η_v and η_g are estimated. ``pairs``: all training pairs, as the paper
    #: does. ``representative``: the evenly spread ones. Trajectories crowd at attractors, where f is small
    #: and some states hardly vary: estimated there, the scales start V several times too small and too
    #: narrow, and a short training ends in a V that is flat along a direction.
    normalise_on: Literal["pairs", "representative"] = "representative"
    #: What η_v is estimated from. ``speed``: ∣∇V∣ is as large as the observed speed, as in the paper.
    #: ``descent``: -D∇V is the part of the observed velocity that goes down the initial V. Where the rotation
    #: is many times faster than the descent the former starts V as many times too steep.
    potential_from: Literal["speed", "descent"] = "speed"
    #: Factor on η_v; the paper has 1. A larger one lets V learn faster beside g, which a short training
    #: needs: otherwise g takes over what V has not yet learned, and V stays flat along a direction.
    potential_gain: Annotated[float, Field(gt=0)] = 3.0
    #: Share of the recordings that train; the others measure the held-out loss
    training_share: Annotated[float, Field(gt=0, lt=1)] = 0.7
    #: Floating-point type of the networks
    precision: Literal["float32", "float64"] = "float32"

    def attempt(self, number: int) -> TrainingOptions:
        """Options of a training that comes after `number` trainings that failed.

        What failed once is likelier to succeed in another way than once more: every second training has a λ
        ten times as large, starts V as steep as f descends, and, where the pairs are free of noise, judges
        each by its own speed. Which of the two ways a system needs is known of none beforehand: the first
        fails where f turns much faster than it descends, the second where V is to be steep.
        """
        if number % 2 == 0:
            return self
        return replace(
            self, orthogonality_weight=10 * self.orthogonality_weight, potential_from="descent",
            potential_gain=1.0,
            slow_speed=(self.slow_speed or 0.1) if self.matching == "symmetric" else self.slow_speed,
        )  # fmt: skip


Layer = tuple[np.ndarray, np.ndarray]
"""Weights, shape ``(inputs, outputs)``, and biases, shape ``(1, outputs)``."""


@dataclass(frozen=True)
class TrainedNetworks:
    """An orthogonal decomposition ``f = -D∇V + g`` given by two tanh networks.

    Not to be confused with `siq.networks.networks.Networks`, the tensors of several runs that
    training changes; this is one run of them, at rest.
    """

    potential: tuple[Layer, ...]  #: layers of V^NN, from d inputs to one output
    circulatory: tuple[Layer, ...]  #: layers of g^NN, from d inputs to d outputs
    #: μ and σ of ``y = (x - μ)/σ``, shape ``(1, d)``, in the units of the states.
    mean: np.ndarray
    scale: np.ndarray
    #: η_v and η_g, shape ``(1, 1)``.
    potential_scale: np.ndarray
    circulatory_scale: np.ndarray
    diffusion: np.ndarray  #: D, shape ``(d, d)``

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """V ``(n,)``, g and f ``(n, d)`` at points ``(n, d)`` in the units of the states."""
        pieces = zip(*map(self._evaluate, self._parts(x)), strict=True)
        potential, circulatory, vector_field = map(np.concatenate, pieces)
        return potential, circulatory, vector_field

    def potential_at(self, x: np.ndarray) -> np.ndarray:
        """V alone, shape ``(n,)``, at a third of the cost of `evaluate`."""
        values = [
            (self.potential_scale * (_hidden(self.potential, y)[-1] + (y * y).sum(axis=1, keepdims=True)))
            for y in self._parts(x)
        ]
        return np.concatenate(values)[:, 0].astype(float)

    def gradients_at(self, x: np.ndarray) -> np.ndarray:
        """∇V alone, shape ``(n, d)``, at half the cost of `evaluate`."""
        gradients = [_gradient(self.potential, _hidden(self.potential, y)) + 2 * y for y in self._parts(x)]
        return (self.potential_scale / self.scale * np.concatenate(gradients)).astype(float)

    def _parts(self, x: np.ndarray) -> list[np.ndarray]:
        """Normalised points y, in parts that are evaluated one after the other."""
        y = (x.astype(self.mean.dtype) - self.mean) / self.scale
        rows = max(CHUNK // max(biases.size for _, biases in (*self.potential, *self.circulatory)), 1)
        return [y[begin : begin + rows] for begin in range(0, max(len(y), 1), rows)]

    @cached_property
    def _shared(self) -> bool:
        """Whether both networks have the same hidden layers, as those with solved output weights do."""
        pairs = zip(self.potential[:-1], self.circulatory[:-1], strict=False)
        same = all(np.array_equal(one, two) for layers in pairs for one, two in zip(*layers, strict=True))
        return same and len(self.potential) == len(self.circulatory)

    def _evaluate(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        hidden = _hidden(self.potential, y)
        potential = self.potential_scale * (hidden[-1] + (y * y).sum(axis=1, keepdims=True))
        gradient = self.potential_scale / self.scale * (_gradient(self.potential, hidden) + 2 * y)
        if self._shared:
            weights, biases = self.circulatory[-1]
            circulatory = hidden[-2] @ weights + biases
        else:
            circulatory = _hidden(self.circulatory, y)[-1]
        circulatory = self.circulatory_scale * circulatory
        values = (potential[:, 0], circulatory, circulatory - gradient @ self.diffusion)
        return tuple(np.asarray(array, dtype=float) for array in values)  # type: ignore[return-value]


@dataclass(frozen=True)
class NetworksByWell:
    """Networks of one run, a pair of them about each attractor, since V has a kink between its wells."""

    NOWHERE: ClassVar[int] = -1

    #: Networks that hold in the well of each attractor; V of each is zero there.
    parts: tuple[TrainedNetworks, ...]
    #: What is added to V of each, shape ``(k,)``; zeros where it is not known, as wells end before saddles.
    heights: np.ndarray
    #: V of each at its lowest saddle, or where recordings end before it, shape ``(k,)``. Close to there, and
    #: beyond, V is less exact than elsewhere.
    levels: np.ndarray
    #: States ``(n, d)``, and in the well of which attractor each lies, shape ``(n,)``, or `NOWHERE` where
    #: none of the networks holds. A point belongs to the well of the nearest of them.
    states: np.ndarray
    attractor_of: np.ndarray

    @property
    def diffusion(self) -> np.ndarray:
        """D, shape ``(d, d)``."""
        return self.parts[0].diffusion

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """V ``(n,)``, g and f ``(n, d)`` at points ``(n, d)`` of the states, NaN outside the wells."""
        potential = np.full(len(x), np.nan)
        circulatory, vector_field = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
        for index, rows in enumerate(self.of_wells(x)):
            values, circulatory[rows], vector_field[rows] = self.parts[index].evaluate(x[rows])
            potential[rows] = values + self.heights[index]
        return potential, circulatory, vector_field

    def potential_at(self, x: np.ndarray) -> np.ndarray:
        """V alone, shape ``(n,)``, NaN outside the wells."""
        return self.lifted(x, [one.potential_at for one in self.parts])

    def gradients_at(self, x: np.ndarray) -> np.ndarray:
        """∇V alone, shape ``(n, d)``, NaN outside the wells."""
        gradients = np.full(x.shape, np.nan)
        for index, rows in enumerate(self.of_wells(x)):
            gradients[rows] = self.parts[index].gradients_at(x[rows])
        return gradients

    def lifted(self, x: np.ndarray, potentials: Sequence[Callable[[np.ndarray], np.ndarray]]) -> np.ndarray:
        """V by functions for the wells, each zero at its attractor, so that they meet: shape ``(n,)``."""
        potential = np.full(len(x), np.nan)
        for values, height, rows in zip(potentials, self.heights, self.of_wells(x), strict=True):
            potential[rows] = values(x[rows]) + height
        return potential

    def below(self, share: float, attractor: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)`` in the well of an attractor ``(d,)``, below a share of its level: ``(m, d)``."""
        index = int(np.argmin([float(np.linalg.norm(one.mean[0] - attractor)) for one in self.parts]))
        x = x[self.of_wells(x)[index]]
        return np.asarray(x[self.parts[index].potential_at(x) < share * self.levels[index]])

    def of_wells(self, x: np.ndarray) -> list[np.ndarray]:
        """Rows of points ``(n, d)`` by the well that they lie in."""
        label, finite = np.full(len(x), self.NOWHERE), np.isfinite(x).all(axis=1)
        label[finite] = self.attractor_of[self._tree.query(x[finite] / self._width)[1]]
        return [np.flatnonzero(label == index) for index in range(len(self.parts))]

    @cached_property
    def _width(self) -> np.ndarray:
        return np.ptp(self.states, axis=0)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.states / self._width)


AnyNetworks = TrainedNetworks | NetworksByWell


def shuffled(networks: AnyNetworks, *, generator: np.random.Generator) -> AnyNetworks:
    """Networks with the same weights in random order, as a null model for comparison."""

    def mixed(array: np.ndarray) -> np.ndarray:
        return array.ravel()[generator.permutation(array.size)].reshape(array.shape)

    def layers(source: tuple[Layer, ...]) -> tuple[Layer, ...]:
        return tuple((mixed(weights), mixed(biases)) for weights, biases in source)

    def of(one: TrainedNetworks) -> TrainedNetworks:
        return replace(one, potential=layers(one.potential), circulatory=layers(one.circulatory))

    if isinstance(networks, NetworksByWell):
        return replace(networks, parts=tuple(map(of, networks.parts)))
    return of(networks)


def _hidden(layers: tuple[Layer, ...], y: np.ndarray) -> list[np.ndarray]:
    """Activations of the hidden layers, and the output behind them."""
    found = []
    for weights, biases in layers[:-1]:
        y = y @ weights
        y += biases
        found.append(np.tanh(y, out=y))
    weights, biases = layers[-1]
    return [*found, y @ weights + biases]


def _gradient(layers: tuple[Layer, ...], hidden: list[np.ndarray]) -> np.ndarray:
    """Gradient of a scalar tanh network, backwards through its activations and its output."""
    delta = layers[-1][0].T
    for (weights, _), activation in zip(reversed(layers[:-1]), reversed(hidden[:-1]), strict=True):
        slopes = activation * activation
        np.subtract(1, slopes, out=slopes)
        slopes *= delta
        delta = slopes @ weights.T
    return delta


def potential_on_grid(networks: AnyNetworks, axes: Sequence[np.ndarray], grid: np.ndarray) -> np.ndarray:
    """V of networks on the grid ``(d, n)`` of some axes, shape ``(n,)``.

    With one hidden layer ``V^NN = Σ_k v_k tanh z_k`` and ``tanh z = 1 - 2/(1 + e^{2z})``. As z is a sum over
    states, ``e^{2z}`` is a product of what is worked out along each axis alone.
    """
    if not isinstance(networks, TrainedNetworks) or len(networks.potential) != 2:
        return networks.potential_at(grid.T)
    (weights, biases), (outer, shift) = networks.potential
    scaled = (grid.T - networks.mean) / networks.scale
    most = LARGEST_EXPONENT / (len(axes) + 1)
    *others, last = [
        np.exp(np.clip(2 * (axis[:, None] - mean) / scale * row, -most, most))
        for axis, mean, scale, row in zip(axes, networks.mean[0], networks.scale[0], weights, strict=True)
    ]
    rows, values, terms = np.exp(2 * biases), [], np.empty_like(last)
    for factor in others:
        rows = (rows[:, None] * factor).reshape(-1, factor.shape[1])
    for row in rows:
        np.multiply(last, row, out=terms)
        terms += 1
        values.append(np.reciprocal(terms, out=terms) @ outer[:, 0])
    potential = outer.sum() + shift[0, 0] - 2 * np.concatenate(values) + (scaled**2).sum(axis=1)
    return np.asarray(networks.potential_scale[0, 0] * potential, dtype=float)


def save_networks(path: str | Path, runs: Sequence[AnyNetworks]) -> None:
    """Write the networks of one or more runs, whole or not at all."""
    parts = [one.parts if isinstance(one, NetworksByWell) else (one,) for one in runs]
    arrays = pack([part for of_run in parts for part in of_run])
    arrays["parts"] = np.array([len(of_run) for of_run in parts])
    for number, one in enumerate(runs):
        if isinstance(one, NetworksByWell):
            arrays |= {f"{name}{number}": getattr(one, name) for name in _OF_WELLS}
    write_archive(path, arrays)


_OF_WELLS = ("heights", "levels", "states", "attractor_of")


def load_networks(path: str | Path, *, run: int = 0) -> AnyNetworks:
    """Read the networks of one of the runs that `save_networks` wrote.

    Raises
    ------
    InputError
        When the file is missing or is no such archive.
    """
    arrays = read_archive(path)
    try:
        counts = arrays["parts"]
        first = int(counts[:run].sum())
        parts = tuple(unpack(arrays, first + part) for part in range(int(counts[run])))
        if f"heights{run}" not in arrays:
            return parts[0]
        return NetworksByWell(parts, **{name: arrays[f"{name}{run}"] for name in _OF_WELLS})
    except (KeyError, IndexError, ValueError, TypeError):
        raise InputError(path, "", "it is not an archive of networks", "make it again") from None


_NUMBERS = ("mean", "scale", "potential_scale", "circulatory_scale", "diffusion")


def pack(networks: Sequence[TrainedNetworks]) -> dict[str, np.ndarray]:
    """Arrays by name, each of which ends in the number of the networks."""
    arrays = {"count": np.array(len(networks))}
    for number, one in enumerate(networks):
        arrays |= {f"{name}_{number}": getattr(one, name) for name in _NUMBERS}
        for name in ("potential", "circulatory"):
            layers = getattr(one, name)
            arrays[f"{name}_{number}"] = np.array(len(layers))
            for index, (weights, biases) in enumerate(layers):
                arrays |= {
                    f"{name}_{number}_weights{index}": weights,
                    f"{name}_{number}_biases{index}": biases,
                }
    return arrays


def unpack(arrays: Mapping[str, np.ndarray], number: int) -> TrainedNetworks:
    """One of the networks that `pack` put side by side."""

    def layers(name: str) -> tuple[Layer, ...]:
        stem = f"{name}_{number}"
        return tuple(
            (arrays[f"{stem}_weights{index}"], arrays[f"{stem}_biases{index}"])
            for index in range(int(arrays[stem]))
        )

    numbers = {name: arrays[f"{name}_{number}"] for name in _NUMBERS}
    return TrainedNetworks(potential=layers("potential"), circulatory=layers("circulatory"), **numbers)


def write_archive(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a NumPy archive of plain arrays, never pickles, whole or not at all."""
    with whole_file(path) as partial, partial.open("wb") as file:  # given a name, savez would add .npz
        np.savez(file, allow_pickle=False, **arrays)


def read_archive(path: str | Path) -> dict[str, np.ndarray]:
    """Read such an archive, or refuse the file with an `InputError`."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile):
        raise InputError(path, "", "it is not an archive of networks", "make it again") from None
