"""Which test refuses which false solution.

The equation ∇V·(f + D∇V) = 0 has false solutions that are just as exact as the true one. Each false V that is
known is built here, and the tests that must refuse it are listed beside those that cannot see it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy
import torch
from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    double_well,
    exact_field,
    hamilton_jacobi_residual,
    limit_cycle,
    linear_system,
    maier_stein,
    polynomial_system,
    portrait_of,
    potential_gradient,
    potential_values,
    uniform_points,
)

from siq.data.recordings import Recordings, SnapshotPairs
from siq.inference.checks import PredictionLimits, check_prediction, prediction_errors
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.inference.library import candidate_library, monomial_exponents
from siq.networks.decomposition import AnyNetworks, NetworksByWell, shuffled
from siq.networks.networks import Networks, at_rest, initial_layers
from siq.numerics.randomness import representative_subset
from siq.quasipotential import certificate as certificate_module
from siq.quasipotential.certificate import (
    OF_DYNAMICS,
    OF_TIMES,
    TOLERANCE,
    Certificate,
    Evidence,
    _candidate_in_well,
    _follow_well,
    caustics_below,
    certify,
    certify_wells,
    check_agreement,
    references_about,
)
from siq.quasipotential.certificate_tests import (
    LEVEL_SHARE,
    MAX_ERROR_FROM_FIELD,
    MIN_POINTS,
    Candidate,
    CertificateOptions,
    Reference,
    _check_branch,
    _check_characteristics,
)
from siq.quasipotential.characteristics import SHEET_MARGIN, Fan, adapted_fan
from siq.quasipotential.formulas import exact_decomposition
from siq.quasipotential.global_formula import fit_values, refine_globally
from siq.quasipotential.hamilton_jacobi import LibraryBasis
from siq.quasipotential.wells import Well, _grow_well
from siq.remarks import Remark, sentence
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait, RecordedRegion
from siq.systems.simulation import SimulationOptions, simulate_snapshots

PASSED = Verdict(0.0, 0.01, True)
x, y, z = (sympy.Symbol(name, real=True) for name in "xyz")


def degree_of(known: KnownSystem) -> int:
    return max(
        sympy.Poly(equation, *known.dynamics.symbols).total_degree() for equation in known.dynamics.formulas
    )


def certified(
    known: KnownSystem,
    potential: sympy.Expr,
    *,
    found: FieldEstimate | None = None,
    networks: AnyNetworks | None = None,
    prediction: Verdict = PASSED,
    circulatory: tuple[sympy.Expr, ...] | None = None,
    share: float = 0.6,
    relative_error: float = 0.0,
) -> Certificate:
    """Certificate of a formula of V; g is f + D∇V unless it is given."""
    found = found or exact_field(known, degree_of(known))
    formulas = exact_decomposition(known.dynamics, 2 * potential)
    if circulatory is not None:
        formulas = replace(formulas, circulatory=circulatory)
    evidence = evidence_of(known, found, prediction=prediction, share=share)
    return certify(
        formulas, evidence, networks=networks, compared=networks is not None, relative_error=relative_error
    )


def networks_of(known: KnownSystem) -> AnyNetworks:
    """Stand-ins of networks whose V is that of a known system."""
    return SimpleNamespace(  # type: ignore[return-value]
        potential_at=lambda x: potential_values(known, x), gradients_at=lambda x: potential_gradient(known, x)
    )


def evidence_of(
    known: KnownSystem,
    found: FieldEstimate | None = None,
    *,
    prediction: Verdict = PASSED,
    share: float = 0.6,
    held_out: int = 150,
    count: int = 300,
) -> Evidence:
    """States from all over the domain, where each comes to in a hundredth of a time unit, characteristics."""
    x0 = uniform_points(known, held_out, seed=5, share=share)
    return Evidence(
        replace(found or exact_field(known, degree_of(known)), prediction=prediction),
        portrait_of(known, count, share=share), x0, pairs_from(known, x0, 0.01),
        references_of(known, share=share, count=count),
    )  # fmt: skip


def pairs_from(known: KnownSystem, x0: np.ndarray, h: float) -> SnapshotPairs:
    """Pairs without noise, by the classical Runge–Kutta rule."""
    drift = known.dynamics.drift
    first = drift(x0)
    second = drift(x0 + h / 2 * first)
    third = drift(x0 + h / 2 * second)
    fourth = drift(x0 + h * third)
    xh = x0 + h / 6 * (first + 2 * second + 2 * third + fourth)
    return SnapshotPairs(x0, xh, np.full(len(x0), h), np.arange(len(x0)))


def references_of(known: KnownSystem, *, share: float = 0.6, count: int = 300) -> tuple[Reference, ...]:
    """V by characteristics, made once for a system."""
    text = (str(known.dynamics.formulas), known.diffusion.tobytes(), known.domain.tobytes(), count, share)
    if text not in _REFERENCES:
        _REFERENCES[text] = references_about(known.dynamics, portrait_of(known, count, share=share))
    return _REFERENCES[text]


_REFERENCES: dict[tuple[object, ...], tuple[Reference, ...]] = {}


def over_terms(found: FieldEstimate, coefficients: np.ndarray) -> sympy.Expr:
    """V as a formula, from its coefficients over the library of f."""
    terms = zip(found.library.terms, coefficients, strict=True)
    return sympy.Add(*(sympy.Float(float(value)) * term for term, value in terms))


def refusals(certificate: Certificate) -> set[str]:
    return {name for name, verdict in certificate.tests.items() if not verdict.passed}


def wells_of(known: KnownSystem, *, degree: int = 4, share: float = 0.6) -> tuple[Well, ...]:
    """V about each attractor, made once for a system."""
    found = portrait_of(known, 300, share=share)
    key = (str(known.dynamics.formulas), degree, share)
    if key not in _WELLS:
        _WELLS[key] = tuple(
            _grow_well(
                known.dynamics, attractor, found.basins[index], found.saddles[index],
                degree=degree, generator=np.random.default_rng(0),
            )
            for index, attractor in enumerate(found.attractors)
        )  # fmt: skip
    return _WELLS[key]


_WELLS: dict[tuple[object, ...], tuple[Well, ...]] = {}


# ---------------------------------------------------------------------------------------- true solutions

TRUE = {
    "gradient system": partial(double_well, 2),
    **{f"linear in {d} dimensions": partial(linear_system, d) for d in (2, 4)},
    **{f"archetype in {d} dimensions": partial(archetype, d) for d in (2, 3, 4)},
    "Maier-Stein": partial(maier_stein, 1),
    **{f"polynomial, draw {seed}": partial(polynomial_system, 2, seed=seed) for seed in range(2)},
}
LARGE = ("polynomial, draw 1", "archetype in 4 dimensions")  # each has a smaller one of its kind beside it


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in LARGE else name for name in TRUE]
)
def test_the_true_solution_is_certified(name: str) -> None:
    known = TRUE[name]()
    certificate = certified(known, known.potential)
    assert certificate.certified, certificate.reason
    assert certificate.error < 1e-6
    assert certificate.tests["hamilton_jacobi"].value < 1e-10
    assert certificate.tests["branch"].value < 1e-6
    assert certificate.tests["descent"].value == 0


@pytest.mark.parametrize("name", ["gradient system", "archetype in 3 dimensions", "Maier-Stein"])
def test_the_true_solution_agrees_with_the_local_route(name: str) -> None:
    known = TRUE[name]()
    certificate = certified(known, known.potential, networks=networks_of(known))
    assert certificate.certified, certificate.reason
    assert certificate.tests["agreement"].value < 1e-8


def test_a_constant_in_v_means_nothing() -> None:
    known = TRUE["archetype in 3 dimensions"]()
    certificate = certified(known, known.potential + 17, networks=networks_of(known))
    assert certificate.certified, certificate.reason


# --------------------------------------------------------------------------------------- false solutions


@dataclass(frozen=True)
class FalseSolution:
    """A V that is wrong, the tests that must refuse it, and those that by their nature cannot."""

    known: KnownSystem
    potential: sympy.Expr
    refused_by: frozenset[str]
    blind: frozenset[str] = frozenset({"identity", "prediction"})


EXACT = frozenset({"identity", "prediction", "hamilton_jacobi"})


def separable() -> KnownSystem:
    """A gradient system V = V₁(x) + V₂(y), of which V₁ and V₂ alone solve the equation as well."""
    potential = (x**2 - 1) ** 2 / 4 + y**2 + y**4 / 4
    diffusion = np.diag([1.0, 0.5])
    equations = (-sympy.expand(potential.diff(x)), -sympy.expand(potential.diff(y)) / 2)
    return KnownSystem(
        Dynamics.of((x, y), equations, diffusion=diffusion), sympy.expand(potential),
        np.array([[-1.0, 0], [1.0, 0]]), np.array([[-2.0, 2.0], [-1.5, 1.5]]),
    )  # fmt: skip


def mirrored(known: KnownSystem) -> sympy.Expr:
    """V of the same system with its states exchanged: a formula of another system."""
    a, b = known.dynamics.symbols[:2]
    return known.potential.subs({a: b, b: a}, simultaneous=True)


def random_polynomial(known: KnownSystem, seed: int) -> sympy.Expr:
    draw = np.random.default_rng(seed)
    return sympy.Add(
        *(
            round(float(draw.normal()), 2)
            * sympy.Mul(*(s**e for s, e in zip(known.dynamics.symbols, row, strict=True)))
            for row in monomial_exponents(known.dynamics.dimension, 4)[1:]
        )
    )


def false_solutions() -> Iterator[tuple[str, FalseSolution]]:
    gradient, turning = separable(), archetype(3)
    across = (y + z) ** 2 / 4
    yield "flat along y", FalseSolution(gradient, (x**2 - 1) ** 2 / 4, frozenset({"branch"}), EXACT)
    yield "flat along x", FalseSolution(gradient, y**2 + y**4 / 4, frozenset({"branch"}), EXACT)
    # y and z couple to x through y + z alone, so that y - z may be left out.
    yield (
        "archetype, flat along y - z",
        FalseSolution(turning, (x**2 - 1) ** 2 / 2 + across, frozenset({"branch"}), EXACT),
    )
    yield (
        "archetype, y - z alone",
        FalseSolution(turning, (y - z) ** 2 / 4, frozenset({"branch"}), EXACT),
    )
    for name, known in {
        "archetype": archetype(2), "Maier-Stein": maier_stein(1), "gradient system": double_well(2),
        "linear": linear_system(2),
    }.items():  # fmt: skip
        yield f"{name}, zero", FalseSolution(known, sympy.S.Zero, frozenset({"hamilton_jacobi", "branch"}))
        yield f"{name}, a constant", FalseSolution(known, sympy.S(3), frozenset({"hamilton_jacobi"}))
        yield f"{name}, -V", FalseSolution(known, -known.potential, frozenset({"descent", "branch"}))
        yield (
            f"{name}, V/2",
            FalseSolution(known, known.potential / 2, frozenset({"branch", "hamilton_jacobi"})),
        )
        yield f"{name}, U for V", FalseSolution(known, 2 * known.potential, frozenset({"branch"}))
        yield (
            f"{name}, random polynomial",
            FalseSolution(known, random_polynomial(known, 0), frozenset({"hamilton_jacobi", "branch"})),
        )
    yield (
        "archetype with its states exchanged",
        FalseSolution(turning, mirrored(turning), frozenset({"hamilton_jacobi", "branch", "descent"})),
    )
    yield (
        "Maier-Stein with the V of the archetype",
        FalseSolution(maier_stein(1), archetype(2).potential, frozenset({"hamilton_jacobi", "branch"})),
    )
    yield (
        "archetype with the V of Maier-Stein",
        FalseSolution(archetype(2), maier_stein(1).potential, frozenset({"hamilton_jacobi", "branch"})),
    )
    yield (
        "one of two wells, as a parabola",
        # By symmetry both attractors have the curvature of this parabola.
        FalseSolution(
            archetype(2),
            2 * (x - 1) ** 2 + y**2 / 2,
            frozenset({"hamilton_jacobi", "descent"}),
            frozenset({"identity", "prediction", "branch"}),
        ),
    )


FALSE = dict(false_solutions())


@pytest.mark.parametrize("name", FALSE)
def test_false_solutions_are_refused_by_the_test_that_is_meant_for_them(name: str) -> None:
    case = FALSE[name]
    certificate = certified(case.known, case.potential)
    assert not certificate.certified
    assert case.refused_by | {"characteristics"} <= refusals(certificate), certificate.tests
    assert not case.blind & refusals(certificate), certificate.tests
    assert certificate.reason
    assert certificate.as_data()["certified"] is False


@pytest.mark.parametrize("name", [name for name, case in FALSE.items() if case.blind is EXACT])
def test_those_that_only_the_branch_sees_are_exact(name: str) -> None:
    case = FALSE[name]
    assert hamilton_jacobi_residual(case.known._replace(potential=sympy.expand(case.potential))) == 0


@pytest.mark.parametrize("name", ["gradient system", "Maier-Stein"])
def test_a_false_solution_disagrees_with_the_local_route(name: str) -> None:
    known = {"gradient system": separable(), "Maier-Stein": maier_stein(1)}[name]
    flat = (x**2 - 1) ** 2 / 4
    certificate = certified(known, flat, networks=networks_of(known))
    assert {"branch", "agreement"} <= refusals(certificate)


# ------------------------------------------------------------ invariant subspaces of linear systems


def riccati_solutions(jacobian: np.ndarray, diffusion: np.ndarray) -> list[np.ndarray]:
    """All real P with ``P J + Jᵀ P + 2 P D P = 0``, from invariant subspaces of the Hamiltonian matrix."""
    d = len(jacobian)
    hamiltonian = np.block([[jacobian, 2 * diffusion], [np.zeros((d, d)), -jacobian.T]])
    values, vectors = np.linalg.eig(hamiltonian)
    found: list[np.ndarray] = []
    for chosen in itertools.combinations(range(2 * d), d):
        rows = list(chosen)
        conjugate = sorted(values[rows].tolist(), key=lambda v: (v.real, v.imag))
        other = sorted(values[rows].conj().tolist(), key=lambda v: (v.real, v.imag))
        if not np.allclose(conjugate, other):
            continue
        upper, lower = vectors[:d, rows], vectors[d:, rows]
        if np.linalg.cond(upper) > 1e8:
            continue
        candidate = lower @ np.linalg.inv(upper)
        symmetric = np.abs(candidate - candidate.T).max() < 1e-7 * (1 + np.abs(candidate).max())
        if symmetric and np.abs(candidate.imag).max() < 1e-7:
            found.append((candidate.real + candidate.real.T) / 2)
    return found


def in_basis(basis: LibraryBasis, own: np.ndarray, points: np.ndarray, portrait: PhasePortrait) -> Candidate:
    return Candidate(
        values=lambda at: basis.values(at) @ own,
        gradients=lambda at: basis.gradients(at) @ own,
        hessians=lambda at: basis.hessians(at) @ own,
        circulatory=None,
        points=points,
        attractors=portrait.attractors,
    )


@pytest.mark.parametrize(
    ("dimension", "rotation", "seed"),
    [
        *[(2, 0.0, 0), (2, 0.3, 1), (2, 6.0, 0), (3, 0.0, 0)],
        *[pytest.param(*one, marks=pytest.mark.slow) for one in ((3, 6.0, 0), (4, 0.0, 0), (4, 0.5, 1))],
    ],
)
def test_every_other_invariant_subspace_is_refused(dimension: int, rotation: float, seed: int) -> None:
    known = linear_system(dimension, seed=seed, rotation=rotation)
    jacobian = known.dynamics.jacobian(np.zeros((1, dimension)))[0]
    true = np.array(sympy.hessian(known.potential, known.dynamics.symbols), dtype=float)
    solutions = riccati_solutions(jacobian, known.diffusion)
    modes = np.linalg.eigvals(jacobian)
    independent = int((np.abs(modes.imag) < 1e-12).sum()) + int((modes.imag > 1e-12).sum())
    assert len(solutions) == 2**independent
    found, library = (
        exact_field(known, 2),
        candidate_library([s.name for s in known.dynamics.symbols], degree=2),
    )
    basis = LibraryBasis(library, np.arange(1, library.size))
    portrait, points = portrait_of(known, 300, share=0.6), uniform_points(known, 150, seed=5, share=0.6)
    accepted = 0
    for hessian in solutions:
        residual = hessian @ jacobian + jacobian.T @ hessian + 2 * hessian @ known.diffusion @ hessian
        assert np.abs(residual).max() < 1e-6 * np.abs(true).max() * np.abs(jacobian).max()
        states = sympy.Matrix(known.dynamics.symbols)
        potential = sympy.expand((states.T * sympy.Matrix(hessian.tolist()) * states)[0] / 2)
        as_dict = potential.as_coefficients_dict()
        coefficients = np.array([float(as_dict.get(term, 0)) for term in library.terms])
        own = coefficients[1:]
        candidate = replace(in_basis(basis, own, points, portrait), references=references_of(known))
        equation = candidate.check_hamilton_jacobi(found, CertificateOptions())
        branch = _check_branch(candidate, found, CertificateOptions())
        followed, _ = _check_characteristics(candidate, found, CertificateOptions(), error=1e-6)
        if np.allclose(hessian, true, rtol=1e-6, atol=1e-8):
            accepted += 1
            assert equation.passed
            assert branch.passed
            assert followed.passed
        else:
            zero = np.abs(hessian).max() < 1e-9 * np.abs(true).max()
            assert equation.passed is not zero
            assert not branch.passed
            assert not followed.passed
    assert accepted == 1


# -------------------------------------------------------------------- what Gauss–Newton makes of bad starts


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_network_trained_for_too_short_ends_in_an_exact_false_solution(seed: int) -> None:
    known = archetype(3)
    found, points = exact_field(known, 5), uniform_points(known, 400, share=0.7)
    direction = np.random.default_rng(seed).normal(size=3)
    # V as a short training leaves it: hardly any curvature along y - z, and everything a little wrong.
    network = 0.9 * ((points[:, 0] ** 2 - 1) ** 2 / 2 + (points[:, 1] + points[:, 2]) ** 2 / 4)
    network += 0.03 * np.sin(points @ direction) + 0.02 * (points[:, 1] - points[:, 2]) ** 2
    start = fit_values(found.library, [points], [network])
    refined = refine_globally(start, found, points, sparse=False)
    rough, exact = (
        certified(known, over_terms(found, coefficients), found=found)
        for coefficients in (start, refined.potential)
    )
    assert {"hamilton_jacobi", "branch", "error"} <= refusals(rough)
    # Refined it solves the equation to rounding, and is off by three quarters.
    assert refined.residual < 1e-12
    own, true = found.library.evaluate(points) @ refined.potential, potential_values(known, points)
    assert np.std(own - true) > 0.5 * np.std(true)
    assert "branch" in refusals(exact)
    assert "hamilton_jacobi" not in refusals(exact)


@pytest.mark.parametrize("seed", range(2))
def test_a_randomised_network_is_refused(seed: int) -> None:
    known = archetype(3)
    found = exact_field(known, 4)
    points = uniform_points(known, 400, share=0.7)
    draws = [np.random.default_rng(seed)]
    ones = torch.ones(1, 1, 1, dtype=torch.float64)
    networks = Networks(
        potential=initial_layers((3, 20, 20, 1), generators=draws, dtype=torch.float64),
        circulatory=initial_layers((3, 20, 3), generators=draws, dtype=torch.float64),
        mean=torch.zeros(1, 1, 3, dtype=torch.float64), scale=torch.ones(1, 1, 3, dtype=torch.float64),
        potential_scale=ones, circulatory_scale=ones, diffusion=torch.eye(3, dtype=torch.float64),
    )  # fmt: skip
    random = shuffled(at_rest(networks, 0), generator=np.random.default_rng(seed))
    random = replace(
        random, potential=tuple((3 * weights, 3 * biases) for weights, biases in random.potential)
    )
    values = random.potential_at(points)
    start = fit_values(found.library, [points], [values])
    plain, refined = (
        certified(known, over_terms(found, coefficients), found=found)
        for coefficients in (start, refine_globally(start, found, points).potential)
    )
    assert not plain.certified
    assert {"hamilton_jacobi", "branch"} & refusals(plain)
    # Gauss–Newton may find the truth from anywhere, but then it is the truth.
    assert refined.certified is (refined.tests["branch"].value < 1e-6)


# ------------------------------------------------------------------------------ one test after the other


def test_a_limit_cycle_is_named_and_refused_without_any_division_by_zero() -> None:
    known = limit_cycle()
    fault = portrait_of(known, 300, share=0.6).fault()
    assert fault is not None
    assert "limit cycle" in sentence(fault)
    with np.errstate(all="raise"):
        certificate = certified(known, known.potential)
    assert not certificate.certified
    assert "branch" in refusals(certificate)
    assert "limit cycle" in certificate.reason
    assert certificate.as_data()["stated_error"] is None


def test_a_g_that_does_not_belong_is_refused_by_the_identity_alone() -> None:
    known = archetype(3)
    true = exact_decomposition(known.dynamics, 2 * known.potential)
    for wrong in [
        tuple(-g for g in true.circulatory),
        (true.circulatory[0] + x / 50, *true.circulatory[1:]),
        (sympy.S.Zero,) * 3,
    ]:
        certificate = certified(known, known.potential, circulatory=wrong)
        assert refusals(certificate) == {"identity"}
        assert certificate.reason == "V and g do not make up f"


def test_the_identity_sees_every_state_whatever_its_unit() -> None:
    units = np.array([1e3, 1e-3])
    known = archetype(2)
    back = {s: s / sympy.Rational(str(u)) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    scaled = KnownSystem(
        Dynamics.of(
            known.dynamics.symbols,
            tuple(
                sympy.expand(sympy.Rational(str(u)) * f.subs(back, simultaneous=True))
                for u, f in zip(units, known.dynamics.formulas, strict=True)
            ), diffusion=np.diag(units**2)),
        sympy.expand(known.potential.subs(back, simultaneous=True)),
        known.attractors * units, known.domain * units[:, None],
    )  # fmt: skip
    certificate = certified(scaled, scaled.potential)
    assert certificate.certified, certificate.reason
    true = exact_decomposition(scaled.dynamics, 2 * scaled.potential)
    for wrong in [
        (true.circulatory[0] * 2, true.circulatory[1]),
        (true.circulatory[0], true.circulatory[1] * 2),
    ]:
        assert refusals(certified(scaled, scaled.potential, circulatory=wrong)) == {"identity"}
    # The figures of a wrong V are the same in both units.
    one = certified(known, known.potential * sympy.Rational(21, 20))
    two = certified(scaled, scaled.potential * sympy.Rational(21, 20))
    for name in ("hamilton_jacobi", "branch", "identity"):
        assert two.tests[name].value == pytest.approx(one.tests[name].value, rel=0.02, abs=1e-9)
    assert two.error == pytest.approx(one.error, rel=0.05)


def test_the_v_of_another_system_is_refused_by_the_agreement_alone() -> None:
    known, other = archetype(2), maier_stein(1)
    certificate = certified(known, known.potential, networks=networks_of(other))
    assert refusals(certificate) == {"agreement"}


def test_a_v_that_is_flat_along_a_state_is_refused_though_it_solves_the_equation() -> None:
    known = archetype(2)
    flat = known._replace(potential=known.potential.subs(known.dynamics.symbols[0], 1))
    residual = potential_gradient(flat, uniform_points(known, 50))
    assert np.abs(residual[:, 0]).max() == 0
    assert refusals(certified(known, known.potential, networks=networks_of(flat))) == {"agreement"}


def test_agreement_is_relative_and_up_to_a_constant() -> None:
    known = archetype(2)
    scaled = known._replace(potential=sympy.Rational(101, 100) * known.potential + 5)
    formulas, evidence = exact_decomposition(known.dynamics, 2 * known.potential), evidence_of(known)
    verdict = check_agreement(networks_of(scaled), formulas, evidence)
    assert verdict.passed
    assert verdict.value == pytest.approx(0.01, rel=1e-6)
    # What its own residual leaves open is twice the truth, for safety.
    assert verdict.limit == pytest.approx(0.02, rel=0.1)
    assert check_agreement(networks_of(known), formulas, evidence).value < 1e-9


def test_networks_whose_residual_explains_any_difference_are_no_second_route() -> None:
    known = archetype(2)
    twice = known._replace(potential=sympy.Rational(3, 2) * known.potential)
    certificate = certified(known, known.potential, networks=networks_of(twice))
    assert refusals(certificate) == {"agreement"}
    assert "no second route" in certificate.reason


def test_networks_that_are_missing_are_no_second_route() -> None:
    known = archetype(2)
    certificate = certify(wells_of(known), evidence_of(known), compared=True)
    assert refusals(certificate) == {"agreement"}


def test_networks_that_are_not_to_be_compared_refuse_nothing() -> None:
    known = archetype(2)
    certificate = certify(wells_of(known), evidence_of(known), networks=networks_of(maier_stein(1)))
    assert certificate.certified and "agreement" not in certificate.tests


def held_out(known: KnownSystem) -> Recordings:
    options = SimulationOptions(trajectories=12, pairs=15, pair_step=0.01, interval=0.1)
    return simulate_snapshots(as_system(known), options=options, generator=np.random.default_rng(0))


def test_a_wrong_f_is_refused_by_the_prediction_alone() -> None:
    # Both routes share f: that of another system has a V as good as any.
    known, wrong = archetype(2), maier_stein(1)
    for dynamics, passes in [(known.dynamics, True), (wrong.dynamics, False)]:
        errors = prediction_errors(dynamics, held_out(known))
        prediction = check_prediction(
            noise_fault=None, errors=errors, mean_probability=None, held_out_ratio=1.0,
            limits=PredictionLimits(),
        )  # fmt: skip
        assert prediction.passed is passes
    certificate = certified(wrong, wrong.potential, prediction=prediction)
    assert refusals(certificate) == {"prediction"}
    assert certificate.reason == "f does not predict held-out recordings"


@pytest.mark.parametrize(
    ("options", "passes", "reason"),
    [
        ({"mean_probability": 0.3}, True, ""),
        ({"mean_probability": 1e-6}, False, "f misses a term"),
        ({"mean_probability": 0.3, "held_out_ratio": 1.3}, False, "worse than its own"),
        ({"mean_probability": 0.3, "noise_fault": "the recordings carry measurement noise"}, False, "carry"),
        ({"errors": np.array([1e-4, 1e-4, 5.0])}, True, ""),
        ({"errors": np.array([1e-4, 1.0, np.inf])}, False, "does not predict"),
        ({"errors": np.array([np.inf, np.inf])}, False, "does not predict"),
    ],
)
def test_the_verdict_on_f(options: dict, passes: bool, reason: str) -> None:
    settings = {
        "noise_fault": None, "errors": None, "mean_probability": None, "held_out_ratio": 1.0,
        "limits": PredictionLimits(),
    }  # fmt: skip
    verdict = check_prediction(**{**settings, **options})
    assert verdict.passed is passes
    assert (verdict.value <= verdict.limit) is passes
    assert reason in verdict.reason
    assert verdict.as_data()["passed"] is passes


def test_the_uncertainty_of_f_widens_the_limits_and_no_more() -> None:
    known, error = linear_system(2), 5e-3
    found = exact_field(known, 1, relative_error=error)
    certificate = certified(known, known.potential, found=found, relative_error=error)
    assert certificate.certified, certificate.reason
    assert certificate.error >= 2 * error
    free = certified(known, known.potential)
    for name in ("hamilton_jacobi", "branch", "identity"):
        assert certificate.tests[name].limit > free.tests[name].limit
    # A difference of many standard errors is refused all the same.
    wrong = known.potential * (1 + sympy.Float(60 * error))
    assert "branch" in refusals(certified(known, wrong, found=found, relative_error=error))


def test_a_well_that_is_missing_is_refused() -> None:
    known = archetype(2)
    certificate = certify(wells_of(known)[:1], evidence_of(known))
    assert "branch" in refusals(certificate)
    assert "1 of 2 attractors have no formula" in certificate.reason


def test_networks_must_agree_with_every_well() -> None:
    known = archetype(2)
    same = certify(wells_of(known), evidence_of(known), networks=networks_of(known), compared=True)
    assert same.certified, same.reason
    foreign = networks_of(maier_stein(1))
    different = certify(wells_of(known), evidence_of(known), networks=foreign, compared=True)
    assert refusals(different) == {"agreement"}


def networks_by_well(known: KnownSystem, states: np.ndarray, level: float) -> NetworksByWell:
    """Stand-ins that know V in two wells, left and right, up to 0.9 of their level, and err above."""

    def known_from(attractor: np.ndarray, x: np.ndarray) -> np.ndarray:
        values = potential_values(known, x) - potential_values(known, attractor[None])
        return values + 3 * np.maximum(values - LEVEL_SHARE * level, 0)

    parts: Any = tuple(
        SimpleNamespace(
            mean=one[None],
            potential_at=partial(known_from, one),
            gradients_at=partial(potential_gradient, known),
        )
        for one in known.attractors
    )
    side = (states[:, 0] > 0).astype(int)
    return NetworksByWell(parts, np.zeros(2), np.full(2, level), states, side)


@pytest.mark.parametrize("followed", [True, False], ids=["where curves come to", "at their own states"])
def test_networks_by_well_are_compared_in_each_well_below_their_level(followed: bool) -> None:
    known, wells = archetype(2), wells_of(archetype(2))
    evidence, level = evidence_of(known), wells[0].level
    rows = slice(None, 60 if followed else 0)  # few, as of a small well
    thin = [replace(one, points=one.points[rows], values=one.values[rows]) for one in evidence.references]
    evidence = replace(evidence, references=thin)
    grid = np.mgrid[-1.6:1.6:40j, -0.8:0.8:20j].reshape(2, -1).T
    # A formula that claims less than networks do is compared no higher than it claims.
    for claimed in (level, level / 2):
        formulas = [replace(one, level=claimed) for one in wells]
        verdict = check_agreement(networks_by_well(known, grid, level), formulas, evidence)
        assert verdict.passed and verdict.value < 1e-6
    few = check_agreement(networks_by_well(known, grid[::37], level), wells, evidence)
    assert followed or (not few.passed and "too few to compare two routes" in few.reason)


# ------------------------------------------------------------------------------- wells with a caustic


def fan_of(beta: float, level: float) -> Fan:
    known = maier_stein(beta)
    return adapted_fan(
        known.dynamics, known.attractors[0], level=level,
        box=np.array([[-2.0, 0.0], [-1.5, 1.5]]), generator=np.random.default_rng(0),
        count=32, most=120, rounds=3,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("beta", "barrier"), [(5, 0.4831), pytest.param(10, 0.34004, marks=pytest.mark.slow)]
)
def test_the_error_that_is_stated_lies_above_the_true_one(beta: float, barrier: float) -> None:
    known = maier_stein(beta)
    setting = portrait_of(known, 400)
    well = _grow_well(
        known.dynamics, setting.attractors[0], setting.basins[0], setting.saddles[0],
        degree=8, generator=np.random.default_rng(0),
    )  # fmt: skip
    certificate = certify([well], evidence_of(known, share=1.0, held_out=600, count=400))
    fan = fan_of(beta, barrier / 2)
    kept = fan.lowest_sheet()
    at, exact = fan.points[kept], fan.values[kept]
    inside = exact < 0.9 * barrier / 2
    at, exact = at[inside], exact[inside]
    rows = representative_subset(at, distance=0.03, generator=np.random.default_rng(0))
    true = np.linalg.norm(well.values(at[rows]) - exact[rows]) / np.linalg.norm(exact[rows])
    assert true < certificate.error < 0.15
    assert refusals(certificate) == {"branch"}  # as the other well is missing
    # At the saddle itself, the worst place for a polynomial, the error is up to twice the mean.
    assert abs(2 * well.level / barrier - 1) < 2 * certificate.error


def test_without_an_attractor_no_error_can_be_stated() -> None:
    known = archetype(2)
    candidate = Candidate(
        values=lambda at: potential_values(known, at), gradients=lambda at: at, hessians=lambda at: at,
        circulatory=None, points=uniform_points(known, 20), attractors=(),
    )  # fmt: skip
    assert candidate.stated_error(exact_field(known, 3)) == np.inf


def test_a_phase_portrait_with_a_fault_refuses_whatever_else_passes() -> None:
    known = archetype(2)
    setting = portrait_of(known, 300, share=0.6)
    escaped = replace(setting.descents, ends=np.where(np.arange(300) < 30, -1, setting.descents.ends))
    faulty: PhasePortrait = replace(setting, descents=escaped)
    assert faulty.fault() is not None
    formulas = exact_decomposition(known.dynamics, 2 * known.potential)
    evidence = evidence_of(known)
    certificate = certify(formulas, replace(evidence, portrait=faulty))
    assert not certificate.certified
    assert "another attractor" in certificate.reason
    assert certificate.tests["branch"].limit == certify(formulas, evidence).tests["branch"].limit > 0


KNOWN = maier_stein(1)
PORTRAIT = portrait_of(KNOWN, 300, share=0.6)
REGION = RecordedRegion.of_basin(PORTRAIT, 0)


@pytest.fixture(scope="module")
def well() -> Well:
    return wells_of(KNOWN)[0]


@pytest.fixture(scope="module")
def reference() -> Reference:
    return references_of(KNOWN)[0]


def evidence_in_well(count: int, reference: Reference | None) -> Evidence:
    x0 = uniform_points(KNOWN, count, seed=7, share=0.6)
    xh = x0 + 0.01 * KNOWN.dynamics.drift(x0)
    pairs = SnapshotPairs(x0, xh, np.full(count, 0.01), np.arange(count))
    references = () if reference is None else (reference,)
    return Evidence(KNOWN.dynamics, PORTRAIT, x0, pairs, references)


def test_a_basin_is_told_by_recorded_descents() -> None:
    side = PORTRAIT.attractors[0].position[0]  # -1 or 1; the ridge is at x = 0
    x = uniform_points(KNOWN, 300, seed=8, share=0.55)
    x = x[np.abs(x[:, 0]) > 0.2]
    assert (REGION.across(x) == (x[:, 0] * side < 0)).all()
    assert not REGION.recorded(np.array([[30.0 * side, 0.0]])).any()


def test_they_are_held_out_states_of_the_well_and_of_no_other(well: Well, reference: Reference) -> None:
    given = evidence_in_well(400, reference)
    part = _candidate_in_well(well, given)
    rows = {tuple(row) for row in given.points}
    assert len(part.points) >= MIN_POINTS and all(tuple(row) in rows for row in part.points)
    assert (part.points[:, 0] * well.attractor[0] > 0).all()
    assert (well.values(part.points) < 0.9 * well.level).all()
    assert part.claimed == 1.0 and "all held out" in part.tested_on
    # Pairs count by their first sample alone.
    inside = {tuple(row) for row in part.points}
    assert {tuple(row) for row in part.pairs.x0} == inside


def test_where_they_are_few_characteristics_give_more_and_it_is_said(
    well: Well, reference: Reference
) -> None:
    part = _candidate_in_well(well, evidence_in_well(40, reference))
    assert len(part.points) > MIN_POINTS
    assert "reached by characteristics" in part.tested_on
    alone = _candidate_in_well(well, evidence_in_well(40, None))
    assert 0 < len(alone.points) < MIN_POINTS and "characteristics" not in alone.tested_on


@pytest.mark.parametrize("name", ["characteristics", "descent", *OF_TIMES])
def test_what_was_not_tested_refuses_all_but_where_it_is_of_times(name: str) -> None:
    passed = Verdict(0.0, 1.0, True)
    tests = dict.fromkeys(["characteristics", "descent", *OF_TIMES], passed)
    whole = Certificate(tests, 0.1, "")
    assert whole.certified and whole.times_certified
    untested = Certificate(tests | {name: Verdict(np.nan, 1.0, False, tested=False)}, 0.1, "")
    assert untested.certified == (name in OF_TIMES) and not untested.times_certified
    failed = Certificate(tests | {name: Verdict(2.0, 1.0, False)}, 0.1, "")
    assert not failed.certified and not failed.times_certified
    assert not Certificate({"descent": passed}, 0.1, "").certified  # none is independent


def test_an_error_that_is_not_known_is_read_back_as_such() -> None:
    for error in (0.1, np.inf):
        whole = Certificate({"descent": Verdict(0.0, 1.0, True)}, error, "why")
        assert Certificate.from_data(whole.as_data()).error == error


# ------------------------------------------------------------------------------- what it comes to


LADDER = dict.fromkeys([*OF_DYNAMICS, "characteristics", "descent", "gaussian_force", *OF_TIMES], PASSED)
REFUSED, UNTESTED = Verdict(2.0, 1.0, False, "no"), Verdict(np.nan, 1.0, False, "too short", tested=False)


@pytest.mark.parametrize(
    ("changed", "rung"),
    [
        ({}, 6),
        *[({name: REFUSED}, 2) for name in (*OF_DYNAMICS, "gaussian_force", *OF_TIMES)],
        ({"characteristics": REFUSED}, 4),
        ({"descent": REFUSED}, 4),
        *[({name: UNTESTED}, 4) for name in OF_TIMES],
    ],
)
def test_an_answer_stands_on_the_rung_that_its_tests_bear(changed: dict[str, Verdict], rung: int) -> None:
    seen = SimpleNamespace(rung=2, limit=None)
    certificate = Certificate(LADDER | changed, 0.1, "")
    assert Certificate.rung(certificate, seen) == rung  # type: ignore[arg-type]
    assert Certificate.rung(certificate, seen, hidden=True) == (5 if rung > 2 else 2)  # type: ignore[arg-type]
    assert Certificate.rung(certificate, None) == (rung if rung > 2 else 0)
    # The states themselves are all that can be had of a record that changes, or that predicted nothing.
    other = SimpleNamespace(rung=2, limit=Remark("data.few_hops", {}))
    changing = SimpleNamespace(rung=2, limit=Remark("data.not_stationary", {}))
    assert Certificate.rung(certificate, other) == rung  # type: ignore[arg-type]
    assert Certificate.rung(certificate, changing) == 2  # type: ignore[arg-type]
    without = {name: one for name, one in certificate.tests.items() if name != "prediction"}
    assert Certificate.rung(replace(certificate, tests=without), seen) == 2  # type: ignore[arg-type]
    assert Certificate.rung(None, seen) == 2  # type: ignore[arg-type]


def test_further_tests_add_their_reasons_once() -> None:
    whole = Certificate({"characteristics": PASSED}, 0.1, "")
    assert whole.with_tests({"times": UNTESTED, "descent": PASSED}).reason == ""
    refused = whole.with_tests({"record": REFUSED, "descent": REFUSED, "prediction": UNTESTED})
    assert refused.reason == "no; too short" and whole.with_tests({"times": REFUSED}).reason == "no"
    assert set(refused.tests) == {"characteristics", "record", "descent", "prediction"}
    assert whole.certified and not refused.certified


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_what_is_open_is_the_fault_of_f_or_of_the_formula(share: float) -> None:
    known, found = archetype(2), exact_field(archetype(2), 3)
    for factor, reason in ((1.0, "f is not known well enough"), (0.5, "its residual leaves open")):
        potential = factor * known.potential
        verdict = certified(known, potential, found=found, relative_error=share).tests["error"]
        assert verdict.passed is (share == 0.0 and factor == 1.0)
        assert (reason in verdict.reason) is not verdict.passed
        # Twice the standard error of V is stated.
        assert verdict.value == pytest.approx(2 * share, rel=1e-6, abs=1e-6) or factor < 1
    limit = MAX_ERROR_FROM_FIELD / 2
    for near, passes in ((0.99 * limit, True), (1.01 * limit, False)):
        assert certified(known, known.potential, relative_error=near).tests["error"].passed is passes


def test_networks_may_be_off_by_what_f_leaves_open_and_by_three_standard_errors_of_their_own() -> None:
    known = archetype(2)
    for share in (0.0, 0.01):
        made = certified(known, known.potential, networks=networks_of(known), relative_error=share)
        assert made.tests["agreement"].limit == pytest.approx(5 * share, abs=2e-6)


@pytest.fixture(scope="module")
def vain(well: Well) -> Well:
    """The well with another curvature across: the residual is large, and it claims hardly anything."""
    wrong = np.where(well.basis.exponents[:, 1] == 2, 3.0, 1.0) * well.coefficients
    return Well(well.basis, wrong, well.dynamics, well.attractor, well.level, well.saddle, 1.0, well.points)


def test_a_formula_that_claims_hardly_anything_is_refused_with_its_place(
    vain: Well, reference: Reference
) -> None:
    given = evidence_in_well(400, reference)
    assert _candidate_in_well(vain, given).claimed < 0.5
    certificate = certify([vain], given)
    assert {"hamilton_jacobi", "error"} <= refusals(certificate) and certificate.error == np.inf
    assert "characteristics" not in certificate.tests
    name = "(−1, 0)" if vain.attractor[0] < 0 else "(1, 0)"
    said = certificate.tests["hamilton_jacobi"].reason
    assert f"in the well about {name}: raise refinement.degrees" in said
    recorded = certify([vain], replace(given, found=exact_field(KNOWN, 3)))
    assert "record more there, or raise" in recorded.tests["hamilton_jacobi"].reason


def test_without_a_state_to_compare_at_nothing_is_claimed(well: Well) -> None:
    given = replace(evidence_in_well(40, None), points=np.array([[1.9, 1.9], [-1.9, 1.9]]))
    assert "at 0% of" in certify([well], given).tests["hamilton_jacobi"].reason


def test_powers_stand_in_for_units_that_are_refused_and_for_no_others(vain: Well) -> None:
    both, evidence = wells_of(KNOWN), replace(evidence_of(KNOWN), found=KNOWN.dynamics)
    turn = slice(None) if np.array_equal(both[0].attractor, vain.attractor) else slice(None, None, -1)
    good, other = both[turn]
    for instead, passes in ((good, True), (replace(vain), False)):
        units = replace(vain, instead=instead)
        chosen, certificate = certify_wells([units, other], evidence)
        assert certificate.certified is passes
        assert chosen[0] is (good if passes else units) and chosen[1] is other
    kept = replace(good, instead=other)
    chosen, certificate = certify_wells([kept, other], evidence)
    assert certificate.certified and chosen[0] is kept
    chosen, certificate = certify_wells([kept, None], evidence)
    assert chosen == [kept, None] and "1 of 2 attractors have no formula" in certificate.reason
    assert "2 of 2 attractors" in certify_wells([None, None], evidence)[1].reason


def test_a_caustic_is_told_where_the_error_leaves_room_for_one(reference: Reference) -> None:
    remark = Remark("quasipotential.caustic", {})
    given = (reference, replace(reference, caustic=remark))
    assert caustics_below(given, 0.1) == (remark,) and caustics_below(given, 1e-6) == ()


# ------------------------------------------------------------------------------- how far curves are followed


def test_without_a_saddle_they_come_to_most_recorded_starts() -> None:
    known = linear_system(2)
    portrait = portrait_of(known, 300, share=0.6)
    (found,) = references_of(known)
    starts = potential_values(known, portrait.descents.paths[:, 0])
    assert LEVEL_SHARE * found.level == pytest.approx(np.quantile(starts, 0.9), rel=1e-6)
    assert (found.values <= LEVEL_SHARE * found.level * (1 + 1e-9)).all() and not found.fault
    # As many steps as a curve has may err by the tolerance each.
    assert 10 * TOLERANCE < found.error < 1000 * TOLERANCE


def test_where_they_cross_the_place_is_told_and_a_margin_between_sheets_stated() -> None:
    known = maier_stein(10)
    found = _follow_well(known.dynamics, portrait_of(known, 400), 0)
    assert found.error == pytest.approx(SHEET_MARGIN, rel=0.01) and found.caustic is not None
    # They meet on the axis of symmetry, where U = (x² - 1)²/2 whatever β is.
    across = float(str(found.caustic.values["place"]).strip("()").replace("−", "-").split(",")[0])
    assert found.caustic.values["level"] == pytest.approx((across**2 - 1) ** 2 / 2, rel=1e-3)


def test_where_a_barrier_is_known_they_are_followed_no_further() -> None:
    way = SimpleNamespace(start=0, path=SimpleNamespace(action=0.2))
    (low, high) = references_about(KNOWN.dynamics, PORTRAIT, ways=[way])
    assert low.level == 0.1 and low.values.max() <= LEVEL_SHARE * 0.1 * (1 + 1e-9)
    assert high.level == pytest.approx(0.25, rel=0.05)


def test_curves_that_draw_together_say_which_states_to_leave_out() -> None:
    stiff = KnownSystem(
        Dynamics.of((x, y), (-x, -50 * y)), None, np.zeros((1, 2)), np.array([[-2.0, 2.0]] * 2)
    )
    (found,) = references_of(stiff)
    assert 0 < len(found.values) < MIN_POINTS and f"give {len(found.values)} points" in found.fault
    assert "its rates being too different: leave out the fastest states" in found.fault


@pytest.mark.parametrize(("steps", "believed"), [(10, False), (11, True)])
def test_where_most_curves_stall_one_has_to_come_near_the_level(
    steps: int, believed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(certificate_module, "_level", lambda *_: 0.25)
    monkeypatch.setattr(certificate_module, "MAX_STEPS", steps)
    found = _follow_well(KNOWN.dynamics, PORTRAIT, 0)
    assert len(found.values) >= MIN_POINTS and ("too stiff" in found.fault) is not believed
    assert bool(found.values.max() >= 0.8 * LEVEL_SHARE * 0.25) == (not found.fault) == believed


def test_from_where_nothing_is_stable_none_is_followed() -> None:
    unstable = replace(KNOWN.dynamics, equations=tuple(-one for one in KNOWN.dynamics.equations))
    with np.errstate(invalid="ignore"):
        found = _follow_well(unstable, PORTRAIT, 0)
    assert "characteristics cannot be followed from the attractor" in found.fault
    assert found.points.shape == (0, 2) and found.values.shape == (0,) and found.error == np.inf
