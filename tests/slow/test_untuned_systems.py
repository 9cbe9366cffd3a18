"""Systems for which nothing was ever tuned: trained until certified, with one set of options for all.

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
from siq.networks.decomposition import CheckOptions, TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.study import Sampling, StateSpace
from siq.workflow.tables import Method

TRAINING = TrainingOptions(
    steps=8000,
    check=CheckOptions(first=500, every=500, attempts=2),
    batch_size=256,
    precision="float32",
    learning_rate=0.006,
    decay_steps=90,
    relative_dynamics=True,
    orthogonality_weight=1.0,
    representative_share=1.0,
    normalise_on="representative",
    potential_gain=3.0,
    matching="symmetric",
    matching_order=2,
)
DEGREE = 4
EVERYWHERE = 1e6  # a level above every recorded state


def trained_until_certified(known: KnownSystem, seed: int = 0) -> tuple[Analysis, np.ndarray]:
    """All that the pipeline finds of a known system, and the recorded states on which it is judged."""
    recordings, step = simulated(known)
    x = snapshot_pairs(recordings, pair_step=step).x0
    # The lowest three quarters of the states, where V is known; otherwise all of them.
    level = EVERYWHERE
    if known.potential is not None:
        values = potential_values(known, x)
        level = float(np.quantile(values - values.min(), 0.75))
        x = x[values < values.min() + level]
    settings = PipelineSettings(
        seed=seed,
        space=StateSpace(diffusion=known.diffusion.tolist()),
        sampling=Sampling(pair_step=step),
        identification=IdentificationOptions(degree=5 if known.dynamics.dimension < 5 else 3),
        training=TRAINING,
        published_method=False,
        regression=RegressionOptions(degree=DEGREE, level=level),
        landscape=None,
    )
    began = time.perf_counter()
    found = analyse(recordings, settings, device="cpu")
    print(f"\n{found.trained.outcome}, {time.perf_counter() - began:.0f} s")
    return found, x


def certificate_of(found: Analysis) -> Mapping[str, Any]:
    """The certificate of the refined formulas."""
    return found.refined.certificates[Method.REFINED]


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_systems_with_a_known_formula_are_certified_and_right(name):
    torch.set_num_threads(1)
    known = SYSTEMS[name]
    found, x = trained_until_certified(known)
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
    found, _ = trained_until_certified(maier_stein(beta))
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
    found, _ = trained_until_certified(known)
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
    found, _ = trained_until_certified(limit_cycle())
    certificate = certificate_of(found)
    assert not certificate["certified"]
    assert "limit cycle" in certificate["reason"]
