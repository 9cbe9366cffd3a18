from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import torch

from siq.networks.networks import mean_velocity

RULES = [("explicit", 2), ("explicit", 4), ("symmetric", 2), ("symmetric", 4)]


def pendulum(x: torch.Tensor) -> torch.Tensor:
    return torch.stack([x[..., 1], -torch.sin(x[..., 0]) - 0.2 * x[..., 1] ** 3], dim=-1)


def exact_pair(h: float) -> tuple[torch.Tensor, torch.Tensor]:
    x0 = np.array([0.7, 0.9])
    solution = scipy.integrate.solve_ivp(
        lambda t, x: pendulum(torch.from_numpy(x)).numpy(),
        (0, h),
        x0,
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
    )
    return torch.from_numpy(x0), torch.from_numpy(solution.y[:, -1].copy())


def mismatch(kind: str, order: int, h: float) -> float:
    x0, xh = exact_pair(h)
    step = torch.tensor([h], dtype=torch.float64)
    velocity = mean_velocity(pendulum, x0, xh, step, kind=kind, order=order)
    return float(torch.linalg.norm(velocity - (xh - x0) / h))


@pytest.mark.parametrize(("kind", "order"), RULES)
def test_every_rule_has_the_order_that_it_claims(kind: str, order: int) -> None:
    steps = [0.4, 0.2, 0.1] if order == 4 else [0.1, 0.05, 0.025]
    errors = [mismatch(kind, order, h) for h in steps]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, order, atol=0.25)


@pytest.mark.parametrize(("kind", "order"), RULES)
def test_every_rule_is_exact_for_uniform_motion(kind: str, order: int) -> None:
    velocity = torch.tensor([0.3, -2.0], dtype=torch.float64)
    x0 = torch.tensor([[1.0, 2.0], [3.0, -1.0]], dtype=torch.float64)
    h = torch.tensor([[0.5], [2.0]], dtype=torch.float64)
    found = mean_velocity(velocity.expand_as, x0, x0 + h * velocity, h, kind=kind, order=order)
    torch.testing.assert_close(found, velocity.expand(2, 2), rtol=1e-14, atol=0)


@pytest.mark.parametrize(
    ("kind", "order", "degree"),
    [("explicit", 2, 1), ("explicit", 4, 3), ("symmetric", 2, 1), ("symmetric", 4, 3)],
)
def test_a_velocity_that_is_polynomial_in_time_is_integrated_exactly(
    kind: str, order: int, degree: int
) -> None:
    # States (t, s) with s' = t^degree: the rule is then a quadrature in t.
    def field(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([torch.ones_like(x[..., 0]), x[..., 0] ** degree], dim=-1)

    t0, h = 0.4, 0.7
    x0 = torch.tensor([t0, 0.0], dtype=torch.float64)
    xh = torch.tensor(
        [t0 + h, ((t0 + h) ** (degree + 1) - t0 ** (degree + 1)) / (degree + 1)], dtype=torch.float64
    )
    found = mean_velocity(field, x0, xh, torch.tensor([h], dtype=torch.float64), kind=kind, order=order)
    torch.testing.assert_close(found, (xh - x0) / h, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("kind", "order", "evaluations"),
    [("explicit", 2, 2), ("explicit", 4, 4), ("symmetric", 2, 1), ("symmetric", 4, 3)],
)
def test_every_rule_takes_the_evaluations_that_it_claims(kind: str, order: int, evaluations: int) -> None:
    calls = []

    def field(x: torch.Tensor) -> torch.Tensor:
        calls.append(x)
        return -x

    x = torch.ones(3, 2)
    mean_velocity(field, x, 0.9 * x, torch.full((3, 1), 0.1), kind=kind, order=order)
    assert len(calls) == evaluations


def test_every_pair_has_its_own_step() -> None:
    pairs = [exact_pair(h) for h in (0.01, 0.3)]
    x0, xh = (torch.stack([pair[side] for pair in pairs]) for side in (0, 1))
    h = torch.tensor([[0.01], [0.3]], dtype=torch.float64)
    for kind, order in RULES:
        together = mean_velocity(pendulum, x0, xh, h, kind=kind, order=order)
        for row in range(2):
            alone = mean_velocity(pendulum, x0[row], xh[row], h[row], kind=kind, order=order)
            torch.testing.assert_close(together[row], alone, rtol=1e-14, atol=0)


def test_an_unknown_rule_is_refused() -> None:
    x = torch.ones(1, 1)
    with pytest.raises(ValueError, match="order 3"):
        mean_velocity(torch.neg, x, x, x, kind="explicit", order=3)
