from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy

from siq.data.recordings import SnapshotPairs
from siq.inference.checks import mean_residual_probability
from siq.inference.diffusion_model import ResidualLikelihood, with_process_noise_rate
from siq.inference.field_estimate import FieldEstimate, read_field, write_field
from siq.inference.library import IdentificationOptions, candidate_library
from siq.inference.regression import identify_vector_field, residuals, with_noise_formula
from siq.systems.dynamics import Dynamics

X, Y = sympy.symbols("x y", real=True)
STEP, WITHIN, INTENSITY, FALSE = 0.02, 10, 0.1, 0.01
OPTIONS = IdentificationOptions(degree=3, false_terms=FALSE)
MULTIPLIED = Dynamics.of((X,), (X - X**3,), diffusion=((1 + sympy.Rational(3, 5) * X,),))
CONSTANT = Dynamics.of((X, Y), (X - X**3, -Y - X), diffusion=np.diag([1.0, 2.0]))
CORRELATED = Dynamics.of((X, Y), (X - X**3, -Y), diffusion=((1, 0), (0, sympy.Rational(1, 2) + X**2)))


def recorded(
    dynamics: Dynamics, *, seed: int, records: int = 20, samples: int = 1000,
    box: tuple[float, float] = (-0.8, 0.8), step: float = STEP, intensity: float = INTENSITY,
) -> SnapshotPairs:  # fmt: skip
    """Pairs of records by Euler and Maruyama with short steps, which here stand for the process itself."""
    draw = np.random.default_rng(seed)
    x = draw.uniform(*box, size=(dynamics.dimension, records))
    kept = [x]
    for _ in range(samples):
        for _ in range(WITHIN):
            numbers = draw.standard_normal(x.shape)
            kick = np.sqrt(intensity * step / WITHIN) * dynamics.diffusion.kicks(x, numbers)
            x = x + step / WITHIN * dynamics.drift_of_components(x) + kick
        kept.append(x)
    states = np.array(kept)
    first, last = states[:-1].transpose(2, 0, 1), states[1:].transpose(2, 0, 1)
    d = dynamics.dimension
    count = records * samples
    return SnapshotPairs(
        first.reshape(-1, d),
        last.reshape(-1, d),
        np.full(count, step),
        np.repeat(np.arange(records), samples),
    )


def identified(dynamics: Dynamics, pairs: SnapshotPairs) -> FieldEstimate:
    library = candidate_library(dynamics.states, degree=OPTIONS.degree)
    return with_process_noise_rate(identify_vector_field(library, pairs, options=OPTIONS), pairs)


def terms_of(found: FieldEstimate) -> set[tuple[int, str]]:
    return {(int(i), found.library.names[k]) for i, k in found.support}


@pytest.fixture(scope="module")
def pairs() -> SnapshotPairs:
    return recorded(MULTIPLIED, seed=1)


@pytest.fixture(scope="module")
def found(pairs: SnapshotPairs) -> FieldEstimate:
    one = with_noise_formula(identified(MULTIPLIED, pairs), pairs, false_terms=FALSE)
    assert one is not None
    return one


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_noise_in_proportion_to_what_it_drives_is_that_where_it_is_least_too(step: float) -> None:
    """A grazed pasture: D is four hundred times larger in the one state than in the other."""
    grazed = X * (1 - X / 10) - 2 * X**2 / (1 + X**2)
    pasture = Dynamics.of((X,), (grazed,), diffusion=((X**2,),))
    pairs = recorded(pasture, seed=3, box=(0.4, 9.0), step=step, intensity=0.04)
    library = candidate_library(("x",), degree=5)
    one = identify_vector_field(library, pairs, options=IdentificationOptions(degree=5, false_terms=FALSE))
    found = with_noise_formula(with_process_noise_rate(one, pairs), pairs, false_terms=FALSE)
    assert found is not None and found.noise is not None
    assert [str(term) for term in found.noise.terms] == ["x**2"]
    assert found.noise.values == pytest.approx([0.04], rel=0.05)


