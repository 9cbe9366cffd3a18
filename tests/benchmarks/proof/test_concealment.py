from __future__ import annotations

import ast
import dataclasses
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import sympy
import yaml
from pyarrow import parquet
from scipy.integrate import solve_ivp

from benchmarks.proof.batches import digests_of, load_proofs
from benchmarks.proof.concealment import cases as concealment_cases
from benchmarks.proof.concealment.cases import (
    KINDS,
    Design,
    draw_cases,
    make_case,
)
from benchmarks.proof.concealment.catalogue import CATALOGUES
from benchmarks.proof.concealment.effects import Effect
from benchmarks.proof.concealment.experiments import Experiment
from benchmarks.proof.concealment.mechanics import (
    COUPLED_MASSES_EFFECTS,
    OSCILLATOR_EFFECTS,
    OSCILLATOR_WITHHELD,
)
from benchmarks.proof.concealment.model import Drive, TrueSystem
from benchmarks.proof.concealment.simulation import simulate
from benchmarks.proof.concealment.systems import SYSTEMS, PhysicalSystem
from siq.systems.cards import check_name
from siq.systems.formulas import compile_formulas, parse_formula

POINTS = 40
PROOF, PROOF_FULL = (
    load_proofs(Path(__file__).parents[3] / "config/proof.yaml")[name].shares
    for name in ("proof", "proof_full")
)


def builders() -> Iterator[tuple[str, str, str]]:
    for system, catalogue in CATALOGUES.items():
        yield from ((system, "mechanism", name) for name in catalogue.mechanisms)
        yield system, "process noise", "process noise"
        yield from ((system, "withheld", name) for name in catalogue.withheld)


def build(system: str, kind: str, name: str, rng: np.random.Generator) -> Effect:
    catalogue = CATALOGUES[system]
    if kind == "process noise":
        return catalogue.noise(rng)
    return (catalogue.mechanisms if kind == "mechanism" else catalogue.withheld)[name](rng)


def design(system: str, kind: str, mechanism: str | None = None, **other: object) -> Design:
    whole: dict[str, object] = {
        "name": "case-0001",
        "system": system,
        "kind": kind,
        "mechanism": mechanism,
        "shifted": kind == "shift",
        "strength": 0.1 if mechanism else None,
        "noise_db": 30.0,
        "without": (),
        "seed": 5,
    }
    return Design(**{**whole, **other})  # type: ignore[arg-type]


@cache
def quiet_recordings(system: str) -> Mapping[str, np.ndarray]:
    return make_case(design(system, "null", noise_db=300.0)).recordings


def small(system: PhysicalSystem, rng: np.random.Generator, samples: int = 40) -> Experiment:
    whole = system.experiment(rng)
    return Experiment(whole.interval, samples, whole.starts[:, :3], whole.inputs[:, :3, :samples])


def values_of(formulas: list[str], numbers: dict[str, np.ndarray]) -> np.ndarray:
    names = list(numbers)
    symbols = [sympy.Symbol(name, real=True) for name in names]
    expressions = [parse_formula(formula, dict(zip(names, symbols, strict=True))) for formula in formulas]
    points = np.array([np.broadcast_to(numbers[name], POINTS) for name in names])
    return compile_formulas(expressions, symbols)(points)


def replaced(formula: str, replacements: dict[str, str]) -> str:
    for symbol, text in replacements.items():
        formula = re.sub(rf"\b{symbol}\b", f"({text})", formula)
    return formula


# --- The formulas of the key are what was simulated


@pytest.mark.parametrize(("name", "kind", "effect_name"), list(builders()))
def test_formulas_agree_with_the_right_hand_side(name: str, kind: str, effect_name: str) -> None:
    system = SYSTEMS[name]
    rng = np.random.default_rng(len(effect_name))
    effect = build(name, kind, effect_name, rng)
    model = TrueSystem(system, system.nominal(), effect)
    sizes = np.array([system.sizes.get(state, 0.3) for state in model.names])
    x = sizes[:, None] * rng.uniform(0.2, 1.5, (len(sizes), POINTS))
    if name != "predator_prey":
        x *= rng.choice([-1, 1], x.shape)
    t = rng.uniform(0, 5, POINTS)
    u = rng.normal(0, 5, (len(system.inputs), POINTS))
    key = effect.formulas()
    numbers = {
        **dict(zip(model.names, x, strict=True)),
        **dict(zip(system.inputs, u, strict=True)),
        **system.nominal(),
        **key["parameters"],
        "t": t,
    }
    assert len(numbers) == 1 + len(model.names) + len(u) + len(system.nominal()) + len(key["parameters"])
    # What has arrived is handed over as u: a delayed input is the input there.
    replacements = {s: f for s, f in key["replace"].items() if not f.startswith("delay(")}
    formulas = [
        replaced(system.card["equations"][state], replacements) + "+" + key["terms"].get(state, "0")
        for state in system.states
    ]
    wanted = values_of([*formulas, *key["states"].values()], numbers)
    np.testing.assert_allclose(model.drift(t, x, u), wanted, rtol=1e-10, atol=1e-12 * np.max(np.abs(wanted)))
    if effect.measured:
        for output, formula in key["outputs"].items():
            measured = effect.measured(numbers[output], effect.parameters)
            np.testing.assert_allclose(measured, values_of([formula], numbers)[0], rtol=1e-12)


