from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from known_settings import PAPER

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.errors import InputError, NumericalFailure
from siq.networks.decomposition import (
    TrainingOptions,
    load_networks,
    pack,
    save_networks,
)
from siq.networks.networks import at_rest, dynamics_loss, orthogonality_loss
from siq.networks.training import (
    HISTORY,
    TrainingData,
    _Batches,
    _failed_runs,
    _load_checkpoint,
    _save_checkpoint,
    _TrainingState,
    prepare_data,
    start,
    train,
)
from siq.numerics.randomness import generator, seed_sequence
from siq.systems.diffusion import Diffusion

OPTIONS = replace(
    PAPER,
    widths=(8, 8),
    steps=120,
    batch_size=32,
    decay_steps=100,
    thinning_distance=0.3,
    orthogonality_weight=1.0,
)
FULL = np.array([[2.0, 0.6], [0.6, 1.0]])
SEEDS = [seed_sequence(0, run, "training") for run in range(3)]


def spiral_pairs(run: int, recordings: int = 12, length: int = 20, h: float = 0.05) -> SnapshotPairs:
    """Exact pairs of x' = -x + 2y, y' = -y - 2x: V = |x|²/2, g = (2y, -2x)."""
    x0 = generator(run, "x0").uniform(-2, 2, size=(recordings * length, 2))
    turn = np.exp(-h) * np.array([[np.cos(2 * h), np.sin(2 * h)], [-np.sin(2 * h), np.cos(2 * h)]])
    recording = np.repeat(np.arange(recordings), length)
    return SnapshotPairs(x0, x0 @ turn.T, np.full(len(x0), h), recording)


def data(run: int, options: TrainingOptions = OPTIONS) -> TrainingData:
    return prepare_data(spiral_pairs(run), options=options, generator=generator(run, "divide"))


def trained(
    runs: list[int],
    *,
    options: TrainingOptions = OPTIONS,
    diffusion: np.ndarray | None = None,
    state: _TrainingState | None = None,
    checkpoint: Callable[[_TrainingState], None] | None = None,
    checkpoint_every: int = 1000,
) -> _TrainingState:
    parts, seeds = [data(run, options) for run in runs], [SEEDS[run] for run in runs]
    state = state or start(
        parts,
        options=options,
        diffusion=Diffusion(np.eye(2) if diffusion is None else diffusion),
        seeds=seeds,
    )
    return train(
        state, parts, options=options, seeds=seeds, log_every=30,
        checkpoint=checkpoint, checkpoint_every=checkpoint_every,
    )  # fmt: skip


