"""Roles: what each state of a simulation is, as far as its equations tell.

Mechanisms are written for roles - a position, a velocity, the two quadratures of a rotating frame, a
population, a level, a store - and roles are read off equations and units, never off names. A system of mere
numbers is described by generic monomials only.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values
from siq.dynamics.parametric import Signals, arguments_of, evaluable, symbol

SAME = 1e-9  # relative difference of values of formulas that are the same
TRIALS = 12
ANYWHERE = (0.5, 1.5)  # where formulas of a state without a domain are compared, as those of inputs are


@dataclass(frozen=True)
class Roles:
    """Names by role.

    Attributes
    ----------
    motions
        Pairs of position and velocity, ``x' = v``.
    angles
        Positions that are angles: in radians, or within a sine or cosine of the equations.
    amplitudes
        Pairs of quadratures: but for a constant drive, the equations look the same from every angle, and turn
        the state.
    populations
        States that stay zero once they are.
    feeding
        Pairs of prey and predator: populations whose meetings make the one fewer and the other more.
    levels
        States whose own outflow goes with their square root.
    cascades
        Pairs of levels of which the first flows into the second.
    stores
        All others that have a unit: a charge, a temperature, a concentration. Of a mere number nothing is
        known that a mechanism could be written for.
    states
        All that are not mere derivatives; only in their equations can physics be missing.
    """

    motions: tuple[tuple[str, str], ...] = ()
    angles: tuple[str, ...] = ()
    amplitudes: tuple[tuple[str, str], ...] = ()
    populations: tuple[str, ...] = ()
    feeding: tuple[tuple[str, str], ...] = ()
    levels: tuple[str, ...] = ()
    cascades: tuple[tuple[str, str], ...] = ()
    stores: tuple[str, ...] = ()
    states: tuple[str, ...] = ()

    @property
    def physical(self) -> bool:
        """Whether any state has a role for which mechanisms have names."""
        return bool(self.motions or self.amplitudes or self.populations or self.levels)


def roles_of(model: Dynamics) -> Roles:
    """Read the roles of a model's states off its equations."""
    motions = tuple(
        (name, str(equation))
        for name, equation, definition in zip(model.states, model.equations, model.kinematic, strict=True)
        if definition
    )
    in_motion = {name for pair in motions for name in pair}
    dynamic = tuple(
        name for name, definition in zip(model.states, model.kinematic, strict=True) if not definition
    )
    others = [name for name in dynamic if name not in in_motion]
    amplitudes = tuple(
        (a, b)
        for place, a in enumerate(others)
        for b in others[place + 1 :]
        if _turns(model, model.states.index(a), model.states.index(b))
    )
    in_pairs = {name for pair in amplitudes for name in pair}
    alone = [name for name in others if name not in in_pairs]
    equations = dict(zip(model.states, model.equations, strict=True))
    levels = tuple(name for name in alone if _has_root(equations[name], name))
    populations = tuple(
        name for name in alone if name not in levels and _stays_zero(model, model.states.index(name))
    )
    units = dict(zip(model.states, model.units, strict=True))
    return Roles(
        motions=motions,
        angles=tuple(x for x, _ in motions if units[x] == "rad" or _turns_round(model, x)),
        amplitudes=amplitudes,
        populations=populations,
        feeding=tuple(
            (prey, predator)
            for prey, predator in itertools.permutations(populations, 2)
            if _feeds(model, prey, predator)
        ),
        levels=levels,
        cascades=tuple(
            (upper, lower)
            for upper, lower in itertools.permutations(levels, 2)
            if _has_root(equations[lower], upper)
        ),
        stores=tuple(name for name in alone if name not in (*levels, *populations) and units[name] != "1"),
        states=dynamic,
    )


def meetings(equation: sympy.Expr, one: str, other: str) -> sympy.Expr:
    """The part of an equation in which two states stand together."""
    terms = sympy.Add.make_args(sympy.expand(equation))
    both = {symbol(one), symbol(other)}
    return sympy.Add(*(term for term in terms if both <= term.free_symbols))


