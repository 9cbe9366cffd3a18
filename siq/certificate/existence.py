"""Do the stable states and saddles that f has stay, whatever f its uncertainty allows for?

A well that the next recording might not show is no well. f is drawn from its distribution, rivals of its
terms included, and every equilibrium is followed from the identified f to the drawn one by Newton's method,
in small steps. It is lost where it vanishes together with another one, where its stability changes, and where
it has jumped to another one that is followed as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from siq.certificate.tests import Verdict
from siq.dynamics.equilibria import Equilibrium
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.phase_portrait import PhasePortrait
from siq.identify.identified_field import IdentifiedField
from siq.numerics.measured_text import place_text
from siq.numerics.normal_draws import normal_draws
from siq.numerics.share_text import percent

DRAWS = 200  # of f: a share of one in twenty is then known to ±0.015
STEPS = 10  # from the identified f to a drawn one
NEWTON = 6  # steps of Newton's method at each
SAME = 1e-3  # of the recorded box: closer equilibria are one
SETTLED = 1e-6  # of the recorded box, by which Newton's last step may still move
ROUNDING = 1e-13  # of a Jacobian: one that is singular to rounding need not stop the others
LARGEST_SHARE = 0.05  # of the draws in which an equilibrium may be lost: what is claimed is claimed at 95 %


def lost_shares(
    found: IdentifiedField, equilibria: Sequence[Equilibrium], *, box: np.ndarray, seed: int = 0
) -> np.ndarray:
    """In which share of the f that the data allow each equilibrium does not exist: shape ``(k,)``.

    Parameters
    ----------
    found
        f with its uncertainty.
    equilibria
        Of the identified f.
    box
        Shape ``(d, 2)``: the recorded region.
    seed
        Of the draws.
    """
    if found.noise_free or not equilibria:
        return np.zeros(len(equilibria))
    changes = _drawn_changes(found, np.random.default_rng(seed))
    followed = [_followed(found, one, changes, box) for one in equilibria]
    places = np.array([place for place, _ in followed])
    lost = np.array([gone for _, gone in followed])
    width = box[:, 1] - box[:, 0]
    far = np.array(
        [np.abs((at - one.position) / width).max(axis=1) for at, one in zip(places, equilibria, strict=True)]
    )
    met = np.zeros_like(lost)
    for one, two in itertools.combinations(range(len(equilibria)), 2):
        same = (np.abs((places[one] - places[two]) / width).max(axis=1) < SAME) & ~lost[one] & ~lost[two]
        # Whichever came from afar has jumped; both have where they come from equally far.
        met[one] |= same & (far[one] > far[two] / 2)
        met[two] |= same & (far[two] > far[one] / 2)
    return np.asarray((lost | met).mean(axis=1))


def check_existence(found: IdentifiedField, portrait: PhasePortrait, *, seed: int = 0) -> Verdict:
    """Whether attractors and the saddles between them exist with the whole uncertainty of f.

    Parameters
    ----------
    found
        f with its uncertainty.
    portrait
        Its equilibria.
    seed
        Of the draws.
    """
    saddles = {one.position.tobytes(): one for around in portrait.saddles for one in around}
    claimed = [*portrait.attractors, *saddles.values()]
    shares = lost_shares(found, claimed, box=portrait.box, seed=seed)
    if not len(shares):
        return Verdict(0.0, LARGEST_SHARE, True)
    worst = int(np.argmax(shares))
    value, one = float(shares[worst]), claimed[worst]
    if value <= LARGEST_SHARE:
        return Verdict(value, LARGEST_SHARE, True)
    kind = "stable state" if one.kind == "attractor" else "saddle"
    reason = (
        f"the recordings do not tell whether there is a {kind} at {place_text(one.position)}: it is missing"
        f" in {percent(value)} of the f that they allow for; record more about it"
    )
    return Verdict(value, LARGEST_SHARE, False, reason)


def _drawn_changes(found: IdentifiedField, draw: np.random.Generator) -> np.ndarray:
    """Changes of all coefficients, shape ``(n, q, d)``."""
    changes = np.zeros((DRAWS, found.library.size, found.library.dimension))
    own = normal_draws(np.zeros(len(found.support)), found.covariance, DRAWS, generator=draw)
    changes[:, found.support[:, 1], found.support[:, 0]] = own
    if found.rivals is not None:
        changes += found.rivals.drawn(DRAWS, generator=draw)
    return changes


def _followed(
    found: IdentifiedField, one: Equilibrium, changes: np.ndarray, box: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where changes of f lead an equilibrium, shape ``(n, d)``, and a mask of those that lose it."""
    library, width = found.library, box[:, 1] - box[:, 0]
    d = library.dimension
    first = [term.diff(symbol) for term in library.terms for symbol in library.symbols]
    derivative = compile_formulas(first, library.symbols)

    def jacobians(x: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        slopes = derivative(np.ascontiguousarray(x.T)).T.reshape(len(x), library.size, d)
        return np.einsum("nqj,nqi->nij", slopes, coefficients)

    x = np.repeat(one.position[None], len(changes), axis=0)
    lost = np.zeros(len(changes), dtype=bool)
    for step in range(1, STEPS + 1):
        coefficients = found.coefficients + changes * step / STEPS
        moved = np.full(len(x), np.inf)
        for _ in range(NEWTON):
            value = np.einsum("nq,nqi->ni", library.evaluate(x), coefficients)
            matrix = jacobians(x, coefficients)
            matrix = matrix + ROUNDING * np.abs(matrix).max(axis=(1, 2), keepdims=True) * np.eye(d)
            change = np.linalg.solve(matrix, value[..., None])[..., 0]
            moved = np.abs(change / width).max(axis=1)
            lost |= ~(moved < 1.0)
            x = np.where(lost[:, None], one.position, x - change)
        unstable = (np.linalg.eigvals(jacobians(x, coefficients)).real > 0).sum(axis=1)
        lost |= (moved > SETTLED) | (unstable != one.unstable)
        x = np.where(lost[:, None], one.position, x)
    return x, lost
