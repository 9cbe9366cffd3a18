"""What follows from a landscape that was read back: invariant distribution, shares of wells, escapes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from two_lines import analysed

from siq.inference.field_estimate import write_field
from siq.inference.library import IdentificationOptions
from siq.quasipotential.landscape import LandscapeOptions
from siq.quasipotential.landscape_files import write_landscape
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.workflow.pipeline import Analysis
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import Method
from workflow import comparison
from workflow.comparison import first_stored

CARD = Path(__file__).parents[2] / "config" / "systems" / "maier-stein.yaml"
INTENSITY = 0.15  # ΔU/ε = 3.3: walkers settle, and change wells, within a short simulation


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Analysis:
    return analysed("system: maier-stein", tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def files(found: Analysis, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("run")
    field, landscape = folder / "vector_field.json", folder / "quasipotential.json"
    record = found.identified.result
    assert record is not None and found.landscape is not None and found.landscape.result is not None
    write_field(field, record, IdentificationOptions())
    write_landscape(landscape, found.landscape.result)
    return field, landscape


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch) -> Dynamics:
    """The card, with simulations that take a second."""
    monkeypatch.setattr(comparison, "DENSITY_WALKERS", 500)
    monkeypatch.setattr(comparison, "STEPS", 4000)
    monkeypatch.setattr(comparison, "WALKERS", 200)
    return load_system(CARD)


def asked(*intensities: float) -> PipelineSettings:
    return PipelineSettings(seed=1, invariant=intensities)


def test_the_first_landscape_with_heights_is_read_and_gives_the_same_u(
    found: Analysis, files: tuple[Path, Path], tmp_path: Path
) -> None:
    field, landscape = files
    empty = tmp_path / "empty.json"
    empty.touch()
    first = first_stored([empty, field], [empty, landscape])
    assert first is not None and found.landscape is not None and found.landscape.result is not None
    assert first[0] == 1
    x = np.array([[1.0, 0.0], [-0.7, 0.1], [0.5, -0.2]])
    assert first[1].global_quasipotential is not None
    np.testing.assert_allclose(first[1].quasipotential(x), found.landscape.result.quasipotential(x))


def test_the_density_of_two_like_wells_is_that_of_a_simulation(
    files: tuple[Path, Path], system: Dynamics, tmp_path: Path
) -> None:
    first = first_stored([files[0]], [files[1]])
    assert first is not None
    table, shares, densities = comparison.compare_invariant(
        asked(INTENSITY), system, first[1], {}, run=first[0], method="local formulas"
    )
    row = table.iloc[0]
    assert row["simulated_distance"] < 2 * row["sampling_floor"] and len(densities) == 1
    np.testing.assert_allclose(shares["share"], 0.5, atol=1e-3)
    np.testing.assert_allclose(shares["by_rates"], 0.5, atol=1e-6)


def test_the_density_of_a_formula_is_normalised_and_that_of_a_simulation(
    found: Analysis, system: Dynamics
) -> None:
    formulas = found.refined.formulas[Method.REFINED]
    table, shares, _ = comparison.compare_invariant(
        asked(INTENSITY), system, formulas, {}, run=0, method=str(Method.REFINED)
    )
    assert len(table) == 1 and shares.empty
    axes = [np.linspace(low, high, 801) for low, high in system.box]
    u = formulas.evaluate(np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")]))[0] * 2
    cell = np.prod([axis[1] - axis[0] for axis in axes])
    total = np.exp(-u / INTENSITY).sum() * cell
    assert table["quadrature"][0] == pytest.approx(total, rel=5e-3)


def test_nothing_is_simulated_where_nothing_was_asked(found: Analysis, system: Dynamics) -> None:
    formulas = found.refined.formulas[Method.REFINED]
    table, shares, densities = comparison.compare_invariant(
        asked(), system, formulas, {}, run=0, method="refined"
    )
    assert table.empty and shares.empty and densities == []


def test_escapes_are_simulated_beside_the_law(files: tuple[Path, Path], system: Dynamics) -> None:
    landscape = json.loads(files[1].read_text(encoding="utf-8"))
    settings = PipelineSettings(seed=2, landscape=LandscapeOptions(noise_intensities=(INTENSITY,)))
    table = comparison.run_escapes(settings, system, [None, landscape])
    assert list(table["transition"]) == ["A1 to A2", "A2 to A1"]
    for way, row in zip(landscape["transitions"], table.to_dict("records"), strict=True):
        law = way["prefactor"] * np.exp(way["barrier"] / INTENSITY)
        assert row["predicted"] == pytest.approx(law)
        # The law is the leading order: at ΔU/ε = 3.3 it is right to some ten per cent.
        assert 0.5 < row["simulated"] / law < 2
        assert row["escapes"] > 100
