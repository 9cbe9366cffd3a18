"""The networks of one run after training: evaluated with numpy alone, stored as plain arrays.

What comes after training needs V_θ, g and f at points and no gradient by a weight, so that it does without
torch, which takes longer to import than such an evaluation does to run.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from siq.errors import InputError
from siq.numerics.files import whole_file

Layer = tuple[np.ndarray, np.ndarray]
"""Weights, shape ``(inputs, outputs)``, and biases, shape ``(1, outputs)``."""


@dataclass(frozen=True)
class PointValues:
    """The decomposition at points: V ``(n,)``, g and f ``(n, d)``."""

    potential: np.ndarray
    circulatory: np.ndarray
    vector_field: np.ndarray


@dataclass(frozen=True)
class TrainedNetworks:
    """An orthogonal decomposition ``f = -D∇V + g`` given by two tanh networks.

    Not to be confused with `siq.networks.networks.Networks`, the tensors of several runs that
    training changes; this is one run of them, at rest.

    Attributes
    ----------
    potential
        Layers of V^NN, from d inputs to one output.
    circulatory
        Layers of g^NN, from d inputs to d outputs.
    mean, scale
        μ and σ of ``y = (x - μ)/σ``, shape ``(1, d)``, in the units of the states.
    potential_scale, circulatory_scale
        η_v and η_g, shape ``(1, 1)``.
    diffusion
        D, shape ``(d, d)``.
    """

    potential: tuple[Layer, ...]
    circulatory: tuple[Layer, ...]
    mean: np.ndarray
    scale: np.ndarray
    potential_scale: np.ndarray
    circulatory_scale: np.ndarray
    diffusion: np.ndarray

    def evaluate(self, x: np.ndarray, *, chunk: int = 50_000) -> PointValues:
        """Evaluate V, g and f.

        Parameters
        ----------
        x
            Points, shape ``(n, d)``, in the units of the states.
        chunk
            Points evaluated together, which bounds the memory.
        """
        pieces = [self._evaluate(x[begin : begin + chunk]) for begin in range(0, len(x), chunk)]
        potential, circulatory, vector_field = zip(*pieces or [self._evaluate(x)], strict=True)
        return PointValues(
            np.concatenate(potential), np.concatenate(circulatory), np.concatenate(vector_field)
        )

    def _evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        y = (x.astype(self.mean.dtype) - self.mean) / self.scale
        value, gradient = _value_and_gradient(self.potential, y)
        potential = self.potential_scale * (value + (y * y).sum(axis=1, keepdims=True))
        gradient = self.potential_scale / self.scale * (gradient + 2 * y)
        circulatory = self.circulatory_scale * _hidden(self.circulatory, y)[-1]
        values = (potential[:, 0], circulatory, circulatory - gradient @ self.diffusion)
        return tuple(np.asarray(array, dtype=float) for array in values)  # type: ignore[return-value]


def shuffled(networks: TrainedNetworks, *, generator: np.random.Generator) -> TrainedNetworks:
    """The same weights in random order: a network that knows nothing, for comparison."""

    def layers(source: tuple[Layer, ...]) -> tuple[Layer, ...]:
        return tuple(
            (_shuffle(weights, generator), _shuffle(biases, generator)) for weights, biases in source
        )

    return replace(networks, potential=layers(networks.potential), circulatory=layers(networks.circulatory))


def _shuffle(array: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return array.ravel()[generator.permutation(array.size)].reshape(array.shape)


def _hidden(layers: tuple[Layer, ...], y: np.ndarray) -> list[np.ndarray]:
    """Activations of the hidden layers, and the output behind them."""
    found = []
    for weights, biases in layers[:-1]:
        y = np.tanh(y @ weights + biases)
        found.append(y)
    weights, biases = layers[-1]
    return [*found, y @ weights + biases]


def _value_and_gradient(layers: tuple[Layer, ...], y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value of a scalar tanh network and its gradient, backwards through the layers."""
    *hidden, value = _hidden(layers, y)
    delta = layers[-1][0].T
    for (weights, _), activation in zip(reversed(layers[:-1]), reversed(hidden), strict=True):
        delta = (delta * (1 - activation * activation)) @ weights.T
    return value, delta


def save_networks(path: str | Path, runs: Sequence[TrainedNetworks]) -> None:
    """Write the networks of one or more runs, whole or not at all."""
    write_archive(path, pack(runs))


def load_networks(path: str | Path, *, run: int = 0) -> TrainedNetworks:
    """Read the networks of one of the runs that `save_networks` wrote.

    Raises
    ------
    InputError
        When the file is missing or is no such archive.
    """
    arrays = read_archive(path)
    try:
        return unpack(arrays, run)
    except (KeyError, IndexError, ValueError, TypeError):
        raise InputError(path, "", "it is not an archive of networks", "make it again") from None


def pack(runs: Sequence[TrainedNetworks]) -> dict[str, np.ndarray]:
    """Arrays by name, with a leading axis of runs in all but D, which runs share."""
    first = runs[0]
    arrays = {
        "sizes": np.array(json.dumps([len(first.potential), len(first.circulatory)])),
        "diffusion": first.diffusion,
    }
    for name in ("mean", "scale", "potential_scale", "circulatory_scale"):
        arrays[name] = np.stack([getattr(one, name) for one in runs])
    for name in ("potential", "circulatory"):
        for index in range(len(getattr(first, name))):
            weights, biases = zip(*(getattr(one, name)[index] for one in runs), strict=True)
            arrays[f"{name}_weights{index}"] = np.stack(weights)
            arrays[f"{name}_biases{index}"] = np.stack(biases)
    return arrays


def unpack(arrays: dict[str, np.ndarray], run: int) -> TrainedNetworks:
    """One of the runs that `pack` put side by side."""
    potential, circulatory = json.loads(str(arrays["sizes"]))

    def layers(name: str, count: int) -> tuple[Layer, ...]:
        return tuple(
            (arrays[f"{name}_weights{index}"][run], arrays[f"{name}_biases{index}"][run])
            for index in range(count)
        )

    own = {field.name for field in fields(TrainedNetworks)} - {"potential", "circulatory", "diffusion"}
    return TrainedNetworks(
        potential=layers("potential", potential),
        circulatory=layers("circulatory", circulatory),
        diffusion=arrays["diffusion"],
        **{name: arrays[name][run] for name in own},
    )


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
