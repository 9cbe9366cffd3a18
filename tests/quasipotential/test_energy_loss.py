from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.errors import NumericalFailure
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.rates import (
    EscapeRate,
    NoiseStrength,
    _depopulation_factor,
    _energy_loss_per_cycle,
    escape_rate,
)
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import Neighbourhood, simulate_escapes

X, V, Y, W = sympy.symbols("x v y w", real=True)


def particle_rate(loss: float) -> EscapeRate:
    return EscapeRate(2.0, 4.0, loss=loss, loss_beyond=loss, particle=True)


def test_strong_losses_leave_the_law_as_it_is_and_weak_ones_limit_the_rate() -> None:
    assert _depopulation_factor(100.0) == pytest.approx(1, abs=1e-9)
    assert _depopulation_factor(1e-4) == pytest.approx(1e-4, rel=0.01)  # the rate of energy diffusion
    assert particle_rate(100.0).slowing(1.0) == pytest.approx(1, abs=1e-9)
    # Of two wells half of what crosses comes back.
    assert particle_rate(1e-4).slowing(1.0) == pytest.approx(0.5e-4, rel=0.01)


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_the_loss_of_a_cubic_well_is_exact(speed: float) -> None:
    """Of Φ = x²/2 - x³/3 the orbit at the height of the saddle has ∮ v dx = 6/5, with v = dx/dt."""
    friction, noise = 0.2, 0.7
    system = Dynamics.of(
        (X, V), (speed * V, -friction * V - (X - X**2) / speed), diffusion=np.diag([0.0, noise])
    )
    path = minimum_action_path(system, np.zeros(2), np.array([1.0, 0.0]))
    loss, beyond, exact = _energy_loss_per_cycle(system, path, beyond=False)
    assert exact and beyond is None
    assert loss == pytest.approx(2 * friction**2 / noise * 1.2 / speed**2, rel=1e-4)


@pytest.mark.slow
def test_two_weakly_damped_particles_have_a_time_only_where_it_is_known() -> None:
    forces = (X - X**3 - 0.1 * V - (X - Y) / 2, -Y - 0.1 * W + (X - Y) / 2)
    system = Dynamics.of((X, Y, V, W), (V, W, *forces), diffusion=np.diag([0.0, 0.0, 0.1, 0.1]))
    start = np.array([np.sqrt(2 / 3), np.sqrt(2 / 3) / 3, 0.0, 0.0])
    path = minimum_action_path(system, start, np.zeros(4))
    rate = escape_rate(system, path)
    assert rate.loss is not None and not rate.particle and 0 < rate.loss < path.action
    with pytest.raises(NumericalFailure, match="damping is too weak"):
        rate.mean_time(path.action / 2)
    assert np.isfinite(rate.mean_time(rate.loss / 20))
    way = EscapeRate(path.action, rate.prefactor, loss=rate.loss)
    assert way.mean_exit_time(NoiseStrength(path.action / 2)) is None


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "height"), [(1.0, 5.0), (0.1, 6.0)])
def test_simulated_escapes_last_as_long_as_the_law_says(friction: float, height: float) -> None:
    """At weak damping the law of Kramers alone is too fast by a third and more."""
    system = Dynamics.of((X, V), (V, X - X**3 - friction * V), diffusion=np.diag([0.0, 0.5]))
    path = minimum_action_path(system, np.array([-1.0, 0.0]), np.zeros(2), tolerance=1e-5)
    rate, intensity = escape_rate(system, path), path.action / height
    expected = rate.mean_time(intensity)
    there = Neighbourhood.about(system, np.array([1.0, 0.0]), level=0.15 * path.action)
    seen = simulate_escapes(
        system, np.array([-1.0, 0.0]), [there], intensity=intensity, longest=3 * expected,
        generator=np.random.default_rng(1), walkers=600,
    )  # fmt: skip
    mean = (seen.times.sum() + seen.censored * seen.longest) / seen.escapes
    assert mean == pytest.approx(expected, rel=1 / height + 3 / np.sqrt(seen.escapes))
    if friction < 0.5:
        assert mean > 1.3 * rate.prefactor * np.exp(height)
