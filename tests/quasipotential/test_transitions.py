from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    maier_stein,
    portrait_of,
    potential_values,
    uniform_points,
)

from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.transitions import (
    Transition,
    _barrier_by_formula,
    _barrier_uncertainty,
    missing_diffusion,
    transitions,
    ways_out,
)
from siq.quasipotential.wells import Well, local_well
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait, phase_portrait


def sheared(known: KnownSystem, shear: np.ndarray) -> KnownSystem:
    """The same system in the states ``T x``, in which D is ``T D Tᵀ`` and no diagonal matrix."""
    symbols, back = known.dynamics.symbols, np.linalg.inv(shear)
    old = {
        symbol: sum(sympy.nsimplify(back[i, j]) * symbols[j] for j in range(len(symbols)))
        for i, symbol in enumerate(symbols)
    }
    inside = [equation.subs(old, simultaneous=True) for equation in known.dynamics.formulas]
    equations = tuple(
        sympy.expand(sum(sympy.nsimplify(row[j]) * inside[j] for j in range(len(symbols)))) for row in shear
    )
    return KnownSystem(
        Dynamics.of(symbols, equations, diffusion=shear @ known.diffusion @ shear.T),
        None if known.potential is None else sympy.expand(known.potential.subs(old, simultaneous=True)),
        known.attractors @ shear.T,
        known.domain,
    )


SYSTEMS = {
    "archetype": archetype(2),
    "double well": double_well(2),
    "Maier-Stein": maier_stein(1),
    "sheared archetype": sheared(archetype(2), np.array([[1.0, 0.5], [-0.25, 1.0]])),
}


@functools.cache
def formulas(name: str) -> tuple[Well, ...]:
    known = SYSTEMS[name]
    found = portrait_of(known, 250, share=0.8)
    options = RefinementOptions(degrees=(4,))
    return tuple(local_well(known.dynamics, found, index, options=options) for index in range(2))


@functools.cache
def ways(name: str, *, with_formulas: bool) -> tuple[Transition, ...]:
    """The two ways out of the two wells of a system, its f known to a thousandth."""
    known = SYSTEMS[name]
    local = formulas(name) if with_formulas else (None, None)
    return tuple(ways_of(known, portrait_of(known, 250, share=0.8), local))


def ways_of(
    known: KnownSystem,
    found: PhasePortrait,
    local: tuple[Well | None, ...],
    *,
    relative_error: float = 1e-3,
) -> list[Transition]:
    identified = exact_field(known, 3, relative_error=relative_error)
    return transitions(identified, ways_out(identified.dynamics, found), local)


def exact_barrier(known: KnownSystem, found: PhasePortrait, way: Transition) -> float:
    ends = np.stack([way.saddle.position, found.attractors[way.start].position])
    values = potential_values(known, ends)
    return float(2 * (values[0] - values[1]))


@pytest.mark.parametrize("name", SYSTEMS)
def test_barriers_are_those_of_the_exact_potential(name: str) -> None:
    known = SYSTEMS[name]
    found = portrait_of(known, 250, share=0.8)
    both = ways(name, with_formulas=True)
    assert [(way.start, way.end) for way in both] == [(0, 1), (1, 0)]
    for way in both:
        exact = exact_barrier(known, found, way)
        assert way.barrier == pytest.approx(exact, rel=1e-6)
        assert way.path is not None
        assert way.path.action == pytest.approx(exact, rel=1e-5)
        assert 0.95 < way.formula_share <= 1 + 1e-9
        assert way.rate is not None
        assert way.rate.barrier == way.path.action
        np.testing.assert_allclose(
            np.stack([way.path.points[0], way.path.downhill[-1]]),
            np.stack([found.attractors[i].position for i in (way.start, way.end or 0)]),
            atol=1e-6,
        )


