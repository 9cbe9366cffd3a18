"""On which states a formula about one attractor is tested: none that a fit saw."""

from __future__ import annotations

import numpy as np
import pytest
from known_systems import maier_stein, portrait_of, uniform_points

from siq.data.recordings import SnapshotPairs
from siq.inference.field_estimate import GivenField
from siq.quasipotential.certificate import Evidence, _candidate_in_well, _follow_well
from siq.quasipotential.certificate_tests import FEWEST, Reference
from siq.quasipotential.wells import Well, _grow_well
from siq.systems.phase_portrait import RecordedRegion

KNOWN = maier_stein(1)
PORTRAIT = portrait_of(KNOWN, 300, share=0.6)
REGION = RecordedRegion.of_basin(PORTRAIT, 0)


@pytest.fixture(scope="module")
def well() -> Well:
    return _grow_well(
        KNOWN.dynamics, PORTRAIT.attractors[0], PORTRAIT.basins[0], PORTRAIT.saddles[0],
        degree=4, generator=np.random.default_rng(0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def reference() -> Reference:
    return _follow_well(KNOWN.dynamics, PORTRAIT, 0)


def held_out(count: int, reference: Reference | None) -> Evidence:
    x0 = uniform_points(KNOWN, count, seed=7, share=0.6)
    xh = x0 + 0.01 * KNOWN.dynamics.drift(x0)
    pairs = SnapshotPairs(x0, xh, np.full(count, 0.01), np.arange(count))
    references = () if reference is None else (reference,)
    return Evidence(GivenField(KNOWN.dynamics), PORTRAIT, x0, pairs, references)


def test_a_basin_is_told_by_recorded_descents() -> None:
    side = PORTRAIT.attractors[0].position[0]  # -1 or 1; the ridge is at x = 0
    x = uniform_points(KNOWN, 300, seed=8, share=0.55)
    x = x[np.abs(x[:, 0]) > 0.2]
    assert (REGION.across(x) == (x[:, 0] * side < 0)).all()
    assert not REGION.recorded(np.array([[30.0 * side, 0.0]])).any()


def test_they_are_held_out_states_of_the_well_and_of_no_other(well: Well, reference: Reference) -> None:
    given = held_out(400, reference)
    part = _candidate_in_well(well, given)
    rows = {tuple(row) for row in given.points}
    assert len(part.points) >= FEWEST and all(tuple(row) in rows for row in part.points)
    assert (part.points[:, 0] * well.attractor[0] > 0).all()
    assert (well.values(part.points) < 0.9 * well.level).all()
    assert part.claimed == 1.0 and "all held out" in part.tested_on
    # Pairs count by their first sample alone.
    inside = {tuple(row) for row in part.points}
    assert {tuple(row) for row in part.pairs.x0} == inside


def test_where_they_are_few_characteristics_give_more_and_it_is_said(
    well: Well, reference: Reference
) -> None:
    part = _candidate_in_well(well, held_out(40, reference))
    assert len(part.points) > FEWEST
    assert "reached by characteristics" in part.tested_on
    alone = _candidate_in_well(well, held_out(40, None))
    assert 0 < len(alone.points) < FEWEST and "characteristics" not in alone.tested_on


def test_a_formula_answers_where_it_claims_to_hold(well: Well, reference: Reference) -> None:
    # An other curvature across: the residual is large, and the formula claims hardly anything.
    wrong = np.where(well.basis.exponents[:, 1] == 2, 3.0, 1.0) * well.coefficients
    other = Well(well.dynamics, well.attractor, well.basis, wrong, well.level, well.saddle, 1.0, well.points)
    assert _candidate_in_well(other, held_out(400, reference)).claimed < 0.5
