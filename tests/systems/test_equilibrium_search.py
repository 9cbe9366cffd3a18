"""Equilibria of equations are all found, without any trajectory, and what is missed is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy

from siq.remarks import sentence
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import _boundary_degree, all_equilibria, distinct_roots
from siq.systems.phase_portrait import phase_portrait

X, Y = sympy.symbols("x y", real=True)
LATTICE = Dynamics.of((X, Y), (-sympy.sin(X), -sympy.sin(Y)), domain=[(-8, 8), (-8, 8)])


def found(system: Dynamics, seed: int = 0):
    return all_equilibria(system, generator=np.random.default_rng(seed))


def test_all_of_a_lattice_are_found() -> None:
    equilibria, remarks = found(LATTICE)
    kinds = [one.kind for one in equilibria]
    assert len(kinds) == 25 and kinds.count("attractor") == 9 and not remarks
    assert _boundary_degree(LATTICE, equilibria) == 1  # nine wells, four tops, twelve saddles


@pytest.mark.parametrize("apart", [1e-2, 1e-4])
def test_a_pair_that_is_about_to_meet_in_a_corner_is_found(apart: float) -> None:
    """A fold: a saddle and an attractor, as close as that, far from the third."""
    f = -(X + 1) * ((X - 0.9) ** 2 - apart**2)
    equilibria, _ = found(Dynamics.of((X, Y), (f, -Y), domain=[(-2, 2), (-30, 30)]))
    positions = sorted(one.position[0] for one in equilibria)
    assert positions == pytest.approx([-1, 0.9 - apart, 0.9 + apart], abs=1e-9)
    assert [one.kind for one in equilibria].count("attractor") == 2


def test_deflation_leads_from_a_known_root_to_others() -> None:
    box = np.array([[-2.0, 2.0], [-2.0, 2.0]])
    system = Dynamics.of((X, Y), (X - X**3, -Y), domain=box)
    starts = np.full((1, 2), 0.9) + np.random.default_rng(0).normal(scale=0.01, size=(20, 2))
    known = [np.array([1.0, 0.0])]
    others = distinct_roots(system, starts, box=box, margin=0.0, known=known)
    assert others and all(abs(one[0]) < 1 + 1e-9 and abs(one[0] - 1) > 0.5 for one in others)


def test_a_missed_root_is_noticed() -> None:
    equilibria, _ = found(LATTICE)
    assert _boundary_degree(LATTICE, equilibria) is not None
    one_state = Dynamics.of((X,), (X - X**3,), domain=[(-2, 2)])
    assert _boundary_degree(one_state, found(one_state)[0]) == -1


def test_a_root_outside_the_domain_is_none_of_it() -> None:
    system = Dynamics.of((X, Y), (X - X**3, -Y), domain=[(-2, 0.5), (-1, 1)])
    assert len(found(system)[0]) == 2


def test_a_degenerate_equilibrium_at_the_edge_takes_no_part_and_is_named() -> None:
    """Logistic growth whose extinct state is neither stable nor unstable to first order."""
    system = Dynamics.of((X, Y), (X**2 * (1 - X) * (2 - X), -Y), domain=[(0, 1.5), (-1, 1)])
    portrait = phase_portrait(system)
    assert portrait.fault() is None and len(portrait.harmless) == 1
    assert portrait.remarks[0].code == "systems.degenerate_equilibrium_without_part"
    between = Dynamics.of((X, Y), (-(X**3) * (X - 1) * (X + 1), -Y), domain=[(-1.5, 1.5), (-1, 1)])
    fault = phase_portrait(between).fault()  # here it parts two wells
    assert fault is not None and "neither stable nor unstable" in sentence(fault)


@pytest.mark.parametrize("size", [3.0, 40.0])
def test_a_well_that_is_small_in_its_domain_has_states_enough(size: float) -> None:
    box = np.array([[-size, size], [-size, size]])
    portrait = phase_portrait(replace(Dynamics.of((X, Y), (X - X**3, -Y)), domain=box))
    assert all(len(basin.chosen) > 1000 for basin in portrait.basins)
