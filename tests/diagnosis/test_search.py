"""Parts of the search: blocks for clustered errors, and what tells most where nothing has a name."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats
import sympy
from homes_of_mechanisms import HOMES, RESIDENTS, recorded

from siq.data.correlation import correlation_time_of
from siq.data.recordings import Recordings
from siq.diagnosis import evidence, naming, screening, search
from siq.diagnosis.dictionary import Roles, Shape, roles_of, standard_dictionary
from siq.diagnosis.evidence import FittedCandidate, _blocks_of, _correlated_probability
from siq.diagnosis.mechanisms import MechanismCandidate, candidates_of
from siq.diagnosis.naming import Investigation, _judge_mechanisms
from siq.diagnosis.residual_structure import Remainder, Structure
from siq.diagnosis.screening import Ranked, by_likelihood, rank, screen_all
from siq.diagnosis.search import (
    AcceptedMechanism,
    FitContext,
    Search,
    _accepted,
    _better_without,
    _fit_most_promising,
    _last_alone,
)
from siq.diagnosis.study import MismatchStudy, SearchOptions
from siq.diagnosis.terms import ONE, Place
from siq.diagnosis.verdict import _most_telling
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, measurements
from siq.inference.recalibration import fit_with_process_noise_as_needed, recalibrate
from siq.remarks import sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter


def autoregressive(memory: float, size: int) -> np.ndarray:
    kicks = np.random.default_rng(3).normal(size=size)
    series = np.empty(size)
    now = 0.0
    for place, kick in enumerate(kicks):
        now = memory * now + kick
        series[place] = now
    return series


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_the_correlation_time_of_an_autoregressive_series(memory: float) -> None:
    found = correlation_time_of(autoregressive(memory, 40_000), np.zeros(40_000), least=0.0)
    assert found == pytest.approx((1 + memory) / (1 - memory), rel=0.15)


def test_blocks_are_long_compared_with_correlations_and_never_span_recordings() -> None:
    recording = np.repeat([0, 1], [3000, 6000])
    block = _blocks_of(recording, autoregressive(0.9, 9000), least=10)
    count = block.max() + 1
    assert sorted(set(block)) == list(range(count))
    assert 10 < count < 9000 / (3 * 19)
    for place in range(count):
        rows = np.flatnonzero(block == place)
        assert len(set(recording[rows])) == 1 and (np.diff(rows) == 1).all()


def test_there_are_at_least_so_many_blocks() -> None:
    assert _blocks_of(np.zeros(400, dtype=int), autoregressive(0.99, 400), least=10).max() == 9


@pytest.fixture(scope="module")
def decaying() -> Dynamics:
    x, k = sympy.symbols("x k", real=True)
    return Dynamics(("x",), (-k * x,), Diffusion.identity(1), parameters=(Parameter("k", 1.0),))


def fit_with_errors(model: Dynamics, errors: np.ndarray) -> tuple[Fit, Measurements]:
    """A simulation fitted to one recording that is off by given errors."""
    t = np.linspace(0, 3, len(errors))
    table = Recordings(
        ("x",), (None,), ("a",), np.zeros(len(t), dtype=int), t, (np.exp(-t) + errors)[:, None]
    )
    data = measurements(table, model)
    return recalibrate(model, data)[1], data


def test_a_gain_weighs_as_much_as_there_are_independent_errors(decaying: Dynamics) -> None:
    """Likelihood weighs n errors; of those that hang together over τ samples it may count n/τ."""
    candidate = SimpleNamespace(searches=(), new=("c",))
    found = {}
    for memory in (0.0, 0.9):
        fit, data = fit_with_errors(decaying, 0.01 * autoregressive(memory, 2000))
        found[memory] = _correlated_probability(fit, data, candidate, gained=60.0)
    assert found[0.0] == pytest.approx(scipy.stats.chi2.sf(60.0, 1), rel=30)
    assert 1e-3 < found[0.9] < 0.5  # about χ² of 60/19


def test_every_place_at_which_a_shape_was_looked_for_is_a_chance(decaying: Dynamics) -> None:
    fit, data = fit_with_errors(decaying, 0.01 * autoregressive(0.0, 400))
    once = SimpleNamespace(searches=(), new=("c", "w"))
    often = SimpleNamespace(
        searches=(Shape(frequencies=90), Shape(scale_of="x", at=(1.0, 2.0))), new=("c", "w")
    )
    alone = _correlated_probability(fit, data, once, gained=30.0)
    told_apart = 399 // 4  # frequencies, of 400 samples: more than the ninety at which it was looked for
    assert _correlated_probability(fit, data, often, gained=30.0) == pytest.approx(2 * told_apart * alone)


def test_an_amplitude_that_may_not_be_negative_is_zero_and_leaves_the_special_case(
    decaying: Dynamics, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = np.linspace(0, 3, 400)
    shapes = np.stack([np.sin(6 * t), np.cos(9 * t)], axis=1)
    noise = 0.01 * np.random.default_rng(5).normal(size=400)
    fit, data = fit_with_errors(decaying, shapes @ [0.05, -0.05] + noise)
    known = fit.linearisation
    with_shapes = replace(
        known,
        measured_response=np.concatenate([known.measured_response, shapes[:, None, :]], axis=2),
        response=np.concatenate([known.response, np.zeros((*known.response.shape[:2], 2))], axis=2),
    )
    groups = [slice(0, 2), slice(0, 1), slice(0, 2)]
    signs = [True, True], [True], [False, False]
    terms = [SimpleNamespace(positive=np.array(each), width=len(each)) for each in signs]
    monkeypatch.setattr(screening, "linearised_with", lambda *_: (with_shapes, groups))
    (either, first, both), _ = rank(fit, data, terms, judge=by_likelihood)
    assert either.amplitudes[1] == 0
    assert either.amplitudes[0] == pytest.approx(first.amplitudes[0])
    assert either.gain == pytest.approx(first.gain)
    assert both.amplitudes[1] < 0 and both.gain > either.gain > 0


def test_a_mechanism_that_was_found_is_not_found_once_more_in_another_form() -> None:
    def one(name: str, label: str, equations: tuple[str, ...], coordinate: str) -> MechanismCandidate:
        model = SimpleNamespace(states=("h", "g"))
        return MechanismCandidate(name, label, model, (), equations, coordinate)

    found = one("overflow", "overflow in h, g", ("h", "g"), "h")
    assert one("overflow", "overflow in h", ("h",), "h").repeats(found)
    assert not one("overflow", "overflow in g", ("g",), "g").repeats(found)
    assert not one("leak", "leak in h", ("h",), "h").repeats(found)
    # Two parameters may drift in time, each by its own.
    drift = one("parameter drift", "parameter drift in h (a)", ("h",), "t")
    assert not one("parameter drift", "parameter drift in h (b)", ("h",), "t").repeats(drift)


def place(coordinate: str, *equations: str) -> Place:
    """Of a force along a coordinate; of two equations across the amplitude."""
    factors = ONE, -ONE
    return Place(tuple(zip(equations, factors, strict=False)), (), (ONE,), (coordinate,), np.zeros(4))


def structure(excess: float, *gains: tuple[str, str, float]) -> Structure:
    curves = [
        Ranked(place(coordinate, equation), gain, 1.0, np.zeros(4), np.ones(4))
        for equation, coordinate, gain in gains
    ]
    return Structure(tuple(curves), 0.0, 0.0, excess + 100, 100)


def remainder(share: float, p_curves: float = 1.0) -> Remainder:
    """What is left, of which only the share and the probability count here."""
    return Remainder(structure(0), Structure((), p_curves, 1.0, 100, 100), share)


def found_with(number: int) -> Search:
    """A search that found so many mechanisms, one after the other."""

    def found(place: int) -> AcceptedMechanism:
        candidate = SimpleNamespace(name=f"mechanism {place}", label=f"mechanism {place}", number=place)
        fit = SimpleNamespace(number=place, has_process_noise=False, noise=SimpleNamespace(measurement=1.0))
        return AcceptedMechanism(FittedCandidate(candidate, fit, 100.0, -90.0, 0.0, 0.0), {"same": ()})

    each = tuple(found(place) for place in range(1, number + 1))
    return Search(SimpleNamespace(number=0, x=None), each, each[-1].best.fit, ())


MOTION = Roles(motions=(("x", "v"),), states=("v",))
FRAME = Roles(amplitudes=(("P", "Q"),), states=("P", "Q"))
POPULATIONS = Roles(populations=("prey", "predator"), states=("prey", "predator"))


@pytest.mark.parametrize(
    ("roles", "found", "expected"),
    [
        # The best coordinate is that of the motion itself.
        (MOTION, structure(1000, ("v", "x", 700.0), ("v", "u", 400.0)), "x"),
        # The input tells hardly more than the velocity.
        (MOTION, structure(1000, ("v", "u", 990.0), ("v", "v", 950.0)), "v"),
        # The input tells nearly all, and the motion does not.
        (MOTION, structure(1000, ("v", "u", 990.0), ("v", "v", 400.0)), "u"),
        # No coordinate tells nearly all.
        (MOTION, structure(1000, ("v", "u", 500.0), ("v", "v", 200.0)), "x, v"),
        (POPULATIONS, structure(1000, ("prey", "t", 990.0), ("prey", "prey", 985.0)), "prey"),
        # The time tells less than a third more than a state, of whatever equation.
        (POPULATIONS, structure(1000, ("prey", "t", 155.0), ("prey", "predator", 122.0)), "predator"),
        (POPULATIONS, structure(1000, ("prey", "t", 155.0), ("prey", "predator", 100.0)), "t"),
        (POPULATIONS, structure(1000, ("prey", "t", 155.0), ("predator", "prey", 150.0)), "t"),
        (POPULATIONS, structure(1000, ("prey", "predator", 500.0), ("prey", "prey", 200.0)), "predator"),
    ],
)
def test_the_coordinate_that_tells_most(roles: Roles, found: Structure, expected: str) -> None:
    equations, coordinate = _most_telling(found, roles)
    assert equations == found.curves[0].term.targets
    assert coordinate == expected


def test_of_a_rotating_frame_the_motion_is_its_amplitude() -> None:
    across = Ranked(place("amplitude", "P", "Q"), 128.0, 1.0, np.zeros(4), np.ones(4))
    assert across.term.across
    found = structure(370, ("Q", "t", 150.0))
    found = replace(found, curves=(*found.curves, across))
    assert _most_telling(found, FRAME) == (("P", "Q"), "amplitude")


def judged(
    monkeypatch: pytest.MonkeyPatch,
    odds: tuple[float, ...],
    left: list[Remainder],
    *,
    together: float = 20.0,
) -> Investigation:
    """A search of so many mechanisms, judged by odds that are given."""

    def of_a_name(_: object, candidates: list[SimpleNamespace], context: FitContext) -> float:
        return odds[candidates[0].number - 1] if len(candidates) == 1 else together

    monkeypatch.setattr(naming, "_log_odds_of_a_name", of_a_name)
    study = MismatchStudy(search=SearchOptions(wrong_names=0.05, unnamed=0.2))
    context = FitContext(SimpleNamespace(), SimpleNamespace(), MOTION, study=study)
    return _judge_mechanisms(found_with(len(odds)), left, context)


@pytest.mark.parametrize(
    ("odds", "shares", "kept"),
    [
        ((9.0, 5.0), (0.998, 0.9999), 2),
        ((9.0, 2.0), (0.998, 0.9999), 1),  # a function without a name would do as well
        ((9.0, 5.0), (0.9993, 0.9991), 1),  # leaves more than without it
        ((9.0, 2.0, 5.0), (0.998, 0.999, 0.9999), 1),  # what came after a patch goes with it
    ],
)
def test_further_mechanisms_stay_as_long_as_each_is_likely_and_leaves_less(
    odds: tuple[float, ...], shares: tuple[float, ...], kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = judged(monkeypatch, odds, [remainder(share) for share in shares])
    assert len(found.search.found) == kept
    assert found.search.fit.number == kept
    assert found.remainder.share == shares[kept - 1]


@pytest.mark.parametrize(
    ("odds", "together", "p_left", "verdict", "said"),
    [
        ((9.0,), 20.0, 1.0, "missing physics", None),
        ((2.5,), 20.0, 1.0, "unexplained", "nearly as likely (odds of 12 to 1)"),
        ((-1.0,), 20.0, 1.0, "unexplained", "a function without a name is likelier"),
        # Two that are a description of one function.
        ((9.0, 9.0), 1.0, 1.0, "unexplained", "mechanism 1 and mechanism 2"),
        # What leaves something is not named by odds that suppose that nothing is left.
        ((9.0,), 20.0, 1e-9, "unexplained", None),
    ],
)
def test_a_name_has_to_be_likelier_than_none(
    odds: tuple[float, ...],
    together: float,
    p_left: float,
    verdict: str,
    said: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left = [remainder(0.99 + 0.001 * place, p_left) for place in range(len(odds))]
    found = judged(monkeypatch, odds, left, together=together)
    assert found.verdict.names == (verdict == "missing physics")
    assert said is None or said in sentence(found.remarks[-1])


def test_a_name_has_to_leave_less_than_what_speaks_of_a_mismatch_by_itself() -> None:
    clear, hardly, noise = remainder(0.9, 1e-6), remainder(0.9, 3e-4), remainder(0.9, 0.2)
    assert (clear.structured, clear.doubtful) == (True, True)
    assert (hardly.structured, hardly.doubtful) == (False, True)
    assert (noise.structured, noise.doubtful) == (False, False)


@pytest.mark.parametrize(("random_forces", "expected"), [(False, "better"), (True, "steadier")])
def test_of_equals_the_one_that_all_recordings_ask_for_where_white_errors_mean_little(
    random_forces: bool, expected: str
) -> None:
    def trial(name: str, gain: float, p_cluster: float) -> FittedCandidate:
        fit = SimpleNamespace(has_process_noise=random_forces)
        general = ("steadier",) if name == "general" else ()
        candidate = SimpleNamespace(name=name, new=("c",), weight=1.0, equations=("v",), generalises=general)
        return FittedCandidate(candidate, fit, gain, 7.0 - gain, 0.0, p_cluster)

    trials = [trial("better", 331, 1e-9), trial("steadier", 325, 1e-49), trial("worse", 276, 1e-60)]
    found = _accepted(trials, 50, 1e-4, options=SearchOptions())
    assert found is not None and found.best.candidate.name == expected
    # Nor does what has that one as a special case lead, though recordings ask for it the more.
    again = _accepted([*trials, trial("general", 330, 1e-55)], 50, 1e-4, options=SearchOptions())
    assert again is not None and again.best.candidate.name == expected
    assert {each.candidate.name for each in found.others["same"]} == {"better", "steadier"} - {expected}


@pytest.mark.parametrize(("weights", "leads"), [((0.2, 5.0), "growth"), ((1.0, 1.0), "season")])
def test_of_two_that_explain_alike_the_likelier_beforehand_leads(
    weights: tuple[float, float], leads: str
) -> None:
    # Yeast that fills its vessel has no season of births, though that has two more numbers to fit.
    def trial(name: str, gain: float, new: tuple[str, ...], weight: float) -> FittedCandidate:
        fit = SimpleNamespace(has_process_noise=False)
        candidate = SimpleNamespace(name=name, new=new, weight=weight, equations=("n",))
        return FittedCandidate(candidate, fit, gain, len(new) * np.log(14) - gain, 0.0, 1e-9)

    season, growth = weights
    trials = [trial("season", 59.1, ("c", "d", "w"), season), trial("growth", 53.3, ("c",), growth)]
    found = _accepted(trials, 20, 1e-4, options=SearchOptions())
    assert found is not None and found.best.candidate.name == leads
    assert len(found.others["same"]) == 1


def test_where_recordings_begin_in_a_hidden_state_is_a_parameter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "probability_by_chance", lambda *_, **__: 1.0)

    def fit(states: int, parameters: int, log_likelihood: float) -> Any:
        model = SimpleNamespace(free=range(parameters), dimension=states)
        return SimpleNamespace(model=model, log_likelihood=log_likelihood, degrees_of_freedom=90 - parameters)

    data, candidate = SimpleNamespace(labels=("a",) * 9), SimpleNamespace()
    plain, hidden = (
        FittedCandidate.of(fit(1 + states, 3, 20.0), fit(1, 2, 0.0), data, candidate, blocks=10)
        for states in (0, 1)
    )
    assert hidden.delta_bic - plain.delta_bic == pytest.approx(9 * np.log(10))
    assert hidden.p_white == pytest.approx(scipy.stats.chi2.sf(40, 10)) and plain.p_white < hidden.p_white


def test_of_fits_that_are_equal_but_for_rounding_one_in_an_equation_leads() -> None:
    def trial(name: str, gain: float, *equations: str) -> FittedCandidate:
        fit = SimpleNamespace(has_process_noise=False)
        candidate = SimpleNamespace(name=name, new=("c",), weight=1.0, equations=equations)
        return FittedCandidate(candidate, fit, gain, 7.0 - gain, 0.0, 1e-9)

    for rounding in (-1e-7, 1e-7):
        trials = [trial("sensor", 331), trial("force", 331 + rounding, "v")]
        found = _accepted(trials, 50, 1e-4, options=SearchOptions())
        assert found is not None and found.best.candidate.name == "force"


def test_nothing_is_missing_where_its_fit_only_found_better_parameters(decaying: Dynamics) -> None:
    _, data = fit_with_errors(decaying, 0.01 * autoregressive(0.0, 400))
    x, c = sympy.symbols("x c", real=True)
    wider = replace(
        decaying,
        equations=(decaying.equations[0] - c * x**2,),
        parameters=(*decaying.parameters, Parameter("c", 0.0)),
    )
    right, with_c = recalibrate(decaying, data)[0], recalibrate(wider, data)[0]
    trial = FittedCandidate(SimpleNamespace(label="c"), with_c, 80.0, -70.0, 1e-9, 1e-9)
    missed = replace(
        right, model=right.model.with_values(np.array([9.0])), log_likelihood=right.log_likelihood - 40
    )
    context = FitContext(decaying, data, Roles())
    found = _better_without(trial, missed, context)
    assert found is not None and found.model.values == pytest.approx(right.model.values, rel=1e-3)
    assert _better_without(trial, right, context) is None


def test_what_a_later_mechanism_makes_idle_is_not_named() -> None:
    """A periodic force was the best there was before the store that the recordings come from was tried."""
    home, resident = HOMES["heat"], next(each for each in RESIDENTS if each.name == "decay or leakage")
    model, data = home.model, recorded(resident)
    roles = roles_of(model)
    some = [each for each in standard_dictionary() if each.name in ("decay or leakage", "periodic forcing")]
    candidates = candidates_of(model, roles, some)
    force = next(each for each in candidates if each.label == "periodic forcing in s")
    leak = next(each for each in candidates if each.label.startswith("decay or leakage to nothing in s"))
    context, (fit, _) = FitContext(model, data, roles, tuple(candidates)), recalibrate(model, data)
    found, current = [], fit
    for each in (force, leak.rebased(model, force.model)):
        begun = each.begun(current.model, {"w_1": 2.0})
        before, current = current, fit_with_process_noise_as_needed(begun, data, current)
        trial = FittedCandidate.of(current, before, data, each, blocks=10)
        found.append(AcceptedMechanism(trial, {"same": (), "needless": (), "less": ()}))
    assert force.idle(current, all)
    alone = _last_alone(Search(fit, tuple(found), current, ()), context)
    assert [each.best.candidate.label for each in alone.found] == [leak.label]
    assert [each.name for each in alone.fit.model.parameters][len(model.parameters) :] == ["c_1"]
    assert alone.fit.model.values[-1] == pytest.approx(resident.values["c"], rel=0.05)


def test_what_brings_a_state_is_fitted_from_every_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    """Delays that are too long by half explain nearly as much, and no fit leads from one to the other."""
    model = HOMES["crop"].model
    data = recorded(next(each for each in RESIDENTS if each.label == "one length"))
    some = [each for each in standard_dictionary() if each.name == "maturation delay"]
    late = [each for each in candidates_of(model, roles_of(model), some) if each.variant == "of one length"]
    context, (fit, _) = FitContext(model, data, roles_of(model), tuple(late)), recalibrate(model, data)
    screened, _ = screen_all(data, fit, late)
    begun = []

    def noted(model: Dynamics, *rest: Any, **options: Any) -> Fit:
        begun.append(float(model.values[-1]))
        return fit_with_process_noise_as_needed(model, *rest, **options)

    monkeypatch.setattr(search, "fit_with_process_noise_as_needed", noted)
    (trial,), _ = _fit_most_promising(context, fit, screened)
    assert len(set(begun)) == sum(each.gain > 0 for each in screened) > 1
    assert trial.fit.model.values[-1] == pytest.approx(2.0, rel=0.1)
    # From where forecasts led it, too.
    begun.clear()
    _fit_most_promising(replace(context, leads=(trial,)), fit, screened[:1])
    assert float(trial.fit.model.values[-1]) in begun
