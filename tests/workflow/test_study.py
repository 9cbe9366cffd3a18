from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from known_settings import PAPER

from siq.errors import InputError
from siq.networks.decomposition import TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.quasipotential.landscape import LandscapeOptions
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationEntry, SimulationOptions
from siq.workflow.study import Study, load_study, load_study_system, settings_of
from siq.workflow.tables import Method
from workflow.places import named_file
from workflow.published import load_published

Write = Callable[..., Path]
CONFIG = Path(__file__).parents[2] / "config"
STUDIES = sorted((CONFIG / "studies").glob("*.yaml"))


def card_of(study: Study) -> Path | None:
    return None if study.system is None else named_file(study.system, "systems", start=CONFIG)


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        load_study(path)
    return caught.value


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_study_of_the_project_loads_with_its_system_and_figures(path: Path) -> None:
    study = load_study(path)
    assert study.name == path.stem
    load_study_system(study, card_of(study), file=str(path))
    if study.published is not None:
        assert load_published(CONFIG / "published" / f"{study.published}.yaml").figures


def test_what_a_study_leaves_out_takes_the_defaults_of_the_schema(write: Write) -> None:
    study = load_study(write("name: plain\nsystem: archetype3d\ntraining: {steps: 7}\n"))
    assert study.simulation == SimulationEntry()
    assert study.training == TrainingOptions(steps=7)
    assert study.regression == RegressionOptions()
    assert study.landscape == LandscapeOptions()
    assert (study.runs, study.seed, study.recordings, study.published) == (1, 0, None, None)


def test_networks_take_part_where_a_study_asks_for_them_and_a_landscape_unless_it_does_not(
    write: Write, archetype: Dynamics
) -> None:
    plain = load_study(write("name: plain\nsystem: archetype3d\n"))
    assert plain.training is None and plain.landscape is not None
    assert settings_of(plain, archetype).refinement.routes == ("local",)
    assert settings_of(plain, archetype).methods == (Method.REFINED,)
    asked = load_study(write("name: plain\nsystem: archetype3d\ntraining: {}\nlandscape: false\n"))
    assert asked.training == TrainingOptions() and asked.landscape is None
    assert settings_of(asked, archetype).refinement.routes == ("network", "local")
    error = refusal(write("name: s\nsystem: a\nrefinement: {routes: [network]}\n"))
    assert "no networks are asked for" in error.fault and "training: {}" in error.remedy


def test_the_published_study_has_the_settings_of_the_paper() -> None:
    study = load_study(CONFIG / "studies" / "archetype3d-published.yaml")
    assert study.runs == 50
    assert study.simulation.options() == SimulationOptions(
        trajectories=5000, pairs=50, pair_step=0.01, interval=0.1, substeps=5
    )
    assert study.training == replace(PAPER, thinning_distance=0.1)
    regression = study.regression
    assert (regression.degree, regression.potential_degree, regression.circulatory_degree) == (5, None, None)
    assert (regression.threshold, regression.threshold_on, regression.scaling) == (0.1, "coefficient", "none")
    assert (regression.relaxation, regression.level, regression.functions) == (1e-5, 2.0, ())


def test_the_published_error_is_that_of_the_paper() -> None:
    figure = load_published(CONFIG / "published" / "archetype3d.yaml").figures["rrmse"]
    assert (figure.mean, figure.standard_deviation) == (8.87e-4, 3.48e-4)


def test_a_study_without_data_is_refused(write: Write) -> None:
    error = refusal(write("name: empty\nruns: 3\n"))
    assert "names no data" in error.fault
    assert "system: NAME" in error.remedy


