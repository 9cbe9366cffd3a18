"""Systems for which nothing was ever tuned: trained until certified, with one set of options for all.

Minutes in all, and therefore no part of `make test`: ``make untuned`` runs them.
"""

import math
import time

import numpy as np
import pytest
import torch
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    limit_cycle,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_values,
)

from siq.certificate import CertificateOptions, check_prediction
from siq.certification import certify_formulas, certify_wells
from siq.decomposition.check import training_check
from siq.decomposition.data import prepare_data, slowest_part
from siq.decomposition.networks import at_rest
from siq.decomposition.options import CheckOptions, TrainingOptions
from siq.decomposition.training import start, train
from siq.held_out import held_out_recordings
from siq.identification import IdentificationOptions, identify_vector_field
from siq.library import candidate_library, joint_library
from siq.outline import evenly_spread, outline
from siq.prediction import prediction_errors
from siq.recordings import select_recordings, snapshot_pairs
from siq.refined_formulas import refined_decomposition
from siq.refinement import RefinementOptions, refine
from siq.simulate import SimulationOptions, simulate_snapshots
from siq.systems import System

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


def simulated(known: KnownSystem, *, trajectories: int = 1000, pairs: int = 30, seed: int = 1):
    """Recordings of a known system, sampled by its own time scales."""
    rates = [
        np.linalg.eigvals(known.field.jacobian(one[None])[0]).real.max() for one in known.attractors
    ] or [-1.0]
    speed = np.quantile(
        np.linalg.norm(
            known.field.jacobian(np.random.default_rng(0).uniform(*known.domain.T, (500, len(known.domain)))),
            axis=(1, 2),
        ),
        0.9,
    )
    relaxation = 1 / -max(rates)
    step = float(min(0.01, 0.1 / speed))
    # Where f is very fast somewhere, recordings that last until all is at rest would take too many steps.
    stride = min(max(math.ceil(3 * relaxation / pairs / (step / 5)), 6), 300)
    system = System(
        name="known", title="", time_unit="1",
        states=tuple(s.name for s in known.field.symbols), units=("1",) * known.field.dimension,
        domain=known.domain, symbols=known.field.symbols, equations=known.field.equations,
        diffusion=known.diffusion,
    )  # fmt: skip
    options = SimulationOptions(
        trajectories=trajectories, pairs=pairs, pair_step=step, interval=stride * step / 5
    )
    return simulate_snapshots(system, options=options, generator=np.random.default_rng(seed)), step


def trained_until_certified(known: KnownSystem, seed: int = 0):
    """Refined formulas with their certificate, and how long the training was."""
    recordings, step = simulated(known)
    held = held_out_recordings(recordings, generator=np.random.default_rng(seed))
    unseen = select_recordings(recordings, np.flatnonzero(held))
    training = select_recordings(recordings, np.flatnonzero(~held))
    pairs = snapshot_pairs(training, pair_step=step)
    library = candidate_library(recordings.names, degree=5 if known.field.dimension < 5 else 3)
    found = identify_vector_field(library, pairs, options=IdentificationOptions())
    verdict = check_prediction(
        noise_fault=None, errors=prediction_errors(found.field, unseen), mean_probability=None,
        held_out_ratio=1.0, limit=0.01,
    )  # fmt: skip
    data = prepare_data(
        snapshot_pairs(recordings, pair_step=step), options=TRAINING, generator=np.random.default_rng(seed)
    )
    check = training_check(
        found, data.training.x0, diffusion=known.diffusion, options=TRAINING.check, seed=seed
    )
    steps = 0
    for attempt in range(TRAINING.check.attempts):
        seeds = [np.random.SeedSequence([seed, attempt])]
        options = TRAINING.attempt(attempt)
        part = slowest_part(data, options.slowest_share)
        state = train(
            start([part], options=options, diffusion=known.diffusion, seeds=seeds), [part],
            options=options, seeds=seeds,
            finished=lambda _, networks: check.passes(at_rest(networks, 0)),
        )  # fmt: skip
        steps += state.step
        if state.step < TRAINING.steps or check.hopeless():
            break
    networks = at_rest(state.networks, 0)

    def network(x):
        return networks.evaluate(x).potential

    points = pairs.x0[evenly_spread(pairs.x0, generator=np.random.default_rng(seed))]
    level = np.quantile(network(points), 0.75)
    setting = outline(found.field, points, diffusion=known.diffusion, seed=seed)
    below = points[network(points) < level]
    refined = refine(
        found, setting, library=joint_library(library, degree=DEGREE, potential_degree=DEGREE),
        formula=None, network=network, points=below, diffusion=known.diffusion,
        options=RefinementOptions(), seed=seed,
    )  # fmt: skip
    x = snapshot_pairs(unseen, pair_step=step).x0
    formulas = refined_decomposition(refined, below)
    if formulas.potential is None:
        certificate = certify_wells(refined, setting, options=CertificateOptions(), prediction=verdict)
    else:
        certificate = certify_formulas(
            formulas, found, setting, x[network(x) < level], diffusion=known.diffusion,
            options=CertificateOptions(), prediction=verdict, wells=refined.wells,
        )  # fmt: skip
    return refined, formulas, certificate, below, steps


SYSTEMS = {
    **{f"linear in {d} dimensions": linear_system(d) for d in range(2, 7)},
    "Maier–Stein, β = 1": maier_stein(1),
    **{
        f"polynomial in {d} dimensions, draw {s}": polynomial_system(d, seed=s)
        for d in (2, 3)
        for s in (0, 1, 2)
    },
    "archetype in 3 dimensions": archetype(3),
    "gradient system": double_well(2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_systems_with_a_known_formula_are_certified_and_right(name):
    torch.set_num_threads(1)
    known = SYSTEMS[name]
    began = time.perf_counter()
    _, formulas, certificate, below, steps = trained_until_certified(known)
    print(f"\n{name}: {steps} steps, {time.perf_counter() - began:.0f} s, stated {certificate.error:.1e}")
    assert certificate.certified, certificate.reason
    assert formulas.potential is not None
    exact = potential_values(known, below)
    own = formulas.evaluate(np.ascontiguousarray(below.T))[0]
    difference = (own - own.min()) - (exact - exact.min())
    error = np.linalg.norm(difference - difference.mean()) / np.linalg.norm(exact - exact.min())
    print(f"relative error of V {error:.1e}")
    assert error < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("beta", [5, 10])
def test_maier_stein_with_a_caustic_states_an_error(beta):
    torch.set_num_threads(1)
    refined, _, certificate, _, steps = trained_until_certified(maier_stein(beta))
    levels = [2 * well.level for well in refined.wells]
    print(f"\nβ = {beta}: {steps} steps, stated {certificate.error:.2e}, barriers of U {levels}")
    print({name: (v.value, v.limit) for name, v in certificate.tests.items()})
    assert certificate.certified, certificate.reason
    assert len(refined.wells) == 2
    for level, known_barrier in zip(levels, [{5: 0.4831, 10: 0.34004}[beta]] * 2, strict=True):
        assert abs(level / known_barrier - 1) < max(certificate.error, 0.05)


@pytest.mark.slow
def test_a_limit_cycle_is_named_and_not_certified():
    torch.set_num_threads(1)
    *_, certificate, _, _ = trained_until_certified(limit_cycle())
    assert not certificate.certified
    assert "limit cycle" in certificate.reason
