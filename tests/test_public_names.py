"""What a user imports from `siq`."""

from __future__ import annotations

import pytest

import siq


def test_every_public_name_can_be_called() -> None:
    assert siq.__all__ == sorted(siq.__all__, key=lambda name: (name.islower(), name))
    for name in siq.__all__:
        assert callable(getattr(siq, name)), name


def test_there_is_no_other() -> None:
    with pytest.raises(AttributeError, match="no attribute 'diagnosis_of'"):
        _ = siq.diagnosis_of
