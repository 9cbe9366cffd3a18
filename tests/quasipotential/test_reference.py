"""References that share no code with the method, against exact answers and against each other."""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io
from known_noise import multiplicative
from known_systems import linear_system, maier_stein, portrait_of, potential_values
from scipy.interpolate import RegularGridInterpolator

from siq.errors import InputError, NumericalFailure
from siq.quasipotential.landscape_comparison import (
    ReferenceLandscape,
    _relative_l2,
    compare_landscape,
    compare_overall,
    reference_landscape,
)
from siq.systems.cards import load_system
from siq.systems.phase_portrait import phase_portrait
from siq.validation.mesh import mesh_potential

ROOT = Path(__file__).parents[2]
PUBLISHED_MESH = Path(os.environ.get("SIQ_RESOURCES", "")) / "meshV1p0018.mat"


def reference_of(known) -> ReferenceLandscape:
    return reference_landscape(
        known.dynamics, portrait_of(known), box=known.domain, reach=1.0,
        generator=np.random.default_rng(0),
        mesh=lambda place, level: mesh_potential(
            known.dynamics, place, box=known.domain, level=level, nodes=256
        ),
    )  # fmt: skip


@pytest.fixture(scope="module")
def smooth() -> ReferenceLandscape:
    return reference_of(maier_stein(1))


def test_both_references_are_the_exact_quasipotential(smooth) -> None:
    exact = 2 * potential_values(maier_stein(1), smooth.points)
    for index, attractor in enumerate(smooth.attractors):
        own = exact - 2 * potential_values(maier_stein(1), attractor[None])
        inside = smooth.below(index, 0.9)
        assert inside.sum() > 500
        assert _relative_l2(smooth.characteristics[index][inside], own[inside]) < 1e-3
        assert _relative_l2(smooth.mesh[index][inside], own[inside]) < 1e-3
    np.testing.assert_allclose(smooth.barriers, 0.5, rtol=1e-5)
    np.testing.assert_allclose(smooth.mesh_barriers, 0.5, rtol=1e-3)
    np.testing.assert_allclose(smooth.heights, 0, atol=1e-6)


@pytest.mark.slow
def test_both_references_are_exact_where_the_noise_depends_on_the_state() -> None:
    known = multiplicative(2)
    found = reference_of(known)
    exact = 2 * potential_values(known, found.points)
    for index, attractor in enumerate(found.attractors):
        own = exact - 2 * potential_values(known, attractor[None])
        inside = found.below(index, 0.9)
        assert inside.sum() > 500
        assert _relative_l2(found.characteristics[index][inside], own[inside]) < 1e-3
        assert _relative_l2(found.mesh[index][inside], own[inside]) < 1e-3
    np.testing.assert_allclose(found.mesh_barriers, 0.5, rtol=1e-3)


def test_a_reference_comes_back_from_its_file(smooth, tmp_path) -> None:
    smooth.write(tmp_path / "r.npz")
    again = ReferenceLandscape.read(tmp_path / "r.npz")
    np.testing.assert_array_equal(again.characteristics, smooth.characteristics)
    np.testing.assert_array_equal(again.heights, smooth.heights)
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="no reference landscape"):
        ReferenceLandscape.read(tmp_path / "bad.npz")


def test_a_well_without_a_formula_counts_as_not_covered(smooth) -> None:
    places = tuple(SimpleNamespace(position=one) for one in smooth.attractors)
    nothing = SimpleNamespace(
        attractors=places, wells=(None, None), global_quasipotential=None, transitions=()
    )
    rows = compare_landscape(smooth, nothing, below=None)[:2]
    assert [row["covered"] for row in rows] == [0.0, 0.0] and all(np.isnan(row["error"]) for row in rows)


def test_the_reference_has_no_difference_from_itself(smooth) -> None:
    row = compare_overall(smooth.values, smooth.values, 0.4)
    assert row["points"] > 500 and row["covered"] == 1 and row["error"] == 0
    shifted = compare_overall(smooth.values, smooth.values + 3.0, 0.4, shifted=True)
    assert shifted["error"] < 1e-12


def test_without_a_saddle_there_is_no_level_to_compare_at() -> None:
    with pytest.raises(NumericalFailure, match="no saddle"):
        reference_of(linear_system(2))


@pytest.fixture(scope="module")
def resonator() -> ReferenceLandscape:
    system = load_system(ROOT / "config" / "systems" / "resonator.yaml")
    draw = np.random.default_rng(0)
    low, high = system.box.T
    setting = phase_portrait(system, draw.uniform(low, high, (400, 2)))
    return reference_landscape(
        system, setting, box=system.box, reach=1.2, generator=draw,
        mesh=lambda place, level: mesh_potential(system, place, box=system.box, level=level),
    )  # fmt: skip


@pytest.mark.slow
def test_three_methods_agree_on_the_resonator(resonator) -> None:
    np.testing.assert_allclose(resonator.barriers, [1.046857e-8, 8.16145e-9], rtol=1e-4)
    np.testing.assert_allclose(resonator.mesh_barriers, resonator.barriers, rtol=1e-3)
    for index in (0, 1):
        inside = resonator.below(index, 0.9)
        on_mesh, exact = resonator.mesh[index][inside], resonator.characteristics[index][inside]
        assert _relative_l2(on_mesh, exact) < 2e-3
    assert compare_overall(resonator.values, resonator.mesh_values, 1.2e-8)["error"] < 2e-3


@pytest.mark.slow
@pytest.mark.skipif(not PUBLISHED_MESH.is_file(), reason="SIQ_RESOURCES has no meshV1p0018.mat")
def test_the_published_mesh_is_as_far_off_as_was_found(resonator) -> None:
    data = scipy.io.loadmat(PUBLISHED_MESH)
    values = next(value for value in data.values() if isinstance(value, np.ndarray) and value.ndim == 2)
    axes = [np.linspace(-0.02, 0.02, size) for size in values.shape]
    at = RegularGridInterpolator(axes, 2 * values, bounds_error=False)
    published = at(resonator.points)
    published = published - at(resonator.attractors[:1])
    row = compare_overall(resonator.values, published, 1.2e-8)
    print(row)
    assert row["covered"] > 0.95
    assert 0.02 < row["error"] < 0.06
