"""What is stated of a part of what is missing, be it a mechanism or a function without a name?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Estimate:
    """A parameter's value with its standard error, None where it has none, and its unit."""

    estimate: float
    standard_error: float | None
    unit: str


@dataclass(frozen=True)
class Evidence:
    """Why a mechanism is believed; None where a test does not apply.

    Attributes
    ----------
    delta_chi2, delta_bic
        What it gains, see `siq.mismatch.tried.TriedMechanism`.
    p_white, p_cluster
        Probabilities of as much by chance: if all errors are independent, and whatever errors within a
        recording have to do with each other.
    log_odds
        Logarithm of the odds that it is this mechanism, rather than a function without a name.
    """

    delta_chi2: float | None
    delta_bic: float | None
    p_white: float | None
    p_cluster: float | None
    log_odds: float | None = None


Standing = Literal["same", "needless", "less"]


@dataclass(frozen=True)
class Rival:
    """A mechanism that was fitted in the place of one that was found.

    Attributes
    ----------
    name, label
        As of `StatedMechanism`.
    delta_chi2
        What it gains, compared with the same simulation.
    further_parameters
        How many more it has than the one that was found.
    standing
        ``same``: it explains the recordings as well. ``needless``: it explains as much, with further
        parameters that gain no more than they would by chance. ``less``: it explains less.
    """

    name: str
    label: str
    delta_chi2: float
    further_parameters: int
    standing: Standing


@dataclass(frozen=True)
class StatedMechanism:
    """A mechanism that is named, or that describes what has no name.

    Attributes
    ----------
    name, label
        Of the dictionary, and told apart from its other forms and places.
    terms
        Formula that is added, by equation; see `siq.mismatch.building.MechanismCandidate.changes`.
    parameters
        Those that it brings.
    evidence
        Why it is believed.
    share_of_excess
        What all mechanisms together explain of the excess over noise.
    indistinguishable_from
        Names of mechanisms that explain the recordings as well; None where it is not named itself.
    equations
        States in whose equations it changes something; none for a fault of the sensor.
    beside
        Labels of the mechanisms that were in place when it was judged.
    rivals
        What else was fitted in its place, the one that gains most first.
    """

    name: str
    label: str
    terms: Mapping[str, str]
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    share_of_excess: float
    indistinguishable_from: tuple[str, ...] | None = None
    equations: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    rivals: tuple[Rival, ...] = ()


@dataclass(frozen=True)
class DescribedCurve:
    """A function of one coordinate with its band.

    Attributes
    ----------
    coordinate
        Of which it is a function.
    at, value, standard_error
        In the units of the card; each as long.
    """

    coordinate: str
    at: tuple[float, ...]
    value: tuple[float, ...]
    standard_error: tuple[float, ...]


@dataclass(frozen=True)
class DescribedSurface:
    """A function of two coordinates on a grid, with its standard errors.

    Attributes
    ----------
    coordinates
        Of which it is a function.
    at
        The grid, along the first and along the second of them, in the units of the card.
    value, standard_error
        A row for each place along the first coordinate.
    """

    coordinates: tuple[str, str]
    at: tuple[tuple[float, ...], tuple[float, ...]]
    value: tuple[tuple[float, ...], ...]
    standard_error: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class StatedFunction:
    """A part of the model of what has no name.

    Attributes
    ----------
    name, label, terms, parameters, evidence, equations, beside
        As of `StatedMechanism`.
    kind
        ``formula``: a sum of a few powers. ``curve``, ``surface``: a smooth function of one coordinate, or of
        two, as a sum of Gaussian bumps. ``mechanism``: one of the dictionary that is not certain enough for
        its name.
    outputs
        What is measured otherwise, for a fault of the sensor.
    coordinates
        What it depends on.
    curve
        Where it is a function of one coordinate, or a curve; a curve in two coordinates is the coefficient of
        the second.
    surface
        Where it is a surface.
    """

    name: str
    label: str
    kind: Literal["formula", "curve", "surface", "mechanism"]
    terms: Mapping[str, str]
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    equations: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    coordinates: tuple[str, ...] = ()
    curve: DescribedCurve | None = None
    surface: DescribedSurface | None = None
    beside: tuple[str, ...] = ()