@pytest.mark.parametrize(("name", "kind", "effect_name"), list(builders()))
def test_keys_are_consistent_with_the_cards(name: str, kind: str, effect_name: str) -> None:
    system = SYSTEMS[name]
    for seed in range(5):
        effect = build(name, kind, effect_name, np.random.default_rng(seed))
        assert effect.name == effect_name
        assert set(effect.equations) <= set(system.states)
        assert set(effect.scaled) <= set(effect.parameters)
        taken = {*system.states, *system.inputs, *system.card["parameters"]}
        for own in (*effect.parameters, *effect.states):
            assert check_name(own) not in taken
        assert set(effect.replaced) <= taken
        assert {*effect.terms, *effect.noise} <= set(system.states)
        assert set(effect.outputs) <= set(system.outputs)
        described = effect.terms or effect.replaced or effect.outputs or effect.noise
        assert described
        assert effect.equations or effect.outputs


@pytest.mark.parametrize("name", SYSTEMS)
def test_equations_agree_with_the_card(name: str) -> None:
    system = SYSTEMS[name]
    rng = np.random.default_rng(1)
    x = rng.normal(size=(len(system.states), POINTS))
    u = rng.normal(size=(len(system.inputs), POINTS))
    numbers = {**dict(zip((*system.states, *system.inputs), (*x, *u), strict=True)), **system.nominal()}
    wanted = values_of(list(system.card["equations"].values()), numbers)
    np.testing.assert_allclose(system.equations(x, u, system.nominal()), wanted, rtol=1e-10, atol=1e-13)


# --- What was simulated is accurate


def test_dry_friction_agrees_with_the_exact_solution() -> None:
    system = SYSTEMS["oscillator"]
    rate, hold = 6.0, 2.0
    effect = OSCILLATOR_EFFECTS["dry friction"](np.random.default_rng(0)).times(hold)
    model = TrueSystem(system, {"k": rate**2, "d": 0.0, "m": 1.0}, effect)
    experiment = Experiment(0.05, 200, np.array([[1.0], [0.0]]), np.zeros((1, 1, 200)))
    x, v = simulate(model, experiment, np.random.default_rng(0)).states[:, 0]

    # Half a period at a time about ± c/k, until it comes to rest where the spring cannot overcome friction.
    offset, amplitude, start = hold / rate**2, 1.0, 0
    wanted = np.empty(200)
    times = experiment.times()
    for half, sign in enumerate([1, -1] * 20):
        if amplitude <= offset:
            wanted[start:] = sign * amplitude
            break
        inside = (times >= half * np.pi / rate) & (times < (half + 1) * np.pi / rate)
        phase = rate * times[inside] - half * np.pi
        wanted[inside] = sign * (offset + (amplitude - offset) * np.cos(phase))
        amplitude -= 2 * offset
        start = int(np.flatnonzero(inside)[-1]) + 1
    np.testing.assert_allclose(x, wanted, atol=1e-7)
    assert np.all(v[start:] == 0)
    assert 50 < start < 190