def test_the_barrier_of_the_archetype_is_one() -> None:
    for way in ways("archetype", with_formulas=True):
        assert way.barrier == pytest.approx(1.0, rel=1e-6)
        # g has no divergence: (2π/λ) sqrt(|det M_S| / det M_A), with f's eigenvalue λ at the saddle.
        unstable = np.linalg.eigvals(SYSTEMS["archetype"].dynamics.jacobian(np.zeros((1, 2)))[0]).real.max()
        assert way.rate is not None
        assert way.rate.prefactor == pytest.approx(2 * np.pi / unstable * np.sqrt(2 / 4), rel=1e-3)
        assert way.notes == ()


def test_without_a_formula_the_path_alone_tells_the_barrier() -> None:
    for way in ways("double well", with_formulas=False):
        assert way.path is not None
        assert way.barrier == way.path.action
        assert way.formula_share == 0


def test_a_formula_that_is_believed_nowhere_leaves_the_path() -> None:
    (way, _), (local, _) = ways("double well", with_formulas=True), formulas("double well")
    assert way.path is not None
    nowhere = replace(local, tolerance=-1.0)
    assert _barrier_by_formula(way.path, nowhere) == (way.path.action, 0.0)


def test_a_barrier_is_put_together_where_the_formula_ends() -> None:
    (way, _), (local, _) = ways("double well", with_formulas=True), formulas("double well")
    assert way.path is not None
    # A formula that is a tenth too high, up to a level of a third, and the path from there on.
    well = replace(local, coefficients=1.1 * local.coefficients, reach=0.11, tolerance=0.2)
    barrier, share = _barrier_by_formula(way.path, well)
    assert 0.2 < share * barrier <= 0.22  # the last node of the path below the level
    exact = way.path.action
    assert barrier == pytest.approx(exact + share * barrier * (1 - 1 / 1.1), rel=1e-3)


@pytest.mark.parametrize("name", ["double well", pytest.param("sheared archetype", marks=pytest.mark.slow)])
def test_standard_errors_follow_from_small_changes_of_f(name: str) -> None:
    known = SYSTEMS[name]
    found = exact_field(known, 3)
    way = ways(name, with_formulas=False)[1]
    start = portrait_of(known, 250, share=0.8).attractors[1].position
    assert way.path is not None
    slope = np.array([barrier_slope(found, way, start, k) for k in range(len(found.values))])
    largest = np.abs(slope).max()
    for k, one in enumerate(slope):
        alone = np.zeros((len(slope), len(slope)))
        alone[k, k] = 1.0
        spread, _ = _barrier_uncertainty(way.path, replace(found, covariance=alone))
        assert spread == pytest.approx(abs(one), abs=2e-3 * largest)
    # Errors that go together, as those of coefficients do: only their signs tell whether they cancel.
    root = np.random.default_rng(0).normal(size=(len(slope), 3))
    spread, _ = _barrier_uncertainty(way.path, replace(found, covariance=root @ root.T))
    assert spread == pytest.approx(np.linalg.norm(slope @ root), rel=5e-3)


def barrier_slope(found: FieldEstimate, way: Transition, attractor: np.ndarray, k: int) -> float:
    """The derivative of a barrier with respect to a coefficient of f, by its own paths on both sides."""
    step = 1e-3 * abs(found.values[k])
    assert way.path is not None

    def action(change: float) -> float:
        values = found.values.copy()
        values[k] += change
        dynamics = found.dynamics.with_values(values)
        return minimum_action_path(
            dynamics, settled(dynamics, attractor), settled(dynamics, way.saddle.position),
            initial=[way.path.points],  # type: ignore[union-attr]
        ).action  # fmt: skip

    return (action(step) - action(-step)) / (2 * step)


def settled(dynamics: Dynamics, x: np.ndarray) -> np.ndarray:
    """The equilibrium near a state."""
    for _ in range(8):
        x = x - np.linalg.solve(dynamics.jacobian(x[None])[0], dynamics.drift(x[None])[0])
    return x


