"""Evidence: is a mechanism likelier than a smooth function, and could chance do as much?

Both are compared as whole explanations of what is missing, by their marginal likelihoods: along the
trajectories of the fit with the mechanism everything is linear, and amplitudes, shapes and functions have
normal priors. How large an effect is nobody knows beforehand, so that its size on the recordings is drawn
evenly on a logarithmic scale, for both alike. A smooth function could have been anything, and pays for it:
the more so the more the recordings tell. (MacKay, Information Theory, Inference, and Learning Algorithms,
chapter 28.)

Errors of a simulation that lacks more than what is in question hang together over time. Of n errors with an
integral correlation time τ, n/τ are independent; logarithms of likelihoods are divided by τ, as those of so
many errors are. Of white errors τ is 1.

Smooth functions are compared in all places by their evidence (`siq.diagnosis.evidence`), along the
trajectories of a fit and at several levels of random forces, as mechanisms are screened.

A mechanism that leaves something may be right and not alone, or wrong and alike. Effects without a name are
drawn as smooth functions in all places; along the trajectories of the recalibrated simulation everything is
linear, so that least squares tells how much of each the best mechanisms would explain.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from siq.diagnosis.dictionary import Roles
from siq.diagnosis.function_sites import (
    Place,
    Power,
    linearised_with_places,
    places_in,
    powers,
    products_in,
    with_formula,
)
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.screening import PROBE_SUBSTEPS, Probe, ProbeColumns, levels_of, probe_response, projected
from siq.diagnosis.significance import correlation_time_of
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Grid, Noise, Whitened, profile_likelihood, solve, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics

LENGTHS = (0.125, 0.25)
"""Of the range of the coordinate, over which a smooth function without a name changes.

What is smoother is a constant, a straight line or a parabola, for which there are names.
"""
JITTER = 1e-9  # numerical: on the diagonal of a prior's covariance


def log_odds_of_a_name(
    fit: Fit,
    data: Measurements,
    candidates: Sequence[MechanismCandidate],
    roles: Roles,
    model: Dynamics,
    *,
    considered: Sequence[MechanismCandidate],
    unnamed: float,
) -> float:
    """Logarithm of the odds that what is missing is the mechanism, rather than a function without a name.

    Parameters
    ----------
    fit, data
        The fit with the mechanism in place, and the recordings.
    candidates
        The mechanism; where there are several, all of them together against one function.
    roles, model
        The simulation as its author believes it, and the roles of its states.
    considered
        The mechanisms that could have been named: each name is as likely beforehand, and so is each of its
        forms and places.
    unnamed
        Probability beforehand that what is missing has no name.

    Returns
    -------
    float
        Positive where the name is likelier.
    """
    ours, theirs = -np.inf, []
    single = places_in(model, roles, data, fit.x)
    there = {name for each in candidates for name in each.equations}
    products = products_in([each for each in single if there & set(each.targets)], model, data, fit.x)
    for response, some in linearised_with_places(fit, data, (*single, *products)):
        problem = Missing(whiten(response, data, fit.noise), fit, candidates)
        ours = problem.log_evidence_of_mechanisms()
        theirs += [
            problem.log_evidence_of_function(columns, place) for columns, place in problem.functions(some)
        ]
    if not theirs:
        return np.inf
    forms = Counter(each.name for each in considered)
    chosen = sum(np.log(len(forms) * forms[each.name]) for each in candidates if forms[each.name])
    named = ours + np.log1p(-unnamed) - chosen
    nameless = scipy.special.logsumexp(theirs) + np.log(unnamed) - np.log(len(theirs))
    return float(named - nameless)


class Missing:
    """What is missing, as a linear problem: innovations without the mechanism, and what could explain them.

    Parameters
    ----------
    white
        Innovations of the fit with the mechanism, with columns of its parameters and of places.
    fit
        The fit.
    candidates
        The mechanisms whose effect counts as missing.
    """

    def __init__(self, white: Whitened, fit: Fit, candidates: Sequence[MechanismCandidate]) -> None:
        names = [fit.model.parameters[place].name for place in fit.model.free]
        own = white.columns[:, : len(names)]
        change, _ = solve(own, white.innovations)
        values = fit.model.values[list(fit.model.free)] + change
        linear = [n for each in candidates for n in (each.amplitudes or each.shapes) if n in names]
        others = [n for each in candidates for n in each.shapes if n in names and n not in linear]
        self._tested = [names.index(name) for name in (*linear, *others)]
        self._linear = len(linear)
        rest = [place for place in range(len(names)) if place not in self._tested]
        self._basis = orthonormal(own[:, rest])
        effect = own[:, self._tested[: self._linear]] @ values[self._tested[: self._linear]]
        left = white.innovations - own @ change
        self.correlated = correlation_time_of(left, white.recording, outputs=len(fit.model.outputs))
        self._target = self._projected((left + effect)[:, None])[:, 0]
        self._total = float(self._target @ self._target)
        self._freedom = (white.degrees_of_freedom - len(rest)) / self.correlated
        self._values = values[self._tested]
        self._white, self._parameters = white, len(names)

    def _projected(self, columns: np.ndarray) -> np.ndarray:
        """Columns without what the other parameters can do, weighed as so many independent errors are."""
        return (columns - self._basis @ (self._basis.T @ columns)) / np.sqrt(self.correlated)

    def functions(self, places: Sequence[Place]) -> Iterator[tuple[np.ndarray, Place]]:
        """The columns of each place, its parameters' effect taken off, shape ``(n, k)``."""
        begin = self._parameters
        for place in places:
            columns = self._white.columns[:, begin : begin + len(place.knots)]
            begin += len(place.knots)
            if np.isfinite(columns).all():
                yield self._projected(columns), place

    def log_evidence_of_mechanisms(self) -> float:
        """Log-likelihood of the mechanisms, averaged over their amplitudes and shapes, to that of nothing.

        An amplitude has the size that the effect has; a shape may be off by as much as it is.
        """
        columns = self._projected(self._white.columns[:, self._tested])
        gram = columns.T @ columns
        own = np.diag(gram)[: self._linear]
        unit, wide = np.zeros(len(self._tested)), np.zeros(len(self._tested))
        unit[: self._linear] = 1.0 / np.where(own > 0, own, np.inf) / self._linear
        wide[self._linear :] = self._values[self._linear :] ** 2
        priors = [np.diag(size * unit + wide) for size in sizes_of_effects(self._total)]
        return averaged_evidence(gram, columns.T @ self._target, priors, self._total, self._freedom)

    def log_evidence_of_function(self, columns: np.ndarray, place: Place) -> float:
        """The same of a smooth function; see `evidence_of_function`."""
        return evidence_of_function(columns, self._target, place.knots, freedom=self._freedom)


