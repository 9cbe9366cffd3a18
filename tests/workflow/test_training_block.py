"""The training of a block of runs: attempts, checks, and what a killed job goes on from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from known_settings import PAPER

from siq.data.recordings import SnapshotPairs
from siq.networks.decomposition import CheckOptions, NetworksByWell, TrainedNetworks, TrainingOptions, pack
from siq.networks.training import Block, prepare_data
from siq.systems.diffusion import Diffusion
from siq.workflow.tables import Outcome, Status, Step
from siq.workflow.training import _outcome_of, clean

TRAINING = replace(
    PAPER,
    widths=(6,),
    steps=60,
    batch_size=16,
    thinning_distance=0.3,
    check=CheckOptions(first=20, every=20, attempts=2),
)


def data(run: int):
    x0 = np.random.default_rng(run).uniform(-2, 2, size=(200, 2))
    pairs = SnapshotPairs(x0, x0 * np.exp(-0.05), np.full(200, 0.05), np.repeat(np.arange(10), 20))
    return prepare_data(pairs, options=TRAINING, generator=np.random.default_rng(run))


class Check:
    """Passes at its n-th call, or for the networks given, and may be told to die at a call.

    Where it never passes there may be something `instead`.
    """

    def __init__(
        self,
        passes_at: int = -1,
        *,
        like: TrainedNetworks | None = None,
        dies_at: int = -1,
        instead: NetworksByWell | None = None,
    ):
        self.calls, self.passes_at, self.like, self.dies_at = 0, passes_at, like, dies_at
        self.instead = instead

    def hopeless(self) -> None:
        return None

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        self.calls += 1
        if self.calls == self.dies_at:
            raise KeyboardInterrupt
        if self.like is not None:  # a pure function of the networks, as the real check is
            return networks if same(networks, self.like) else None
        return networks if self.calls == self.passes_at else None

    def by_wells(self) -> NetworksByWell | None:
        return self.instead


def same(left: TrainedNetworks, right: TrainedNetworks) -> bool:
    one, other = pack([left]), pack([right])
    return all(np.array_equal(one[name], other[name]) for name in one)


def block(
    folder: Path | None, checks: dict[int, Check], *, options: TrainingOptions = TRAINING, **further
) -> Block:
    return Block(
        {run: data(run) for run in (0, 1)}, checks, options=options, diffusion=Diffusion.identity(2), seed=3,
        folder=folder, mark="m" * 20, device=torch.device("cpu"), **further,
    )  # type: ignore[arg-type]  # fmt: skip


def test_each_run_stops_where_its_check_passed_and_only_the_others_start_afresh(tmp_path: Path) -> None:
    one = block(tmp_path, {0: Check(2), 1: Check(5)})  # run 1 passes in its second training
    one.train()
    assert set(one.passed) == {0, 1}
    assert _outcome_of(one, 0).status == _outcome_of(one, 1).status == Status.OK
    assert [_outcome_of(one, run).details["position"] for run in (0, 1)] == [0, 1]
    history = one.history()
    assert set(history["run"]) == {0, 1}
    assert list(tmp_path.glob("kept-*"))
    clean(tmp_path)
    assert not list(tmp_path.glob("kept-*"))


def test_a_run_whose_check_never_passes_is_shown_as_such(tmp_path: Path) -> None:
    one = block(tmp_path, {0: Check(1), 1: Check(99)})
    one.train()
    said = _outcome_of(one, 1)
    assert said.status == Status.WARNING and "passed in none of 2 trainings" in said.reason


@pytest.mark.parametrize("options", [TRAINING, replace(TRAINING, learning_rate=1e30)], ids=["", "lost"])
def test_networks_by_well_serve_where_no_training_has_passed(options: TrainingOptions) -> None:
    by_well = NetworksByWell((), np.zeros(0), np.zeros(0), np.zeros((0, 2)), np.zeros(0, dtype=int))
    checks = {0: Check(1, instead=by_well), 1: Check(99, instead=by_well)}
    one = block(None, checks, options=options)
    one.train()
    assert isinstance(one.last[0], TrainedNetworks) and one.last[1] is by_well
    assert checks[1].calls == 2 * 3  # every step of both trainings at which it was asked came first
    assert _outcome_of(one, 1) == Outcome(1, Step.TRAIN, Status.OK, "", {"position": 1})


def test_why_a_run_has_no_check_is_said() -> None:
    one = block(None, {0: Check(1)}, faults={1: "the check could not be prepared: no attractor"})
    one.train()
    assert _outcome_of(one, 0).status == Status.OK
    said = _outcome_of(one, 1)
    assert (said.status, said.reason) == (Status.WARNING, "the check could not be prepared: no attractor")


def test_a_killed_job_ends_with_the_same_networks(tmp_path: Path) -> None:
    whole = block(tmp_path / "whole", {0: Check(2), 1: Check(5)})
    whole.train()
    goals = whole.passed
    for dies_at in (2, 3, 4, 5):
        folder = tmp_path / f"killed at {dies_at}"
        killed = block(folder, {0: Check(like=goals[0]), 1: Check(like=goals[1], dies_at=dies_at)})
        with pytest.raises(KeyboardInterrupt):
            killed.train()
        resumed = block(folder, {0: Check(like=goals[0]), 1: Check(like=goals[1])})
        resumed.train()
        assert set(resumed.passed) == {0, 1}
        assert all(same(resumed.last[run], whole.last[run]) for run in (0, 1))
