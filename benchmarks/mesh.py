"""How fast the error of V on a mesh falls with the number of nodes, and how long it takes.

    .venv/bin/python benchmarks/mesh.py

Prints for systems with known V the error as a share of the highest V reached (rms and largest), the order
between one mesh and the next, and seconds; for the method as it is here and as published, each with its own
reach. ``V = (x² - 1)²/2 + y²/2`` with ``|g| = rotation |∇V|``, about the attractor (-1, 0).
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import time

import numpy as np

from siq.systems.diffusion import Diffusion
from siq.validation.mesh import _MeshQuasipotential, mesh_quasipotential

BOX = np.array([[-2.0, 0.0], [-1.0, 1.0]])
COUNTS = (64, 128, 256, 512)
ROTATIONS = (0.0, 1.0, 3.0, 10.0)


def potential(x: np.ndarray) -> np.ndarray:
    """V at points, ``(..., 2)`` to ``(...,)``."""
    return (x[..., 0] ** 2 - 1) ** 2 / 2 + x[..., 1] ** 2 / 2


def solve(rotation: float, count: int, *, as_published: bool) -> _MeshQuasipotential:
    """V on a mesh of `count` widths each way."""

    def field(x: np.ndarray) -> np.ndarray:
        slope = np.stack([2 * x[:, 0] * (x[:, 0] ** 2 - 1), x[:, 1]], axis=1)
        return -slope + rotation * slope[:, ::-1] * [-1, 1]

    return mesh_quasipotential(
        field,
        np.array([-1.0, 0.0]),
        hessian=np.diag([4.0, 1.0]),
        box=BOX,
        shape=(count + 1, count + 1),
        diffusion=Diffusion.identity(2),
        as_published=as_published,
    )


def main() -> None:
    """Measure and print."""
    solve(1.0, 32, as_published=False)  # compiles
    for as_published in (False, True):
        for rotation in ROTATIONS:
            print(f"{'as published' if as_published else 'as here'}, rotation {rotation:g}")
            before = np.nan
            for count in COUNTS:
                began = time.perf_counter()
                mesh = solve(rotation, count, as_published=as_published)
                took = time.perf_counter() - began
                x = np.stack(np.meshgrid(*mesh.axes, indexing="ij"), axis=-1)
                known = np.isfinite(mesh.values)
                error = (mesh.values[known] - potential(x[known])) / mesh.level
                size = np.sqrt(np.mean(error**2))
                print(
                    f"  N = {count:4d}  reach {mesh.reach:2d}  rms {size:.1e}  largest "
                    f"{np.abs(error).max():.1e}  order {np.log2(before / size):5.2f}  {took:6.2f} s"
                )
                before = size


if __name__ == "__main__":
    main()
