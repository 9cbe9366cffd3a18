"""Reference systems whose quasipotential is known, and how well.

The two are Newton's method on the geometric action of a chain of points (`siq.quasipotential.paths`), and
collocation of Hamilton's equations (`siq.quasipotential.hamiltonian_paths`). The error is their difference,
or one in the last figure given.

The noise is ``dX = f dt + √ε σ dW`` in the sense of Itô, with ``D = σσᵀ``; U is the quasipotential, so that
states are found with a density that goes as ``exp(-U/ε)`` and are left after times that go as ``exp(ΔU/ε)``.
U solves ``f·∇U + ½ ∇U·D∇U = 0``. Other texts have ``√(2ε) dW``: their ε is half of this one, and their V is
U/2.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.optimize
import scipy.stats.qmc
import sympy
import yaml

from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_formulas, parse_formula

TWO_METHODS = "least action of a chain of points, and Hamilton's equations"


@dataclass(frozen=True, eq=False)
class _KnownBarrier:
    """How high U rises between two attractors, and how long it takes to leave the first."""

    start: np.ndarray  #: the attractor, shape (d,)
    saddle: np.ndarray  #: the pass
    end: np.ndarray  #: the attractor behind it
    value: float  #: ΔU = U(saddle) - U(start)
    error: float  #: by how much it may be wrong
    prefactor: float  #: of the law E[τ] = prefactor · exp(ΔU/ε) for small ε; NaN where it is not known
    how: str  #: how it is known


X, Y, Z, V = sympy.symbols("x y z v", real=True)


@dataclass(frozen=True)
class _ReferenceSystem:
    """A system, and what is known of its landscape."""

    name: str
    about: str  #: in a sentence
    source: str  #: where it comes from
    dynamics: Dynamics  #: f, D and the domain
    quasipotential: sympy.Expr | None  #: U in the whole domain, up to a constant; None where it is unknown
    barriers: tuple[_KnownBarrier, ...]  #: between attractors, known exactly or by two methods


def reference_systems() -> dict[str, _ReferenceSystem]:
    """Every system whose landscape is known exactly, or was computed by two methods, by name.

    Returns
    -------
    dict
        New objects at every call.

    Examples
    --------
    >>> import siq
    >>> systems = siq.reference_systems()
    >>> systems["maier-stein"].quasipotential
    x**4/2 - x**2 + y**2*(x**2 + 1) + 1/2
    >>> systems["maier-stein"].barriers[0].value
    0.5
    """
    half, tenth, nothing = sympy.Rational(1, 2), sympy.Rational(1, 10), sympy.S.Zero
    over_and_back = ((-1,), (0,), (1,)), ((1,), (0,), (-1,))
    hessian = sympy.Matrix([[2, 1], [1, 3]]) / 2
    noise, turning = sympy.Matrix([[2, half], [half, 1]]), sympy.Matrix([[0, -3], [3, 0]])
    plane = sympy.Matrix([X, Y])
    archetype = (X**2 - 1) ** 2 + Y**2 + Z**2
    slope = [archetype.diff(each) / 2 for each in (X, Y, Z)]
    east, north = X - 4, Y - 5
    inside = 1 - east**2 - north**2
    place, friction = (X**2 - 1) ** 2 / 4 - X / 10, half
    units = sympy.symbols("x:10", real=True)
    wells = sum(((s**2 - 1) ** 2 / 4 for s in units), nothing)
    wells += sum((half * (a - b) ** 2 for a, b in itertools.pairwise(units)), nothing)
    falls = [0, *(wells.diff(s) for s in units), 0]
    systems = [
        _exact(
            "linear",
            "A linear system that turns, with a full D.",
            "Lyapunov's equation",
            Dynamics.of(
                (X, Y),
                tuple(map(sympy.expand, (turning - noise) * hessian * plane)),
                diffusion=np.array(noise.tolist(), dtype=float),
                domain=[(-2, 2)] * 2,
            ),
            sympy.expand((plane.T * hessian * plane)[0]),
        ),
        _exact(
            "double-well",
            "A tilted double well of one state.",
            "Kramers, Physica 7, 284 (1940)",
            Dynamics.of((X,), (X - X**3 + tenth,), domain=[(-2, 2)]),
            (X**2 - 1) ** 2 / 2 - X / 5,
            over_and_back,
        ),
        _exact(
            "growing-noise",
            "A double well whose noise grows with the state.",
            "U' = -2f/D",
            Dynamics.of((X,), (X - X**3,), diffusion=[[1 + X**2]], domain=[(-2, 2)]),
            X**2 - 2 * sympy.log(1 + X**2),
            over_and_back[:1],
        ),
        _exact(
            "archetype",
            "Two wells of three states with a circulation.",
            "the archetype of the paper that siq implements",
            Dynamics.of(
                (X, Y, Z),
                tuple(map(sympy.expand, (-sum(slope, nothing), slope[0] - slope[1], slope[0] - slope[2]))),
                domain=[(-2, 2), (-1.5, 1.5), (-1.5, 1.5)],
            ),
            archetype,
            (((-1, 0, 0), (0, 0, 0), (1, 0, 0)),),
        ),
        _exact(
            "maier-stein",
            "Maier and Stein's system with β = 1, where its drift has a potential.",
            "Maier and Stein, Phys. Rev. Lett. 71, 1783 (1993)",
            Dynamics.of((X, Y), (X - X**3 - X * Y**2, -(1 + X**2) * Y), domain=[(-2, 2), (-1, 1)]),
            X**4 / 2 - X**2 + (1 + X**2) * Y**2 + half,
            (((-1, 0), (0, 0), (1, 0)),),
        ),
        _exact(
            "cycle",
            "A stable limit cycle about an unstable point.",
            "the second example of Moore et al., The R Journal 8, 19 (2016)",
            Dynamics.of(
                (X, Y),
                (tenth * 2 * east * inside - north, tenth * 2 * north * inside + east),
                domain=[(2, 6), (3, 7)],
            ),
            tenth * inside**2,
        ),
        _exact(
            "chain",
            "Ten bistable units in a row that turn about each other: f = (A - 1)∇Φ, U = 2Φ.",
            "any f = (A - 1)∇Φ with A constant and antisymmetric",
            Dynamics.of(
                units,
                [sympy.expand(falls[k + 1] - falls[k] - falls[k - 1]) for k in range(1, 11)],
                domain=[(-2, 2)] * 10,
            ),
            2 * wells,
        ),
        _exact(
            "particle",
            "A damped particle in a tilted double well, with noise on its velocity alone.",
            "Kramers, Physica 7, 284 (1940)",
            Dynamics.of(
                (X, V),
                (V, sympy.expand(-place.diff(X) - friction * V)),
                diffusion=[[0, 0], [0, 1]],
                domain=[(-2, 2)] * 2,
            ),
            2 * friction * (V**2 / 2 + place),
            tuple(tuple((*each, 0) for each in way) for way in over_and_back),
        ),
        _point_and_cycle(),
        *_computed_twice(),
    ]
    return {each.name: each for each in systems}


def _exact(
    name: str,
    about: str,
    source: str,
    dynamics: Dynamics,
    quasipotential: sympy.Expr,
    ways: Sequence[Sequence[Sequence[float]]] = (),
) -> _ReferenceSystem:
    """A system whose U is a formula; ways are attractor, saddle and the attractor behind it, about where."""
    symbols, noise, barriers = dynamics.symbols, dynamics.diffusion, []
    second = compile_formulas([quasipotential.diff(a, b) for a in symbols for b in symbols], symbols)
    divergence_free = False
    if noise.constant:  # of g = f + ½D∇U
        slope = sympy.Matrix([quasipotential.diff(each) for each in symbols])
        circulation = sympy.Matrix(dynamics.formulas) + sympy.Matrix(noise.matrix) * slope / 2
        parts = (g.diff(each) for g, each in zip(circulation, symbols, strict=True))
        divergence = sympy.expand(sum(parts, sympy.S.Zero))
        divergence_free = bool(sympy.nsimplify(divergence, rational=True) == 0)
    for way in ways:
        start, saddle, end = (
            scipy.optimize.root(
                lambda x: dynamics.drift(x[None])[0], np.array(place, dtype=float),
                jac=lambda x: dynamics.jacobian(x[None])[0], tol=1e-14,
            ).x
            for place in way
        )  # fmt: skip
        # The law of Eyring and Kramers, (2π/λ) √(|det H_S| / det H_A) with the unstable eigenvalue λ at the
        # saddle and the Hessians of U, where g has no divergence; in one state with D(x), times D_S/D_A
        # (Bouchet and Reygner, Annales Henri Poincaré 17, 3499 (2016)).
        places = np.stack([start, saddle])
        levels = compile_formulas([quasipotential], symbols)(places.T)[0]
        bottom, top = np.abs(np.linalg.det(second(places.T).T.reshape(2, len(symbols), len(symbols))))
        unstable = float(np.linalg.eigvals(dynamics.jacobian(saddle[None])[0]).real.max())
        share = 1.0 if divergence_free else np.nan
        if len(symbols) == 1:
            share = noise.at(places)[1, 0, 0] / noise.at(places)[0, 0, 0]
        prefactor = float(2 * np.pi / unstable * np.sqrt(top / bottom) * share)
        barriers.append(
            _KnownBarrier(start, saddle, end, float(levels[1] - levels[0]), 0.0, prefactor, "exact")
        )
    return _ReferenceSystem(name, about, source, dynamics, quasipotential, tuple(barriers))


def _computed_twice() -> Iterator[_ReferenceSystem]:
    """Systems without a known formula of U, of which two methods give the barriers."""
    path = Path(__file__).with_name("reference_systems.yaml")
    for name, known in yaml.safe_load(path.read_text(encoding="utf-8")).items():
        symbols, barriers = {state: symbol(state) for state in known["states"]}, []
        for each in known["barriers"]:
            start, saddle, end = (np.array(each[place], dtype=float) for place in ("start", "saddle", "end"))
            value, error = each["value"], 1e-9 * max(each["value"], 1.0)
            barriers.append(_KnownBarrier(start, saddle, end, value, error, np.nan, TWO_METHODS))
        dynamics = Dynamics.of(
            tuple(symbols.values()), [parse_formula(each, symbols) for each in known["equations"]],
            diffusion=known.get("diffusion"), domain=list(known["states"].values()),
        )  # fmt: skip
        yield _ReferenceSystem(name, known["about"], known["source"], dynamics, None, tuple(barriers))


def _point_and_cycle() -> _ReferenceSystem:
    """Rings about a stable point: V' = r(r² - a²)(r² - b²) with a turn."""
    inner, outer, turns = sympy.Rational(1, 4), sympy.S.One, 2
    square = X**2 + Y**2
    half = square**3 / 6 - (inner + outer) * square**2 / 4 + inner * outer * square / 2
    field = (-half.diff(X) - turns * Y, -half.diff(Y) + turns * X)
    dynamics = Dynamics.of((X, Y), tuple(map(sympy.expand, field)), domain=[(-1.5, 1.5)] * 2)
    value = float(2 * half.subs({X: sympy.Rational(1, 2), Y: 0}))
    beyond = value - float(2 * half.subs({X: 1, Y: 0}))
    origin, edge, circle = np.zeros(2), np.array([0.5, 0.0]), np.array([1.0, 0.0])
    how = "exact; any point of the circles"
    barriers = (
        _KnownBarrier(origin, edge, circle, value, 0.0, np.nan, how),
        _KnownBarrier(circle, edge, origin, beyond, 0.0, np.nan, how),
    )
    return _ReferenceSystem(
        "point-and-cycle", "A stable point within a stable limit cycle, and an unstable cycle between them.",
        "V' = r(r² - a²)(r² - b²) with a turn", dynamics, 2 * half, barriers,
    )  # fmt: skip