def test_a_barrier_of_a_known_f_has_no_error_and_one_twice_as_uncertain_twice_the_error() -> None:
    known, (way, _) = SYSTEMS["archetype"], ways("archetype", with_formulas=True)
    assert way.path is not None
    errors = [
        _barrier_uncertainty(way.path, exact_field(known, 3, relative_error=error))[0]
        for error in (1e-3, 2e-3)
    ]
    assert way.standard_error == pytest.approx(errors[0])
    assert errors[1] == pytest.approx(2 * errors[0])
    exact = exact_field(known, 3)
    exact = replace(exact, covariance=np.zeros_like(exact.covariance))
    assert _barrier_uncertainty(way.path, exact) == (0, 0)


def test_units_change_no_barrier_and_no_error() -> None:
    known = SYSTEMS["double well"]
    scale, speed = np.array([1e-3, 1e2]), 1e-4
    back = {symbol: symbol / s for symbol, s in zip(known.dynamics.symbols, scale, strict=True)}
    other = KnownSystem(
        Dynamics.of(
            known.dynamics.symbols,
            tuple(speed * s * f.subs(back) for s, f in zip(scale, known.dynamics.formulas, strict=True)),
            diffusion=speed * known.diffusion * np.outer(scale, scale),
        ),
        None,
        known.attractors * scale,
        known.domain * scale[:, None],
    )
    points = uniform_points(known, 250, share=0.8)
    found = phase_portrait(other.dynamics, points * scale)
    scaled = ways_of(other, found, (None, None))
    for one, two in zip(ways("double well", with_formulas=False), scaled, strict=True):
        assert (two.start, two.end) == (one.start, one.end)
        assert two.barrier == pytest.approx(one.barrier, rel=1e-6)
        assert two.standard_error == pytest.approx(one.standard_error, rel=1e-3)
        assert one.rate is not None and two.rate is not None
        assert two.rate.prefactor * speed == pytest.approx(one.rate.prefactor, rel=1e-3)


def test_a_saddle_that_leads_out_of_the_region_has_no_end() -> None:
    known = SYSTEMS["archetype"]
    x = np.random.default_rng(0).uniform([-1.8, -1.0], [0.1, 1.0], size=(300, 2))
    found = phase_portrait(known.dynamics, x)
    assert len(found.attractors) == 1
    (way,) = ways_of(known, found, (None,))
    assert way.start == 0 and way.end is None
    assert way.path is None and way.rate is None
    assert np.isnan([way.barrier, way.formula_share, way.standard_error]).all()
    np.testing.assert_allclose(way.saddle.position, 0, atol=1e-9)
    assert way.notes == ("behind the saddle lies no other attractor of the recorded region",)


def test_a_path_that_is_not_found_is_told_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    known = SYSTEMS["double well"]

    def fails(*_: object, **__: object) -> MinimumActionPath:
        raise NumericalFailure("no path has a finite action")

    monkeypatch.setattr("siq.quasipotential.transitions.transition_path", fails)
    found = portrait_of(known, 250, share=0.8)
    both = ways_of(known, found, (None, None))
    assert [(way.start, way.end, way.path) for way in both] == [(0, 1, None), (1, 0, None)]
    assert all(way.notes == ("no path has a finite action",) for way in both)


def test_where_v_is_not_smooth_at_the_saddle_there_is_a_barrier_but_no_escape_time() -> None:
    known = maier_stein(10)
    found = portrait_of(known)
    for way in ways_of(known, found, (None, None)):
        assert way.barrier == pytest.approx(0.34004, abs=1e-4)
        assert way.rate is None
        assert any("V is not smooth" in note for note in way.notes)


