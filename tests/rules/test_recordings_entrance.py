"""Recordings in the place of a simulation: the same data, the same answer. See also `test_command`."""

import shutil

import pytest
import yaml

pytestmark = pytest.mark.workflow


@pytest.mark.slow
def test_both_entrances_give_the_same_answer_on_the_same_data(fresh_project, finished):
    project = fresh_project
    shutil.copy(finished.path("results/mini/runs/000/recordings.parquet"), project.path("measured.parquet"))
    study = yaml.safe_load(finished.path("study.yaml").read_text())
    assert study.pop("simulation") and study.pop("published")
    study |= {"name": "measured", "recordings": {"file": "measured.parquet", "pair_step": 0.01}}
    project.path("study.yaml").write_text(yaml.safe_dump(study))
    models = [f"results/measured/runs/{run}/model.json" for run in ("000", "001")]
    project.make(*models)
    measured, resampled = (project.path(model).read_text() for model in models)
    assert measured == finished.path("results/mini/runs/000/model.json").read_text()
    assert measured != resampled
