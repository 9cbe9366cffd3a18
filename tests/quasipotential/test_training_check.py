"""The check that ends a training, held against networks of which it is known what they are."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from known_systems import KnownSystem, archetype, exact_field, limit_cycle, linear_system, potential_values

from siq.networks.decomposition import CheckOptions
from siq.quasipotential.refinement import TrainingCheck


def check_of(known: KnownSystem, degree: int = 3) -> TrainingCheck:
    x = np.random.default_rng(0).uniform(*known.domain.T, (1500, len(known.domain)))
    return TrainingCheck(exact_field(known, degree), x, options=CheckOptions(), seed=0)


def verdict(checked: TrainingCheck, potential) -> bool:
    """Whether the check passes for networks whose V is a given function."""
    networks = SimpleNamespace(evaluate=lambda x: SimpleNamespace(potential=potential(x)))
    return checked.passes(networks)  # type: ignore[arg-type]


@pytest.mark.parametrize("known", [linear_system(2), linear_system(3), archetype(2)])
def test_networks_that_are_a_tenth_off_are_ready(known: KnownSystem) -> None:
    def rough(x: np.ndarray) -> np.ndarray:
        exact = potential_values(known, x)
        return exact + 0.1 * exact.std() * np.sin(x.sum(axis=1))

    assert verdict(check_of(known), rough)


def test_networks_that_are_flat_along_a_state_are_not() -> None:
    checked = check_of(archetype(2))
    assert not verdict(checked, lambda x: 0.5 * x[:, 1] ** 2)


def test_networks_that_know_nothing_are_not() -> None:
    checked = check_of(archetype(2))
    assert not verdict(checked, lambda x: np.sin(5 * x[:, 0]) * np.cos(4 * x[:, 1]))


def test_a_limit_cycle_is_hopeless_and_said_to_be() -> None:
    known = limit_cycle()
    checked = check_of(known)
    assert "limit cycle" in (checked.hopeless() or "")
    assert not verdict(checked, lambda x: potential_values(known, x))
