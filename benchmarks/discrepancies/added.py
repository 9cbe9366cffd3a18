"""What can a method add to the equations of a card? Functions of states and inputs, as data in a file."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

Numbers = list[float]
Rows = list[list[float]]


class _Added(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Polynomial(_Added):
    """A sum of products of powers in some equations.

    Attributes
    ----------
    exponents
        Of each product, by states and inputs; shape ``(L, d + i)``.
    coefficients
        Shape ``(d, L)``.
    """

    kind: Literal["polynomial"] = "polynomial"
    exponents: list[list[int]]
    coefficients: Rows

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """What is added at states ``(d, n)`` and inputs ``(i, n)``; shape ``(d, n)``."""
        if not self.exponents:
            return np.zeros_like(x)
        return np.array(self.coefficients) @ products(np.array(self.exponents), np.concatenate([x, u]))


class Network(_Added):
    """A tanh network of scaled states and inputs.

    Attributes
    ----------
    weights, biases
        Of every layer.
    middle, width
        By which states and inputs are scaled, shape ``(d + i,)``.
    size
        By which outputs are multiplied, shape ``(d,)``; zero for equations that it stays out of.
    """

    kind: Literal["network"] = "network"
    weights: list[Rows]
    biases: list[Numbers]
    middle: Numbers
    width: Numbers
    size: Numbers

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """What is added at states ``(d, n)`` and inputs ``(i, n)``; shape ``(d, n)``."""
        z = scaled(np.concatenate([x, u]), self.middle, self.width)
        for place, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            z = np.array(weight) @ z + np.array(bias)[:, None]
            z = np.tanh(z) if place + 1 < len(self.weights) else z
        return np.array(self.size)[:, None] * z


class Kernel(_Added):
    """The mean of a Gaussian process in one equation: squared exponentials about the points it has seen.

    Attributes
    ----------
    equation
        Place of the equation.
    points
        In scaled states and inputs, shape ``(n, d + i)``.
    weights
        Shape ``(n,)``.
    lengths
        Of each scaled state and input, shape ``(d + i,)``.
    """

    equation: int
    points: Rows
    weights: Numbers
    lengths: Numbers


class Process(_Added):
    """Means of Gaussian processes.

    Attributes
    ----------
    kernels
        One for each equation that has one.
    middle, width
        By which states and inputs are scaled, shape ``(d + i,)``.
    """

    kind: Literal["process"] = "process"
    kernels: list[Kernel]
    middle: Numbers
    width: Numbers

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """What is added at states ``(d, n)`` and inputs ``(i, n)``; shape ``(d, n)``."""
        z = scaled(np.concatenate([x, u]), self.middle, self.width)
        result = np.zeros_like(x)
        for one in self.kernels:
            lengths = np.array(one.lengths)[:, None]
            here, there = z / lengths, np.array(one.points).T / lengths
            square = (here**2).sum(axis=0)[:, None] + (there**2).sum(axis=0) - 2 * here.T @ there
            result[one.equation] = np.exp(-np.maximum(square, 0) / 2) @ np.array(one.weights)
        return result


Added = Annotated[Polynomial | Network | Process, Field(discriminator="kind")]


def products(exponents: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Products of powers, ``(L, n)``, of coordinates ``(c, n)`` by exponents ``(L, c)``."""
    with np.errstate(all="ignore"):  # a simulation may run away
        return np.stack([np.prod(z ** powers[:, None], axis=0) for powers in exponents])


def scaled(z: np.ndarray, middle: Numbers | np.ndarray, width: Numbers | np.ndarray) -> np.ndarray:
    """Coordinates ``(c, n)`` about their middle, in units of their width."""
    return (z - np.array(middle)[:, None]) / np.array(width)[:, None]
