"""Real records whose answers are known from elsewhere, where they are at hand: `docs/real-records.md`."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from siq.data.inspection import inspect
from siq.data.recordings import read_recordings
from siq.workflow.pipeline import Analysis, analyse

PLACE = Path(os.environ.get("SIQ_RESOURCES", ""))
ICE, CHIP = PLACE / "greenland-ice" / "ngrip.csv", PLACE / "neuromorphic-chip" / "activity.csv"


def refused(found: Analysis) -> bool:
    """Whether nothing is certified."""
    return found.refined.certificate is None or not found.refined.certificate.certified


@pytest.mark.slow
@pytest.mark.skipif(not ICE.is_file(), reason="the recordings are not at hand")
def test_dust_in_the_ice_has_two_states_whose_barrier_is_not_resolved() -> None:
    found = analyse(read_recordings(ICE, columns=["lnCa"]))
    assert refused(found) and found.landscape is not None and found.landscape.result is not None
    landscape = found.landscape.result
    places = np.array([one.position[0] for one in landscape.attractors])
    assert np.allclose(places, [4.0, 5.55], atol=0.25)
    visits = landscape.visits
    assert sum(one.whole.visits for one in visits) == pytest.approx(40, abs=6)
    # The published mean waiting time from onset to onset is 2,400 years.
    low, high = (sum(one.whole.limits[side] for one in visits) for side in (0, 1))
    assert low < 2400 < high
    for one in visits:
        assert one.method == "operator" and one.probability > 0.05
        assert abs(np.log(one.predicted / one.whole.mean)) < 0.7
    barriers = landscape.barriers()
    assert (barriers["barrier"] < 2 * barriers["standard_error"]).all()
    said = landscape.report()
    assert "as counted" in said and "not resolved" in said


@pytest.mark.skipif(not CHIP.is_file(), reason="the recordings are not at hand")
def test_the_states_of_the_chip_last_as_its_authors_say() -> None:
    record = read_recordings(CHIP, columns=["rate"])
    seen = inspect(record).switching
    assert seen is not None and seen.supported
    for count, authors in zip(seen.counts, (1.51, 0.313), strict=True):
        low, high = count.limits
        assert low < authors < high
    assert seen.transitions == pytest.approx(108, abs=20)
    assert refused(analyse(record))
