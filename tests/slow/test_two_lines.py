"""Default settings alone: systems of which nobody told anything but where the data are.

Minutes in all, and therefore no part of `make test`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from known_systems import KnownSystem, limit_cycle, maier_stein, potential_values
from two_lines import analysed
from untuned_systems import SYSTEMS, error_beside_mesh, simulated

from siq.data.recordings import snapshot_pairs
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.study import StateSpace
from siq.workflow.tables import Method

pytestmark = pytest.mark.slow


def by_default(known: KnownSystem) -> tuple[Analysis, np.ndarray]:
    """What default settings and D give, and the recorded states."""
    recordings, _ = simulated(known)
    space = StateSpace(diffusion=known.diffusion.tolist())
    return analyse(recordings, PipelineSettings(space=space)), snapshot_pairs(recordings).x0


def barriers_of(found: Analysis) -> np.ndarray:
    assert found.landscape is not None and found.landscape.result is not None
    return found.landscape.result.barriers()["barrier"].to_numpy()


@pytest.mark.parametrize("name", SYSTEMS)
def test_systems_with_a_known_formula_are_certified_and_right(name: str) -> None:
    known = SYSTEMS[name]
    found, x = by_default(known)
    certificate, formulas = found.refined.certificates[Method.REFINED], found.refined.formulas[Method.REFINED]
    assert certificate["certified"], certificate["reason"]
    exact = potential_values(known, x)
    low = exact < np.quantile(exact, 0.75)  # beyond, hardly anything is recorded
    own, exact = formulas.evaluate(np.ascontiguousarray(x[low].T))[0], exact[low]
    difference = (own - own.min()) - (exact - exact.min())
    assert np.linalg.norm(difference - difference.mean()) / np.linalg.norm(exact - exact.min()) < 1e-8


def test_barriers_are_right_where_v_has_a_weak_kink() -> None:
    found, _ = by_default(maier_stein(5))
    certificate = found.refined.certificates[Method.REFINED]
    assert certificate["certified"], certificate["reason"]
    np.testing.assert_allclose(barriers_of(found), 0.4831, rtol=0.03)


def test_where_v_has_a_strong_kink_the_wells_are_as_good_as_stated() -> None:
    """They claim to hold on this side of the caustic alone, and are certified there."""
    known = maier_stein(10)
    found, _ = by_default(known)
    certificate = found.refined.certificates[Method.REFINED]
    assert certificate["certified"] and certificate["scope"] == "wells"
    assert error_beside_mesh(known, found.refined.wells) < certificate["stated_error"] < 0.05
    np.testing.assert_allclose(barriers_of(found), 0.34004, rtol=0.03)


def test_a_limit_cycle_is_named_and_not_certified() -> None:
    certificate = by_default(limit_cycle())[0].refined.certificates[Method.REFINED]
    assert not certificate["certified"] and "limit cycle" in certificate["reason"]


@pytest.mark.parametrize(
    ("card", "barriers", "within"),
    [
        ("archetype3d", (1.0, 1.0), 1e-8),
        ("maier-stein", (0.5, 0.5), 1e-8),
        ("resonator", (1.047e-8, 8.16e-9), 2e-3),  # by minimum action, to four and three digits
    ],
)
def test_studies_of_two_lines_are_certified_and_right(
    card: str, barriers: tuple[float, float], within: float, tmp_path: Path
) -> None:
    found = analysed(f"system: {card}", tmp_path)
    certificate = found.refined.certificates[Method.REFINED]
    assert certificate["certified"], certificate["reason"]
    np.testing.assert_allclose(barriers_of(found), barriers, rtol=within)
