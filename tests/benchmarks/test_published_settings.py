"""The training of fifty runs on a card trains what the study trains."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import published_settings
from siq.networks import training
from siq.networks.networks import side_by_side
from siq.systems.cards import load_exact, load_system
from siq.systems.formulas import compile_formulas
from siq.workflow.study import load_study, settings_of

H = 0.01


@pytest.fixture(scope="module")
def data() -> list[published_settings.Data]:
    return [published_settings.drawn(number) for number in range(2)]


def test_its_loss_is_that_of_the_library(data: list[published_settings.Data]) -> None:
    system = load_system(published_settings.CARD)
    options = settings_of(load_study(published_settings.STUDY), system).training
    assert options is not None
    networks = [one.networks for one in data]
    pairs = torch.from_numpy(np.stack([one.pairs[:500] for one in data])).double()
    points = torch.from_numpy(np.stack([one.points[:300] for one in data])).double()
    parameters, fixed = published_settings.flattened(networks)
    weight, asymmetry = options.orthogonality_weight, options.asymmetry
    ours = published_settings.loss(
        parameters, fixed, pairs, points, step=H, weight=weight, asymmetry=asymmetry
    )  # fmt: skip
    tensors = side_by_side(networks)
    kind: dict[str, Any] = {"options": options, "device": torch.device("cpu"), "dtype": torch.float64}
    runs: list[Any] = [None, None]  # mean squares are asked for by other options only
    objective = training._Objective(runs, diffusion=tensors.diffusion, **kind)
    x0, velocity = pairs.split(3, dim=-1)
    rows = torch.cat([x0, x0 + H * velocity, velocity, torch.full_like(x0[..., :1], H)], dim=-1)
    dynamics, orthogonality = objective(tensors, rows, points)
    torch.testing.assert_close(ours, dynamics + weight * orthogonality)


def test_a_training_goes_on_where_it_stopped_and_added_units_stay_zero(
    data: list[published_settings.Data],
) -> None:
    system = load_system(published_settings.CARD)
    options = settings_of(load_study(published_settings.STUDY), system).training
    assert options is not None
    options = replace(options, batch_size=8 * published_settings.PARTS)

    def begun() -> published_settings.Training:
        return published_settings.Training(data, options=options, step=H, group=1, device="cpu")

    first, second = begun(), begun()
    torch.manual_seed(1)
    first.one_step()
    second.restore(first.state())
    torch.manual_seed(2)
    first.one_step()
    torch.manual_seed(2)
    second.one_step()
    for one, other in zip(first.state(), second.state(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    whole = published_settings.flattened(first.networks())[0]
    groups = [torch.cat(parts).double() for parts in zip(*first.parameters, strict=True)]
    for one, other in zip(whole, groups, strict=True):  # nothing is lost with the added units
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_the_grid_covers_the_domain() -> None:
    system = load_system(published_settings.CARD)
    assert system.domain is not None
    _, grid = published_settings._domain_grid(system.domain, points=published_settings.GRID_POINTS)
    assert np.array_equal(grid.min(axis=1), system.domain[:, 0])
    assert np.array_equal(grid.max(axis=1), system.domain[:, 1])
    exact = compile_formulas([load_exact(published_settings.CARD)], system.symbols)(grid)
    assert exact.shape == (1, published_settings.GRID_POINTS)