@pytest.mark.parametrize(
    "effect_name", ["hysteresis", "stop beyond a gap", "input delay", "Stribeck friction", "quadratic drag"]
)
def test_kinks_and_jumps_are_accurate(effect_name: str) -> None:
    """Held against many small steps of a rule that knows nothing of kinks."""
    system = SYSTEMS["oscillator"]
    rng = np.random.default_rng(3)
    effect = {**OSCILLATOR_EFFECTS, **OSCILLATOR_WITHHELD}[effect_name](rng)
    effect = effect if effect.limit else effect.times(3.0)
    model = TrueSystem(system, system.nominal(), effect)
    experiment = small(system, rng)
    path = simulate(model, experiment, rng)
    drive = Drive(path.times, path.inputs, system.held, model.lag)

    def rates(t: float, flat: np.ndarray) -> np.ndarray:
        value, slope, origin = drive.line(t)
        return model.drift(t, flat.reshape(len(model.names), -1), value + slope * (t - origin)).ravel()

    step = path.times[1] / 400
    x = path.states[..., 0].ravel()
    for index in range(10 * 400):
        t = index * step
        one = rates(t, x)
        x = x + step * rates(t + step / 2, x + step / 2 * one)
    found = path.states[..., 10].ravel()
    # A jump of a force costs the crude rule an error of its step: friction / rate * 1e-4.
    scale = np.abs(path.states[..., :11]).max(axis=(1, 2)).repeat(3)
    assert np.max(np.abs(found - x) / scale) < (2e-3 if effect.friction else 2e-5)


def test_true_motion_satisfies_tighter_tolerances() -> None:
    system = SYSTEMS["predator_prey"]
    rng = np.random.default_rng(2)
    model = TrueSystem(
        system, system.nominal(), CATALOGUES["predator_prey"].mechanisms["saturation"](rng).times(0.1)
    )
    experiment = small(system, rng)
    path = simulate(model, experiment, rng)
    u = np.zeros((0, 1))
    for index in range(3):
        exact = solve_ivp(
            lambda t, x: model.drift(t, x[:, None], u).ravel(),
            (0, path.times[-1]),
            path.states[:, index, 0],
            "Radau" if index else "LSODA",
            t_eval=path.times,
            rtol=1e-9,
            atol=1e-10,
        )
        np.testing.assert_allclose(path.states[:, index], exact.y, rtol=1e-6)


def test_process_noise_has_its_stated_intensity() -> None:
    system = SYSTEMS["archetype3d"]
    effect = CATALOGUES["archetype3d"].noise(np.random.default_rng(0)).times(0.3)
    whole = Experiment(0.002, 60, np.tile([[1.0], [0.0], [0.0]], 150), np.zeros((0, 150, 60)))
    path = simulate(TrueSystem(system, system.nominal(), effect), whole, np.random.default_rng(1))
    increments = np.diff(path.states, axis=-1)
    np.testing.assert_allclose(increments.std(axis=(1, 2)), 0.3 * np.sqrt(0.002), rtol=0.05)


def test_delayed_inputs_follow_the_stated_interpolation() -> None:
    times, inputs = 0.1 * np.arange(4), np.array([[[0.0, 1.0, 3.0, 2.0]]])
    straight = Drive(times, inputs, held=False, lag=0.15).at_samples()[0, 0]
    np.testing.assert_allclose(straight, np.interp(times - 0.15, times, inputs[0, 0]))
    held = Drive(times, inputs, held=True, lag=0.15).at_samples()[0, 0]
    np.testing.assert_allclose(held, [0, 0, 0, 1])


@pytest.mark.parametrize("name", ["oscillator", "coupled_masses"])
def test_delays_are_as_strong_as_wanted_however_inputs_are_held(name: str) -> None:
    key = make_case(design(name, "mechanism", "input delay", strength=0.05)).key
    assert key["strength"] == pytest.approx(0.05, rel=0.5)
    assert key["effect"]["parameters"]["tau"] > 0.002


def test_inputs_are_band_limited_and_start_at_zero() -> None:
    for name in ("oscillator", "coupled_masses"):
        experiment = SYSTEMS[name].experiment(np.random.default_rng(4))
        inputs = experiment.inputs[0]
        assert np.all(inputs[:, 0] == 0)
        power = np.abs(np.fft.rfft(inputs * np.hanning(inputs.shape[1]))) ** 2
        quarter = int(power.shape[1] / 2)  # of the sampling rate: half of the highest frequency
        assert power[:, quarter:].sum() < 1e-4 * power.sum()


# --- Which cases there are


def test_designs_are_deterministic_and_respect_the_shares() -> None:
    designs = draw_cases(count=200, seed=1, shares=PROOF)
    assert designs == draw_cases(count=200, seed=1, shares=PROOF)
    assert designs != draw_cases(count=200, seed=2, shares=PROOF)
    counts = Counter(d.kind for d in designs)
    assert counts == {kind: round(200 * share) for kind, share in PROOF.items()}
    assert [d.name for d in designs[:2]] == ["case-0001", "case-0002"]
    assert len({d.seed for d in designs}) == 200
    kinds = [d.kind for d in designs]
    assert kinds != sorted(kinds, key=KINDS.index)
    with_effect = [d for d in designs if d.mechanism]
    assert sum(d.shifted for d in with_effect) == len(with_effect) / 2
    assert all(d.shifted == (d.kind == "shift") for d in designs if not d.mechanism)
    assert all(0.01 <= d.strength <= 0.3 for d in with_effect if d.strength)
    assert set(Counter(d.noise_db for d in designs)) == {20.0, 30.0, 40.0}
    assert max(Counter(d.system for d in designs).values()) <= 44
    full = Counter(d.kind for d in draw_cases(count=400, seed=1, shares=PROOF_FULL))
    assert full["null"] + full["shift"] == 200


