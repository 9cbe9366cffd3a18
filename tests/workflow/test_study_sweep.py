"""What a study may ask of a sweep, and how points are called."""

import pytest
from pydantic import ValidationError

from siq.workflow.study import Study, SweepOptions

BASE = {"name": "s", "system": "toggle", "from": "equations"}


def test_values_are_written_as_somebody_would():
    options = SweepOptions.model_validate({"parameter": "K", "from": 8, "to": 12, "step": 0.1})
    assert len(options.numbers) == 41 and options.numbers[1] == 8.1 and options.numbers[-1] == 12
    assert options.point_names[:3] == ["K=8", "K=8.1", "K=8.2"]


def test_another_range_has_the_same_names_where_they_overlap():
    def names(first, last):
        asked = {"parameter": "K", "from": first, "to": last, "step": 0.1}
        return set(SweepOptions.model_validate(asked).point_names)

    assert names(8, 9) < names(7, 12)


def test_two_parameters_are_combined():
    second = {"parameter": "h", "values": [0.5, -1e-5]}
    options = SweepOptions.model_validate({"parameter": "K", "values": [2, 1], "second": second})
    names = options.point_names
    assert names == ["K=1,h=-1e-05", "K=1,h=0.5", "K=2,h=-1e-05", "K=2,h=0.5"]
    points = [(("K", "h"), values) for values in options.points]
    assert [SweepOptions.of_point(name) for name in names] == points


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"from": 1, "to": 2}, "write 'from', 'to' and 'step', or 'values'"),
        ({"from": 1, "to": 2, "step": 0.1, "values": [1]}, "given twice"),
        ({"from": 2, "to": 1, "step": 0.1}, "exchange them"),
        ({"from": 1, "to": 2, "step": 3}, "shorten it"),
        ({"from": 1, "to": 2, "step": 1e-9}, "lengthen the step"),
        ({"values": [1], "second": {"parameter": "K", "values": [1]}}, "swept twice"),
        ({"from": 1, "to": 2, "step": 0}, "greater than 0"),
    ],
)
def test_bad_values_are_told_in_one_sentence(asked, message):
    with pytest.raises(ValidationError, match=message):
        Study.model_validate(BASE | {"sweep": {"parameter": "K"} | asked})


def test_trajectories_are_not_swept():
    asked = {"name": "s", "system": "toggle", "sweep": {"parameter": "K", "values": [1, 2]}}
    with pytest.raises(ValidationError, match="add 'from: equations'"):
        Study.model_validate(asked)
