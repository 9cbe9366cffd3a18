"""Saddles between attractors are found without being told, in many states too."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import sympy

from siq.numerics.integration import dormand_prince_step
from siq.quasipotential.landscape import Landscape
from siq.systems import basins
from siq.systems.basins import STEPS_PER_CHECK, _saddle_near, edge_saddle, follow
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify


def chain(
    count: int, *, coupling: float, turning: float = 0.5, tilt: float = 0.1
) -> tuple[Dynamics, sympy.Expr]:
    """``f = (A - 1)∇Φ`` of bistable units in a row, A antisymmetric between neighbours; and Φ."""
    x = sympy.symbols(f"x:{count}", real=True)
    alone = [(one**2 - 1) ** 2 / 4 + tilt * one for one in x]
    between = [coupling * (one - two) ** 2 / 2 for one, two in itertools.pairwise(x)]
    gradient = [
        sum(term.diff(one) for term in [alone[i], *between[max(i - 1, 0) : i + 1]]) for i, one in enumerate(x)
    ]
    equations = [
        -gradient[i]
        + (turning * gradient[i + 1] if i + 1 < count else 0)
        - (turning * gradient[i - 1] if i else 0)
        for i in range(count)
    ]
    domain = [(-1.6, 1.6)] * count
    return Dynamics.of(x, [sympy.expand(one) for one in equations], domain=domain), sum(alone) + sum(between)


def test_a_symmetric_start_does_not_end_at_a_top() -> None:
    """The straight way between both wells leads over the top in the middle; the passes lie beside it."""
    x, y = sympy.symbols("x y", real=True)
    system = Dynamics.of(
        (x, y), (x - x**3 - 2 * x * y**2, y - y**3 - 2 * x**2 * y), domain=[(-2, 2), (-2, 2)]
    )
    wells = [
        classify(system, np.array(place)) for place in ([-1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, -1.0])
    ]
    assert [one.kind for one in wells] == ["attractor"] * 4
    top = edge_saddle(system, 0, 1, wells, box=system.box, generator=np.random.default_rng(0))
    assert top is not None and top.unstable == 1 and np.abs(top.position) == pytest.approx([3**-0.5, 3**-0.5])


@pytest.mark.slow
def test_a_chain_of_ten_has_exact_barriers_and_prefactors() -> None:
    system, potential = chain(10, coupling=2.0)
    value = sympy.lambdify(system.symbols, potential)
    curvature = sympy.lambdify(system.symbols, sympy.hessian(potential, system.symbols))
    landscape = Landscape.from_equations(system)
    assert len(landscape.attractors) == 2 and all(well is None for well in landscape.wells)
    assert landscape.transitions and any("so many states" in note for note in landscape.notes)
    for way in landscape.transitions:
        start, top = landscape.attractors[way.start].position, way.saddle.position
        assert way.barrier == pytest.approx(2 * (value(*top) - value(*start)), rel=1e-6)
        determinants = [np.linalg.det(np.array(curvature(*place), dtype=float)) for place in (top, start)]
        rate = way.saddle.eigenvalues[0].real
        exact = 2 * np.pi / rate * np.sqrt(abs(determinants[0]) / determinants[1])
        assert way.rate is not None and way.rate.prefactor == pytest.approx(exact, rel=0.01)
        assert way.path is not None and way.path.residual < 1e-4


def test_a_front_that_crosses_a_long_chain_is_followed_until_it_has_arrived() -> None:
    system, _ = chain(24, coupling=2.0, tilt=0.03)
    low, _, high = np.sort(np.roots([1, 0, -1, 0.03]).real)
    attractors = [classify(system, np.full(24, value)) for value in (low, high)]
    front = np.where(np.arange(24) < 6, low, high)[None]
    box = system.box
    assert follow(system, front, attractors, box=box, states=2).ends[0] == -1  # still on its way
    assert follow(system, front, attractors, box=box, states=2, patience=24).ends[0] == 0


@pytest.mark.parametrize("centre", [11.5, 12.0])
def test_a_root_between_two_sites_leads_to_the_saddle_beside_it(centre: float) -> None:
    """A droplet in a long chain is a saddle between sites, and one with two unstable directions on a site."""
    system, _ = chain(24, coupling=2.0)
    low, _, high = np.sort(np.roots([1, 0, -1, 0.1]).real)
    droplet = high - 0.75 * (high - low) * np.exp(-(((np.arange(24) - centre) / 2.5) ** 2))
    found = _saddle_near(system, droplet, system.box)
    assert found is not None and found.kind == "saddle" and found.unstable == 1
    assert np.abs(system.drift(found.position[None])).max() < 1e-9


def test_what_rests_elsewhere_is_not_followed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stiff well beyond the attractors that are asked for: steps there stay short for ever."""
    x, y = sympy.symbols("x y", real=True)
    system = Dynamics.of([x, y], [x - x**3, -100 * y], domain=[(-1.6, 1.6)] * 2)
    wells = [classify(system, np.array([place, 0.0])) for place in (-1.0, 1.0)]
    starts = np.array([[-1e-3, 0.5], [1e-3, 0.5]])
    steps = []

    def counted(*given: Any) -> Any:
        steps.append(given)
        return dormand_prince_step(*given)

    monkeypatch.setattr(basins, "dormand_prince_step", counted)
    both = follow(system, starts, wells, box=system.box)
    needed = len(steps)
    one = follow(system, starts, wells[1:], box=system.box)
    assert (both.ends.tolist(), one.ends.tolist()) == ([0, 1], [-1, 0])
    assert len(steps) <= 2 * needed + 2 * STEPS_PER_CHECK
    assert one.paths[0, -1] == pytest.approx([-1, 0], abs=1e-4)