def test_every_effect_is_drawn() -> None:
    designs = draw_cases(count=500, seed=3, shares=PROOF)
    assert {(d.system, d.kind, d.mechanism) for d in designs if d.mechanism} == set(builders())


def test_studies_do_without_hysteresis_where_it_is_withheld_and_elsewhere() -> None:
    designs = draw_cases(count=500, seed=3, shares=PROOF)
    concealed = [d for d in designs if d.mechanism == "hysteresis"]
    assert all((d.kind == "withheld") == ("hysteresis" in d.without) for d in concealed)
    decoys = [d for d in designs if "hysteresis" in d.without and d.mechanism != "hysteresis"]
    assert {d.system for d in decoys} == {"oscillator", "coupled_masses"}
    assert len(decoys) > sum(d.kind == "withheld" for d in concealed)


def test_wrong_shares_are_refused() -> None:
    with pytest.raises(ValueError, match="sum to 1"):
        draw_cases(count=10, seed=1, shares={"null": 0.5})


# --- What a case consists of


def test_files_are_complete_and_the_key_stays_apart(tmp_path: Path) -> None:
    conceals = design("oscillator", "mechanism", "cubic stiffness", shifted=True, without=("hysteresis",))
    for folder in ("one", "two"):
        case = make_case(conceals)
        case.write(conceals.name, cases=tmp_path / folder / "cases", keys=tmp_path / folder / "keys")
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    assert [str(file) for file in files] == [
        "cases/case-0001/recordings.parquet",
        "cases/case-0001/study.yaml",
        "cases/case-0001/system.yaml",
        "keys/case-0001.json",
        "keys/case-0001.npz",
    ]
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()

    keys, case = tmp_path / "one" / "keys", tmp_path / "one" / "cases" / "case-0001"
    key = json.loads((keys / "case-0001.json").read_text())
    card = yaml.safe_load((case / "system.yaml").read_text())
    study = yaml.safe_load((case / "study.yaml").read_text())
    table = parquet.read_table(case / "recordings.parquet")
    assert set(key) == {
        *("case", "salt", "system", "kind", "mechanism", "equations", "coordinates", "noise_db"),
        *("strength", "shifts", "effect"),
    }
    assert re.fullmatch("[0-9a-f]{32}", key["salt"])
    assert set(key["effect"]) == {"states", "terms", "replace", "outputs", "noise", "parameters"}
    assert table.column_names == ["recording", "t", "x", "u"]
    assert not table.schema.metadata
    labels = sorted(set(table["recording"].to_pylist()))
    assert labels == [f"r{number:02d}" for number in range(1, len(labels) + 1)]
    assert 8 <= len(labels) <= 12
    assert 1000 <= len(table) <= 2000
    assert set(study) == {"held_out", "without"}
    assert study["without"] == ["hysteresis"]
    assert set(study["held_out"]) < set(labels)
    assert len(study["held_out"]) in (2, 3)
    assert card["equations"] == SYSTEMS["oscillator"].card["equations"]
    for name, shift in key["shifts"].items():
        assert card["parameters"][name]["value"] == shift["card"]
        assert 0.02 < abs(shift["card"] / shift["true"] - 1) < 0.26
    contents = b"".join(path.read_bytes() for path in case.iterdir())
    for secret in ("cubic", key["salt"], "mechanism", "x**3", "case-0001"):
        assert secret.encode() not in contents

    with np.load(keys / "case-0001.npz") as truth:
        rows = len(truth["t"])
        assert rows <= 500
        assert truth["states"].shape == truth["derivative_true"].shape == (rows, 2)
        assert truth["derivative_without"].shape == (rows, 2)
        assert truth["inputs"].shape == (rows, 1)
        difference = (truth["derivative_true"] - truth["derivative_without"])[:, 1]
        c = key["effect"]["parameters"]["c"]
        np.testing.assert_allclose(difference, -c * truth["states"][:, 0] ** 3, atol=1e-9)
        strength = np.sqrt(np.mean(difference**2) / np.mean(truth["derivative_without"][:, 1] ** 2))
    assert strength == pytest.approx(key["strength"], rel=0.1)
    digests = digests_of(keys)
    assert list(digests) == ["case-0001"]
    assert re.fullmatch("[0-9a-f]{64}", digests["case-0001"])


