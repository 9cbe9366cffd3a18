"""A universal differential equation: a network within the card's equations, trained through an integrator.

Multiple shooting: every segment has a first state of its own, and pays for not going on where the one before
it ended. The card's free parameters are trained, too. Of segments that are left out only first states are
fitted; they say when to stop, and whether the network foresees them better than the card alone does. Its
output is regressed on the library afterwards.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import sympy
import torch

from benchmarks.discrepancies.added import Network, products
from benchmarks.discrepancies.answers import Answer, Term
from benchmarks.discrepancies.refit import runs_better
from benchmarks.discrepancies.regression import SURE, Equation, chosen_terms, powers, sureness
from benchmarks.discrepancies.segments import Segments, segments_of
from benchmarks.discrepancies.sindy import WORSE, along, dynamic, strongest_term, values_of
from benchmarks.discrepancies.states import SeenStates, parts, seen_states, smooth
from siq.diagnosis.study import Comparison
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import recalibrate

HIDDEN = 16  # in each of two layers
TOGETHER = 0.02  # of a state's deviation, by which segments may miss each other
RATE = 5e-3  # of Adam
BEGIN = 80  # steps with the card alone
CARD = 0.15  # of the time, at most, for these
TAUGHT = 300  # steps in which the network learns what the card leaves of smoothed derivatives, to begin with
CHECK = 40  # steps between looks at what is left out
PATIENCE = 15  # looks without a gain, after which training ends
ADAM = 0.75  # of the time left for training; the rest is L-BFGS's
REGRESSING = 7.0  # seconds kept for the regression
SEED = 0
EQUALS = 0.5  # of the largest effect in units of its equation, from which on an equation counts as a place
Report = Callable[[Answer], None]


def universal(case: Comparison, seconds: float, report: Report) -> Answer:
    """Train a universal differential equation within a time, and say what its network has learned."""
    end = time.process_time() + seconds - REGRESSING
    recalibrated, _ = recalibrate(case.system, case.learn)
    report(Answer(values=values_of(recalibrated.model)))
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    cut = segments_of(case.learn)
    learned, out = cut.only(np.flatnonzero(~cut.left_out)), cut.only(np.flatnonzero(cut.left_out))
    left_out = Training(recalibrated, case.learn, out)
    outside = torch.optim.Adam([left_out.starts], lr=2 * RATE)
    both = Both(Training(recalibrated, case.learn, learned), left_out, outside)
    without, best = trained(both, end, seen_states(recalibrated.model, case.learn))
    evidence = sureness(without.left_out, best.left_out)
    if not evidence > SURE:
        return Answer(evidence=evidence, values=values_of(recalibrated.model))
    answer = _said(recalibrated, case.learn, both.learned.network(best), best, evidence)
    mended, starts = recalibrated.model.with_values(best.values), recalibrated.x[case.learn.first[:-1]]
    if runs_better(recalibrated.model, mended, both.learned.network(best), case.learn, [starts]):
        return answer
    return answer.model_copy(update={"values": values_of(recalibrated.model), "added": None, "fault": WORSE})


class Equations(torch.nn.Module):
    """The card's equations with a network in them, at states ``(segments, d)``."""

    middle: torch.Tensor
    width: torch.Tensor
    size: torch.Tensor
    values: torch.Tensor

    def __init__(self, fit: Fit, data: Measurements) -> None:
        super().__init__()
        model = fit.model
        self.model = model
        arguments = model.arguments
        self._card = sympy.lambdify(
            arguments, [model.evaluable(each) for each in model.equations], modules="torch", cse=True
        )
        self._outputs = sympy.lambdify(
            arguments, [model.evaluable(formula) for _, formula in model.outputs], modules="torch", cse=True
        )
        signals = data.signals(data.t, data.recording, delays=())
        z = np.concatenate([fit.x.T, signals.inputs])
        rates = model.functions.rates(fit.x.T, signals, model.values)
        size = np.where(model.kinematic, 0.0, rates.std(axis=1))
        self.register_buffer("middle", torch.tensor(z.mean(axis=1)))
        self.register_buffer("width", torch.tensor(np.where(z.std(axis=1) > 0, z.std(axis=1), 1.0)))
        self.register_buffer("size", torch.tensor(size))
        self.register_buffer("values", torch.tensor(model.values))
        self.free = list(model.free)
        self.change = torch.nn.Parameter(torch.zeros(len(self.free)))  # of parameters, relative
        generator = torch.Generator().manual_seed(SEED)
        widths = [len(z), HIDDEN, HIDDEN, model.dimension]
        self.weights = torch.nn.ParameterList()
        self.biases = torch.nn.ParameterList()
        for here, there in itertools.pairwise(widths):
            last = there == widths[-1] and len(self.weights) == len(widths) - 2
            weight = torch.randn(there, here, generator=generator) / np.sqrt(here)
            self.weights.append(torch.nn.Parameter(weight * (0.0 if last else 1.0)))  # begins as the card
            self.biases.append(torch.nn.Parameter(torch.zeros(there)))
        self.on = False

    def parameters_now(self) -> torch.Tensor:
        """The card's parameters."""
        values = self.values.clone()
        old = self.values[self.free]
        scale = torch.where(old.abs() > 0, old.abs(), torch.ones_like(old))
        values[self.free] = old + scale * self.change
        return values

    def rates(self, x: torch.Tensor, u: torch.Tensor, t: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Derivatives, of the shape of the states."""
        card = self._card(*x.unbind(-1), *u.unbind(-1), t, *values.unbind())
        rates = torch.stack([each + torch.zeros_like(t) for each in card], dim=-1)
        if not self.on:
            return rates
        return rates + self.size * self.network((torch.cat([x, u], dim=-1) - self.middle) / self.width)

    def network(self, z: torch.Tensor) -> torch.Tensor:
        """The network's outputs for scaled states and inputs."""
        for place, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            z = torch.nn.functional.linear(z, weight, bias)
            z = torch.tanh(z) if place + 1 < len(self.weights) else z
        return z

    def outputs(
        self, x: torch.Tensor, u: torch.Tensor, t: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        """What is measured of states ``(segments, length, d)``."""
        read = self._outputs(*x.unbind(-1), *u.unbind(-1), t, *values.unbind())
        return torch.stack([each + torch.zeros_like(t) for each in read], dim=-1)


class Training(torch.nn.Module):
    """Segments and their first states."""

    def __init__(self, fit: Fit, data: Measurements, cut: Segments) -> None:
        super().__init__()
        self.cut = cut
        self.h, self.u, self.t = map(torch.tensor, (cut.h, cut.u, cut.t))
        self.known = torch.tensor(np.isfinite(cut.y))
        self.y = torch.tensor(np.nan_to_num(cut.y))
        self.noise = torch.tensor(remaining_noise(data))
        spread = fit.x.std(axis=0)
        self.spread = torch.tensor(np.where(spread > 0, spread, 1.0))
        self.middle = torch.tensor(fit.x.mean(axis=0))
        begin = (fit.x[cut.first] - fit.x.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
        self.starts = torch.nn.Parameter(torch.tensor(begin))
        self.equations = Equations(fit, data)

    def misfit(self, equations: Equations) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean squared error of each segment in units of the noise, and what segments miss each other by."""
        values = equations.parameters_now()
        x = self.middle + self.spread * self.starts
        states = []
        for k in range(self.h.shape[1]):
            h, u, t = self.h[:, k, None], self.u[:, :, k], self.t[:, :, k]
            first = equations.rates(x, u[0], t[0], values)
            second = equations.rates(x + h / 2 * first, u[1], t[1], values)
            third = equations.rates(x + h / 2 * second, u[1], t[1], values)
            last = equations.rates(x + h * third, u[2], t[2], values)
            x = x + h / 6 * (first + 2 * second + 2 * third + last)
            states.append(x)
        read = equations.outputs(torch.stack(states, dim=1), self.u[2], self.t[2], values)
        errors = torch.where(self.known, (read - self.y) / self.noise, torch.zeros_like(self.y)) ** 2
        each = errors.sum(dim=(1, 2)) / self.known.sum(dim=(1, 2)).clamp(min=1)
        going = np.flatnonzero(self.cut.next >= 0)
        missed = (x[going] - self.middle) / self.spread - self.starts[self.cut.next[going]]
        return each, ((missed / TOGETHER) ** 2).sum() / max(len(self.h), 1) / x.shape[1]

    def loss(self, equations: Equations) -> torch.Tensor:
        """What training makes small."""
        each, missed = self.misfit(equations)
        return each.mean() + missed

    def network(self, best: State) -> Network:
        """The network of a state of training, as data."""
        own = self.equations
        own.load_state_dict(best.equations)
        return Network(
            weights=[each.tolist() for each in own.weights],
            biases=[each.tolist() for each in own.biases],
            middle=own.middle.tolist(),
            width=own.width.tolist(),
            size=own.size.tolist(),
        )


@dataclass(frozen=True)
class Both:
    """What is learned from, what is left out, and what fits first states of the latter."""

    learned: Training
    out: Training
    outside: torch.optim.Optimizer


@dataclass(frozen=True)
class State:
    """A state of training.

    Attributes
    ----------
    equations
        Parameters and network, as torch keeps them.
    left_out
        Mean squared error of each segment that was left out, in units of the noise.
    values
        Of the card's parameters.
    """

    equations: dict[str, torch.Tensor]
    left_out: np.ndarray
    values: np.ndarray


def remaining_noise(data: Measurements) -> np.ndarray:
    """Deviation of each output from smoothing splines, ``(m,)``; a thousandth of its motion at least."""
    left = np.empty_like(data.outputs)
    for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
        for place, y in enumerate(data.outputs[begin:end].T):
            left[begin:end, place] = y - smooth(data.t[begin:end], y)(data.t[begin:end])
    return np.maximum(np.nanstd(left, axis=0), 1e-3 * np.nanstd(data.outputs, axis=0))


def taught(equations: Equations, seen: SeenStates) -> None:
    """Begin the network with what the card leaves of the derivatives of smoothed states."""
    model = equations.model
    left = seen.rates - model.functions.rates(seen.x, seen.signals, model.values)
    z = torch.tensor(((seen.coordinates.T - equations.middle.numpy()) / equations.width.numpy())[seen.inside])
    size = equations.size.numpy()
    target = torch.tensor((left.T / np.where(size > 0, size, np.inf))[seen.inside])
    optimizer = torch.optim.Adam([*equations.weights, *equations.biases], lr=2 * RATE)
    for _ in range(TAUGHT):
        optimizer.zero_grad()
        ((equations.network(z) - target) ** 2).mean().backward()
        optimizer.step()


def trained(both: Both, end: float, seen: SeenStates | None = None) -> tuple[State, State]:
    """Train the card alone, then with its network: the states that foresee best what is left out."""
    equations = both.learned.equations
    begin = time.process_time()
    without = _with_adam(
        both, [both.learned.starts, equations.change], _looked(both, 20),
        end=begin + CARD * (end - begin), most=BEGIN // CHECK,
    )  # fmt: skip
    if seen is not None:
        taught(equations, seen)
    equations.on = True
    own = [both.learned.starts, *equations.parameters()]
    best = _with_adam(both, own, without, end=begin + ADAM * (end - begin))
    return without, _with_newton(both, own, best, end=end)


def _looked(both: Both, steps: int) -> State:
    """How well what is left out is foreseen now, after some steps with its first states alone."""
    equations = both.learned.equations
    for _ in range(steps):
        both.outside.zero_grad()
        both.out.loss(equations).backward()
        both.outside.step()
    with torch.no_grad():
        each, _ = both.out.misfit(equations)
    kept = {name: value.detach().clone() for name, value in equations.state_dict().items()}
    return State(kept, each.numpy().copy(), equations.parameters_now().detach().numpy().copy())


def _better(first: State, second: State) -> State:
    return second if second.left_out.mean() < first.left_out.mean() else first


def _with_adam(
    both: Both, own: list[torch.nn.Parameter], best: State, *, end: float, most: int | None = None
) -> State:
    """Steps of Adam until a time, a number of looks, or until nothing is gained any more."""
    optimizer = torch.optim.Adam(own, lr=RATE)
    look = last = 0
    while time.process_time() < end and look - last < PATIENCE and (most is None or look < most):
        for _ in range(CHECK):
            if time.process_time() > end or not _step(optimizer, both.learned, both.learned.equations):
                break
        look += 1
        found = _looked(both, 10)
        if _better(best, found) is found:
            best, last = found, look
    return best


def _with_newton(both: Both, own: list[torch.nn.Parameter], best: State, *, end: float) -> State:
    """Steps of L-BFGS as long as there is time for another one."""
    fine = torch.optim.LBFGS(own, max_iter=10, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        fine.zero_grad()
        loss = both.learned.loss(both.learned.equations)
        loss.backward()
        return loss

    longest, look, last = 0.0, 0, 0
    while (now := time.process_time()) + longest < end and look - last < PATIENCE:
        if not torch.isfinite(fine.step(closure)):
            break
        look, found = look + 1, _looked(both, 10)
        if _better(best, found) is found:
            best, last = found, look
        longest = max(longest, time.process_time() - now)
    return best


def _step(optimizer: torch.optim.Optimizer, training: Training, equations: Equations) -> bool:
    optimizer.zero_grad()
    loss = training.loss(equations)
    if not torch.isfinite(loss):
        return False
    loss.backward()
    torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 100.0)
    optimizer.step()
    return True


def _most_telling(network: Network, z: np.ndarray, place: int, states: int) -> np.ndarray:
    """Which coordinate of ``(c, n)`` the network's output in an equation depends on most, as exponents."""
    still = network(z[:states], z[states:])[place]
    changes = []
    for row in range(len(z)):
        moved = z.copy()
        moved[row] = np.random.default_rng(SEED).permutation(moved[row])
        changes.append(np.std(network(moved[:states], moved[states:])[place] - still))
    return np.eye(len(z), dtype=int)[int(np.argmax(changes))]


def _said(fit: Fit, data: Measurements, network: Network, best: State, evidence: float) -> Answer:
    """The place in which the network does most, in units of the equation, and a formula of its output."""
    model = fit.model.with_values(best.values)
    signals = data.signals(data.t, data.recording, delays=())
    x = fit.x.T
    added = network(x, signals.inputs)
    _, slopes = model.functions.slopes(x, signals, model.values)
    rates = model.functions.rates(x, signals, model.values)
    exponents = powers(len(x) + len(signals.inputs))
    library = products(exponents, np.concatenate([x, signals.inputs])).T
    block, fold = parts(data)
    places = dynamic(model)
    effects = []
    for place in places:
        columns = slopes[place].T
        left = added[place] - columns @ np.linalg.lstsq(columns, added[place], rcond=1e-10)[0]
        effects.append(float(left.std() / (rates[place].std() or 1.0)))
    first = places[int(np.argmax(effects))]
    found = chosen_terms(Equation(first, added[first], slopes[first].T, library, block, fold))
    coefficients, *_ = np.linalg.lstsq(
        np.concatenate([slopes[first].T, library[:, found.support]], axis=1), added[first], rcond=1e-10
    )
    count = slopes.shape[1]
    support = np.flatnonzero(found.support)
    telling = strongest_term(found, exponents)
    if not telling.any():  # no term but a constant: a step, say, is none of these
        telling = _most_telling(network, np.concatenate([x, signals.inputs]), first, len(x))
    return Answer(
        detected=True,
        evidence=evidence,
        equations=tuple(
            model.states[place]
            for place, effect in zip(places, effects, strict=True)
            if effect >= EQUALS * max(effects)
        ),
        coordinates=along(model, telling),
        terms=tuple(
            Term(equation=model.states[first], exponents=tuple(map(int, exponents[k])), coefficient=value)
            for k, value in zip(support, coefficients[count:], strict=True)
        ),
        values=values_of(model),
        added=network,
    )
