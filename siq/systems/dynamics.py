"""Dynamics: drift, noise, inputs and outputs of a system as one object.

``dx = f(x, u, t; θ) dt + √ε σ(x) dW`` with ``D = σσᵀ`` (Itô), of which ``y = h(x, u, t; θ)`` is measured. A
card describes it, identification returns it with the covariance of its parameters, a diagnosis changes it;
simulation, landscape and references take it.

Two ways lead to numbers. Without inputs, `Dynamics.drift` and its derivatives take points as rows, with the
parameters' values inserted. Where parameters are fitted and inputs drive the system, `Dynamics.functions`
takes components, signals (inputs, their delays, the time) and the values of the parameters. Numpy is slow for
the many small steps of a trajectory, and to compile the formulas of every candidate would take seconds: a
tape is made in no time, and one compiled loop runs all tapes (`siq.inference.trajectories`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import sympy

from siq.errors import Fault
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import MAX_COMPILED, compile_formulas, compile_values, delay, exact_number

TIME = sympy.Symbol("t", real=True)
Compiled = Callable[..., Sequence[np.ndarray | float]]
TURN_TOLERANCE = 1e-9  # numerical, of a period: a state at the lower end of the domain belongs to it
JUMP_WIDTHS = 30.0  # widths of a jump over which its derivative is spread


@lru_cache(maxsize=MAX_COMPILED)  # sympy looks through the assumptions each time
def symbol(name: str) -> sympy.Symbol:
    """The symbol that stands for a name in every formula of a dynamics."""
    return TIME if name == "t" else sympy.Symbol(name, real=True)


@dataclass(frozen=True)
class Signals:
    """Inputs and times at n instants."""

    inputs: np.ndarray  #: (i, n), in the order of the model's inputs
    delayed: np.ndarray  #: (j, n): the delayed inputs of the compiled model
    slopes: np.ndarray  #: (j, n): their time derivatives
    t: np.ndarray  #: (n,)

    @classmethod
    def joined(cls, several: Sequence[Signals]) -> Signals:
        """Those at several sets of instants, one after the other."""
        return cls(
            *(
                np.concatenate(each, axis=-1)
                for each in zip(*(vars(one).values() for one in several), strict=True)
            )
        )


# Operations of a tape, by the numbers that `siq.inference.trajectories` knows.
_INVERT, _WHOLE_POWER, _POWER, _SQRT = 2, 3, 4, 5
_CHAINS = {sympy.Add: 0, sympy.Mul: 1, sympy.Max: 15, sympy.Min: 16}
_FUNCTIONS = {
    sympy.sin: 6, sympy.cos: 7, sympy.tan: 8, sympy.exp: 9, sympy.log: 10, sympy.tanh: 11, sympy.atan: 12,
    sympy.Abs: 13, sympy.sign: 14,
}  # fmt: skip


@dataclass(frozen=True)
class Tape:
    """Formulas as operations on registers.

    An operation has the registers of its arguments; the second is the exponent itself of a whole power. The
    result goes to the register ``base + k``.
    """

    operations: np.ndarray  #: (k, 3)
    registers: np.ndarray  #: (base + k,), to begin with: arguments, which are to be filled in, then constants
    base: int  #: how many arguments and constants there are
    results: np.ndarray  #: registers that hold the values of the formulas in the end

    @classmethod
    def of(cls, formulas: Sequence[sympy.Expr], arguments: Sequence[sympy.Symbol]) -> Tape | None:
        """The tape of formulas in some arguments; None where a formula has a function that no tape knows.

        What occurs twice is worked out once.
        """
        formulas = [sympy.sympify(formula) for formula in formulas]
        constants: dict[sympy.Expr, float] = {}
        for formula in formulas:
            for part in sympy.preorder_traversal(formula):
                if part.is_number and not part.free_symbols:
                    constants.setdefault(part, float(part) if part.is_real else np.nan)
        known = {each: place for place, each in enumerate((*arguments, *constants))}
        start = np.concatenate([np.zeros(len(arguments)), list(constants.values())])
        operations: list[tuple[int, int, int]] = []

        def add(operation: int, one: int, other: int) -> int:
            operations.append((operation, one, other))
            return len(start) + len(operations) - 1

        def register(formula: sympy.Expr) -> int:
            """Where the value of a formula is, once the tape has run so far."""
            if formula not in known:
                known[formula] = written(formula)
            return known[formula]

        def written(formula: sympy.Expr) -> int:
            if formula.func in _CHAINS:
                place = register(formula.args[0])
                for other in formula.args[1:]:
                    place = add(_CHAINS[formula.func], place, register(other))
                return place
            if formula.func in _FUNCTIONS:
                return add(_FUNCTIONS[formula.func], register(formula.args[0]), 0)
            if not isinstance(formula, sympy.Pow):
                raise NotImplementedError(str(formula.func))
            base, exponent = formula.args
            place = register(base)
            if exponent.is_Integer:
                if abs(int(exponent)) > 1:
                    place = add(_WHOLE_POWER, place, abs(int(exponent)))
            elif abs(exponent) == sympy.S.Half:
                place = add(_SQRT, place, 0)
            else:
                return add(_POWER, place, register(exponent))
            return place if exponent > 0 else add(_INVERT, place, 0)

        try:
            results = [register(formula) for formula in formulas]
        except NotImplementedError:
            return None
        return cls(
            operations=np.array(operations, dtype=np.int64).reshape(-1, 3),
            registers=np.concatenate([start, np.zeros(len(operations))]),
            base=len(start),
            results=np.array(results, dtype=np.int64),
        )


class ParametricFunctions:
    """Dynamics as functions of arrays, with derivatives by states and by free parameters.

    States come as ``(d, n)``, for parameters' values ``(p,)``.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        self._delays, self._arguments, self._states = dynamics.delays, dynamics.arguments, dynamics.symbols
        self._equations = [dynamics.evaluable(each) for each in dynamics.equations]
        self._measured = [dynamics.evaluable(each) for _, each in dynamics.outputs]
        # A jump's derivative is a spike. Spread over more than a step it is seen in full by every rule of
        # integration, and carries deviations across the jump as they are carried in the mean.
        self._smooth = [dynamics.evaluable(each, wider=JUMP_WIDTHS) for each in dynamics.equations]
        self._free = [symbol(dynamics.parameters[place].name) for place in dynamics.free]
        self._divisors = [symbol(dynamics.parameters[place].name) for place in dynamics.divisors]
        self._compiled: dict[str, tuple[int, Compiled]] = {}

    @cached_property
    def tape(self) -> Tape | None:
        """f as a tape in the same arguments; None where it has a function that no tape knows."""
        return Tape.of(self._equations, self._arguments)

    def rates(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """f: shape ``(d, n)``."""
        return self._evaluated("rates", x, signals, values)

    def outputs(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """h: shape ``(m, n)``."""
        return self._evaluated("outputs", x, signals, values)

    def slopes(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of f by states and by free parameters: ``(d, d, n)`` and ``(d, p, n)``."""
        return self._parted(len(self._equations), self._evaluated("slopes", x, signals, values))

    def output_slopes(
        self, x: np.ndarray, signals: Signals, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of h by states and by free parameters: ``(m, d, n)`` and ``(m, p, n)``."""
        return self._parted(len(self._measured), self._evaluated("output_slopes", x, signals, values))

    def sides(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """On which side of each pole of f all states lie: 1 or -1, and 0 where it lies among them, ``(k,)``.

        Of poles that move with a free parameter, as that of s/(K + s) does, and of `divisors`.
        """
        side = np.sign(self._evaluated("denominators", x, signals, values))
        return np.where((side == side[:, :1]).all(axis=1), side[:, 0], 0.0)

    def _parted(self, count: int, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ends, n = count * len(self._states), flat.shape[1]
        return flat[:ends].reshape(count, -1, n), flat[ends:].reshape(count, len(self._free), n)

    def _evaluated(self, what: str, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        if what not in self._compiled:
            formulas = self._formulas(what)
            self._compiled[what] = len(formulas), compile_values(formulas, self._arguments)
        count, function = self._compiled[what]
        result = np.empty((count, x.shape[1]))
        arguments = (*x, *signals.inputs, *signals.delayed, *signals.slopes, signals.t, *values)
        with np.errstate(all="ignore"):  # a trial state may lie where a formula has no value; fits step back
            for place, value in enumerate(function(*arguments)):
                result[place] = value
        return result

    def _formulas(self, what: str) -> list[sympy.Expr]:
        if what in ("rates", "outputs"):
            return self._equations if what == "rates" else self._measured
        if what == "denominators":
            powers = set[sympy.Pow]().union(*(each.atoms(sympy.Pow) for each in self._equations))
            below = {each.base: each.base.free_symbols for each in powers if each.exp.is_negative}
            states, free = {*self._states}, {*self._free}
            moving = [one for one, names in below.items() if names & states and names & free]
            return sorted([*moving, *self._divisors], key=str)
        smooth, formulas = self._smooth, self._equations
        if what == "output_slopes":
            smooth, formulas = [_without_teeth(each) for each in self._measured], self._measured
        # u(t - τ) depends on a parameter in τ through the slope of u, backwards.
        delays = [(_delayed(k), _slope(k), each.args[1]) for k, each in enumerate(self._delays)]
        by_state = [_derivative(each, state) for each in smooth for state in self._states]
        return by_state + [
            _derivative(each, one)
            - sum(_derivative(each, u) * slope * time.diff(one) for u, slope, time in delays)
            for each in formulas
            for one in self._free
        ]


@lru_cache(maxsize=4 * MAX_COMPILED)
def _derivative(formula: sympy.Expr, by: sympy.Symbol) -> sympy.Expr:
    """Its derivative, part by part of sums and products: candidates have all parts but one in common."""
    if by not in formula.free_symbols:
        return sympy.Integer(0)
    parts = formula.args
    if formula.is_Add:
        return sympy.Add(*(_derivative(each, by) for each in parts))
    if formula.is_Mul:
        derived = ((place, _derivative(each, by)) for place, each in enumerate(parts))
        return sympy.Add(*(sympy.Mul(*parts[:k], one, *parts[k + 1 :]) for k, one in derived if one != 0))
    return formula.diff(by)


def roots_of(formula: sympy.Expr) -> set[sympy.Pow]:
    """Its powers below one of what moves, such as a square root: at zero their slope is infinite."""
    powers = formula.atoms(sympy.Pow)
    return {one for one in powers if one.exp.is_number and 0 < one.exp < 1 and one.base.free_symbols}


def _without_teeth(formula: sympy.Expr) -> sympy.Expr:
    """A formula whose sawtooth ``atan(tan(z))``, as of rounding, is taken for its mean, zero.

    A reading that is rounded stands still and jumps: its slope is nothing almost everywhere, and says nothing
    of what it follows, step by step. On the whole it follows with the slope that it has without the teeth.
    """
    return formula.replace(
        lambda each: isinstance(each, sympy.atan) and isinstance(each.args[0], sympy.tan),
        lambda each: sympy.Integer(0),
    )


def _delayed(place: int) -> sympy.Symbol:
    return sympy.Symbol(f"_delayed_{place}", real=True)


def _slope(place: int) -> sympy.Symbol:
    return sympy.Symbol(f"_slope_{place}", real=True)


@dataclass(frozen=True)
class Input:
    """An exogenous signal: its name, unit, and how it runs between samples; None: as its record shows."""

    name: str
    unit: str
    interpolation: str | None = None


@dataclass(frozen=True)
class Parameter:
    """A parameter with its value; a fixed one is never recalibrated.

    Where a value is expected, estimates are about that, within its error, or its own size where none is
    given, unless recordings tell more (`siq.inference.measurements`).
    """

    name: str
    value: float
    unit: str = "1"
    fixed: bool = False
    expected: float | None = None
    error: float | None = None  #: one standard deviation, in the unit of the value


@dataclass(frozen=True, eq=False)
class JointExpectation:
    """A joint prior of several parameters: ``roots @ values`` are standard normal.

    The weight is how often it counts against the data: of errors that are correlated over τ samples, n count
    as n/τ, and a fit that takes them for independent has to count what it expects τ times.
    """

    names: tuple[str, ...]
    roots: np.ndarray  #: (r, k); the inverse of their covariance is ``roots.T @ roots``
    weight: float = 1.0


COMPILED = ("functions", "delays", "free", "divisors", "symbols", "_lags")
"""Cached properties that do not depend on the values of the parameters."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """A system: ``dx = f dt + √ε σ dW``, with what is known of its units, inputs and outputs.

    Main attributes
    ---------------
    states
        Names of the d states, in the order of the state vector.
    equations
        Components of f, in symbols for states, inputs, parameters and the time ``t``.
    diffusion
        D.

    Other attributes
    ----------------
    name, title, time_unit
        As a card says.
    units
        Of each state; ``1`` by default.
    domain
        Shape ``(d, 2)``: where the states are expected, in their units; NaN for a state, or None for all of
        them, where not given.
    inputs
        The signals that drive it.
    parameters, covariance
        θ, in the order of the parameter vector; and of the free ones' estimates, shape ``(p, p)``: None where
        they are not estimates.
    outputs
        What a recording measures, by the name of its column; by default the states.
    edges
        Arguments of ``sign`` and of roots in f and widths over which these are spread when f is evaluated, so
        that an integrator can follow: ``sign(e)`` as ``tanh(e/w)``, ``e^a`` as ``e (e² + w²)^((a - 1)/2)``.
    parameters_of_noise
        Names of the parameters of a card that stand in D, where they count with the card's values.
    expected_together
        What is expected of several parameters at a time.
    periodic
        Names of states whose domain is one period, such as angles: f and D are the same a period on. Such a
        state is not wrapped, so that it counts its turns.

    Raises
    ------
    ValueError
        When equations, units, domain or D do not fit the states.

    Examples
    --------
    >>> x, y = sympy.symbols("x y", real=True)
    >>> well = Dynamics.of((x, y), (x - x**3, -y))
    >>> well.drift(np.array([[0.5, 1.0]]))
    array([[ 0.375, -1.   ]])
    >>> well.jacobian(np.array([[0.0, 0.0]]))[0]
    array([[ 1.,  0.],
           [ 0., -1.]])
    """

    states: tuple[str, ...]
    equations: tuple[sympy.Expr, ...]
    diffusion: Diffusion
    name: str = ""
    title: str = ""
    time_unit: str = "1"
    units: tuple[str, ...] = ()
    domain: np.ndarray | None = None
    inputs: tuple[Input, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    covariance: np.ndarray | None = None
    outputs: tuple[tuple[str, sympy.Expr], ...] = ()
    edges: tuple[tuple[sympy.Expr, float], ...] = ()
    parameters_of_noise: tuple[str, ...] = ()
    expected_together: tuple[JointExpectation, ...] = ()
    periodic: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        d = len(self.states)
        if not self.units:
            object.__setattr__(self, "units", ("1",) * d)
        if not self.outputs:
            object.__setattr__(self, "outputs", tuple((name, symbol(name)) for name in self.states))
        counts = {"equations": len(self.equations), "units": len(self.units)}
        for what, count in (counts | {"rows of D": self.diffusion.dimension}).items():
            if count != d:
                raise Fault(f"there are {count} {what} for {d} states", "give one for each")
        if self.diffusion.symbols not in ((), self.symbols):
            raise Fault("D is one of other states", "give it with these in their order")
        if self.domain is not None and np.shape(self.domain) != (d, 2):
            raise Fault(f"the domain has the shape {np.shape(self.domain)}", "give two limits a state")
        for name in self.periodic:
            if name not in self.states or not np.ptp(self.limits[self.states.index(name)]) > 0:
                raise Fault(f"the period of '{name}' is not known", "give the state a domain of one period")

    @classmethod
    def of(
        cls, symbols: Sequence[sympy.Symbol], equations: Sequence[sympy.Expr], *,
        diffusion: Diffusion | np.ndarray | Sequence[Sequence[sympy.Expr | float]] | None = None,
        domain: Sequence[Sequence[float]] | np.ndarray | None = None,
        parameters: Mapping[sympy.Symbol, float] | None = None, periodic: Sequence[str] = (),
    ) -> Dynamics:  # fmt: skip
        """Dynamics of formulas alone, with D = 1 unless another is given.

        Parameters
        ----------
        symbols
            The d states. Symbols of any assumptions stand for the real ones of their names.
        equations
            The components of f.
        diffusion
            D, as `Diffusion`, as a matrix ``(d, d)``, or as rows of formulas.
        domain
            Two limits a state, where they are given.
        parameters
            Symbols of f that may take other values, with the values that they have.
        periodic
            Names of states whose domain is one period.

        Raises
        ------
        ValueError
            When a symbol of f is no state and no parameter, and as `Dynamics` itself.
        """
        # SymPy tells x from a positive or complex x, by which all derivatives would be zero.
        real = {each: symbol(each.name) for each in (*symbols, *(parameters or ()))}
        if diffusion is None:
            diffusion = Diffusion.identity(len(symbols))
        elif isinstance(diffusion, np.ndarray):
            diffusion = Diffusion(np.asarray(diffusion, dtype=float))
        elif not isinstance(diffusion, Diffusion):
            rows = [[sympy.sympify(entry).xreplace(real) for entry in row] for row in diffusion]
            diffusion = Diffusion.of_formulas([real[each] for each in symbols], rows)
        names = tuple(each.name for each in symbols)
        formulas = tuple(sympy.sympify(each).xreplace(real) for each in equations)
        for each in sorted(
            set().union(*(f.free_symbols for f in formulas)) - {*real.values(), TIME}, key=str
        ):
            raise Fault(f"'{each}' is no state and no parameter", "give its value among the parameters")
        box = None if domain is None else np.asarray(domain, dtype=float)
        named = tuple(Parameter(each.name, float(value)) for each, value in (parameters or {}).items())
        return cls(names, formulas, diffusion, domain=box, parameters=named, periodic=tuple(periodic))

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.states)

    @cached_property
    def symbols(self) -> tuple[sympy.Symbol, ...]:
        """The states as they stand in the formulas."""
        return tuple(symbol(name) for name in self.states)

    @property
    def box(self) -> np.ndarray:
        """The domain, shape ``(d, 2)``, where it has to be known; raises ValueError where it is not given."""
        unknown = [name for name, ends in zip(self.states, self.limits, strict=True) if np.isnan(ends).any()]
        if unknown:
            raise Fault(f"no domain of {', '.join(unknown)} is known", "give the limits of each state")
        return self.limits

    @property
    def limits(self) -> np.ndarray:
        """The domain as far as it is known, shape ``(d, 2)``: NaN where it is not given."""
        return np.full((self.dimension, 2), np.nan) if self.domain is None else self.domain

    @cached_property
    def periods(self) -> np.ndarray:
        """The period of each state, shape ``(d,)``, zero of one that has none."""
        return np.where([name in self.periodic for name in self.states], np.ptp(self.limits, axis=1), 0.0)

    @cached_property
    def shifts(self) -> np.ndarray:
        """What leads to a state and its next images, shape ``(3^k, d)`` for k periodic states; zero first."""
        signs = ((0, -1, 1) if period else (0,) for period in self.periods)
        return np.array(list(itertools.product(*signs))) * self.periods

    def turns(self, x: np.ndarray) -> np.ndarray:
        """By how many periods states ``(n, d)`` lie beyond the domain, whole numbers of that shape."""
        known = self.periods > 0
        places = (x - np.where(known, self.limits[:, 0], 0.0)) / np.where(known, self.periods, 1.0)
        return np.where(known, np.floor(places + TURN_TOLERANCE), 0.0)

    def wrapped(self, x: np.ndarray) -> np.ndarray:
        """States ``(n, d)`` moved by whole periods into the domain."""
        return x - self.turns(x) * self.periods

    def unwrapped(self) -> Dynamics:
        """These dynamics on three periods of each periodic state, the domain being the middle one."""
        return replace(
            self, domain=self.limits + np.stack([-self.periods, self.periods], axis=1), periodic=()
        )

    @property
    def output_names(self) -> tuple[str, ...]:
        """The measured columns."""
        return tuple(name for name, _ in self.outputs)

    @property
    def values(self) -> np.ndarray:
        """The parameters' values, shape ``(p,)``."""
        return np.array([parameter.value for parameter in self.parameters], dtype=float)

    @cached_property
    def free(self) -> tuple[int, ...]:
        """Places of the parameters that may be recalibrated."""
        used = set().union(*(each.free_symbols for each in (*self.equations, *dict(self.outputs).values())))
        return tuple(
            place
            for place, parameter in enumerate(self.parameters)
            if not parameter.fixed and symbol(parameter.name) in used
        )

    @cached_property
    def divisors(self) -> dict[int, int | None]:
        """Places of free parameters that only divide, and only some terms, as K of ``r N (1 - N/K)``.

        Those terms are absent where it is infinite. With the place of what multiplies them all, r, if that is
        one free parameter. A mass or a time constant divides the whole rate of a state, and is none of them.
        """
        formulas, found = (*self.equations, *dict(self.outputs).values()), dict[int, int | None]()
        powers = set[sympy.Pow]().union(*(each.atoms(sympy.Pow) for each in formulas))
        below = {one: sympy.S.One for one in powers if one.base.is_Symbol and one.exp == -1}
        elsewhere = set().union(*(each.xreplace(below).free_symbols for each in formulas))
        named = {symbol(self.parameters[place].name): place for place in self.free}
        for one in named.keys() & {each.base for each in below} - elsewhere:
            parts = [sympy.Add.make_args(each.expand()) for each in formulas if one in each.free_symbols]
            terms = [[term for term in part if 1 / one in term.args] for part in parts]
            if all(0 < len(each) < len(part) for each, part in zip(terms, parts, strict=True)):
                shared = set.intersection(*({*term.args} for each in terms for term in each)) & named.keys()
                found[named[one]] = named[shared.pop()] if len(shared) == 1 else None
        return found

    def moved(self, change: np.ndarray) -> Dynamics:
        """The dynamics after a change ``(p,)`` of its free parameters that their slopes ask for.

        What divides a term moves so that f changes straight: ``r'/K' = r/K + d(r/K)``.
        """
        values, step = self.values, np.zeros(len(self.parameters))
        step[list(self.free)] = change
        new = values + step
        for place, beside in self.divisors.items():
            weight, more = (1.0, 0.0) if beside is None else (values[beside], step[beside])
            if share := (weight + more - weight * step[place] / values[place]) / values[place]:
                new[place] = (weight + more) / share
        return self.with_values(new)

    @property
    def names(self) -> dict[str, sympy.Symbol]:
        """Symbols by the names that stand in formulas."""
        known = [*self.states, *(each.name for each in self.inputs), *(each.name for each in self.parameters)]
        return {name: symbol(name) for name in known} | {"t": TIME}

    @property
    def kinematic(self) -> tuple[bool, ...]:
        """Mask of the equations that only define a state as the derivative of another, ``dx/dt = v``.

        Such an equation holds by definition: no physics can be missing in it, and no noise drives it.
        """
        return tuple(equation in self.symbols for equation in self.equations)

    def with_values(self, values: np.ndarray) -> Dynamics:
        """The dynamics with other values of its parameters, shape ``(p,)``."""
        pairs = zip(self.parameters, values, strict=True)
        result = replace(self, parameters=tuple(replace(each, value=float(value)) for each, value in pairs))
        # Formulas and names are the same, and compiling them takes longer than most uses.
        for name in COMPILED:
            if name in self.__dict__:
                result.__dict__[name] = self.__dict__[name]
        return result

    def held(self, names: Collection[str], *, zero: Collection[str] = ()) -> Dynamics:
        """The dynamics with some of its parameters fixed, and some of these at zero."""
        entries = (replace(p, value=0.0) if p.name in zero else p for p in self.parameters)
        held = tuple(replace(p, fixed=True) if p.name in names else p for p in entries)
        return replace(self, parameters=held)

    def with_diffusion(self, diffusion: Diffusion) -> Dynamics:
        """The dynamics with another diffusion."""
        return replace(self, diffusion=diffusion)

    def to_card(self) -> str:
        """The text of a system card that is read back as the same dynamics."""
        from siq.systems.cards import card_of  # which knows of dynamics

        return card_of(self)

    # Values and derivatives without inputs, parameters inserted: points come as rows.

    @property
    def autonomous(self) -> bool:
        """Whether f depends on the states alone."""
        return not self.inputs and not any(TIME in each.free_symbols for each in self.equations)

    @cached_property
    def formulas(self) -> tuple[sympy.Expr, ...]:
        """Components of f with the parameters' values inserted."""
        inserted = {symbol(each.name): exact_number(each.value) for each in self.parameters}
        return tuple(equation.xreplace(inserted) if inserted else equation for equation in self.equations)

    def drift(self, x: np.ndarray) -> np.ndarray:
        """f at points: ``(n, d)`` to ``(n, d)``."""
        return self.drift_of_components(np.ascontiguousarray(x.T)).T

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """∂f_i/∂x_j at points: ``(n, d)`` to ``(n, d, d)``, i before j."""
        result = np.zeros((*x.shape, self.dimension))
        (i, j), compiled = self._first
        result[:, i, j] = compiled(np.ascontiguousarray(x.T)).T
        return result

    def hessian(self, x: np.ndarray) -> np.ndarray:
        """∂²f_i/∂x_j∂x_k at points: ``(n, d)`` to ``(n, d, d, d)``, i first."""
        result = np.zeros((*x.shape, self.dimension, self.dimension))
        (i, j, k), compiled = self._second
        if len(i):
            result[:, i, j, k] = result[:, i, k, j] = compiled(np.ascontiguousarray(x.T)).T
        return result

    def bend(self, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """``Σ_i w_i ∂²f_i`` at points and weights ``(n, d)``: to ``(n, d, d)``, without all of `hessian`."""
        result = np.zeros((*x.shape, self.dimension))
        places, compiled = self._second
        if places.size:
            for (i, j, k), values in zip(places.T, compiled(np.ascontiguousarray(x.T)), strict=True):
                result[:, j, k] += weights[:, i] * values
                if j != k:
                    result[:, k, j] += weights[:, i] * values
        return result

    @cached_property
    def drift_of_components(self) -> Callable[[np.ndarray], np.ndarray]:
        """f of components ``(d, ...)``, for loops over many states at once: contiguous in memory.

        Raises ValueError where inputs or the time stand in f.
        """
        return compile_formulas(self._autonomous_formulas(), self.symbols)

    @cached_property
    def _derivatives(self) -> dict[tuple[int, int], sympy.Expr]:
        """∂f_i/∂x_j by (i, j), those that vanish left out: in many states most of them do."""
        number = {symbol: place for place, symbol in enumerate(self.symbols)}
        found = {
            (i, number[symbol]): _derivative(formula, symbol)
            for i, formula in enumerate(self._autonomous_formulas())
            for symbol in sorted(formula.free_symbols & set(self.symbols), key=number.__getitem__)
        }
        return {place: one for place, one in found.items() if one != 0}

    @cached_property
    def _first(self) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Places i, j of the derivatives that do not vanish, shape ``(2, m)``, and these as a function."""
        places = np.array(list(self._derivatives), dtype=int).reshape(-1, 2).T
        return places, compile_formulas(list(self._derivatives.values()), self.symbols)

    @cached_property
    def _second(self) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Places i, j, k, k ≥ j, of second derivatives that do not vanish, and these as a function."""
        found = {
            (i, j, k): second
            for (i, j), first in self._derivatives.items()
            for k, symbol in enumerate(self.symbols)
            if k >= j and symbol in first.free_symbols and (second := _derivative(first, symbol)) != 0
        }
        places = np.array(list(found), dtype=int).reshape(-1, 3).T
        return places, compile_formulas(list(found.values()), self.symbols)

    def _autonomous_formulas(self) -> tuple[sympy.Expr, ...]:
        if not self.autonomous:
            raise ValueError(f"{self.name or 'the system'} is driven: its drift is no function of x alone")
        return self.formulas

    # What inputs and fitted parameters need.

    @cached_property
    def functions(self) -> ParametricFunctions:
        """f, h and their derivatives as functions of states, signals and parameters."""
        return ParametricFunctions(self)

    @property
    def arguments(self) -> list[sympy.Symbol]:
        """Of compiled formulas: states, inputs, delayed inputs and their slopes, the time, parameters."""
        delayed = range(len(self.delays))
        return [
            *self.symbols, *(symbol(each.name) for each in self.inputs), *map(_delayed, delayed),
            *map(_slope, delayed), TIME, *(symbol(each.name) for each in self.parameters),
        ]  # fmt: skip

    def evaluable(self, formula: sympy.Expr, *, wider: float = 1.0) -> sympy.Expr:
        """A formula with symbols for delayed inputs and its edges spread, over a multiple of their widths."""
        spread: dict[sympy.Expr, sympy.Expr] = {}
        for at, width in self.edges:
            spread[sympy.sign(at)] = sympy.tanh(at / (wider * width))
            for one in (each for each in roots_of(formula) if each.base == at):
                spread[one] = at * (at**2 + (wider * width) ** 2) ** ((one.exp - 1) / 2)
        return formula.xreplace(spread).xreplace({each: _delayed(k) for k, each in enumerate(self.delays)})

    @cached_property
    def delays(self) -> tuple[sympy.Expr, ...]:
        """The delayed inputs in its formulas, each once, in an order that does not change."""
        formulas = [*self.equations, *(formula for _, formula in self.outputs)]
        return tuple(sorted({each for formula in formulas for each in formula.atoms(delay)}, key=str))

    @cached_property
    def _lags(self) -> Callable[..., Sequence[np.ndarray | float]]:
        return compile_values(
            [each.args[1] for each in self.delays], [symbol(each.name) for each in self.parameters]
        )

    def lags(self, values: np.ndarray) -> tuple[tuple[int, float], ...]:
        """Delayed inputs at parameters' values: the place of the input, and by how much time it lags."""
        if not self.delays:
            return ()
        places = {entry.name: place for place, entry in enumerate(self.inputs)}
        pairs = zip(self.delays, self._lags(*values), strict=True)
        return tuple((places[str(each.args[0])], float(time)) for each, time in pairs)