def test_more_residuals_than_memory_has_room_for_are_thinned(
    pairs: SnapshotPairs, found: FieldEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("siq.inference.diffusion_model.MAX_NUMBERS", 2e4)  # a sixth of them
    thinned = with_noise_formula(identified(MULTIPLIED, pairs), pairs, false_terms=FALSE)
    assert thinned is not None and thinned.noise is not None and found.noise is not None
    assert thinned.noise.terms == found.noise.terms
    assert (np.abs(thinned.noise.values - found.noise.values) < 4 * thinned.noise.standard_errors).all()


def test_a_noise_that_depends_on_the_state_is_found_with_its_formula(found: FieldEstimate) -> None:
    assert found.noise is not None
    assert [str(term) for term in found.noise.terms] == ["1", "x"]
    expected = INTENSITY * np.array([1, 0.6])
    assert (np.abs(found.noise.values - expected) < 4 * found.noise.standard_errors).all()
    assert (found.noise.standard_errors < 0.03 * expected).all()
    x = np.linspace(-1, 1, 9)[:, None]
    np.testing.assert_allclose(
        found.intensity * found.diffusion.at(x), found.noise.diffusion(1.0).at(x), rtol=1e-12
    )


def test_f_has_its_right_terms_with_the_weights_of_d(found: FieldEstimate) -> None:
    assert terms_of(found) == {(0, "x"), (0, "x**3")}
    off = (found.values - np.array([1, -1])) / np.sqrt(np.diag(found.covariance))
    assert (np.abs(off) < 4).all()


def test_the_geometric_mean_of_d_over_the_record_is_one(found: FieldEstimate, pairs: SnapshotPairs) -> None:
    logarithm = np.log(found.diffusion.at(pairs.x0)[:, 0, 0]).mean()
    assert logarithm == pytest.approx(0, abs=1e-3)  # the last refit of D moves it a little


def test_held_out_residuals_have_no_mean_left_and_a_missing_term_is_seen(found: FieldEstimate) -> None:
    unseen = recorded(MULTIPLIED, seed=2)
    assert mean_residual_probability(found, unseen) > 1e-3
    false = replace(found, coefficients=0.5 * found.coefficients)
    assert mean_residual_probability(false, unseen) < 1e-6


def test_a_field_with_a_formula_of_its_noise_survives_its_file(found: FieldEstimate, tmp_path: Path) -> None:
    write_field(tmp_path / "field.json", found, OPTIONS)
    record = read_field(tmp_path / "field.json")
    assert record is not None and record.noise is not None and found.noise is not None
    x = np.linspace(-1, 1, 5)[:, None]
    np.testing.assert_array_equal(record.diffusion.at(x), found.diffusion.at(x))
    np.testing.assert_array_equal(record.noise.covariance, found.noise.covariance)
    assert record.intensity == found.intensity


def test_a_given_formula_of_d_weighs_the_residuals(pairs: SnapshotPairs) -> None:
    first, known = identified(MULTIPLIED, pairs), MULTIPLIED.diffusion
    given = with_noise_formula(first, pairs, false_terms=FALSE, given=known)
    assert given is not None
    assert terms_of(given) == {(0, "x"), (0, "x**3")}
    assert given.diffusion is MULTIPLIED.diffusion


def test_of_two_states_each_entry_has_its_own_terms() -> None:
    pairs = recorded(CORRELATED, seed=3)
    found = with_noise_formula(identified(CORRELATED, pairs), pairs, false_terms=FALSE)
    assert found is not None and found.noise is not None
    shown = {
        (int(i), int(j), str(term))
        for (i, j), term in zip(found.noise.places, found.noise.terms, strict=True)
    }
    assert shown == {(0, 0, "1"), (1, 1, "1"), (1, 1, "x**2")}
    expected = INTENSITY * np.array([1, 0.5, 1])
    order = np.argsort(
        [f"{i}{term}" for (i, _), term in zip(found.noise.places, found.noise.terms, strict=True)]
    )
    assert (np.abs(found.noise.values - expected)[order] < 4 * found.noise.standard_errors[order]).all()


@pytest.mark.parametrize("dynamics", [CONSTANT, Dynamics.of((X,), (X - X**3,))])
@pytest.mark.parametrize(
    ("seeds", "most"),
    [
        (5, 1),  # more happen by chance in one of a thousand trials
        pytest.param(200, 7, marks=pytest.mark.slow),  # and here in one of a thousand
    ],
)
def test_a_constant_noise_is_given_up_as_rarely_as_asked(dynamics: Dynamics, seeds: int, most: int) -> None:
    given_up = 0
    for seed in range(seeds):
        pairs = recorded(dynamics, seed=seed, samples=250)
        one = identified(dynamics, pairs)
        given_up += ResidualLikelihood(one, pairs, residuals(one, pairs)).constant_probability() < FALSE
    assert given_up <= most


def test_what_forgetting_does_to_residuals_is_no_noise_that_depends_on_the_state() -> None:
    """A residual over a step of a fast relaxation is smaller where f relaxes faster."""
    dynamics = Dynamics.of((X,), (-3 * X - 6 * X**3,))
    pairs = recorded(dynamics, seed=0, samples=4000)
    one = identified(dynamics, pairs)
    assert ResidualLikelihood(one, pairs, residuals(one, pairs)).constant_probability() > FALSE