def reference_table(*, points: int = 100) -> pd.DataFrame:
    """Known values of the reference systems, as a table that other codes can read.

    Parameters
    ----------
    points
        In the domain of each system whose U is a formula.

    Returns
    -------
    pandas.DataFrame
        A row for every number: ``system``; ``quantity`` (``U``, ``barrier``, ``prefactor``); ``at``, the
        state, or the attractor that is left; ``by`` and ``to``, the saddle and the attractor behind it;
        ``value``, ``error`` and ``how``. States are lists, in the order of ``states``.

    Examples
    --------
    >>> import siq
    >>> table = siq.reference_table()
    >>> table.to_parquet("references.parquet")  # doctest: +SKIP
    """
    rows: list[dict[str, Any]] = []
    for each in reference_systems().values():
        own: dict[str, Any] = {"system": each.name, "states": list(each.dynamics.states)}
        own |= {"by": None, "to": None}
        if each.quasipotential is not None:
            lower, upper = each.dynamics.box.T
            drawn = scipy.stats.qmc.Halton(len(lower), scramble=False).random(points)
            at = lower + (upper - lower) * drawn
            values = compile_formulas([each.quasipotential], each.dynamics.symbols)(at.T)[0]
            rows += [
                own | {"quantity": "U", "at": list(x), "value": value, "error": 0.0, "how": "exact"}
                for x, value in zip(at, values, strict=True)
            ]
        for barrier in each.barriers:
            way: dict[str, Any] = {
                "at": list(barrier.start),
                "by": list(barrier.saddle),
                "to": list(barrier.end),
            }
            way["how"] = barrier.how
            rows.append(own | way | {"quantity": "barrier", "value": barrier.value, "error": barrier.error})
            if np.isfinite(barrier.prefactor):
                rows.append(own | way | {"quantity": "prefactor", "value": barrier.prefactor, "error": 0.0})
    columns = ["system", "states", "quantity", "at", "by", "to", "value", "error", "how"]
    return pd.DataFrame(rows, columns=columns)
