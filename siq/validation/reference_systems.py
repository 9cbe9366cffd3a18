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

from collections.abc import Mapping, Sequence
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
    systems = yaml.safe_load(Path(__file__).with_name("reference_systems.yaml").read_text(encoding="utf-8"))
    return {name: _system(name, **known) for name, known in systems.items()}


def _system(
    name: str, *, about: str, source: str, states: Mapping[str, Sequence[float]], equations: Sequence[str],
    diffusion: Sequence[Sequence[float | str]] | None = None, quasipotential: str | None = None,
    ways: Sequence[Mapping[str, Sequence[float]]] = (), barriers: Sequence[Mapping[str, Any]] = (),
) -> _ReferenceSystem:  # fmt: skip
    """A system as the file has it: states with their domains, formulas, and barriers where they are known."""
    symbols = {state: symbol(state) for state in states}
    dynamics = Dynamics.of(
        tuple(symbols.values()), [parse_formula(each, symbols) for each in equations],
        diffusion=diffusion and [
            [parse_formula(entry, symbols) if isinstance(entry, str) else entry for entry in row]
            for row in diffusion
        ],
        domain=list(states.values()),
    )  # fmt: skip
    known = []
    for each in barriers:
        start, saddle, end = (np.array(each[place], dtype=float) for place in ("start", "saddle", "end"))
        value = each["value"]
        error, how = each.get("error", 1e-9 * max(value, 1.0)), each.get("how", TWO_METHODS)
        known.append(_KnownBarrier(start, saddle, end, value, error, np.nan, how))
    if quasipotential is None:
        return _ReferenceSystem(name, about, source, dynamics, None, tuple(known))
    exact = parse_formula(quasipotential, symbols)
    known += _exact_barriers(dynamics, exact, ways)
    return _ReferenceSystem(name, about, source, dynamics, exact, tuple(known))


def _exact_barriers(
    dynamics: Dynamics, quasipotential: sympy.Expr, ways: Sequence[Mapping[str, Sequence[float]]]
) -> list[_KnownBarrier]:
    """Barriers where U is a formula; ways say about where attractor, saddle and next attractor are."""
    symbols, noise, barriers = dynamics.symbols, dynamics.diffusion, []
    second = compile_formulas([quasipotential.diff(a, b) for a in symbols for b in symbols], symbols)
    divergence_free = False
    if noise.constant:  # of g = f + ½D∇U
        slope = sympy.Matrix([quasipotential.diff(each) for each in symbols])
        circulation = sympy.Matrix(dynamics.formulas) + sympy.Matrix(noise.matrix) * slope / 2
        parts = (g.diff(each) for g, each in zip(circulation, symbols, strict=True))
        divergence_free = bool(sympy.nsimplify(sympy.expand(sum(parts, sympy.S.Zero)), rational=True) == 0)
    for way in ways:
        start, saddle, end = (
            scipy.optimize.root(
                lambda x: dynamics.drift(x[None])[0], np.array(place, dtype=float),
                jac=lambda x: dynamics.jacobian(x[None])[0], tol=1e-14,
            ).x
            for place in (way["start"], way["saddle"], way["end"])
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
    return barriers


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
            at = lower + (upper - lower) * scipy.stats.qmc.Halton(len(lower), scramble=False).random(points)
            values = compile_formulas([each.quasipotential], each.dynamics.symbols)(at.T)[0]
            rows += [
                own | {"quantity": "U", "at": list(x), "value": value, "error": 0.0, "how": "exact"}
                for x, value in zip(at, values, strict=True)
            ]
        for barrier in each.barriers:
            way: dict[str, Any] = {
                "at": list(barrier.start), "by": list(barrier.saddle), "to": list(barrier.end),
            }  # fmt: skip
            way["how"] = barrier.how
            rows.append(own | way | {"quantity": "barrier", "value": barrier.value, "error": barrier.error})
            if np.isfinite(barrier.prefactor):
                rows.append(own | way | {"quantity": "prefactor", "value": barrier.prefactor, "error": 0.0})
    columns = ["system", "states", "quantity", "at", "by", "to", "value", "error", "how"]
    return pd.DataFrame(rows, columns=columns)
