"""Every form of every mechanism is the truth once, and is named, alone or in a class of its look-alikes."""

from __future__ import annotations

import pytest
from homes_of_mechanisms import HOMES, RESIDENTS, Resident, recorded

from siq.diagnosis.dictionary import standard_dictionary
from siq.diagnosis.investigation import investigate
from siq.diagnosis.study import Comparison, MismatchStudy, MismatchVerdict

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("resident", RESIDENTS, ids=lambda each: f"{each.name} of {each.home} {each.label}")
def test_it_is_named_where_it_is_the_truth(resident: Resident) -> None:
    model, study = HOMES[resident.home].model, MismatchStudy()
    data = recorded(resident)
    found = investigate(Comparison(model, data, data, study, standard_dictionary()))
    assert found.verdict is MismatchVerdict.MISSING_PHYSICS
    first = found.search.found[0]
    named = {each.candidate.name for each in (first.best, *first.others["same"])}
    assert resident.name in named
