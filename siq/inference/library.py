"""The candidate library: functions θ_k, their derivatives, and the constraints among coefficients.

V and g are written as ``Θ(x) Ξ_v`` and ``Θ(x) Ξ_g`` over one library. The derivative of a library function
is a combination of library functions, ``∂θ_j/∂x_i = Σ_k T_kij θ_k``, which turns ``f = -D∇V + g`` into the
linear constraint ``C Ξ = 0`` between coefficients (paper, Eqs. form_f and constraint). Functions need not
be monomials: whatever a study lists is taken in, together with the derivatives that it needs.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Literal

import numpy as np
import sympy
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import FAR, Recordings
from siq.errors import Fault, NumericalFailure
from siq.systems.cards import Limit
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol
from siq.systems.formulas import FormulaError, compile_formulas, exact_number, parse_formula


@dataclass(frozen=True)
class CandidateLibrary:
    """Functions in which f, V and g are sought."""

    #: Names of the d states; the same as symbols; and the q functions θ_k.
    states: tuple[str, ...]
    symbols: tuple[sympy.Symbol, ...]
    terms: tuple[sympy.Expr, ...]
    #: Shape ``(q,)``: which functions V, and g, may use. f may use all of them.
    in_potential: np.ndarray
    in_circulatory: np.ndarray
    #: T, shape ``(q, d, q)``: ``derivatives[k, i, j]`` is the coefficient of θ_k in ∂θ_j/∂x_i. Columns of
    #: functions that V may not use are zero.
    derivatives: np.ndarray
    #: States of which the functions are periodic: name, and the two ends of a period.
    angles: tuple[tuple[str, float, float], ...] = ()

    @staticmethod
    def functions(
        symbols: Sequence[sympy.Symbol], degree: int, angles: Sequence[tuple[str, float, float]] = ()
    ) -> list[tuple[int, sympy.Expr]]:
        """Monomials up to a total degree, each with its own; of an angle its harmonics."""
        waves = {name: exact_number(2 * np.pi / (high - low)) for name, low, high in angles}
        found = []
        for row in monomial_exponents(len(symbols), degree):
            parts = [
                [sympy.sin(power * waves[each.name] * each), sympy.cos(power * waves[each.name] * each)]
                if power and each.name in waves
                else [each**power]
                for each, power in zip(symbols, row, strict=True)
            ]
            found += [(sum(row), sympy.Mul(*several)) for several in itertools.product(*parts)]
        return found

    @property
    def size(self) -> int:
        """Number of functions, q."""
        return len(self.terms)

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.states)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The functions as text, such as ``x**2*y``; ``1`` for the constant."""
        return tuple(str(term) for term in self.terms)

    @cached_property
    def constant(self) -> int:
        """Index of the constant function."""
        return self.terms.index(sympy.S.One)

    @cached_property
    def _function(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(self.terms, self.symbols)

    def second_derivatives(self, places: Sequence[int]) -> list[list[sympy.Expr]]:
        """∂²θ_k/∂x_i∂x_j of some functions, k by k: i goes slowest, then j."""
        known = self._second_derivatives
        for k in set(places) - set(known):
            known[k] = [self.terms[k].diff(a, b) for a in self.symbols for b in self.symbols]
        return [known[k] for k in places]

    @cached_property
    def _second_derivatives(self) -> dict[int, list[sympy.Expr]]:
        return {}

    def downhill(self, diffusion: Diffusion) -> np.ndarray:
        """D∇V by the coefficients of V, shape ``(d, q, q)``: [i, k, j] is θ_k's share of (D∇θ_j)_i."""
        return np.asarray(np.einsum("il,klj->ikj", diffusion.matrix, self.derivatives))

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """Θ(x): points of shape ``(n, d)`` to values of shape ``(n, q)``."""
        return self._function(np.ascontiguousarray(x.T)).T

    def total_degree(self, place: int) -> int:
        """Total degree of one of the functions, by its place; 0 of one that is no polynomial."""
        term = self.terms[place]
        return int(term.as_poly(*self.symbols).total_degree()) if term.is_polynomial(*self.symbols) else 0

    def check_origin(self, x: np.ndarray, *, names: Sequence[str]) -> None:
        """Refuse states ``(n, d)`` whose origin is so far from them that their powers are all the same.

        Raises
        ------
        NumericalFailure
            Where errors of coefficients would be rounding. It says what to subtract, by the names that people
            use.
        """
        low, high = x.min(axis=0), x.max(axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        if not (np.abs(middle) > FAR * half).any():
            return
        if Recordings.told_apart(self.evaluate(x)):
            return
        worst = int(np.argmax(np.abs(middle) / np.where(half > 0, half, np.inf)))
        digits = int(np.floor(np.log10(half[worst])))
        raise NumericalFailure(
            f"{names[worst]} stays so far from zero, between {low[worst]:.6g} and {high[worst]:.6g}, that its"
            f" powers cannot be told apart; subtract {round(float(middle[worst]), -digits):.10g} from it"
        )

    def constraints(self, diffusion: Diffusion) -> np.ndarray:
        """C of ``C Ξ = 0``: the identity f = -D∇V + g, and the functions that V and g may not use.

        Shape ``(rows, (2d + 1) q)``, of full row rank. Ξ is flattened by target, in order f_1 … f_d, V,
        g_1 … g_d, with the library's order within each.
        """
        q, d = self.size, self.dimension
        targets = 2 * d + 1
        identity = np.zeros((d, q, targets, q))
        downhill = self.downhill(diffusion)
        for i in range(d):
            identity[i, :, i, :] = np.eye(q)
            identity[i, :, d, :] = downhill[i]
            identity[i, :, d + 1 + i, :] = -np.eye(q)
        absent = np.zeros((targets, q), dtype=bool)
        absent[d] = ~self.in_potential
        absent[d + 1 :] = ~self.in_circulatory
        return np.concatenate([identity.reshape(d * q, targets * q), np.eye(targets * q)[absent.ravel()]])


def candidate_library(
    states: Sequence[str], *, degree: int, potential_degree: int | None = None,
    circulatory_degree: int | None = None, further: Sequence[str] = (),
    angles: Mapping[str, Sequence[float]] | None = None,
) -> CandidateLibrary:  # fmt: skip
    """Monomials up to a total degree, and whatever further functions a study lists.

    Of a periodic state sines and cosines stand in the place of its powers: the k-th harmonics have degree k.

    Parameters
    ----------
    states, degree
        Names of the states; highest total degree of the monomials, for f.
    potential_degree, circulatory_degree
        Limits for V and g, where they are lower.
    further
        Further functions as formulas of the states, such as ``"sqrt(x**2 + 1)"``. V may use all of them;
        their derivatives are taken into the library for f and g.
    angles
        The two ends of a period of each periodic state, by its name.

    Raises
    ------
    siq.systems.formulas.FormulaError
        When a further function is not a formula of the states, or is there already.
    """
    limits = (degree if limit is None else limit for limit in (potential_degree, circulatory_degree))
    periods = tuple((name, *map(float, (angles or {})[name])) for name in states if name in (angles or {}))
    return _candidate_library(tuple(states), degree, *limits, tuple(further), periods)


@lru_cache(maxsize=64)
def _candidate_library(
    states: tuple[str, ...], degree: int, potential_degree: int, circulatory_degree: int,
    further: tuple[str, ...], angles: tuple[tuple[str, float, float], ...],
) -> CandidateLibrary:  # fmt: skip
    """`candidate_library`, once for the same functions: every step of a run asks for them, and every run."""
    symbols = tuple(sympy.Symbol(name, real=True) for name in states)
    known = CandidateLibrary.functions(symbols, degree, angles)
    degrees, terms = [total for total, _ in known], [term for _, term in known]
    names: Mapping[str, sympy.Expr] = dict(zip(states, symbols, strict=True))
    for text in further:
        function = parse_formula(text, names)
        if not function.free_symbols:
            raise FormulaError(f"the library function '{text}' is constant", "leave it out")
        if function in terms:
            raise FormulaError(f"the library function '{text}' is in the library already", "leave it out")
        terms.append(function)
    in_potential = [total <= potential_degree for total in degrees] + [True] * len(further)
    # The library is closed once under differentiation of what V may use; what that adds serves f and g.
    columns = {
        (i, j): linear_combination(terms[j].diff(symbol))
        for j in np.flatnonzero(in_potential)
        for i, symbol in enumerate(symbols)
    }
    terms = list(dict.fromkeys(itertools.chain(terms, *columns.values())))
    in_potential += [False] * (len(terms) - len(in_potential))
    in_circulatory = [total <= circulatory_degree for total in degrees]
    in_circulatory += [True] * (len(terms) - len(degrees))
    position = {term: k for k, term in enumerate(terms)}
    derivatives = np.zeros((len(terms), len(states), len(terms)))
    for (i, j), combination in columns.items():
        for function, coefficient in combination.items():
            derivatives[position[function], i, j] = coefficient
    arrays = (np.array(in_potential), np.array(in_circulatory), derivatives)
    for array in arrays:
        array.flags.writeable = False
    return CandidateLibrary(states, symbols, tuple(terms), *arrays, angles)


def monomial_exponents(dimension: int, degree: int) -> list[tuple[int, ...]]:
    """Exponents of all monomials up to a total degree, by degree and then as a dictionary would."""
    return [
        tuple(chosen.count(state) for state in range(dimension))
        for total in range(degree + 1)
        for chosen in itertools.combinations_with_replacement(range(dimension), total)
    ]


def linear_combination(expression: sympy.Expr) -> dict[sympy.Expr, float]:
    """Split a derivative into functions and their numerical coefficients."""
    combination: dict[sympy.Expr, float] = {}
    for part in sympy.Add.make_args(sympy.expand(expression)):
        if not part.free_symbols:
            coefficient, function = part, sympy.S.One
        else:  # π and roots belong to the coefficient as well
            coefficient, function = part.as_independent(*part.free_symbols, as_Add=False)
        if coefficient != 0:
            combination[function] = combination.get(function, 0.0) + float(coefficient)
    return combination


def field_dynamics(
    library: CandidateLibrary, support: np.ndarray, values: np.ndarray, *, diffusion: Diffusion,
    covariance: np.ndarray | None = None,
) -> Dynamics:  # fmt: skip
    """Dynamics whose parameters are the coefficients of f over some terms of a library.

    Their values ``(p,)`` and covariance ``(p, p)`` belong to a support ``(p, 2)`` of components and terms.
    """
    prefix = "c"
    while any(f"{prefix}{place}" in library.states for place in range(len(support))):
        prefix += "_"
    names = [f"{prefix}{place}" for place in range(len(support))]
    equations = [sympy.S.Zero] * library.dimension
    for (component, term), name in zip(support, names, strict=True):
        equations[component] += symbol(name) * library.terms[term]
    parameters = tuple(Parameter(name, float(value)) for name, value in zip(names, values, strict=True))
    ends = {name: limits for name, *limits in library.angles}
    return Dynamics(
        library.states, tuple(equations), diffusion, parameters=parameters, covariance=covariance,
        domain=np.array([ends.get(name, [np.nan] * 2) for name in library.states]) if ends else None,
        periodic=tuple(ends),
    )  # fmt: skip


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class IdentificationOptions:
    """In which functions the vector field is sought, and what makes a term significant."""

    #: Highest degree of the monomials
    degree: Annotated[int, Field(ge=1, le=12)] = 5
    #: Further functions of the states, as formulas: roots, fractions and whatever else
    functions: tuple[str, ...] = ()
    #: Probability that noise alone brings any false term into f. Each candidate is judged by its own standard
    #: error, at its share of this probability, of which high degrees have less than low ones.
    false_terms: Annotated[float, Field(gt=0, lt=0.5)] = 0.02
    #: A term that contributes less than this share of f is dropped also from data without noise, whose
    #: residuals are the integrator's error and not random
    precision: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7
    #: Most pairs used where the data carry no noise; with noise all are
    pairs: Annotated[int, Field(ge=100)] = 8_000
    #: Whether the recorded states are positions whose velocities were not recorded. These are states then,
    #: too, called ``v_x`` for a position x, and f says how forces change them. ``"auto"``: where one position
    #: was recorded, its inertia is seen, and f of the position alone is refuted; and where it is refuted
    #: otherwise, a slow force that was not recorded is tried, ``force_x``.
    hidden_velocities: bool | Literal["auto"] = "auto"
    #: States that are angles, or phases, each with the two ends of a period, such as ``phi: [0, 2*pi]``. They
    #: are unwrapped; f is sought in their sines and cosines, and wells are the same a period on. Those of a
    #: card say it there.
    angles: dict[str, tuple[Limit, Limit]] = Field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, (low, high) in self.angles.items():
            if not low < high:
                raise Fault(f"the period of '{name}' is empty", "write it as [lower, upper], lower < upper")


def field_library(states: Sequence[str], options: IdentificationOptions) -> CandidateLibrary:
    """The functions in which f is sought."""
    return candidate_library(states, degree=options.degree, further=options.functions, angles=options.angles)
