"""Training: fit the two networks to snapshot pairs (paper, section 2.2 and Appendix B).

Several runs can train side by side. All random choices of a run come from its own seed and from the
number of the step, so that a run neither depends on its neighbours nor on interruptions: a killed
training resumes from its checkpoint and ends with the same networks.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from siq.dynamics.diffusion import Diffusion
from siq.errors import needs_extra
from siq.networks.data import Batches, TrainingData, child_seed
from siq.networks.initial import initial_networks
from siq.networks.loss import dynamics_loss, orthogonality_loss
from siq.networks.matching import mean_velocity
from siq.networks.networks import Networks, evaluate, move
from siq.networks.options import TrainingOptions

with needs_extra("networks"):
    import torch
    from torch import Tensor

logger = logging.getLogger(__name__)

HISTORY = ("run", "step", "training_loss", "held_out_loss", "dynamics", "orthogonality", "learning_rate")


@dataclass(frozen=True)
class TrainingState:
    """Everything that a training needs to go on from where it stands.

    Attributes
    ----------
    step
        Steps done.
    networks
        As they are.
    first_moments, second_moments
        Adam's running means, one array for each of ``networks.parameters()``.
    history
        Rows of the loss so far, see `train`.
    """

    step: int
    networks: Networks
    first_moments: tuple[Tensor, ...]
    second_moments: tuple[Tensor, ...]
    history: pd.DataFrame


def choose_device(wish: str) -> torch.device:
    """``auto`` is the first accelerator where there is one, otherwise the CPU; else as named."""
    if wish == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(wish)


def start(
    data: Sequence[TrainingData],
    *,
    options: TrainingOptions,
    diffusion: Diffusion,
    seeds: Sequence[np.random.SeedSequence],
) -> TrainingState:
    """The state of a training before its first step."""
    generators = [np.random.default_rng(child_seed(seed, 0)) for seed in seeds]
    networks = initial_networks(data, options=options, diffusion=diffusion, generators=generators)
    zeros = tuple(torch.zeros_like(tensor) for tensor in networks.parameters())
    return TrainingState(0, networks, zeros, zeros, pd.DataFrame(columns=list(HISTORY)))


def failed_runs(state: TrainingState) -> dict[int, str]:
    """Runs whose networks are of no use, with the reason in words."""
    failures = {}
    for run in range(state.networks.runs):
        rows = state.history[state.history["run"] == run]
        lost = rows[~np.isfinite(rows["held_out_loss"].to_numpy(dtype=float))]
        finite = all(bool(torch.isfinite(tensor[run]).all()) for tensor in state.networks.parameters())
        if len(lost) or not finite:
            step = int(lost["step"].iloc[0]) if len(lost) else state.step
            failures[run] = f"the loss was no longer finite at step {step}; lower training.learning_rate"
    return failures


def train(
    state: TrainingState,
    data: Sequence[TrainingData],
    *,
    options: TrainingOptions,
    seeds: Sequence[np.random.SeedSequence],
    device: torch.device | str = "cpu",
    log_every: int = 500,
    checkpoint_every: int = 1000,
    checkpoint: Callable[[TrainingState], None] | None = None,
    finished: Callable[[int, Networks], bool] | None = None,
) -> TrainingState:
    """Train from a state to the last step, or until it is finished.

    Parameters
    ----------
    state
        From `start`, or from a checkpoint of the same training.
    data
        One entry a run.
    options
        What is trained.
    seeds
        One a run; batches follow from the seed and the number of the step alone.
    device
        Where to compute. Results are the same to the last bit only on the same kind of device.
    log_every, checkpoint_every
        Steps between rows of the history, and between calls of `checkpoint`.
    checkpoint
        Called with the state as it stands; keeps it where it likes.
    finished
        Called at the steps of the check with the step and the networks; training ends when it says so.

    Returns
    -------
    TrainingState
        After ``options.steps`` steps, or when finished. Its history has one row a run and logged step:
        `training_loss` on the last batch, and on held-out pairs `held_out_loss`, the sum of `dynamics` and
        λ·`orthogonality`. A run whose loss is no longer finite keeps such rows and harms no other run.
    """
    dtype = getattr(torch, options.precision)
    device = torch.device(device)
    networks = move(state.networks, device)
    parameters = [tensor.requires_grad_() for tensor in networks.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=options.learning_rate, fused=True)
    for parameter, first, second in zip(parameters, state.first_moments, state.second_moments, strict=True):
        optimizer.state[parameter] = {
            "step": torch.tensor(float(state.step), device=device),
            "exp_avg": first.detach().clone().to(device),
            "exp_avg_sq": second.detach().clone().to(device),
        }
    batches = Batches(data, options=options, seeds=seeds, device=device, dtype=dtype)
    held_out = batches.held_out()
    objective = _Objective(data, options=options, diffusion=networks.diffusion, device=device, dtype=dtype)
    rows = [state.history] if len(state.history) else []

    def snapshot(step: int) -> TrainingState:
        moments = [optimizer.state[parameter] for parameter in parameters]
        return TrainingState(
            step=step,
            networks=move(networks, "cpu"),
            first_moments=tuple(moment["exp_avg"].detach().to("cpu", copy=True) for moment in moments),
            second_moments=tuple(moment["exp_avg_sq"].detach().to("cpu", copy=True) for moment in moments),
            history=pd.concat(rows, ignore_index=True) if rows else state.history,
        )

    began = time.perf_counter()
    for step in range(state.step, options.steps):
        rate = options.learning_rate * options.decay_rate ** (step / options.decay_steps)
        optimizer.param_groups[0]["lr"] = rate
        optimizer.zero_grad()
        dynamics, orthogonality = objective(networks, *batches.batch(step))
        losses = dynamics + options.orthogonality_weight * orthogonality
        losses.sum().backward()
        optimizer.step()
        done = step + 1
        if done % log_every == 0 or done == options.steps:
            with torch.no_grad():
                dynamics, orthogonality = objective(networks, *held_out)
            total = dynamics + options.orthogonality_weight * orthogonality
            rows.append(
                pd.DataFrame(
                    {
                        "run": range(networks.runs),
                        "step": done,
                        "training_loss": losses.detach().double().cpu(),
                        "held_out_loss": total.double().cpu(),
                        "dynamics": dynamics.double().cpu(),
                        "orthogonality": orthogonality.double().cpu(),
                        "learning_rate": rate,
                    }
                )
            )
            left = (time.perf_counter() - began) / (done - state.step) * (options.steps - done)
            logger.info(
                "step %d of %d, held-out loss %.3e, %.0f s left",
                done, options.steps, float(total.mean()), left,
            )  # fmt: skip
        if finished is not None and is_check(done, options) and finished(done, move(networks, "cpu")):
            return snapshot(done)
        if checkpoint is not None and done % checkpoint_every == 0 and done < options.steps:
            checkpoint(snapshot(done))
    return snapshot(max(options.steps, state.step))


def is_check(step: int, options: TrainingOptions) -> bool:
    """Whether training pauses at a step to see whether it may end."""
    check = options.check
    return check is not None and step >= check.first and (step - check.first) % check.every == 0


class _Objective:
    """The two terms of the loss at a batch, with what does not change from step to step."""

    def __init__(
        self,
        data: Sequence[TrainingData],
        *,
        options: TrainingOptions,
        diffusion: Tensor,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.options = options
        self.diffusion = diffusion
        noise = Diffusion(diffusion.detach().double().cpu().numpy())
        self.precision = torch.from_numpy(noise.precision).to(diffusion)
        squares = torch.ones(len(data), dtype=torch.float64)
        if options.relative_dynamics or options.slow_speed is not None:
            for run, pairs in enumerate(part.training for part in data):
                velocity = (pairs.xh - pairs.x0) / pairs.h[:, None]
                squares[run] = float(noise.squared_speed(pairs.x0, velocity).mean())
        squares = squares.to(device, dtype)
        self.slow = None if options.slow_speed is None else options.slow_speed**2 * squares[:, None]
        self.squares = squares if self.slow is None else torch.ones_like(squares)

    def __call__(self, networks: Networks, pairs: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        d = self.diffusion.shape[0]
        x0, xh, observed, h = pairs.split((d, d, d, 1), dim=-1)
        options = self.options
        if options.matching == "symmetric" and options.matching_order == 2:
            # One evaluation serves both terms: half the operations, and each twice as large.
            both = evaluate(networks, torch.cat([(x0 + xh) / 2, points], dim=1))
            predicted, at_points = both.split(x0.shape[1])
            velocity = predicted.vector_field
        else:
            velocity = mean_velocity(
                lambda x: evaluate(networks, x).vector_field,
                x0, xh, h,
                kind=options.matching, order=options.matching_order,
            )  # fmt: skip
            at_points = evaluate(networks, points)
        dynamics = dynamics_loss(velocity, observed, self.precision, slow=self.slow) / self.squares
        orthogonality = orthogonality_loss(
            at_points, self.diffusion, self.precision, asymmetry=options.asymmetry
        )
        return dynamics, orthogonality
