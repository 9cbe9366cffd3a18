"""What comes to rest nowhere: cycles with their periods, and chaos, which is no cycle."""

from __future__ import annotations

import json

import numpy as np
import pytest
import sympy
from known_systems import limit_cycle

from siq.remarks import Remark, sentence
from siq.systems.cycles import Recurrence, recurrence_of
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import crossing_rate
from siq.systems.phase_portrait import phase_portrait

x, y, z = (sympy.Symbol(name, real=True) for name in "xyz")
THIRD = sympy.Rational(8, 3)
VAN_DER_POL = Dynamics.of((x, y), (y, (1 - x**2) * y - x))
LORENZ = Dynamics.of((x, y, z), (10 * (y - x), x * (28 - z) - y, x * y - THIRD * z))
ROESSLER = (-y - z, x + y / 5)
PLANE = np.array([[-3.0, 3.0], [-4.0, 4.0]])
ROOM = np.array([[-20.0, 20.0], [-25.0, 25.0], [0.0, 50.0]])


def found_of(dynamics: Dynamics, start: np.ndarray, box: np.ndarray) -> Recurrence:
    points = np.random.default_rng(0).uniform(*box.T, (200, len(box)))
    return recurrence_of(
        dynamics, start, box=box, rate=crossing_rate(dynamics, points, np.ptp(points, axis=0))
    )


def settled(dynamics: Dynamics, start: list[float], time: float, step: float = 0.01) -> np.ndarray:
    """A state after a long time, by the rule of Runge and Kutta: shape ``(1, d)``."""
    at = np.array([start])
    for _ in range(round(time / step)):
        k1 = dynamics.drift(at)
        k2 = dynamics.drift(at + step / 2 * k1)
        k3 = dynamics.drift(at + step / 2 * k2)
        at = at + step / 6 * (k1 + 2 * k2 + 2 * k3 + dynamics.drift(at + step * k3))
    return at


def test_the_cycle_of_van_der_pol_has_its_period() -> None:
    found = found_of(VAN_DER_POL, settled(VAN_DER_POL, [1.0, 0.0], 20), PLANE)
    assert found.kind == "cycle"
    assert found.cycle.period == pytest.approx(6.6632868593, rel=1e-8)  # as known to ten digits for μ = 1


def test_a_cycle_is_found_long_before_it_is_reached() -> None:
    found = found_of(limit_cycle().dynamics, np.array([[0.5, 0.0]]), limit_cycle().domain)
    assert found.kind == "cycle" and found.cycle.period == pytest.approx(np.pi, rel=1e-8)


@pytest.mark.parametrize(("start", "stop"), [(1e-4, 1.0), (1e3, 1e-6)])
def test_units_change_the_period_alone(start: float, stop: float) -> None:
    u, v = start * x, start * y
    scaled = Dynamics.of((x, y), tuple(one / start * stop for one in (v, (1 - u**2) * v - u)))
    found = found_of(scaled, np.array([[2.0, 0.0]]) / start, PLANE / start)
    assert found.kind == "cycle" and found.cycle.period == pytest.approx(6.6632868593 / stop, rel=1e-8)


def test_a_cycle_of_two_turns_has_the_period_of_both() -> None:
    dynamics = Dynamics.of((x, y, z), (*ROESSLER, sympy.Rational(1, 5) + z * (x - sympy.Rational(7, 2))))
    box = np.array([[-10.0, 12.0], [-12.0, 9.0], [0.0, 20.0]])
    found = found_of(dynamics, settled(dynamics, [1.0, 1.0, 0.1], 200, 0.02), box)
    assert found.kind == "cycle" and found.cycle.period == pytest.approx(11.545218, rel=1e-6)


def test_chaos_is_no_cycle() -> None:
    # Through the first of them returns are rare: it lies at the rim, next to the axis.
    starts = np.concatenate([settled(LORENZ, [1.0, 1.0, 20.0], time) for time in (20, 23)])
    found = found_of(LORENZ, starts, ROOM)
    assert found.kind == "chaos"
    assert found.exponent == pytest.approx(0.906, rel=0.15)  # of so few returns


