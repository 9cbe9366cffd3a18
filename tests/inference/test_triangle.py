from __future__ import annotations

import numpy as np
import pytest

from siq.inference import selection
from siq.inference.selection import triangle_of


@pytest.mark.parametrize("goals", [(), (2,)])
def test_rows_taken_some_at_a_time_make_the_same_triangle(
    goals: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = np.random.default_rng(0)
    columns, wanted = draw.standard_normal((500, 3)), draw.standard_normal((500, *goals))
    monkeypatch.setattr(selection, "ROWS_AT_ONCE", 32)
    found = triangle_of(columns, wanted)
    together = np.column_stack([columns, wanted])
    assert found.shape == (together.shape[1],) * 2
    np.testing.assert_allclose(found.T @ found, together.T @ together, rtol=1e-12, atol=1e-10)
