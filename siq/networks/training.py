"""Training of the networks on snapshot pairs (paper, section 2.2 and Appendix B).

Several runs can train side by side. All random choices of a run come from its own seed and from the
number of the step, so that a run neither depends on its neighbours nor on interruptions: a killed
training resumes from its checkpoint and ends with the same networks. A block of runs is trained until each
has passed its check, or its attempts are spent.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pandas as pd

from siq.data.recordings import SnapshotPairs
from siq.errors import InputError, NumericalFailure, needs_extra
from siq.networks.decomposition import (
    AnyNetworks,
    NetworksByWell,
    TrainedNetworks,
    TrainingOptions,
    load_networks,
    pack,
    read_archive,
    save_networks,
    unpack,
    write_archive,
)
from siq.networks.networks import (
    Networks,
    at_rest,
    dynamics_loss,
    evaluate,
    initial_layers,
    mean_velocity,
    move,
    orthogonality_loss,
    side_by_side,
)
from siq.numerics.randomness import Purpose, representative_subset, seed_sequence
from siq.systems.diffusion import Diffusion

with needs_extra("networks"):
    import torch
    from torch import Tensor

logger = logging.getLogger(__name__)

CHUNK = 100  # steps whose batches are drawn together; part of what a seed means
STANDARD_THINNING = 0.1  # distance of representative points, in standard deviations of the states
FEWEST_REPRESENTATIVE = 10  # below this, orthogonality is asked for almost nowhere
HELD_OUT_PAIRS = 4096  # pairs on which the held-out loss is measured
HISTORY = ("run", "step", "training_loss", "held_out_loss", "dynamics", "orthogonality", "learning_rate")


@dataclass(frozen=True)
class TrainingData:
    """The pairs of one run, divided, with its representative points."""

    #: Pairs of the recordings that train, and of the others.
    training: SnapshotPairs
    held_out: SnapshotPairs
    representative_rows: np.ndarray  #: which S of the training pairs have evenly spread X0

    @property
    def representative(self) -> SnapshotPairs:
        """The training pairs whose X0 are spread evenly."""
        return self.training.take(self.representative_rows)


def prepare_data(
    pairs: SnapshotPairs, *, options: TrainingOptions, generator: np.random.Generator
) -> TrainingData:
    """Divide the recordings into training and held-out ones, and thin the training points.

    Parameters
    ----------
    pairs, options
        Of one run; the share and the thinning distance.
    generator
        Decides which recordings train and which points represent.

    Raises
    ------
    NumericalFailure
        When there are fewer than two recordings to divide, a state does not vary, or hardly any
        representative points remain.
    """
    names = np.unique(pairs.recording)
    if len(names) < 2:
        raise NumericalFailure("there is only one recording; give at least two, so that one can be held out")
    count = min(max(round(options.training_share * len(names)), 1), len(names) - 1)
    trains = np.isin(pairs.recording, generator.permutation(names)[:count])
    training, held_out = pairs.take(trains), pairs.take(~trains)
    spread = training.x0.std(axis=0)
    if not (spread > 0).all():
        raise NumericalFailure("a state does not vary in the recordings; leave it out or record it in motion")
    distance, points = options.thinning_distance, training.x0
    if distance is None:
        distance, points = STANDARD_THINNING, points / spread
    rows = representative_subset(points, distance=distance, generator=generator)
    if len(rows) < FEWEST_REPRESENTATIVE:
        raise NumericalFailure(
            f"only {len(rows)} representative points are {distance} apart;"
            " lower training.thinning_distance or leave it out"
        )
    return TrainingData(training, held_out, rows)


class _Batches:
    """Random batches of every run, drawn from its seed and the number of the step.

    All runs stand in one table, so that one look-up serves them all. A batch depends on the seed and on
    the step alone, which is what lets an interrupted training resume exactly.
    """

    def __init__(
        self, data: Sequence[TrainingData], *, options: TrainingOptions,
        seeds: Sequence[np.random.SeedSequence], device: torch.device, dtype: torch.dtype,
    ) -> None:  # fmt: skip
        self.data, self.seeds, self.device, self.dtype = data, seeds, device, dtype
        self.size = options.batch_size
        self.representative_size = round(options.representative_share * options.batch_size)
        self.pairs = torch.cat([_table(run.training) for run in data]).to(device, dtype)
        self.dimension = data[0].training.x0.shape[1]
        self.chunk = -1

    def batch(self, step: int) -> tuple[Tensor, Tensor]:
        """Rows of X0, Xh, (Xh - X0)/h, h, and representative points: ``(runs, batch, ...)`` each."""
        chunk, position = divmod(step, CHUNK)
        if chunk != self.chunk:
            self.chunk, self.indices = chunk, self._draw(chunk)
        rows = self.pairs[self.indices[:, position]]
        return rows[:, : self.size], rows[:, self.size :, : self.dimension]

    def held_out(self) -> tuple[Tensor, Tensor]:
        """A fixed batch of held-out pairs, and of representative points, for every run."""

        def evenly(count: int) -> np.ndarray:
            return np.linspace(0, count - 1, HELD_OUT_PAIRS).astype(int)

        pairs = [_table(run.held_out)[evenly(len(run.held_out.h))] for run in self.data]
        rows = [run.representative_rows[evenly(len(run.representative_rows))] for run in self.data]
        points = [torch.from_numpy(run.training.x0[some]) for run, some in zip(self.data, rows, strict=True)]
        kind = (self.device, self.dtype)
        return torch.stack(pairs).to(*kind), torch.stack(points).to(*kind)

    def _draw(self, chunk: int) -> Tensor:
        """Rows of a chunk of steps, shape ``(runs, steps, pairs + points)``."""
        drawn, offset = [], 0
        for seed, run in zip(self.seeds, self.data, strict=True):
            generator = np.random.default_rng(_child_seed(seed, 1 + chunk))
            pairs = generator.integers(
                len(run.training.h), size=(CHUNK, self.size - self.representative_size)
            )
            evenly = generator.integers(
                len(run.representative_rows), size=(CHUNK, self.representative_size + self.size)
            )
            drawn.append(offset + np.concatenate([pairs, run.representative_rows[evenly]], axis=1))
            offset += len(run.training.h)
        return torch.from_numpy(np.stack(drawn)).to(self.device)


def _child_seed(seed: np.random.SeedSequence, key: int) -> np.random.SeedSequence:
    """A child seed by its number, without counting how many were taken before."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, key))