def test_where_d_is_missing_there_are_barriers_with_the_words_of_the_landscape() -> None:
    position, speed = sympy.symbols("x v", real=True)
    damped = Dynamics.of((position, speed), (speed, position - position**3 - speed))
    known = KnownSystem(
        damped, None, np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[-2.0, 2.0], [-2.0, 2.0]])
    )
    setting = portrait_of(known, 250, share=0.9)
    told = missing_diffusion(damped)
    assert told is not None and "of the form dx/dt = v" in told
    for way in transitions(exact_field(known, 3), ways_out(damped, setting), (None, None)):
        assert np.isfinite(way.barrier) and way.rate is None
        assert f"no escape time: {told}" in way.notes
    given = damped.with_diffusion(Diffusion(np.diag([1e-3, 1.0])))
    assert missing_diffusion(given) is None
    assert missing_diffusion(maier_stein(1).dynamics) is None


def test_extinction_that_noise_does_not_leave_is_no_well_and_the_way_there_has_its_barrier() -> None:
    prey, predators = sympy.symbols("n p", real=True)
    growth = 4 * (prey - sympy.Rational(1, 10)) * (1 - prey)
    alone = Dynamics.of((prey,), (prey * growth,), diffusion=[[prey**2]], domain=[(0, 1.4)])
    # Predators follow their prey and do not act on it. All saddles lie where there are none, and noise in
    # proportion to their number never leads over the one at (1, 0).
    both = Dynamics.of(
        (prey, predators),
        (prey * growth, predators * (prey - sympy.Rational(1, 2) - predators / 2)),
        diffusion=[[prey**2, 0], [0, predators**2]],
        domain=[(0, 1.4), (0, 1.5)],
    )
    # U = -2∫f/D from 1 down to 1/10.
    exact = float(sympy.integrate(2 * growth / prey, (prey, sympy.Rational(1, 10), 1)))
    for system in (alone, both):
        portrait = phase_portrait(system)
        assert {one.code for one in portrait.remarks} == {"systems.absorbing"}
        (way,) = ways_out(system, portrait, beyond_region=True)
        assert way.path is not None and way.end is None
        assert way.path.action == pytest.approx(exact, rel=1e-4)
        np.testing.assert_allclose(way.saddle.position, [0.1, 0][: system.dimension], atol=1e-9)
    dying = Dynamics.of((prey,), (-prey,), diffusion=[[prey]], domain=[(0, 1)])
    assert getattr(phase_portrait(dying).fault(), "code", None) == "systems.absorbing"


def test_a_saddle_on_an_invariant_boundary_leads_to_the_attractor_behind_the_next_one() -> None:
    prey, predators = sympy.symbols("n p", real=True)
    # Without predators f leads from (1/10, 0) to the saddle (1, 0), and from there to both at (1, 1).
    system = Dynamics.of(
        (prey, predators),
        (4 * prey * (prey - 0.1) * (1 - prey), predators * (prey - 0.5 - predators / 2)),
        domain=[(-0.1, 1.4), (-0.3, 1.5)],
    )
    found = ways_out(system, phase_portrait(system), beyond_region=True)
    ends = {(way.start, way.end) for way in found if way.saddle.position[0] < 0.5 and way.path is not None}
    assert ends == {(0, 1), (1, 0)}


def test_where_the_state_behind_is_shallow_the_law_errs_by_it() -> None:
    """ε over the lower of two depths: from a deep state the law was off by 70 % with an error of 12 %."""
    x = sympy.Symbol("x", real=True)
    system = Dynamics.of(
        (x,), (x - x**3 + sympy.Rational(1, 4),), diffusion=[[1 + x**2 / 2]], domain=[(-2, 2)]
    )
    deep, shallow = sorted(
        transitions(system, ways_out(system, phase_portrait(system)), [None, None]),
        key=lambda way: -way.barrier,
    )
    assert deep.barrier > 3 * shallow.barrier
    expected = np.hypot(1, deep.barrier / shallow.barrier), np.hypot(1, shallow.barrier / deep.barrier)
    assert (deep.rate.unknown, shallow.rate.unknown) == pytest.approx(expected)