def trial_points(
    model: Dynamics, count: int = TRIALS, *, either_sign: bool = False
) -> tuple[np.ndarray, Signals]:
    """States and signals at which formulas are compared; any will do that are the same each time.

    Parameters
    ----------
    model
        Its domain is where the states lie.
    count
        How many points.
    either_sign
        Whether inputs, and states without a domain, are of either sign.

    Returns
    -------
    np.ndarray, Signals
        States of shape ``(d, count)``, and the signals there.
    """
    generator = np.random.default_rng(0)
    known = np.isfinite(model.limits).all(axis=1)
    lower, upper = np.where(known[:, None], model.limits, ANYWHERE).T
    x = generator.uniform(lower[:, None], upper[:, None], size=(model.dimension, count))
    inputs = generator.uniform(*ANYWHERE, size=(len(model.inputs), count))
    delayed = generator.uniform(*ANYWHERE, size=(len(model.delays), count))
    if either_sign:
        x[~known] *= generator.choice([-1.0, 1.0], size=(int((~known).sum()), count))
        inputs *= generator.choice([-1.0, 1.0], size=inputs.shape)
    return x, Signals(
        inputs=inputs,
        delayed=delayed,
        slopes=np.zeros_like(delayed),
        t=generator.uniform(0.0, 1.0, size=count),
    )


def _turns_round(model: Dynamics, name: str) -> bool:
    """Whether a state stands within a sine or cosine."""
    return any(
        symbol(name) in each.free_symbols
        for formula in (*model.equations, *dict(model.outputs).values())
        for each in formula.atoms(sympy.sin, sympy.cos)
    )


def _feeds(model: Dynamics, prey: str, predator: str) -> bool:
    equations = dict(zip(model.states, model.equations, strict=True))
    lost, won = meetings(equations[prey], prey, predator), meetings(equations[predator], prey, predator)
    if lost == 0 or won == 0:
        return False
    x, signals = trial_points(model)
    at = (*np.abs(x), *signals.inputs, *signals.delayed, *signals.slopes, signals.t, *model.values)
    written = [evaluable(each, model) for each in (lost, won)]
    losses, gains = compile_values(written, arguments_of(model), common=False)(*at)
    return bool(np.all(np.asarray(losses) <= 0) and np.all(np.asarray(gains) >= 0))


def _turns(model: Dynamics, first: int, second: int) -> bool:
    """Whether f commutes with rotations of two states, but for a constant, and itself turns them."""
    if model.units[first] != model.units[second]:
        return False
    x, signals = trial_points(model)
    angle = np.linspace(0.3, 5.9, TRIALS)
    turned = x.copy()
    turned[first] = np.cos(angle) * x[first] - np.sin(angle) * x[second]
    turned[second] = np.sin(angle) * x[first] + np.cos(angle) * x[second]
    still = x.copy()
    still[[first, second]] = 0.0
    rates = model.functions.rates
    free = rates(x, signals, model.values) - rates(still, signals, model.values)
    after = rates(turned, signals, model.values) - rates(still, signals, model.values)
    expected = free.copy()
    expected[first] = np.cos(angle) * free[first] - np.sin(angle) * free[second]
    expected[second] = np.sin(angle) * free[first] + np.cos(angle) * free[second]
    size = np.abs(free).max()
    if not (np.isfinite(free).all() and np.abs(after - expected).max() <= SAME * size):
        return False
    turning = x[first] * free[second] - x[second] * free[first]
    return bool(np.abs(turning).max() > SAME * np.abs(x[[first, second]]).max() * size)


def _stays_zero(model: Dynamics, place: int) -> bool:
    x, signals = trial_points(model)
    moving = model.functions.rates(x, signals, model.values)[place]
    x[place] = 0.0
    rate = model.functions.rates(x, signals, model.values)[place]
    return bool(
        np.isfinite(rate).all() and np.abs(rate).max() <= SAME * np.abs(moving).max() and moving.any()
    )


def _has_root(equation: sympy.Expr, name: str) -> bool:
    return any(
        power.exp == sympy.Rational(1, 2) and symbol(name) in power.base.free_symbols
        for power in equation.atoms(sympy.Pow)
    )