def assert_same_networks(left: _TrainingState, right: _TrainingState) -> None:
    for one, other in zip(left.networks.parameters(), right.networks.parameters(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("matching", ["explicit", "symmetric"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_training_lowers_the_held_out_loss(matching: str, precision: str) -> None:
    options = dataclasses.replace(
        OPTIONS, matching=matching, precision=precision, learning_rate=0.02, steps=200
    )
    history = trained([0], options=options).history
    assert list(history.columns) == list(HISTORY)
    assert history["step"].tolist() == [30, 60, 90, 120, 150, 180, 200]
    losses = history["held_out_loss"].to_numpy(dtype=float)
    assert losses[-1] < 0.3 * losses[0]
    np.testing.assert_allclose(
        losses, history["dynamics"] + options.orthogonality_weight * history["orthogonality"], rtol=1e-6
    )
    assert history["learning_rate"].iloc[-1] == pytest.approx(0.02 * 0.95 ** (199 / 100))


def test_runs_side_by_side_equal_each_alone() -> None:
    together = trained([0, 1, 2])
    for run in range(3):
        alone = trained([run])
        for left, right in zip(together.networks.parameters(), alone.networks.parameters(), strict=True):
            torch.testing.assert_close(left[run], right[0], rtol=1e-7, atol=1e-9)
        rows = together.history[together.history["run"] == run]
        np.testing.assert_allclose(
            rows["held_out_loss"].astype(float), alone.history["held_out_loss"].astype(float), rtol=1e-7
        )


def test_the_same_training_twice_is_the_same_to_the_last_bit() -> None:
    assert_same_networks(trained([1]), trained([1]))


@pytest.mark.parametrize("stop", [37, 100, 110])
def test_an_interrupted_training_ends_as_the_uninterrupted_one_to_the_last_bit(
    tmp_path: Path, stop: int
) -> None:
    class Killed(Exception):
        pass

    path = tmp_path / "folder" / "checkpoint.npz"

    def keep_and_die(state: _TrainingState) -> None:
        _save_checkpoint(path, state, fingerprint="mine")
        raise Killed

    whole = trained([0, 2])
    with pytest.raises(Killed):
        trained([0, 2], checkpoint=keep_and_die, checkpoint_every=stop)
    state = _load_checkpoint(path, fingerprint="mine")
    assert state is not None
    assert state.step == stop
    resumed = trained([0, 2], state=state)
    assert_same_networks(resumed, whole)
    for left, right in zip(resumed.first_moments, whole.first_moments, strict=True):
        assert torch.equal(left, right)
    np.testing.assert_array_equal(
        resumed.history[list(HISTORY)].to_numpy(dtype=float),
        whole.history[list(HISTORY)].to_numpy(dtype=float),
    )


def test_training_leaves_the_state_it_started_from_alone() -> None:
    options = dataclasses.replace(OPTIONS, steps=3)
    state = start([data(0)], options=options, diffusion=Diffusion.identity(2), seeds=SEEDS[:1])
    before = [tensor.clone() for tensor in state.networks.parameters()]
    trained([0], options=options, state=state)
    for left, right in zip(before, state.networks.parameters(), strict=True):
        assert torch.equal(left, right)


def test_a_checkpoint_of_other_data_is_passed_over(tmp_path: Path) -> None:
    state = trained([0], options=dataclasses.replace(OPTIONS, steps=2))
    _save_checkpoint(tmp_path / "c", state, fingerprint="mine")
    assert _load_checkpoint(tmp_path / "c", fingerprint="mine") is not None
    assert _load_checkpoint(tmp_path / "c", fingerprint="other") is None
    assert _load_checkpoint(tmp_path / "missing", fingerprint="mine") is None


def test_a_damaged_checkpoint_is_passed_over(tmp_path: Path) -> None:
    state = trained([0], options=dataclasses.replace(OPTIONS, steps=2))
    path = tmp_path / "c"
    _save_checkpoint(path, state, fingerprint="mine")
    whole = path.read_bytes()
    for length in [*range(0, len(whole), 501), len(whole) - 1]:
        path.write_bytes(whole[:length])
        assert _load_checkpoint(path, fingerprint="mine") is None
    for place in range(0, len(whole), 97):  # a flipped byte is noticed, or lies where nothing is read
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        found = _load_checkpoint(path, fingerprint="mine")
        if found is not None:
            assert_same_networks(found, state)
    path.write_bytes(b"")
    assert _load_checkpoint(path, fingerprint="mine") is None


def test_archives_contain_no_pickles_and_come_back_equal(tmp_path: Path) -> None:
    state = trained([0, 1], options=dataclasses.replace(OPTIONS, steps=2), diffusion=FULL)
    runs = [at_rest(state.networks, run) for run in range(2)]
    save_networks(tmp_path / "n.npz", runs)
    _save_checkpoint(tmp_path / "c.npz", state, fingerprint="mine")
    for name in ("n.npz", "c.npz"):
        with np.load(tmp_path / name, allow_pickle=False) as archive:
            assert all(archive[key].dtype.kind in "fiU" for key in archive.files)
    for run, one in enumerate(runs):
        again = pack([load_networks(tmp_path / "n.npz", run=run)])
        for name, array in pack([one]).items():
            np.testing.assert_array_equal(again[name], array)
    with pytest.raises(InputError):
        load_networks(tmp_path / "n.npz", run=2)


def test_an_archive_of_pickles_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "evil.npz", sizes=np.array([{"a": 1}], dtype=object), fingerprint=np.array("mine"))
    with pytest.raises(InputError):
        load_networks(tmp_path / "evil.npz")
    assert _load_checkpoint(tmp_path / "evil.npz", fingerprint="mine") is None


def test_an_archive_of_something_else_is_refused_as_input(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InputError):
        load_networks(tmp_path / "other.npz")


def test_a_run_whose_loss_is_lost_is_reported_and_harms_no_neighbour() -> None:
    options = dataclasses.replace(OPTIONS, steps=60)
    good, bad = data(0, options), data(1, options)
    bad.training.xh[:] *= 1e200
    parts, seeds = [bad, good], [SEEDS[1], SEEDS[0]]
    state = start(parts, options=options, diffusion=Diffusion.identity(2), seeds=seeds)
    state = train(state, parts, options=options, seeds=seeds, log_every=30)
    failures = _failed_runs(state)
    assert list(failures) == [0]
    assert "no longer finite at step 30" in failures[0]
    alone = trained([0], options=options)
    for left, right in zip(state.networks.parameters(), alone.networks.parameters(), strict=True):
        torch.testing.assert_close(left[1], right[0], rtol=1e-8, atol=1e-10)
    assert _failed_runs(alone) == {}


# Data


def test_recordings_train_or_are_held_out_but_never_both() -> None:
    pairs = spiral_pairs(0, recordings=10)
    divided = prepare_data(pairs, options=OPTIONS, generator=generator(0))
    training, held_out = set(divided.training.recording), set(divided.held_out.recording)
    assert training | held_out == set(range(10))
    assert not training & held_out
    assert len(training) == 7  # 70 % of the recordings, not of the pairs


def test_copies_of_a_resampled_recording_do_not_both_train_and_measure() -> None:
    draw = generator(0)
    recordings = Recordings(
        names=("x", "y"),
        units=("1", "1"),
        labels=tuple(f"r{index}" for index in range(12)),
        recording=np.repeat(np.arange(12), 5),
        t=np.tile(0.1 * np.arange(5), 12),
        values=draw.normal(size=(60, 2)),
    )
    pairs = snapshot_pairs(recordings.resampled(generator=draw))
    divided = prepare_data(pairs, options=OPTIONS, generator=draw)
    training = {tuple(row) for row in divided.training.x0}
    assert not training & {tuple(row) for row in divided.held_out.x0}


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_batches_hold_training_pairs_only_and_points_are_representative(share: float) -> None:
    options = dataclasses.replace(OPTIONS, representative_share=share)
    parts = [data(run, options) for run in range(2)]
    batches = _Batches(
        parts, options=options, seeds=SEEDS[:2], device=torch.device("cpu"), dtype=torch.float64
    )
    for step in (0, 1, 99, 100, 250):
        pairs, points = batches.batch(step)
        assert pairs.shape == (2, 32, 2 + 2 + 2 + 1)
        assert points.shape == (2, 32, 2)
        for run, part in enumerate(parts):
            rows = {tuple(row) for row in np.hstack([part.training.x0, part.training.xh])}
            assert {tuple(row) for row in pairs[run, :, :4].numpy()} <= rows
            spread = {tuple(row) for row in part.representative.x0}
            assert {tuple(row) for row in points[run].numpy()} <= spread
            if share == 1:
                assert {tuple(row) for row in pairs[run, :, :2].numpy()} <= spread
    velocity = (pairs[..., 2:4] - pairs[..., :2]) / pairs[..., 6:]
    torch.testing.assert_close(pairs[..., 4:6], velocity, rtol=1e-10, atol=1e-12)


def test_the_held_out_batch_holds_held_out_pairs_only() -> None:
    part = data(0)
    batches = _Batches(
        [part], options=OPTIONS, seeds=SEEDS[:1], device=torch.device("cpu"), dtype=torch.float64
    )
    pairs, _ = batches.held_out()
    assert {tuple(row) for row in pairs[0, :, :2].numpy()} == {tuple(row) for row in part.held_out.x0}


def test_a_batch_depends_on_the_seed_and_the_step_alone() -> None:
    parts = [data(run) for run in range(2)]

    def batches(order: list[int]) -> _Batches:
        return _Batches(
            [parts[run] for run in order], options=OPTIONS, seeds=[SEEDS[run] for run in order],
            device=torch.device("cpu"), dtype=torch.float64,
        )  # fmt: skip

    straight, jumping = batches([0, 1]), batches([1])
    straight.batch(150)
    for step in (203, 5, 104):
        for left, right in zip(straight.batch(step), jumping.batch(step), strict=True):
            assert torch.equal(left[1], right[0])
    assert not torch.equal(straight.batch(0)[0], straight.batch(1)[0])


def test_a_single_recording_is_a_numerical_failure() -> None:
    with pytest.raises(NumericalFailure, match="only one recording"):
        prepare_data(spiral_pairs(0, recordings=1), options=OPTIONS, generator=generator(0))


# Loss


def vectors(seed: int) -> torch.Tensor:
    return torch.from_numpy(generator(seed).normal(size=(2, 40, 2)))


IDENTITY = torch.eye(2, dtype=torch.float64)


def test_the_orthogonality_loss_is_the_asymmetric_square_of_the_cosine() -> None:
    v, g = vectors(0), vectors(1)
    found = orthogonality_loss(v, g, IDENTITY, IDENTITY, asymmetry=0.1)
    z = ((v * g).sum(-1) / v.norm(dim=-1) / g.norm(dim=-1)).numpy()
    np.testing.assert_allclose(found, np.where(z >= 0, z**2, 0.1 * z**2).mean(axis=1), rtol=1e-12)
    one_way = torch.tensor([[[1.0, 0.0]]], dtype=torch.float64)
    for factor, expected in ((2.0, 1.0), (-2.0, 0.1)):
        value = orthogonality_loss(one_way, factor * one_way, IDENTITY, IDENTITY, asymmetry=0.1)
        assert value.tolist() == pytest.approx([expected])


def test_the_losses_do_not_change_with_the_units_of_the_states() -> None:
    v, g, observed = vectors(0), vectors(1), vectors(2)
    diffusion, change = torch.from_numpy(FULL), torch.diag(torch.tensor([1e-3, 50.0], dtype=torch.float64))
    inverse = torch.linalg.inv(change)
    in_new_units = change @ diffusion @ change
    values = []
    for scale, metric in ((IDENTITY, diffusion), (change, in_new_units)):
        precision = torch.linalg.inv(metric)
        v_new = v if scale is IDENTITY else v @ inverse
        values.append(
            (
                orthogonality_loss(v_new, g @ scale, metric, precision, asymmetry=0.1),
                dynamics_loss(g @ scale, observed @ scale, precision),
            )
        )
    for before, after in zip(*values, strict=True):
        torch.testing.assert_close(before, after, rtol=1e-10, atol=0)


def test_the_dynamics_loss_is_the_mean_square_in_the_metric_of_the_noise() -> None:
    predicted, observed = vectors(0), vectors(1)
    found = dynamics_loss(predicted, observed, torch.linalg.inv(torch.from_numpy(FULL)))
    difference = (predicted - observed).numpy()
    expected = [np.mean([row @ np.linalg.solve(FULL, row) for row in run]) for run in difference]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("which", ["gradient", "circulatory", "both"])
def test_a_vanishing_component_costs_nothing_and_has_finite_derivatives(
    dtype: torch.dtype, which: str
) -> None:
    v, g = vectors(0).to(dtype), vectors(1).to(dtype)
    v = (0 * v if which in ("gradient", "both") else v).requires_grad_()
    g = (0 * g if which in ("circulatory", "both") else g).requires_grad_()
    loss = orthogonality_loss(v, g, IDENTITY.to(dtype), IDENTITY.to(dtype), asymmetry=0.1)
    assert loss.tolist() == [0.0, 0.0]
    loss.sum().backward()
    assert torch.isfinite(v.grad).all()
    assert torch.isfinite(g.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e3, 1e6])
def test_the_angle_does_not_depend_on_how_long_the_vectors_are(dtype: torch.dtype, size: float) -> None:
    v, g, unit = vectors(0).to(dtype), vectors(1).to(dtype), IDENTITY.to(dtype)
    before = orthogonality_loss(v, g, unit, unit, asymmetry=0.1)
    after = orthogonality_loss(size * v, size * g, unit, unit, asymmetry=0.1)
    torch.testing.assert_close(before, after, rtol=1e-4, atol=0)


def test_relative_dynamics_divides_by_the_mean_square_velocity() -> None:
    dynamics = []
    for relative in (False, True):  # at so small a rate the networks stay as they are
        options = dataclasses.replace(OPTIONS, relative_dynamics=relative, steps=1, learning_rate=1e-15)
        dynamics.append(float(trained([0], options=options, diffusion=FULL).history["dynamics"].iloc[0]))
    part = data(0).training
    velocity = (part.xh - part.x0) / part.h[:, None]
    square = np.mean([row @ np.linalg.solve(FULL, row) for row in velocity])
    assert dynamics[0] / dynamics[1] == pytest.approx(square, rel=1e-9)


def test_with_a_slow_speed_every_pair_counts_by_its_own_speed() -> None:
    draw = generator(3)
    predicted, observed = draw.normal(size=(2, 2, 50, 2))
    precision, slow = np.linalg.inv(FULL), np.array([[0.3], [0.7]])
    found = dynamics_loss(
        *(torch.from_numpy(one) for one in (predicted, observed, precision)), slow=torch.from_numpy(slow)
    )
    mismatch = np.einsum("rni,ij,rnj->rn", predicted - observed, precision, predicted - observed)
    speed = np.einsum("rni,ij,rnj->rn", observed, precision, observed)
    np.testing.assert_allclose(found, (mismatch / (speed + slow)).mean(axis=1), rtol=1e-12)


def test_a_slow_speed_makes_training_the_same_in_any_units() -> None:
    options = dataclasses.replace(OPTIONS, slow_speed=0.1, potential_from="descent", steps=20)
    losses = []
    for size in (1.0, 1e-3):  # D stays the unit matrix, in units of its own: time takes up the rest
        pairs = spiral_pairs(0)
        pairs = dataclasses.replace(pairs, x0=size * pairs.x0, xh=size * pairs.xh, h=size**2 * pairs.h)
        own = dataclasses.replace(options, thinning_distance=0.3 * size)
        part = [prepare_data(pairs, options=own, generator=generator(0, "divide"))]
        state = start(part, options=own, diffusion=Diffusion.identity(2), seeds=[SEEDS[0]])
        state = train(state, part, options=own, seeds=[SEEDS[0]], log_every=20)
        losses.append(float(state.history["held_out_loss"].iloc[-1]))
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)
