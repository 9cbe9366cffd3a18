from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from known_settings import PAPER

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure
from siq.networks import decomposition
from siq.networks.networks import Networks, at_rest, evaluate, initial_layers, move, side_by_side
from siq.networks.training import _initial_networks, prepare_data
from siq.numerics.randomness import generator
from siq.systems.diffusion import Diffusion

FULL = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.5]])


def networks(
    dimension: int = 3, runs: int = 2, widths: tuple[int, ...] = (7, 5), diffusion: np.ndarray | None = None
) -> Networks:
    draws = [generator(run) for run in range(runs)]
    draw = generator(99)
    return Networks(
        potential=initial_layers((dimension, *widths, 1), generators=draws, dtype=torch.float64),
        circulatory=initial_layers((dimension, *widths, dimension), generators=draws, dtype=torch.float64),
        mean=torch.from_numpy(draw.normal(size=(runs, 1, dimension))),
        scale=torch.from_numpy(draw.uniform(0.01, 100, size=(runs, 1, dimension))),
        potential_scale=torch.from_numpy(draw.uniform(0.5, 5, size=(runs, 1, 1))),
        circulatory_scale=torch.from_numpy(draw.uniform(0.5, 5, size=(runs, 1, 1))),
        diffusion=torch.eye(dimension, dtype=torch.float64)
        if diffusion is None
        else torch.from_numpy(diffusion),
    )


def points(runs: int, dimension: int, count: int = 11) -> torch.Tensor:
    return torch.from_numpy(generator(5).normal(size=(runs, count, dimension)))


def tanh_network(layers: tuple, y: np.ndarray, run: int) -> np.ndarray:
    for index, (weights, biases) in enumerate(layers):
        y = y @ weights[run].numpy() + biases[run].numpy()
        if index < len(layers) - 1:
            y = np.tanh(y)
    return y


@pytest.mark.parametrize("widths", [(4,), (7, 5), (6, 6, 6)])
@pytest.mark.parametrize("dimension", [1, 3])
def test_the_gradient_by_hand_is_that_of_automatic_differentiation(
    dimension: int, widths: tuple[int, ...]
) -> None:
    nets = networks(dimension, widths=widths)
    x = points(2, dimension).requires_grad_()
    potential, gradient, _, _ = evaluate(nets, x)
    (expected,) = torch.autograd.grad(potential.sum(), x)
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-14)


def test_the_gradient_of_the_gradient_reaches_the_weights() -> None:
    nets = networks()
    parameters = [tensor.requires_grad_() for tensor in nets.parameters()]
    x = points(2, 3).requires_grad_()
    potential, gradient, _, _ = evaluate(nets, x)
    mine = torch.autograd.grad(gradient.square().sum(), parameters[:6], retain_graph=True, allow_unused=True)
    (by_autograd,) = torch.autograd.grad(potential.sum(), x, create_graph=True)
    expected = torch.autograd.grad(by_autograd.square().sum(), parameters[:6], allow_unused=True)
    for left, right in zip(mine[:5], expected[:5], strict=True):  # the last bias shifts V only
        torch.testing.assert_close(left, right, rtol=1e-9, atol=1e-13)


def test_values_are_the_formulas_of_the_paper() -> None:
    nets = networks(diffusion=FULL)
    x = points(2, 3)
    v, gradient, g, f = evaluate(nets, x)
    for run in range(2):
        y = (x[run] - nets.mean[run]).numpy() / nets.scale[run].numpy()
        potential = nets.potential_scale[run].numpy() * (
            tanh_network(nets.potential, y, run) + (y**2).sum(axis=1, keepdims=True)
        )
        np.testing.assert_allclose(v[run], potential[:, 0], rtol=1e-12)
        circulatory = nets.circulatory_scale[run].numpy() * tanh_network(nets.circulatory, y, run)
        np.testing.assert_allclose(g[run], circulatory, rtol=1e-12)
        expected = g[run].numpy() - gradient[run].numpy() @ FULL.T
        np.testing.assert_allclose(f[run], expected, rtol=1e-12, atol=1e-14)


def test_two_runs_together_equal_each_alone() -> None:
    nets = networks(diffusion=FULL)
    x = points(2, 3)
    together = evaluate(nets, x)
    for run in range(2):
        alone = evaluate(nets.of_run(run), x[run : run + 1])
        for both, single in zip(together, alone, strict=True):
            torch.testing.assert_close(both[run], single[0], rtol=1e-13, atol=1e-14)


def test_runs_differ_and_do_not_depend_on_their_neighbours() -> None:
    both = initial_layers((3, 4, 1), generators=[generator(0), generator(1)], dtype=torch.float64)
    second = initial_layers((3, 4, 1), generators=[generator(1)], dtype=torch.float64)
    for (weights, biases), (alone_weights, alone_biases) in zip(both, second, strict=True):
        assert torch.equal(weights[1:], alone_weights)
        assert torch.equal(biases[1:], alone_biases)
        assert not torch.equal(weights[0], weights[1])


