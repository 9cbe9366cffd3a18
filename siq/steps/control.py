"""What would the same refinement have made of networks with their weights in random order?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from siq.certificate.certificates import Certificate, uncertified
from siq.certificate.characteristics import Reference
from siq.certificate.common_tests import HARMLESS
from siq.certificate.tests import Function, Verdict
from siq.errors import NumericalFailure
from siq.networks.trained import TrainedNetworks, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.potential.symbolic import SymbolicDecomposition
from siq.steps.ground import Ground
from siq.steps.refined_routes import refined_by_routes


def control(
    ground: Ground,
    networks: TrainedNetworks,
    refined: SymbolicDecomposition | None,
    certificate: Certificate | None,
) -> dict[str, Any]:
    """What becomes of a network with its weights in random order, refined and tested as the real one is.

    Gauss–Newton from a random start ends nowhere, at a false solution that is as exact as the true one, or at
    the true one. The tests have to refuse the first two; `same_as_refined` tells the third.

    Parameters
    ----------
    ground, networks
        What the real refinement had.
    refined, certificate
        What came of it, None where nothing did.

    Returns
    -------
    dict
        A certificate as it stands in `model.json`. `same_as_refined` among its tests has the largest
        relative difference from the refined V in any well; it takes no part in whether it is certified.
    """
    draw = generator(ground.seed, ground.number, Purpose.SHUFFLE)
    randomised = shuffled(networks, generator=draw)
    options = replace(ground.options, routes=("network",))
    limit = ground.limits.hamilton_jacobi
    try:
        _, formulas, made = refined_by_routes(
            ground, options, lambda x: randomised.evaluate(x).potential, None
        )
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        nothing = Verdict(np.inf, limit, False, f"refinement from random weights led to no V: {error}")
        return uncertified(nothing.reason) | {"tests": {"hamilton_jacobi": nothing.as_data()}}
    data = made.as_data()
    if refined is None or certificate is None:
        return data
    difference = _difference(formulas, refined, ground.references)
    explained = HARMLESS + sum(one.error for one in (made, certificate) if np.isfinite(one.error))
    same = bool(difference <= explained)
    if made.certified:
        data["reason"] = (
            "refinement from random weights led to the same V" if same else
            "a V from random weights was certified that is not the refined one: one of the two is false"
        )  # fmt: skip
    verdict = Verdict(difference, explained, same, "" if same else "it is another V than the refined one")
    data["tests"]["same_as_refined"] = verdict.as_data()
    return data


def _difference(
    one: SymbolicDecomposition, two: SymbolicDecomposition, references: Sequence[Reference]
) -> float:
    """Largest relative L2 difference of two V about any attractor; infinite where one has none there."""
    worst = 0.0 if references else np.inf
    for reference in references:
        x, attractor = reference.points, reference.attractor
        first, second = (_about(formulas, attractor) for formulas in (one, two))
        if first is None or second is None or not len(x):
            return np.inf
        mine, theirs = (values(x) - values(attractor[None]) for values in (first, second))
        worst = max(worst, float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs)))
    return worst


def _about(formulas: SymbolicDecomposition, attractor: np.ndarray) -> Function | None:
    """V about an attractor: of the region, or of that well."""
    if formulas.potential is not None:
        return lambda x: np.asarray(formulas.evaluate(np.ascontiguousarray(x.T))[0])
    return next((one.values for one in formulas.wells if np.array_equal(one.attractor, attractor)), None)