@pytest.mark.slow
def test_what_turns_on_a_torus_is_neither() -> None:
    a, b = sympy.symbols("a b", real=True)
    first, second = (1 - x**2 - y**2), (1 - a**2 - b**2)
    turn = sympy.sqrt(2)
    dynamics = Dynamics.of(
        (x, y, a, b), (x * first - y, y * first + x, a * second - turn * b, b * second + turn * a)
    )
    found = found_of(dynamics, np.array([[1.0, 0.0, 1.0, 0.0]]), np.array([[-1.5, 1.5]] * 4))
    assert found.kind == "aperiodic"


def test_what_does_not_return_is_none() -> None:
    drift = Dynamics.of((x, y), (1 + 0 * x, -y))
    found = found_of(drift, np.array([[0.0, 0.5]]), np.array([[-1.0, 1.0]] * 2))
    assert found.kind == "none"


def test_the_phase_portrait_names_the_cycle() -> None:
    points = np.random.default_rng(0).uniform(*PLANE.T, (300, 2))
    fault = phase_portrait(VAN_DER_POL, points).fault()
    assert fault is not None and sentence(fault) == (
        "no recorded state comes to rest at a stable equilibrium: they end on a limit cycle of period 6.663"
    )


@pytest.mark.slow
def test_the_phase_portrait_names_chaos() -> None:
    points = np.random.default_rng(0).uniform(*ROOM.T, (60, 3))
    fault = phase_portrait(LORENZ, points).fault()
    assert fault is not None
    assert "neither on an equilibrium nor on a cycle: aperiodic motion, as of chaos" in sentence(fault)


def test_a_cycle_in_recordings_is_told_by_numbers_that_can_be_stored() -> None:
    oscillator = Dynamics.of((x, y), (y, (1 - x**2) * y - x))
    fault = phase_portrait(oscillator, np.random.default_rng(0).uniform(-2, 2, (60, 2))).fault()
    assert fault is not None and "limit cycle of period 6.663" in sentence(fault)
    json.dumps(fault.as_data(), allow_nan=False)


def test_what_comes_to_rest_slowly_is_none() -> None:
    slow = Dynamics.of((x, y), (-(x**3), -(y**3)))
    found = found_of(slow, np.array([[1e-3, 1e-3]]), np.array([[-1.0, 1.0]] * 2))
    assert found.kind == "none"


@pytest.mark.parametrize(
    ("kind", "words"),
    [("aperiodic", "aperiodic motion"), ("none", "neither rest nor return"), (None, "another attractor")],
)
def test_what_is_not_known_of_the_unsettled_is_said(kind: str | None, words: str) -> None:
    said = sentence(Remark("systems.unsettled", {"share": 0.25, "kind": kind}))
    assert said.startswith("25% of the recorded states lead to no equilibrium: ") and said.endswith(words)


def test_what_ends_at_a_pole_outside_the_domain_is_not_asked_for_its_cycle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Repressor and Cro of phage λ; backwards in time many states come to r = -20, where f has a pole."""
    asked: list[np.ndarray] = []

    def noted(_: Dynamics, starts: np.ndarray, **__: object) -> Recurrence:
        asked.append(starts)
        return Recurrence("none")

    monkeypatch.setattr("siq.systems.phase_portrait.recurrence_of", noted)
    r, c = sympy.symbols("r c", real=True)
    free = 1 + r**2 / 4 + r**3 / 80 + 5 * c / 2 + 5 * c**2 / 8
    flow = (5 * (1 + 5 * r**2 / 2) / free - r / 50, 50 * (1 + 5 * c / 2) / free - c / 50)
    portrait = phase_portrait(Dynamics.of((r, c), flow, domain=[(0, 250)] * 2))
    assert len(portrait.attractors) == 2 and not portrait.cycles and not asked
