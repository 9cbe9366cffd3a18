"""The answer beside the page of a diagnosis."""

from __future__ import annotations

import pytest

from siq.diagnosis.verdict import statement_of_failure
from siq.report.diagnosis_page import mismatch_answer

FIT = {"before": 0.5, "recalibrated": 0.1, "augmented": 0.02, "noise_floor": 0.01}


@pytest.mark.parametrize(
    ("verdict", "named", "described", "after"),
    [
        ("missing physics", ["cubic stiffness"], [], 0.02),
        ("missing physics", ["process noise"], [], 0.1),
        ("parameter shift", [], [], 0.1),
        ("unexplained", [], [], 0.1),
        ("unexplained", [], [{"kind": "curve"}], 0.02),
        ("no mismatch", [], [], 0.5),
    ],
)
def test_the_error_after_is_that_of_the_simulation_that_the_verdict_ends_with(
    verdict, named, described, after
):
    said = {
        "verdict": verdict, "sentence": "So.", "fit": FIT, "described": described,
        "mechanisms": [{"name": name} for name in named],
    }  # fmt: skip
    answer = mismatch_answer(said, title="A spring")
    assert answer == {
        "title": "A spring", "sentence": "So.", "verdict": verdict, "compared": True,
        "held_out_before": 0.5, "held_out_after": after, "held_out_noise": 0.01,
    }  # fmt: skip


def test_a_simulation_that_cannot_be_compared_says_so():
    answer = mismatch_answer(statement_of_failure("it runs away").as_data(), title="t")
    assert answer["compared"] is False and answer["held_out_before"] is None