def test_networks_at_rest_have_the_values_of_those_in_training(monkeypatch: pytest.MonkeyPatch) -> None:
    nets = networks(diffusion=FULL)
    x = generator(2).normal(size=(25, 3))
    for run in range(2):
        one = at_rest(nets, run)
        potential, _, circulatory, field = evaluate(nets.of_run(run), torch.from_numpy(x)[None])
        whole = one.evaluate(x)
        with monkeypatch.context() as patch:
            patch.setattr(decomposition, "CHUNK", 7)
            pieces = one.evaluate(x)
            np.testing.assert_allclose(one.potential_at(x), whole[0], rtol=1e-12)
        for piece, values, expected in zip(pieces, whole, (potential, circulatory, field), strict=True):
            np.testing.assert_allclose(piece, values, rtol=1e-12, atol=1e-14)
            np.testing.assert_allclose(values, expected[0], rtol=1e-12, atol=1e-14)
    assert one.evaluate(x[:0])[-1].shape == (0, 3)
    assert one.potential_at(x[:0]).shape == (0,)


def test_networks_at_rest_can_be_trained_on() -> None:
    nets = networks(diffusion=FULL)
    again = side_by_side([at_rest(nets, run) for run in range(2)])
    for left, right in zip(again.parameters(), nets.parameters(), strict=True):
        assert torch.equal(left, right)
    for name in ("mean", "scale", "potential_scale", "circulatory_scale", "diffusion"):
        assert torch.equal(getattr(again, name), getattr(nets, name))


def test_networks_at_rest_share_no_memory_with_the_training() -> None:
    nets = networks()
    one = at_rest(nets, 0)
    one.potential[0][0][:] = 0
    assert nets.potential[0][0].abs().sum() > 0


def test_moved_networks_share_no_memory() -> None:
    nets = networks()
    copy = move(nets, "cpu")
    with torch.no_grad():
        copy.potential[0][0].zero_()
    assert nets.potential[0][0].abs().sum() > 0


def some_pairs(count: int = 400) -> SnapshotPairs:
    draw = generator(4)
    x0 = draw.normal(size=(count, 2)) * [0.2, 30.0] + [5.0, -1.0]
    return SnapshotPairs(
        x0, x0 + 0.01 * draw.normal(size=(count, 2)), np.full(count, 0.01), np.arange(count) // 20
    )


@pytest.mark.parametrize("gain", [1.0, 3.0])
def test_normalisation_and_rescaling_are_those_of_the_paper(gain: float) -> None:
    options = replace(PAPER, widths=(6, 5), thinning_distance=1.0, potential_gain=gain)
    data = prepare_data(some_pairs(), options=options, generator=generator(0))
    nets = _initial_networks(
        [data], options=options, diffusion=Diffusion.identity(2), generators=[generator(1)]
    )
    x0, xh, h = data.training.x0, data.training.xh, data.training.h
    np.testing.assert_allclose(nets.mean[0, 0], x0.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(nets.scale[0, 0], x0.std(axis=0), rtol=1e-14)
    speed = np.linalg.norm((xh - x0) / h[:, None], axis=1)
    y = torch.from_numpy((x0 - x0.mean(axis=0)) / x0.std(axis=0)).requires_grad_()
    value = (y * y).sum(dim=1)
    hidden = y
    for weights, biases in nets.potential[:-1]:
        hidden = torch.tanh(hidden @ weights[0] + biases[0])
    value = value + (hidden @ nets.potential[-1][0][0] + nets.potential[-1][1][0])[:, 0]
    v = np.linalg.norm(torch.autograd.grad(value.sum(), y)[0].numpy(), axis=1)
    assert float(nets.potential_scale) == pytest.approx(gain * (v @ speed) / (v @ v), rel=1e-10)
    g = np.linalg.norm(tanh_network(nets.circulatory, y.detach().numpy(), 0), axis=1)
    assert float(nets.circulatory_scale) == pytest.approx((g @ speed) / (g @ g), rel=1e-10)


def test_a_state_that_does_not_vary_is_a_numerical_failure() -> None:
    pairs = some_pairs()
    pairs.x0[:, 1] = 3.0
    options = replace(PAPER, widths=(3,), thinning_distance=1.0)
    with pytest.raises(NumericalFailure, match="does not vary"):
        prepare_data(pairs, options=options, generator=generator(0))


def test_the_initial_potential_may_be_as_steep_as_the_descent_within_a_fast_rotation() -> None:
    draw = generator(4)
    x0 = draw.uniform(-1, 1, size=(2000, 2))
    turning = np.array([[-0.02, 5.0], [-5.0, -0.02]])
    pairs = SnapshotPairs(x0, x0 + 0.001 * x0 @ turning.T, np.full(2000, 0.001), np.arange(2000) // 20)
    slopes = {}
    for source in ("speed", "descent"):
        options = replace(PAPER, widths=(6, 5), thinning_distance=0.1, potential_from=source)
        data = prepare_data(pairs, options=options, generator=generator(0))
        nets = _initial_networks(
            [data], options=options, diffusion=Diffusion.identity(2), generators=[generator(1)]
        )
        gradient = evaluate(nets, torch.from_numpy(x0)[None])[1][0].numpy()
        slopes[source] = np.linalg.norm(gradient, axis=1).mean() / np.linalg.norm(x0, axis=1).mean()
    assert slopes["descent"] < 0.2 < 1 < slopes["speed"]