@pytest.mark.parametrize(
    ("text", "place", "fault", "remedy"),
    [
        (
            "sytem: a\nname: s\nsystem: a\n",
            "line 1 (sytem)",
            "'sytem' is unknown",
            "perhaps you meant 'system'",
        ),
        (
            "name: s\nsystem: a\ntraining:\n  step: 5\n",
            "line 4 (training.step)",
            "'step' is unknown",
            "perhaps you meant 'steps'",
        ),
        (
            "name: s\nsystem: a\nregression:\n  tresholds: 5\n",
            "line 4 (regression.tresholds)",
            "'tresholds' is unknown",
            "perhaps you meant 'threshold'",
        ),
        ("name: s\nsystem: a\nruns: 0\n", "line 3 (runs)", "0", "greater than or equal to 1"),
        ("name: s\nsystem: a\nruns: many\n", "line 3 (runs)", "'many'", "integer"),
        ("name: s\nsystem: a\nseed: -1\n", "line 3 (seed)", "-1", "greater than or equal to 0"),
        ("name: a/b\nsystem: a\n", "line 1 (name)", "'a/b'", "use letters"),
        ("name: s\nsystem: a\npublished: ../x\n", "line 3 (published)", "'../x'", "letters"),
        ("name: s\nsystem: a\ntraining:\n  matching_order: 3\n", "line 4", "3", "2 or 4"),
        ("name: s\nsystem: a\ntraining:\n  steps: 0\n", "line 4 (training.steps)", "0", "1"),
        ("name: s\nsystem: a\ntraining:\n  training_share: 1\n", "line 4", "1", "less than 1"),
        ("name: s\nsystem: a\ntraining:\n  widths: []\n", "line 4 (training.widths)", "[]", "at least 1"),
        (
            "name: s\nsystem: a\nsimulation:\n  pair_step: 0.01\n  interval: 0.013\n",
            "",
            "not a multiple",
            "change one of them",
        ),
        ("name: s\nrecordings:\n  pair_step: 1\n", "line 2 (recordings.file)", "'file' is missing", "add"),
        (
            "name: s\nrecordings:\n  file: a.csv\n  stats: [x]\n",
            "line 4",
            "'stats'",
            "perhaps you meant 'states'",
        ),
    ],
)
def test_a_faulty_study_is_refused_with_its_line_and_a_remedy(
    write: Write, text: str, place: str, fault: str, remedy: str
) -> None:
    error = refusal(write(text))
    assert error.place.startswith(place)
    assert fault in error.fault
    assert remedy in error.remedy


def check_system(study_file: Path) -> None:
    study = load_study(study_file)
    load_study_system(study, card_of(study), file=str(study_file))


def test_a_library_function_of_an_unknown_state_is_refused_before_any_job(write: Write) -> None:
    path = write("name: s\nsystem: archetype3d\nregression:\n  functions: ['sin(w)']\n")
    with pytest.raises(InputError, match="the name 'w' is not declared"):
        check_system(path)


def test_hidden_velocities_are_states_of_the_library_and_of_recordings_only(write: Write) -> None:
    hidden = "identification: {hidden_velocities: true, functions: ['x*v_x/(1 + x**2)']}\n"
    recorded = "name: alone\nrecordings: {file: x.csv, states: [x]}\n"
    path = write(recorded + hidden)
    load_study_system(load_study(path), None, file=str(path))
    assert "hidden_velocities" in str(refusal(write(recorded + hidden + "training: {}\n")))
    assert "hidden_velocities" in str(refusal(write("name: alone\nsystem: duffing\n" + hidden)))


def test_states_other_than_those_of_the_system_are_refused(write: Write) -> None:
    path = write("name: s\nsystem: archetype3d\nrecordings: {file: a.csv, states: [x, y]}\n")
    with pytest.raises(InputError, match="not those of the system 'archetype3d'; name x, y, z"):
        check_system(path)


def test_a_diffusion_that_does_not_fit_the_recorded_states_is_refused(write: Write) -> None:
    path = write("name: s\nrecordings: {file: a.csv, states: [x, y], diffusion: [1, 2, 3]}\n")
    with pytest.raises(InputError, match="does not fit 2 states"):
        check_system(path)


def test_noise_may_reach_a_state_by_way_of_others_where_equations_are_all_that_is_asked(write: Write) -> None:
    states = "{x: {domain: [-2, 2]}, v: {domain: [-2, 2]}}"
    text = f"name: s\nstates: {states}\nequations: {{x: v, v: x - x**3 - v}}\ndiffusion: [[0, 0], [0, 1]]\n"
    card = write(text, "s.yaml")
    check_system(write(f"name: s\nsystem: {card}\nfrom: equations\n", "given.yaml"))
    with pytest.raises(InputError, match=r"directly, as it has to .* 'from: equations'"):
        check_system(write(f"name: s\nsystem: {card}\n"))
    card = write(text.replace("x: v,", "x: x - x**3,"), "s.yaml")
    with pytest.raises(InputError, match="does not reach x, neither"):
        check_system(write(f"name: s\nsystem: {card}\nfrom: equations\n", "given.yaml"))