def _table(pairs: SnapshotPairs) -> Tensor:
    """Pairs as rows of X0, Xh, (Xh - X0)/h, h; the quotient is taken in double precision."""
    h = pairs.h[:, None]
    return torch.from_numpy(np.concatenate([pairs.x0, pairs.xh, (pairs.xh - pairs.x0) / h, h], axis=1))


def _initial_networks(
    data: Sequence[TrainingData], *, options: TrainingOptions, diffusion: Diffusion,
    generators: Sequence[np.random.Generator],
) -> Networks:  # fmt: skip
    """Random networks, normalised and rescaled to the data of each run (paper, Eqs. eta_v, eta_g)."""
    dtype = getattr(torch, options.precision)
    dimension = diffusion.dimension
    sources = [run.training if options.normalise_on == "pairs" else run.representative for run in data]
    means = np.stack([pairs.x0.mean(axis=0) for pairs in sources])[:, None]
    scales = np.stack([pairs.x0.std(axis=0) for pairs in sources])[:, None]
    ones = torch.ones(len(data), 1, 1, dtype=dtype)
    networks = Networks(
        potential=initial_layers((dimension, *options.widths, 1), generators=generators, dtype=dtype),
        circulatory=initial_layers(
            (dimension, *options.widths, dimension), generators=generators, dtype=dtype
        ),
        mean=torch.from_numpy(means).to(dtype),
        scale=torch.from_numpy(scales).to(dtype),
        potential_scale=ones,
        circulatory_scale=ones,
        diffusion=torch.from_numpy(diffusion.matrix).to(dtype),
    )
    potential_scales, circulatory_scales = [], []
    for run, pairs in enumerate(sources):
        one = networks.of_run(run)
        # A few thousand pairs fix a single number well; the whole data would only cost memory.
        rows = np.linspace(0, len(pairs.h) - 1, min(len(pairs.h), 20_000)).astype(int)
        _, slope, turning, _ = evaluate(one, torch.from_numpy(pairs.x0[rows]).to(dtype)[None])
        velocity = (pairs.xh[rows] - pairs.x0[rows]) / pairs.h[rows, None]
        speed = np.linalg.norm(velocity, axis=1)
        # ∇ with respect to y = (x - μ)/σ, as the paper writes it. Where the σ differ this makes V several
        # times larger than ∇ with respect to x would, and V then learns as fast as g does; with the
        # smaller scale training ends in a V that is flat along x.
        downhill = torch.linalg.norm(slope * one.scale, dim=-1)[0].numpy()
        circulatory = torch.linalg.norm(turning, dim=-1)[0].numpy()
        along = float(downhill @ speed / (downhill @ downhill))
        if options.potential_from == "descent":
            # With which -D∇V comes closest to the velocities, unless these go up V on the whole.
            gradient = slope[0].double().numpy()
            size = diffusion.contract(pairs.x0[rows], gradient).sum()
            along = max(float(-(gradient * velocity).sum() / size), 0.0) or along
        potential_scales.append(along)
        circulatory_scales.append(float(circulatory @ speed / (circulatory @ circulatory)))
    return replace(
        networks,
        potential_scale=options.potential_gain * torch.tensor(potential_scales, dtype=dtype)[:, None, None],
        circulatory_scale=torch.tensor(circulatory_scales, dtype=dtype)[:, None, None],
    )


