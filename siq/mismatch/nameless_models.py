"""Models of what has no name: what they consist of, how likely they are, and whether they run at all.

What explains the recordings best as a whole describes them, be it a function or a mechanism that was found
and is not certain enough for its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from siq.estimation.budget import Budget
from siq.estimation.fit import Fit
from siq.estimation.free_runs import UsualStates, free_run, normalised_rms
from siq.estimation.measurements import Measurements
from siq.mismatch.evidence import correlation_time_left, log_evidence_of
from siq.mismatch.function_places import Place
from siq.mismatch.roles import Roles
from siq.mismatch.smooth_functions import Smooth
from siq.mismatch.tried import TriedMechanism

MECHANISM = "mechanism"


@dataclass(frozen=True)
class Material:
    """What models are made from, and by which means.

    Attributes
    ----------
    data
        The recordings.
    roles
        Of the simulation's states.
    degree
        Highest degree of formulas.
    blocks
        For clustered errors; see `siq.mismatch.clusters.clustered_probability`.
    considered
        How many mechanisms there are.
    budget
        Charged for the work; the models that it does not reach are left out.
    """

    data: Measurements
    roles: Roles
    degree: int
    blocks: int
    considered: int
    budget: Budget = field(default_factory=Budget)


@dataclass(frozen=True)
class Part:
    """A part of a description.

    Attributes
    ----------
    trial
        What was added, fitted and judged.
    kind
        ``formula``, ``curve``, ``surface``, or ``mechanism``.
    cost
        Logarithm of the number of places, or mechanisms, that it was chosen among.
    place
        Where a function stands; None for a mechanism or a memory.
    smooth
        What a curve or a surface is made of: the amplitudes are the heights of its bumps.
    """

    trial: TriedMechanism
    kind: str
    cost: float
    place: Place | None = None
    smooth: Smooth | None = None


@dataclass(frozen=True)
class Model:
    """A simulation that describes what has no name.

    Attributes
    ----------
    parts
        What was added, in the order in which it was found.
    fit
        Of the simulation with all of it.
    log_evidence
        Of the whole over that of the simulation without its parts, less the costs of these; see `weighed`.
    exact
        The fit whose trajectories follow the equations, if random forces are part of `fit`.
    """

    parts: tuple[Part, ...]
    fit: Fit
    log_evidence: float = float("nan")
    exact: Fit | None = None

    @property
    def coordinates(self) -> int:
        """On how many coordinates the parts depend, each by itself."""
        return sum(1 if part.place is None else len(part.place.words) for part in self.parts)

    @property
    def cost(self) -> float:
        """Logarithm of how many combinations of parts this one was chosen among."""
        return sum(part.cost for part in self.parts)


def weighed(models: Sequence[Model], alone: Fit, data: Measurements) -> list[Model]:
    """Models with their evidence over that of a simulation without their parts, the likeliest first.

    Errors are as correlated as the model that fits best leaves them (`correlation_time_left`), for all.
    """
    fits = [each.fit for each in models]
    correlated = correlation_time_left([alone, *fits], data)
    without = log_evidence_of(alone, data, correlated=correlated)
    known = [
        replace(
            each,
            log_evidence=log_evidence_of(each.fit, data, correlated=correlated) - each.cost - without,
        )
        for each in models
    ]
    return sorted(known, key=lambda each: -each.log_evidence)


def runs_freely(fit: Fit, alone: Fit, data: Measurements) -> bool:
    """Whether a fit without random forces runs along the recordings, and nearer to them than one without it.

    A fit that holds on to every sample may not: where it is steeper than any step of an integration, it runs
    away from where it was held.
    """
    if fit.has_process_noise or alone.has_process_noise:
        return True
    errors = []
    for each in (fit, alone):
        # Steps twice as fine: what depends on them is no property of the simulation.
        usual = UsualStates.along(each.x)
        run = free_run(each.model, data, noise=each.noise, substeps=2 * each.substeps, usual=usual)
        errors.append(normalised_rms(data.outputs, run))
    one, other = errors
    return one is not None and (other is None or one < other)