@pytest.mark.parametrize(
    ("system", "kind"),
    [("archetype3d", "shift"), *product(SYSTEMS, ("mechanism", "process noise", "withheld"))],
)
def test_all_kinds_are_bounded(system: str, kind: str) -> None:
    mechanism = {
        "mechanism": next(iter(CATALOGUES[system].mechanisms)),
        "process noise": "process noise",
        "withheld": next(iter(CATALOGUES[system].withheld)),
    }.get(kind)
    case = make_case(design(system, kind, mechanism))
    low, high = SYSTEMS[system].limits
    states = case.truth["states"].T
    assert np.all((states >= low) & (states <= high))
    assert all(np.isfinite(column).all() for name, column in case.recordings.items() if name != "recording")
    assert (case.key["strength"] is None) == (mechanism is None)
    if case.key["strength"] is not None:
        assert 0.008 <= case.key["strength"] <= 0.36
    assert bool(case.key["shifts"]) == (kind == "shift")


@pytest.mark.parametrize("noise_db", [40.0, 30.0, 20.0])
def test_measurement_noise_is_as_stated(noise_db: float) -> None:
    quiet = quiet_recordings("archetype3d")
    noisy = make_case(design("archetype3d", "null", noise_db=noise_db)).recordings
    for name in ("x", "y", "z"):
        ratio = np.std(noisy[name] - quiet[name]) / np.std(quiet[name])
        assert 20 * np.log10(ratio) == pytest.approx(-noise_db, abs=0.5)


def test_amplitudes_differ_between_recordings() -> None:
    for system in SYSTEMS.values():
        if system.card["name"] == "archetype3d":
            continue
        recordings = quiet_recordings(system.card["name"])
        output = recordings[system.outputs[0]]
        spread = [np.ptp(output[recordings["recording"] == label]) for label in set(recordings["recording"])]
        assert max(spread) > 2 * min(spread)


def test_periods_are_sampled_finely() -> None:
    for system in SYSTEMS.values():
        recordings = quiet_recordings(system.card["name"])
        for label in set(recordings["recording"]):
            for output in system.outputs:
                values = recordings[output][recordings["recording"] == label]
                # Turning points are at least five samples apart for all but tiny wiggles on a slower motion.
                turns = np.flatnonzero(np.diff(np.sign(np.diff(values))))
                if len(turns) > 3:
                    assert np.median(np.diff(turns)) >= 6


def test_cards_of_a_system_differ_in_nothing_but_parameters() -> None:
    null = make_case(design("coupled_masses", "null", seed=1)).card
    other = make_case(design("coupled_masses", "withheld", "memory", seed=2, shifted=True)).card
    assert {**null, "parameters": 0} == {**other, "parameters": 0}
    # The numbers of digits do not tell wrong parameters from right ones.
    for card in (null, other):
        assert all(float(f"{p['value']:.4g}") == p["value"] for p in card["parameters"].values())


def test_forces_between_masses_are_equal_and_opposite() -> None:
    for name in ("linear coupling", "nonlinear coupling"):
        terms = COUPLED_MASSES_EFFECTS[name](np.random.default_rng(0)).terms
        assert terms["v2"] == "-" + terms["v1"]


# --- Its independence


def test_the_generator_knows_nothing_of_the_diagnosis() -> None:
    folder = Path(str(concealment_cases.__file__)).parent
    files = [*sorted(folder.glob("*.py")), folder.parent / "cases.py"]
    assert len(files) > 4
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            modules: list[str] = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{file.name} imports relatively"
                modules = [node.module or ""]
            assert not [m for m in modules if m.split(".")[0] == "siq"], file.name
            assert not isinstance(node, ast.Name) or node.id not in ("eval", "exec", "__import__"), file.name
            if any(m.startswith(("workflow", "benchmarks")) for m in modules):
                own = ("benchmarks.proof.concealment", "benchmarks.proof.cases")
                assert all(m.startswith(own) for m in modules), file.name


def test_designs_are_small() -> None:
    fields = dataclasses.asdict(draw_cases(count=3, seed=1, shares=PROOF)[0])
    assert len(json.dumps(fields)) < 400