@dataclass(frozen=True)
class _TrainingState:
    """Everything that a training needs to go on from where it stands."""

    step: int  #: so many are done
    networks: Networks
    first_moments: tuple[Tensor, ...]  #: Adam's running means, one for each of ``networks.parameters()``
    second_moments: tuple[Tensor, ...]
    history: pd.DataFrame  #: of the loss so far, see `train`


def start(
    data: Sequence[TrainingData], *, options: TrainingOptions, diffusion: Diffusion,
    seeds: Sequence[np.random.SeedSequence],
) -> _TrainingState:  # fmt: skip
    """The state of a training before its first step."""
    generators = [np.random.default_rng(_child_seed(seed, 0)) for seed in seeds]
    networks = _initial_networks(data, options=options, diffusion=diffusion, generators=generators)
    zeros = tuple(torch.zeros_like(tensor) for tensor in networks.parameters())
    return _TrainingState(0, networks, zeros, zeros, pd.DataFrame(columns=list(HISTORY)))


def _failed_runs(state: _TrainingState) -> dict[int, str]:
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
    state: _TrainingState, data: Sequence[TrainingData], *, options: TrainingOptions,
    seeds: Sequence[np.random.SeedSequence], device: torch.device | str = "cpu", log_every: int = 500,
    checkpoint_every: int = 1000, checkpoint: Callable[[_TrainingState], None] | None = None,
    finished: Callable[[int, Networks], bool] | None = None,
) -> _TrainingState:  # fmt: skip
    """Train from a state to the last step, or until it is finished.

    Parameters
    ----------
    state
        From `start`, or from a checkpoint of the same training.
    data, seeds
        One entry a run; batches follow from the seed and the number of the step alone.
    options
        What is trained.
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
    _TrainingState
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
    batches = _Batches(data, options=options, seeds=seeds, device=device, dtype=dtype)
    held_out = batches.held_out()
    objective = _Objective(data, options=options, diffusion=networks.diffusion, device=device, dtype=dtype)
    rows = [state.history] if len(state.history) else []

    def snapshot(step: int) -> _TrainingState:
        moments = [optimizer.state[parameter] for parameter in parameters]
        return _TrainingState(
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
            measured = (losses.detach(), total, dynamics, orthogonality)
            row = (range(networks.runs), done, *(each.double().cpu() for each in measured), rate)
            rows.append(pd.DataFrame(dict(zip(HISTORY, row, strict=True))))
            left = (time.perf_counter() - began) / (done - state.step) * (options.steps - done)
            logger.info(
                "step %d of %d, held-out loss %.3e, %.0f s left",
                done, options.steps, float(total.mean()), left,
            )  # fmt: skip
        check = options.check
        pauses = check is not None and done >= check.first and (done - check.first) % check.every == 0
        if finished is not None and pauses and finished(done, move(networks, "cpu")):
            return snapshot(done)
        if checkpoint is not None and done % checkpoint_every == 0 and done < options.steps:
            checkpoint(snapshot(done))
    return snapshot(max(options.steps, state.step))


class _Objective:
    """The two terms of the loss at a batch, with what does not change from step to step."""

    def __init__(
        self, data: Sequence[TrainingData], *, options: TrainingOptions, diffusion: Tensor,
        device: torch.device, dtype: torch.dtype,
    ) -> None:  # fmt: skip
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
            count = x0.shape[1]
            _, gradient, circulatory, field = evaluate(networks, torch.cat([(x0 + xh) / 2, points], dim=1))
            velocity, gradient, circulatory = field[:, :count], gradient[:, count:], circulatory[:, count:]
        else:
            velocity = mean_velocity(
                lambda x: evaluate(networks, x)[-1], x0, xh, h,
                kind=options.matching, order=options.matching_order,
            )  # fmt: skip
            _, gradient, circulatory, _ = evaluate(networks, points)
        dynamics = dynamics_loss(velocity, observed, self.precision, slow=self.slow) / self.squares
        orthogonality = orthogonality_loss(
            gradient, circulatory, self.diffusion, self.precision, asymmetry=options.asymmetry
        )
        return dynamics, orthogonality


def _save_checkpoint(path: str | Path, state: _TrainingState, *, fingerprint: str) -> None:
    """Write the state of a training, with a fingerprint of the data and options that it belongs to."""
    arrays = pack([at_rest(state.networks, run) for run in range(state.networks.runs)])
    for name, moments in (("first", state.first_moments), ("second", state.second_moments)):
        arrays |= {f"{name}{index}": tensor.numpy() for index, tensor in enumerate(moments)}
    arrays["step"] = np.array(state.step)
    arrays["history"] = state.history[list(HISTORY)].to_numpy(dtype=float)
    arrays["fingerprint"] = np.array(fingerprint)
    write_archive(path, arrays)


def _load_checkpoint(path: str | Path, *, fingerprint: str) -> _TrainingState | None:
    """The state of an interrupted training, or None where there is none that can be continued.

    One of other data or options has another fingerprint and is passed over, and so is one that is damaged:
    training then starts afresh, which costs time but never a wrong result.
    """
    try:
        arrays = read_archive(path)
        if str(arrays["fingerprint"]) != fingerprint:
            return None
        networks = side_by_side([unpack(arrays, run) for run in range(int(arrays["count"]))])
        count = len(networks.parameters())
        history = pd.DataFrame(arrays["history"], columns=list(HISTORY))
        return _TrainingState(
            step=int(arrays["step"]),
            networks=networks,
            first_moments=tuple(torch.from_numpy(arrays[f"first{index}"]) for index in range(count)),
            second_moments=tuple(torch.from_numpy(arrays[f"second{index}"]) for index in range(count)),
            history=history.astype({"run": "int64", "step": "int64"}),
        )
    except (InputError, KeyError, ValueError):
        return None


LOGGED_LOSSES = 100  # times in a training at which its loss is logged
MOST_STEPS_BETWEEN_CHECKPOINTS = 1000  # steps between two checkpoints, at most


class Check(Protocol):
    """When the training of a run may end before its last step, and what takes the place of its networks."""

    def hopeless(self) -> str | None:
        """Why no training can pass, in words; None where one can."""

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        """What the networks have led to; None where they are not good enough."""

    def by_wells(self) -> NetworksByWell | None:
        """What serves where no training has passed, found without the trained networks; None for nothing."""


class Block:
    """The training of a block of runs.

    Parameters
    ----------
    data, checks
        Pairs by run; when the training of a run may end, for those where that is known.
    options, diffusion, seed
        What the networks are told, D, and the seed of the study.
    folder, mark
        Where files lie from which a killed training goes on, None for none; and the fingerprint of the data
        and settings, by which files of another training are passed over.
    device
        Where it is computed.
    faults
        Why some runs have no check, in words.
    """

    def __init__(
        self, data: Mapping[int, TrainingData], checks: Mapping[int, Check], *, options: TrainingOptions,
        diffusion: Diffusion, seed: int, folder: Path | None, mark: str, device: torch.device,
        faults: Mapping[int, str] | None = None,
    ) -> None:  # fmt: skip
        self.data, self.checks, self.options = data, checks, options
        self.diffusion, self.seed = diffusion, seed
        self.folder, self.mark, self.device, self.faults = folder, mark, device, faults or {}
        self.passed: dict[int, AnyNetworks] = {}
        self.last: dict[int, AnyNetworks] = {}
        self.failures: dict[int, str] = {}
        self.histories: list[pd.DataFrame] = []

    @property
    def attempts(self) -> int:
        """How many trainings a run may have."""
        return self.options.check.attempts if self.options.check is not None and self.checks else 1

    def train(self) -> None:
        """All attempts, as far as they are needed; then, where none has passed, what needs no networks."""
        for attempt in range(self.attempts):
            # A first training needs every run; a further one, those whose check could yet pass.
            hopeful = [run for run in self.data if run in self.checks and self.checks[run].hopeless() is None]
            runs = [run for run in (hopeful if attempt else self.data) if run not in self.passed]
            if runs:
                self._attempt(attempt, runs)
        for run, check in self.checks.items():
            if run not in self.passed and (found := check.by_wells()) is not None:
                self.passed[run] = self.last[run] = found
                self.failures.pop(run, None)

    def _checkpoint(self, name: str) -> Path | None:
        return None if self.folder is None else self.folder / f"kept-{self.mark[:12]}-{name}.npz"

    def _keep(self, attempt: int, state: _TrainingState) -> None:
        if (file := self._checkpoint(f"attempt{attempt}")) is not None:
            _save_checkpoint(file, state, fingerprint=self.mark)

    def _attempt(self, attempt: int, runs: list[int]) -> None:
        options = self.options.attempt(attempt)
        purpose = Purpose.TRAINING if attempt == 0 else f"{Purpose.TRAINING} {attempt}"
        seeds = [seed_sequence(self.seed, run, purpose) for run in runs]
        data = [self.data[run] for run in runs]
        file = self._checkpoint(f"attempt{attempt}")
        state = None if file is None else _load_checkpoint(file, fingerprint=self.mark)
        if state is None or state.step > options.steps:  # of a training that was given more steps
            state = start(data, options=options, diffusion=self.diffusion, seeds=seeds)
        kept = {run: self._checkpoint(f"attempt{attempt}-run{run}") for run in runs}
        # Networks that had passed the check before the job was killed.
        early: dict[int, AnyNetworks] = {
            run: load_networks(file) for run, file in kept.items() if file is not None and file.exists()
        }

        def finished(step: int, networks: Networks) -> bool:
            for position, run in enumerate(runs):
                if run in self.checks and run not in early:
                    one = self.checks[run].accepted(at_rest(networks, position))
                    if one is not None:
                        early[run] = one
                        if (file := kept[run]) is not None:
                            save_networks(file, [one])
            return len(early) == len(runs)

        if len(early) < len(runs):
            state = train(
                state, data, options=options, seeds=seeds, device=self.device,
                log_every=max(options.steps // LOGGED_LOSSES, 1),
                checkpoint_every=min(MOST_STEPS_BETWEEN_CHECKPOINTS, max(options.steps // 10, 1)),
                checkpoint=lambda state: self._keep(attempt, state), finished=finished,
            )  # fmt: skip
        # Checkpoints until all attempts are over: a killed job must not train this one again.
        self._keep(attempt, state)
        self.passed |= early
        lost = _failed_runs(state)
        for position, run in enumerate(runs):
            self.last[run] = early.get(run, at_rest(state.networks, position))
            self.failures.pop(run, None)
            if run not in early and position in lost:
                self.failures[run] = lost[position]
        history = state.history
        self.histories.append(history.assign(run=history["run"].map(dict(enumerate(runs)))))

    def history(self) -> pd.DataFrame:
        """The loss of the last training of every run."""
        latest: dict[int, pd.DataFrame] = {}
        for table in self.histories:
            latest |= {int(run): table[table["run"] == run] for run in table["run"].unique()}
        tables = [latest[run] for run in sorted(latest)]
        return pd.concat(tables) if tables else pd.DataFrame(columns=list(HISTORY))
