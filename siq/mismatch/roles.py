"""Roles: what each state of a simulation is, as far as its equations tell.

Mechanisms are written for roles - a position, a velocity, the two quadratures of a rotating frame, a
population, a level - and roles are read off the equations, never off names. A system without any of them is
described by generic monomials only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import Signals, symbol

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
    amplitudes
        Pairs of quadratures: but for a constant drive, the equations look the same from every angle, and turn
        the state.
    populations
        States that stay zero once they are.
    levels
        States whose own outflow goes with their square root.
    states
        All that are not mere derivatives; only in their equations can physics be missing.
    """

    motions: tuple[tuple[str, str], ...]
    amplitudes: tuple[tuple[str, str], ...]
    populations: tuple[str, ...]
    levels: tuple[str, ...]
    states: tuple[str, ...]

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
    return Roles(
        motions=motions,
        amplitudes=amplitudes,
        populations=tuple(
            name for name in alone if name not in levels and _stays_zero(model, model.states.index(name))
        ),
        levels=levels,
        states=dynamic,
    )


def _turns(model: Dynamics, first: int, second: int) -> bool:
    """Whether f commutes with rotations of two states, but for a constant, and itself turns them."""
    if model.units[first] != model.units[second]:
        return False
    x, signals = _trials(model)
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
    x, signals = _trials(model)
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


def _trials(model: Dynamics) -> tuple[np.ndarray, Signals]:
    """States and signals at which formulas are compared; any will do that are the same each time."""
    generator = np.random.default_rng(0)
    lower, upper = np.where(np.isfinite(model.limits), model.limits, ANYWHERE).T
    x = generator.uniform(lower[:, None], upper[:, None], size=(model.dimension, TRIALS))
    delays = len(model.delays)
    return x, Signals(
        inputs=generator.uniform(0.5, 1.5, size=(len(model.inputs), TRIALS)),
        delayed=generator.uniform(0.5, 1.5, size=(delays, TRIALS)),
        slopes=np.zeros((delays, TRIALS)),
        t=generator.uniform(0.0, 1.0, size=TRIALS),
    )