@pytest.mark.parametrize(
    ("states", "further", "place", "fault"),
    [
        ("{x: {unit: m}}", "", "line 2 (states.x)", "the state 'x' has no domain"),
        ("{x: {domain: [-1, 1]}}", "diffusion: [0]\n", "line 4 (diffusion)", "does not reach every state"),
    ],
)
def test_what_a_landscape_needs_is_asked_for(
    write: Write, states: str, further: str, place: str, fault: str
) -> None:
    card = write(f"name: s\nstates: {states}\nequations: {{x: x - x**3}}\n{further}", "s.yaml")
    with pytest.raises(InputError) as caught:
        check_system(write(f"name: s\nsystem: {card}\n"))
    error = caught.value
    assert (error.file, error.place) == (str(card), place) and fault in error.fault


@pytest.mark.parametrize("what", ["inputs", "time"])
def test_a_driven_system_is_refused(write: Write, what: str) -> None:
    driven = (
        "inputs: {u: {}}\nequations: {x: u - x}\n" if what == "inputs" else "equations: {x: cos(t) - x}\n"
    )
    card = write("name: driven\nstates: {x: {domain: [-1, 1]}}\n" + driven, "driven.yaml")
    with pytest.raises(
        InputError, match=f"driven system has no quasipotential; leave the {what} out"
    ) as caught:
        check_system(write(f"name: s\nsystem: {card}\n"))
    assert caught.value.place.startswith("line 3")


@pytest.mark.parametrize(
    ("equation", "fault"),
    [
        ("-x/(x - 1)", "divides by zero within the domain"),
        ("-1/x", "divides by zero within the domain"),
        ("-exp(x)*x", "too large for a number"),
        ("-x + log(x + 900)", "not defined"),
    ],
)
def test_an_equation_without_a_value_in_the_domain_is_refused(
    write: Write, equation: str, fault: str
) -> None:
    card = write(
        "name: odd\nstates:\n  x: {unit: '1', domain: [-1000, 1000]}\nequations:\n"
        f'  x: "{equation}"\ndiffusion: identity\n',
        "odd.yaml",
    )
    study = load_study(write(f"name: odd\nsystem: {card}\n"))
    with pytest.raises(InputError, match=rf"line 5 \(equations.x\): the equation.*{fault}.*choose a domain"):
        load_study_system(study, card_of(study), file="study.yaml")


def test_a_missing_card_is_refused_by_name(write: Write) -> None:
    path = write("name: s\nsystem: nowhere\n")
    with pytest.raises(InputError, match=r"nowhere\.yaml"):
        check_system(path)


@pytest.mark.parametrize(
    ("study", "remedy"),
    [
        ("recordings: {file: mine.csv}\n", "add 'system: NAME'"),
        ("system: archetype3d\nlandscape: false\n", "remove 'landscape: false'"),
        ("system: archetype3d\nfrom: equations\n", "remove it, or 'from: equations'"),
    ],
)
def test_two_landscapes_are_compared_where_there_are_two(write, study, remedy):
    with pytest.raises(InputError, match=remedy):
        load_study(write(f"name: plain\nbeside_equations: true\n{study}"))


@pytest.mark.parametrize(
    ("study", "fault"),
    [
        (f"name: {'ab' * 60}\nsystem: lake\n", "the name 'abababababababababab…' is too long"),
        (f"name: {'a' * 25}\nsystem: lake\n", "is too long, or repeats itself"),
        ("name: a\nrecordings: {file: '{x}.csv'}\n", "the name of the file '{x}.csv' holds braces"),
    ],
)
def test_names_that_no_file_can_have_are_refused(write: Write, study: str, fault: str) -> None:
    assert fault in refusal(write(study)).fault


def test_states_are_named_as_formulas_read_them(write: Write) -> None:
    study = load_study(write("name: a\nrecordings: {file: a.csv, states: [µ, ｘ], units: {µ: m}}\n"))
    assert study.recordings is not None
    assert study.recordings.states == ("μ", "x")
    assert study.recordings.units == {"μ": "m"}
