"""Drift and noise of a record by StochasticForceInference, in an environment of its own.

    PYTHON fit_by_sfi.py RECORD.npz ANSWER.json

PYTHON has ``pip install StochasticForceInference``, which brings jax, and nothing of `siq` is imported. It is
used as its introduction says for noisy recordings: the parametric estimator, terms chosen by PASTIS, then the
noise as a function of the state. Its D is half of our q.
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path

import numpy as np
from SFI import OverdampedLangevinInference, TrajectoryCollection
from SFI.bases import monomials_up_to

POINTS = 2000  # at which its polynomials are read off


def powers(degree: int, dimension: int) -> np.ndarray:
    """Exponents of all monomials up to a degree."""
    every = itertools.product(range(degree + 1), repeat=dimension)
    return np.array([each for each in every if sum(each) <= degree])


def read_off(values: np.ndarray, points: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Coefficients of a polynomial, of its values at points: exact."""
    unit = np.abs(points).max(axis=0)
    terms = np.prod((points / unit)[:, None, :] ** exponents, axis=2)
    found = np.linalg.lstsq(terms, values, rcond=None)[0]
    return found / np.prod(unit**exponents, axis=1)[:, None]


def main() -> None:
    """One record."""
    record, answer = sys.argv[1:]
    with np.load(record) as data:
        seen, step = data["seen"], float(data["step"])
        degree, noise_degree = int(data["degree"]), int(data["noise_degree"])
    dimension = seen.shape[2]
    scale = seen.std(axis=(0, 1))
    trajectories = np.transpose(seen / scale, (1, 0, 2))
    found = OverdampedLangevinInference(TrajectoryCollection.from_arrays(X=trajectories, dt=step))
    found.compute_diffusion_constant()
    found.infer_force(monomials_up_to(order=degree, dim=dimension, rank="vector"))
    found.sparsify_force(criterion="PASTIS")
    rank = "identity_matrix" if dimension > 1 else "symmetric_matrix"
    found.infer_diffusion(monomials_up_to(order=noise_degree, dim=dimension, rank=rank))
    flat = (seen / scale).reshape(-1, dimension)
    points = flat[np.random.default_rng(0).choice(len(flat), POINTS)]
    force = np.asarray(found.force_inferred(points)).reshape(POINTS, dimension)
    noise = np.asarray(found.diffusion_inferred(points)).reshape(POINTS, dimension, dimension)
    exponents, noise_exponents = powers(degree, dimension), powers(noise_degree, dimension)
    own = np.stack([noise[:, place, place] * scale[place] ** 2 for place in range(dimension)], axis=1)
    Path(answer).write_text(
        json.dumps(
            {
                "drift": read_off(force * scale, points * scale, exponents).tolist(),
                "intensity": read_off(2 * own, points * scale, noise_exponents).tolist(),
            }
        ),
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
