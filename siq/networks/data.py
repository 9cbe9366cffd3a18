"""The pairs of a training: what trains, what is held out, and the random batches of every step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure, needs_extra
from siq.networks.options import TrainingOptions
from siq.numerics.thinning import representative_subset

with needs_extra("networks"):
    import torch
    from torch import Tensor

CHUNK = 100  # steps whose batches are drawn together; part of what a seed means
STANDARD_THINNING = 0.1  # distance of representative points, in standard deviations of the states
FEWEST_REPRESENTATIVE = 10  # below this, orthogonality is asked for almost nowhere
HELD_OUT_PAIRS = 4096  # pairs on which the held-out loss is measured


@dataclass(frozen=True)
class TrainingData:
    """The pairs of one run, divided, with its representative points.

    Attributes
    ----------
    training, held_out
        Pairs of the recordings that train, and of the others.
    representative_rows
        Which S of the training pairs have evenly spread X0.
    """

    training: SnapshotPairs
    held_out: SnapshotPairs
    representative_rows: np.ndarray

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
    pairs
        The snapshot pairs of one run.
    options
        For the share and the thinning distance.
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


def slowest_part(data: TrainingData, share: float) -> TrainingData:
    """Representative points without the fastest ones.

    Far out f is often many times faster than about the attractors, and none of what is asked there matters
    to the wells. Speeds are measured in standard deviations of the states.

    Parameters
    ----------
    data
        The pairs of one run.
    share
        Share of the representative points that stay, the slowest; at least a few do.
    """
    if share >= 1:
        return data
    pairs = data.representative
    speed = np.linalg.norm((pairs.xh - pairs.x0) / pairs.h[:, None] / data.training.x0.std(axis=0), axis=1)
    count = max(int(np.ceil(share * len(speed))), min(FEWEST_REPRESENTATIVE, len(speed)))
    return replace(data, representative_rows=np.sort(data.representative_rows[np.argsort(speed)[:count]]))


class Batches:
    """Random batches of every run, drawn from its seed and the number of the step.

    All runs stand in one table, so that one look-up serves them all. A batch depends on the seed and on
    the step alone, which is what lets an interrupted training resume exactly.

    Parameters
    ----------
    data, seeds
        One entry a run.
    options
        For the batch size.
    device, dtype
        Where the batches are wanted, and in which precision.
    """

    def __init__(
        self,
        data: Sequence[TrainingData],
        *,
        options: TrainingOptions,
        seeds: Sequence[np.random.SeedSequence],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.seeds = seeds
        self.device = device
        self.dtype = dtype
        self.size = options.batch_size
        self.representative_size = round(options.representative_share * options.batch_size)
        self.data = data
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
        pairs, points = [], []
        for run in self.data:
            table = _table(run.held_out)
            pairs.append(table[np.linspace(0, len(table) - 1, HELD_OUT_PAIRS).astype(int)])
            rows = run.representative_rows[
                np.linspace(0, len(run.representative_rows) - 1, HELD_OUT_PAIRS).astype(int)
            ]
            points.append(torch.from_numpy(run.training.x0[rows]))
        return (
            torch.stack(pairs).to(self.device, self.dtype),
            torch.stack(points).to(self.device, self.dtype),
        )

    def _draw(self, chunk: int) -> Tensor:
        """Rows of a chunk of steps, shape ``(runs, steps, pairs + points)``."""
        drawn, offset = [], 0
        for seed, run in zip(self.seeds, self.data, strict=True):
            generator = np.random.default_rng(child_seed(seed, 1 + chunk))
            pairs = generator.integers(
                len(run.training.h), size=(CHUNK, self.size - self.representative_size)
            )
            evenly = generator.integers(
                len(run.representative_rows), size=(CHUNK, self.representative_size + self.size)
            )
            drawn.append(offset + np.concatenate([pairs, run.representative_rows[evenly]], axis=1))
            offset += len(run.training.h)
        return torch.from_numpy(np.stack(drawn)).to(self.device)


def child_seed(seed: np.random.SeedSequence, key: int) -> np.random.SeedSequence:
    """A child seed by its number, without counting how many were taken before."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, key))


def _table(pairs: SnapshotPairs) -> Tensor:
    """Pairs as rows of X0, Xh, (Xh - X0)/h, h; the quotient is taken in double precision."""
    h = pairs.h[:, None]
    return torch.from_numpy(np.concatenate([pairs.x0, pairs.xh, (pairs.xh - pairs.x0) / h, h], axis=1))
