"""Files of public benchmarks, imitated, and the scores of simulations."""

from __future__ import annotations

import numpy as np
import pytest

from siq.data.public_recordings import BENCHMARKS, MULTISINE, SAMPLES, read_silverbox, read_tanks
from siq.data.recordings import Recordings
from siq.dynamics.cards import load_system
from siq.errors import InputError
from siq.estimation.measurements import measurements
from siq.mismatch.scores import root_mean_square, windows

CARD = """\
name: decay
states: {x: {domain: [0, 2]}}
parameters: {k: {value: 1.0}}
equations: {x: -k*x}
"""


def silverbox_text(realisations: int) -> str:
    generator = np.random.default_rng(0)
    arrow = np.linspace(0, 0.15, 12_000) * generator.uniform(-1, 1, 12_000)
    parts = [arrow]
    for _ in range(realisations):
        parts += [np.zeros(90), 0.1 * np.sign(generator.normal(size=MULTISINE + 400))]
    u = np.concatenate([*parts, np.zeros(90), arrow[:500]])
    rows = [f"{value + 0.006},{2 * value + 0.001}," for value in u]
    return "\n".join(['"V1","V2",', *rows]) + "\n"


def test_silverbox_is_cut_at_its_gaps_and_freed_of_offsets(write):
    found = read_silverbox(write(silverbox_text(4), "box.csv"))
    assert found.labels == ("arrow", "multisine1", "multisine2", "multisine3")
    lengths = np.bincount(found.recording)
    assert lengths[0] == pytest.approx(12_000, abs=60)
    assert (lengths[1:] == SAMPLES).all()
    y, u = found.values.T
    assert y == pytest.approx(2 * u, abs=1e-9)
    assert abs(u).max() < 0.16
    assert np.diff(found.t[:3]) == pytest.approx(2**14 / 1e7)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (silverbox_text(1), "no gaps"),
        ("a,b\n1,2\n", "no columns"),
        ('"V1","V2",\n1.0,,\n', "missing"),
    ],
    ids=["no gaps", "no columns", "missing"],  # the text is long
)
def test_other_files_are_refused_in_a_sentence(write, text, part):
    with pytest.raises(InputError, match=part):
        read_silverbox(write(text, "box.csv"))


def test_tanks_have_two_recordings(write):
    text = '"uEst","uVal","yEst","yVal","Ts",\n1,2,3,4,4,\n5,6,7,8,,\n'
    found = read_tanks(write(text, "tanks.csv"))
    assert found.labels == ("est", "val")
    assert found.values.tolist() == [[3, 1], [7, 5], [4, 2], [8, 6]]
    assert found.t.tolist() == [0, 4, 0, 4]


def test_every_benchmark_says_what_to_get():
    for one in BENCHMARKS.values():
        assert one.what and one.score and set(one.published) <= set(one.score)


@pytest.mark.parametrize("window", [None, 20])
def test_score_is_the_error_of_a_free_run(write, window):
    model = load_system(write(CARD))
    t = np.linspace(0, 1, 101)
    truth = Recordings(("x",), (None,), ("a",), np.zeros(101, dtype=int), t, np.exp(-t)[:, None])
    data = measurements(truth, model)
    (right,) = root_mean_square(model, data, variance=np.array([1e-8]), window=window)
    (wrong,) = root_mean_square(
        model.with_values(np.array([1.5])), data, variance=np.array([1e-8]), window=window
    )
    assert right < 1e-6 < 1e-3 < wrong


def test_windows_cover_a_recording_and_keep_its_inputs(write):
    model = load_system(write(CARD))
    t = np.linspace(0, 1, 101)
    data = measurements(
        Recordings(("x",), (None,), ("a",), np.zeros(101, dtype=int), t, np.exp(-t)[:, None]), model
    )
    cut = windows(data, 20)
    assert len(cut.labels) == 5
    assert np.array_equal(cut.outputs, data.outputs[:100])
    assert cut.first.tolist() == [0, 20, 40, 60, 80, 100]
