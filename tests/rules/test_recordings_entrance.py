"""Recordings in the place of a simulation: the same data, the same answer. See also `test_command`."""

import shutil

import pytest

pytestmark = pytest.mark.workflow

STUDY = """\
name: measured
system: archetype3d
recordings: {file: measured.parquet, pair_step: 0.01}
runs: 2
seed: 7
training:
  widths: [12, 12]
  steps: 120
  batch_size: 64
  check: null
  decay_steps: 1000
  orthogonality_weight: 10
  representative_share: 0
  relative_dynamics: false
  normalise_on: pairs
  potential_gain: 1
  precision: float32
  matching: symmetric
  thinning_distance: 0.2
regression: {degree: 4, threshold: 0.1, threshold_on: coefficient, level: 2.0}
landscape: false
"""


@pytest.mark.slow
def test_both_entrances_give_the_same_answer_on_the_same_data(fresh_project, finished):
    project = fresh_project
    shutil.copy(finished.path("results/mini/runs/000/recordings.parquet"), project.path("measured.parquet"))
    project.path("study.yaml").write_text(STUDY)
    models = [f"results/measured/runs/{run}/model.json" for run in ("000", "001")]
    project.make(*models)
    measured, resampled = (project.path(model).read_text() for model in models)
    assert measured == finished.path("results/mini/runs/000/model.json").read_text()
    assert measured != resampled
