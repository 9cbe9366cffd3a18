"""What has a search found: which mechanisms, in which order, and what else was fitted or left untried?"""

from __future__ import annotations

from dataclasses import dataclass

from siq.estimation.fit import Fit
from siq.mismatch.probes import Probe
from siq.mismatch.screening import Screened
from siq.mismatch.tried import TriedMechanism, UntriedMechanism


@dataclass(frozen=True)
class Found:
    """A mechanism that stood the tests, and what else was fitted in its place.

    Attributes
    ----------
    best
        The mechanism.
    indistinguishable
        Those that explain the recordings as well.
    needless
        Those that explain as much, but with further parameters that do not earn their place.
    lesser
        Those that explain less.
    """

    best: TriedMechanism
    indistinguishable: tuple[TriedMechanism, ...]
    needless: tuple[TriedMechanism, ...] = ()
    lesser: tuple[TriedMechanism, ...] = ()


@dataclass(frozen=True)
class Search:
    """What a search ended with.

    Attributes
    ----------
    recalibrated
        The simulation with its own parameters fitted, and nothing else.
    found
        Mechanisms, in the order of their discovery; each was judged with those before it in place.
    fit
        Of the simulation with all of them.
    screened
        The last screening: every candidate with what it would gain.
    screened_beside
        Labels of the mechanisms that were in place for it. Where nothing was left to be explained, nothing
        was screened on top of the last mechanism.
    untried
        Candidates whose fit gave nothing that could be judged, with the reason.
    fruitless
        Labels of those that were fitted and gained nothing.
    """

    recalibrated: Fit
    found: tuple[Found, ...]
    fit: Fit
    screened: tuple[tuple[Probe, Screened], ...]
    untried: tuple[UntriedMechanism, ...] = ()
    screened_beside: tuple[str, ...] = ()
    fruitless: frozenset[str] = frozenset()