def evidence_of_function(
    columns: np.ndarray, target: np.ndarray, knots: np.ndarray, *, freedom: float
) -> float:
    """Log-likelihood of a smooth function, averaged over its values, size and smoothness, to that of nothing.

    Parameters
    ----------
    columns
        What its value at each knot does to the innovations, in units of noise, shape ``(n, k)``.
    target
        The innovations, shape ``(n,)``.
    knots
        Shape ``(k,)``.
    freedom
        Degrees of freedom of the target.
    """
    total = float(target @ target)
    values = []
    for length in LENGTHS:
        along = columns @ np.linalg.cholesky(smooth_prior(knots, length))
        values.append(evidences_by_size(along.T @ along, along.T @ target, total, freedom=freedom)[0])
    return float(scipy.special.logsumexp(values) - np.log(np.size(values)))


def evidences_by_size(
    gram: np.ndarray, overlap: np.ndarray, total: float, *, freedom: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log-likelihood of columns with independent normal coefficients, for every size of these.

    Parameters
    ----------
    gram, overlap
        Of the columns with each other and with the target, in units of noise; shapes ``(k, k)`` and ``(k,)``.
    total, freedom
        Sum of squares of the target, and its degrees of freedom; see `log_evidence`.

    Returns
    -------
    gained, variance, rest
        Shape ``(s,)`` each: over that of nothing; of the coefficients, in units of the noise as it is with
        the columns; and the sum of squares then. All zero where no column does anything.
    """
    # In the eigenvectors of what the recordings tell, the evidence is a sum for every size.
    told, vectors = np.linalg.eigh(gram)
    told = np.maximum(told, 0.0)
    sizes = sizes_of_effects(total)
    if not told.any():
        return np.zeros(len(sizes)), np.zeros(len(sizes)), np.full(len(sizes), total)
    seen = (vectors.T @ overlap) ** 2
    scale = sizes[:, None] / told.sum()
    explained = (scale * seen / (1 + scale * told)).sum(axis=1)
    left = np.maximum(total - explained, 1e-12 * total)
    gained = -0.5 * np.log1p(scale * told).sum(axis=1) - 0.5 * freedom * np.log(left / total)
    return gained, scale[:, 0], left


def averaged_evidence(
    gram: np.ndarray, overlap: np.ndarray, priors: Sequence[np.ndarray], total: float, freedom: float
) -> float:
    """Logarithm of the mean evidence over priors; see `log_evidence`."""
    values = [log_evidence(gram, overlap, prior, total=total, freedom=freedom) for prior in priors]
    return float(scipy.special.logsumexp(values) - np.log(len(values)))


def sizes_of_effects(total: float) -> np.ndarray:
    """Expected squares of an effect's size on the recordings, in units of noise, evenly on a logarithm."""
    return np.exp2(np.arange(0.0, max(np.log2(max(total, 2.0)), 1.0) + 2))


def smooth_prior(knots: np.ndarray, length: float) -> np.ndarray:
    """Covariance of a smooth function at knots, as a share of whose range the length is given."""
    distance = np.subtract.outer(knots, knots) / np.ptp(knots)
    return np.exp(-0.5 * (distance / length) ** 2) + JITTER * np.eye(len(knots))


def log_evidence(
    gram: np.ndarray, overlap: np.ndarray, prior: np.ndarray, *, total: float, freedom: float
) -> float:
    """Log-likelihood of columns with normal coefficients, over that without them.

    Parameters
    ----------
    gram, overlap
        Of the columns with each other and with the target, in units of noise; shapes ``(k, k)`` and ``(k,)``.
    prior
        Covariance of the coefficients, shape ``(k, k)``.
    total, freedom
        Sum of squares of the target, and its degrees of freedom. The scale of the noise is at its best, so
        that a target much larger than noise does not make small differences count.

    Returns
    -------
    float
        -½ log det(1 + K G) - ½ν log(1 - q/total), with q = bᵀ K (1 + G K)⁻¹ b.
    """
    unit = np.eye(len(gram))
    inner = unit + gram @ prior
    sign, determinant = np.linalg.slogdet(inner)
    explained = float(overlap @ (prior @ np.linalg.solve(inner, overlap)))
    left = max(total - explained, 1e-12 * total)
    return float(-0.5 * determinant - 0.5 * freedom * np.log(left / total)) if sign > 0 else -np.inf


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of what columns span, shape ``(n, r)``."""
    if not columns.shape[1]:
        return columns
    scale = np.sqrt((columns**2).sum(axis=0))
    basis, values, _ = np.linalg.svd(columns / np.where(scale > 0, scale, 1.0), full_matrices=False)
    return basis[:, values > 1e-9 * values[0]] if values[0] > 0 else basis[:, :0]


def log_evidence_of(fit: Fit, data: Measurements, *, correlated: float = 1.0) -> float:
    """Log-likelihood of a whole explanation, less what its parameters would gain by chance.

    Schwarz's approximation of the marginal likelihood, -½ k log n, with random forces counted as
    parameters, so that explanations with and without them can be compared. What the recordings do not tell
    of the parameters does not count. Of parameters of which something is expected together, such as the
    heights of a smooth function, the likelihood is averaged over that (Laplace's approximation,
    -½ log det(1 + K G)), so that they count as few as the data tell. Where a recording begins is a parameter
    for each state, told or not, so that one more hidden state has to be worth its beginnings.

    Parameters
    ----------
    fit, data
        The explanation, and the recordings.
    correlated
        Correlation time τ of the errors in samples, the same for all explanations that are compared
        (`correlation_time_left`): log L/τ - ½ k log(n/τ).
    """
    white = whiten(fit.linearisation, data, fit.noise)
    names = [fit.model.parameters[place].name for place in fit.model.free]
    smooth = {name for each in fit.model.expected_together for name in each.names}
    basis = orthonormal(white.columns[:, [name not in smooth for name in names]])
    variances = int((fit.noise.process > 0).sum())
    count = max(float(white.known.sum()) / correlated, 2.0)
    price = 0.5 * (basis.shape[1] + variances) * np.log(count)
    beginnings = fit.model.dimension * len(data.labels)
    price += 0.5 * beginnings * np.log(max(count / len(data.labels), 2.0))
    if smooth:
        together = fit.model.expected_together
        own = white.columns[:, [names.index(name) for each in together for name in each.names]]
        own = own - basis @ (basis.T @ own)
        roots = scipy.linalg.block_diag(*(each.roots for each in together))
        told = np.linalg.svd(scipy.linalg.solve(roots.T, own.T), compute_uv=False) ** 2
        price += 0.5 * float(np.log1p(told / correlated).sum())
    return float(fit.log_likelihood / correlated - price)


def correlation_time_left(fits: Sequence[Fit], data: Measurements) -> float:
    """Correlation time of errors, as the likeliest of several fits leaves them, in samples.

    What the others leave is rather the effect that they lack.
    """
    known = [each for each in fits if np.isfinite(each.log_likelihood)]
    if not known:
        return 1.0
    closest = max(known, key=lambda each: each.log_likelihood)
    white = whiten(closest.linearisation, data, closest.noise)
    change, _ = solve(white.columns, white.innovations)
    left = white.innovations - white.columns @ change
    return correlation_time_of(left, white.recording, outputs=len(closest.model.outputs))


FITTED = 3  # places in which functions are fitted, the most likely ones: a choice


@dataclass(frozen=True)
class LikelyPlace:
    """A place, the logarithm of its evidence, and the level of random forces at which it is best.

    The evidence is that of a smooth function there over that of none, each at its best level.
    """

    place: Place
    log_evidence: float
    level: float


def likely_places(fit: Fit, data: Measurements, roles: Roles) -> list[LikelyPlace]:
    """All places, the one in which a smooth function is likeliest first.

    Functions of one coordinate are tried everywhere, and as coefficients of other coordinates in the
    equations in which they do best.
    """
    single = places_in(fit.model, roles, data, fit.x)
    ranked = _compared(fit, data, single)
    if not ranked:
        return []
    equations = {each.place.targets for each in ranked[:FITTED] if each.place.equations}
    products = products_in([each for each in single if each.targets in equations], fit.model, data, fit.x)
    return sorted((*ranked, *_compared(fit, data, products)), key=lambda each: -each.log_evidence)


def _compared(fit: Fit, data: Measurements, places: Sequence[Place]) -> list[LikelyPlace]:
    parameters = len(fit.model.free)
    found: dict[int, LikelyPlace] = {}
    alone = -np.inf
    for response, some in linearised_with_places(fit, data, places):
        for level in levels_of(fit):
            try:
                white = whiten(response, data, fit.noise.scaled(level))
                left, columns = projected(white, parameters)
            except NumericalFailure:  # without random forces an unstable simulation does not follow
                continue
            freedom = white.degrees_of_freedom - parameters
            base = profile_likelihood(float(left @ left), freedom, white.log_determinant)
            alone = max(alone, base)
            begin = 0
            for place in some:
                own = columns[:, begin : begin + len(place.knots)]
                begin += len(place.knots)
                value = base + evidence_of_function(own, left, place.knots, freedom=freedom)
                known = found.get(id(place))
                if own.any() and (known is None or value > known.log_evidence):
                    found[id(place)] = LikelyPlace(place, value, level)
    ranked = sorted(found.values(), key=lambda each: -each.log_evidence)
    return [replace(each, log_evidence=each.log_evidence - alone) for each in ranked]


def few_powers(likely: LikelyPlace, fit: Fit, data: Measurements, *, degree: int) -> tuple[Power, ...]:
    """The powers that a formula needs: each added as long as it earns its place (Schwarz).

    Errors count as correlated as all of the powers leave them (`siq.diagnosis.evidence`).
    """
    terms = powers(likely.place, degree=degree)
    probe = Probe(with_formula(fit.model, likely.place, terms), ())
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(fit.model, grid, [probe], fit.x, fit.model.values)
    white = whiten(probe_response(fit.model, grid, fit, columns), data, fit.noise.scaled(likely.level))
    left, own = projected(white, len(fit.model.free))
    count = independent(left, own, white, fit)
    chosen: list[int] = []
    total = float(left @ left)
    while len(chosen) < len(terms):
        sums = {}
        for place in range(len(terms)):
            if place not in chosen and own[:, place].any():
                some = own[:, [*chosen, place]]
                some = some / np.sqrt((some**2).sum(axis=0))
                sums[place] = float(((left - some @ np.linalg.lstsq(some, left, rcond=1e-9)[0]) ** 2).sum())
        if not sums:
            break
        best = min(sums, key=lambda place: sums[place])
        if count * np.log(total / max(sums[best], 1e-300)) < np.log(count):
            break
        chosen.append(best)
        total = sums[best]
    return tuple(terms[place] for place in sorted(chosen))


def independent(left: np.ndarray, columns: np.ndarray, white: Whitened, fit: Fit) -> float:
    """How many errors count as independent, if columns are fitted to what is left."""
    basis = orthonormal(columns)
    rest = left - basis @ (basis.T @ left)
    correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    return max(float(white.known.sum()) / correlated, 2.0)


DRAWS = 300  # effects without a name, which tell a probability of 5 % to 1 %


def probability_of_a_match(
    recalibrated: Fit,
    data: Measurements,
    probes: Sequence[Probe],
    roles: Roles,
    *,
    share: float,
    mechanisms: int,
    measurement: np.ndarray,
    generator: np.random.Generator,
) -> float:
    """Probability that so many mechanisms explain as large a share of an effect that has no name.

    Parameters
    ----------
    recalibrated, data
        The simulation with nothing added, and the recordings.
    probes
        What could have been named.
    roles
        Of the simulation's states.
    share
        Of the excess that the mechanisms explain.
    mechanisms
        How many they are.
    measurement
        Variance of the sensors' noise, shape ``(m,)``.
    generator
        Draws the effects.

    Raises
    ------
    NumericalFailure
        When the simulation, as linearised, runs away.
    """
    noise = Noise(measurement, np.zeros(recalibrated.model.dimension))
    effects = drawn_effects(recalibrated, data, roles, noise, generator=generator)
    model = recalibrated.model
    grid = Grid(data, min(recalibrated.substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(model, grid, probes, recalibrated.x, model.values)
    white = whiten(probe_response(model, grid, recalibrated, columns), data, noise)
    own = orthonormal(white.columns[:, : len(model.free)])
    effects = effects - own @ (own.T @ effects)
    effects = effects[:, (effects**2).sum(axis=0) > 0]
    if not effects.shape[1]:
        raise NumericalFailure("no effect can be seen in the recordings")
    groups, begin = [], len(model.free)
    for probe in probes:
        group = white.columns[:, begin : begin + probe.width]
        begin += probe.width
        if np.isfinite(group).all():
            groups.append(orthonormal(group - own @ (own.T @ group)))
    best = best_shares(effects, groups, mechanisms)
    return float((np.sum(best >= share) + 1) / (len(best) + 1))


def drawn_effects(
    fit: Fit, data: Measurements, roles: Roles, noise: Noise, *, generator: np.random.Generator
) -> np.ndarray:
    """What smooth functions in places drawn at random do to the innovations, shape ``(n, DRAWS)``."""
    places = places_in(fit.model, roles, data, fit.x)
    if not places:
        return np.zeros((data.outputs.size, 0))
    counts = generator.multinomial(DRAWS, np.full(len(places), 1 / len(places)))
    drawn, place = [], 0
    for response, some in linearised_with_places(fit, data, places):
        white = whiten(response, data, noise)
        begin = len(fit.model.free)
        for each in some:
            columns = white.columns[:, begin : begin + len(each.knots)]
            begin += len(each.knots)
            if np.isfinite(columns).all():
                for _ in range(counts[place]):
                    root = np.linalg.cholesky(smooth_prior(each.knots, generator.choice(LENGTHS)))
                    drawn.append(columns @ (root @ generator.normal(size=len(each.knots))))
            place += 1
    return np.stack(drawn, axis=1) if drawn else np.zeros((data.outputs.size, 0))


def best_shares(effects: np.ndarray, groups: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Share of each effect that the best so many groups explain, each chosen beside those before it.

    Parameters
    ----------
    effects
        Shape ``(n, e)``.
    groups
        Orthonormal columns of each group, shape ``(n, k)``.
    most
        How many groups.
    """
    size = (effects**2).sum(axis=0)
    left = effects.copy()
    chosen: list[list[np.ndarray]] = [[] for _ in size]
    for _ in range(most):
        explained = np.stack([((group.T @ left) ** 2).sum(axis=0) for group in groups])
        for place, best in enumerate(explained.argmax(axis=0)):
            chosen[place].append(groups[best])
            basis = orthonormal(np.concatenate(chosen[place], axis=1))
            left[:, place] = effects[:, place] - basis @ (basis.T @ effects[:, place])
    return 1 - (left**2).sum(axis=0) / size
