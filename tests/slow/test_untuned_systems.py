"""Systems for which nothing was ever tuned, with networks as a second route and with default options for all.

Minutes in all, and therefore no part of `make test`: ``make untuned`` runs them.
"""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from known_systems import KnownSystem, limit_cycle, maier_stein, potential_values
from untuned_systems import SYSTEMS, error_beside_mesh, simulated

from siq.data.recordings import snapshot_pairs
from siq.inference.library import IdentificationOptions
from siq.networks.decomposition import TrainingOptions
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.study import Sampling, StateSpace
from siq.workflow.tables import Method


def found_with_networks(known: KnownSystem, seed: int = 0) -> tuple[Analysis, np.ndarray]:
    """All that the pipeline finds of a known system, and the recorded states on which it is judged."""
    recordings, step = simulated(known)
    x = snapshot_pairs(recordings, pair_step=step).x0
    # The lowest three quarters of the states, where V is known; otherwise all of them.
    if known.potential is not None:
        values = potential_values(known, x)
        x = x[values < np.quantile(values, 0.75)]
    settings = PipelineSettings(
        seed=seed,
        space=StateSpace(diffusion=known.diffusion.tolist()),
        sampling=Sampling(pair_step=step),
        identification=IdentificationOptions(degree=5 if known.dynamics.dimension < 5 else 3),
        training=TrainingOptions(),
        published_method=False,
        landscape=None,
    )
    began = time.perf_counter()
    found = analyse(recordings, settings, device="cpu")
    certificate, networks = certificate_of(found), type(found.trained.result).__name__
    print(f"\n{networks}, {found.trained.outcome}, {time.perf_counter() - began:.0f} s")
    print(certificate["tests"].get("agreement"))
    return found, x


def certificate_of(found: Analysis) -> Mapping[str, Any]:
    """The certificate of the refined formulas."""
    return found.refined.certificates[Method.REFINED]


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_systems_with_a_known_formula_are_certified_and_right(name):
    torch.set_num_threads(1)
    known = SYSTEMS[name]
    found, x = found_with_networks(known)
    certificate, formulas = certificate_of(found), found.refined.formulas[Method.REFINED]
    assert certificate["certified"], certificate["reason"]
    assert formulas.potential is not None
    exact = potential_values(known, x)
    own = formulas.evaluate(np.ascontiguousarray(x.T))[0]
    difference = (own - own.min()) - (exact - exact.min())
    error = np.linalg.norm(difference - difference.mean()) / np.linalg.norm(exact - exact.min())
    print(f"{name}: relative error of V {error:.1e}, stated {certificate['stated_error']:.1e}")
    assert error < 1e-6


def barriers_beside(beta: int, known_barrier: float) -> Mapping[str, Any]:
    """The certificate of Maier and Stein's system; both barriers of U have to be within its stated error."""
    torch.set_num_threads(1)
    found, _ = found_with_networks(maier_stein(beta))
    certificate, wells = certificate_of(found), found.refined.formulas[Method.REFINED].wells
    levels = np.array([2 * well.level for well in wells])
    print({name: (test["value"], test["limit"]) for name, test in certificate["tests"].items()})
    print(f"β = {beta}: stated {certificate['stated_error']}, barriers of U {levels}")
    assert len(levels) == 2
    assert np.abs(levels / known_barrier - 1).max() < max(certificate["stated_error"] or 0, 0.05)
    return certificate


@pytest.mark.slow
def test_maier_stein_with_a_weak_caustic_is_certified_with_an_error():
    certificate = barriers_beside(5, 0.4831)
    assert certificate["certified"], certificate["reason"]


@pytest.mark.slow
def test_maier_stein_with_a_strong_caustic_has_wells_as_good_as_stated():
    torch.set_num_threads(1)
    known = maier_stein(10)
    found, _ = found_with_networks(known)
    certificate, wells = certificate_of(found), found.refined.formulas[Method.REFINED].wells
    error = error_beside_mesh(known, wells)
    print(
        f"β = 10: {certificate['reason'] or 'certified'}, stated {certificate['stated_error']}, true {error}"
    )
    assert len(wells) == 2
    assert error < certificate["stated_error"] < 0.15


@pytest.mark.slow
def test_a_limit_cycle_is_named_and_not_certified():
    torch.set_num_threads(1)
    found, _ = found_with_networks(limit_cycle())
    certificate = certificate_of(found)
    assert not certificate["certified"]
    assert "limit cycle" in certificate["reason"]
