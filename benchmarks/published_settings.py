"""The paper's own settings, run to their end: fifty trainings side by side on a graphics card.

    python -m benchmarks.published_settings train --folder results/published-settings --seconds 500
    .venv/bin/python -m benchmarks.published_settings score

The study ``archetype3d-published``: two networks 3-50-50-50, batches of 5000 pairs and 5000 points, Adam
with its decay, Runge's rule, 150,000 steps, fifty runs. On two cores that takes 217 h. `train` does all runs
at once on one card, in single precision, and goes on from its checkpoint where it is called again. Pairs,
their division and the first weights are those of the study; batches are drawn on the card. A whole step is
one CUDA graph, compiled by torch. The loss is that of `siq.networks.networks`, and a test compares the two.

`train` keeps ``state.npz`` (its checkpoint), ``networks.npz``, and ``curves.csv``: by run and step the
published loss on held-out pairs, and the relative L2 error of U over Ω, for which alone the exact U is
needed. `score` applies the published regression to the networks. It writes ``published_settings.csv``, a row
a run, and ``published_settings_curves.csv``, which are kept with the sources.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn.functional import pad

from siq.data.recordings import snapshot_pairs
from siq.networks.decomposition import (
    TrainedNetworks,
    TrainingOptions,
    pack,
    read_archive,
    unpack,
    write_archive,
)
from siq.networks.networks import at_rest, side_by_side
from siq.networks.training import HELD_OUT_PAIRS, prepare_data, start
from siq.numerics.randomness import Purpose, generator, seed_sequence
from siq.systems.cards import load_exact, load_system
from siq.systems.formulas import compile_formulas
from siq.workflow.pipeline import draw_run, regress_run
from siq.workflow.study import load_study, settings_of
from siq.workflow.tables import Method, Outcome, Step, StepResult
from workflow.scoring import _domain_grid, exact_answer, relative_error, score_run

ROOT = Path(__file__).parents[1]
STUDY = ROOT / "config" / "studies" / "archetype3d-published.yaml"
CARD = ROOT / "config" / "systems" / "archetype3d.yaml"
TABLE = Path(__file__).with_suffix(".csv")
CURVES = TABLE.with_name("published_settings_curves.csv")
LEVEL = 2.0  # of U: the wells, and as much again; the published regression sees no other states
MARKS = (100, 200, 500, 1000, 2000, 3000, 5000, 7000, 10_000, 15_000, *range(20_000, 150_001, 5000))
GRID_POINTS = 31**3  # of the grid over Ω
MULTIPLE = 4  # of a layer's width: rows that begin at multiples of 16 bytes are multiplied faster
PARTS = 8  # of a batch

Parameters = tuple[Tensor, ...]


@dataclass(frozen=True)
class Data:
    """What one run trains on, in single precision, and its first networks.

    Attributes
    ----------
    pairs
        X0 and (Xh - X0)/h of the training pairs, shape ``(n, 2 d)``.
    points
        Representative points, shape ``(m, d)``.
    held_out_pairs, held_out_points
        The same, of what never trains.
    networks
        Before the first step.
    """

    pairs: np.ndarray
    points: np.ndarray
    held_out_pairs: np.ndarray
    held_out_points: np.ndarray
    networks: TrainedNetworks


def drawn(number: int) -> Data:
    """Data and first networks of a run of the study."""
    system = load_system(CARD)
    settings = settings_of(load_study(STUDY), system)
    recordings = draw_run(settings, system, number=number).result
    assert recordings is not None and settings.training is not None
    divided = prepare_data(
        snapshot_pairs(recordings, pair_step=settings.sampling.pair_step),
        options=settings.training, generator=generator(settings.seed, number, Purpose.DIVIDE),
    )  # fmt: skip
    seed = seed_sequence(settings.seed, number, Purpose.TRAINING)
    state = start([divided], options=settings.training, diffusion=system.diffusion, seeds=[seed])

    def table(pairs) -> np.ndarray:  # type: ignore[no-untyped-def]
        return np.concatenate([pairs.x0, (pairs.xh - pairs.x0) / pairs.h[:, None]], axis=1).astype(np.float32)

    def evenly(array: np.ndarray) -> np.ndarray:
        return array[np.linspace(0, len(array) - 1, HELD_OUT_PAIRS).astype(int)]

    points = divided.representative.x0.astype(np.float32)
    held_out, first = evenly(table(divided.held_out)), at_rest(state.networks, 0)
    return Data(table(divided.training), points, held_out, evenly(points), first)


def flattened(networks: Sequence[TrainedNetworks]) -> tuple[Parameters, Parameters]:
    """Weights and biases of several runs, filled with zeros up to a multiple; and what is not trained.

    Weights that lead to and from an added unit are zero, hence so are their gradients: they stay zero.
    """
    runs = side_by_side(networks)
    tensors = []
    for stack in (runs.potential, runs.circulatory):
        for place, (weights, biases) in enumerate(stack):
            rows = -weights.shape[1] % MULTIPLE if place else 0
            columns = -weights.shape[2] % MULTIPLE if place < len(stack) - 1 else 0
            tensors += [pad(weights, (0, columns, 0, rows)), pad(biases, (0, columns))]
    fixed = (runs.mean, runs.scale, runs.potential_scale, runs.circulatory_scale)
    return tuple(tensors), fixed


def restored(parameters: Parameters, like: Sequence[TrainedNetworks]) -> list[TrainedNetworks]:
    """The inverse of `flattened`, in double precision."""
    runs = side_by_side(like)
    arrays, stacks = [tensor.detach().cpu().double() for tensor in parameters], []
    for stack in (runs.potential, runs.circulatory):
        layers = []
        for weights, biases in stack:
            wide, shift = arrays.pop(0), arrays.pop(0)
            layers.append((wide[:, : weights.shape[1], : weights.shape[2]], shift[..., : biases.shape[2]]))
        stacks.append(tuple(layers))
    networks = replace(runs, potential=stacks[0], circulatory=stacks[1])
    return [at_rest(networks, run) for run in range(networks.runs)]


def first_layer(y: Tensor, weights: Tensor, biases: Tensor) -> Tensor:
    """From few inputs sums are cheaper than a product of matrices, and are fused with what follows."""
    total = biases
    for place in range(y.shape[-1]):
        total = total + y[..., place : place + 1] * weights[:, place : place + 1]
    return total


def potential_gradient(layers: Parameters, y: Tensor) -> Tensor:
    """∇ of the scalar tanh network, shape ``(runs, n, d)``."""
    w1, b1, w2, b2, w3, b3, w4, _ = layers
    h1 = torch.tanh(first_layer(y, w1, b1))
    h2 = torch.tanh(torch.bmm(h1, w2) + b2)
    h3 = torch.tanh(torch.bmm(h2, w3) + b3)
    delta = torch.bmm(w4.mT * (1 - h3 * h3), w3.mT)
    delta = torch.bmm(delta * (1 - h2 * h2), w2.mT) * (1 - h1 * h1)
    return torch.bmm(delta, w1.mT)


def vector_network(layers: Parameters, y: Tensor) -> Tensor:
    """The network of g, shape ``(runs, n, d)``."""
    w1, b1, w2, b2, w3, b3, w4, b4 = layers
    h1 = torch.tanh(first_layer(y, w1, b1))
    h2 = torch.tanh(torch.bmm(h1, w2) + b2)
    h3 = torch.tanh(torch.bmm(h2, w3) + b3)
    return torch.bmm(h3, w4) + b4


def fields(parameters: Parameters, fixed: Parameters, x: Tensor) -> tuple[Tensor, Tensor]:
    """∇V and g in the units of the states."""
    mean, scale, potential_scale, circulatory_scale = fixed
    y = (x - mean) / scale
    gradient = potential_scale / scale * (potential_gradient(parameters[:8], y) + 2 * y)
    return gradient, circulatory_scale * vector_network(parameters[8:], y)


def loss(
    parameters: Parameters,
    fixed: Parameters,
    pairs: Tensor,
    points: Tensor,
    *,
    step: float,
    weight: float,
    asymmetry: float,
) -> Tensor:
    """The published loss of each run, shape ``(runs,)``; D is the identity."""
    count, d = pairs.shape[1], points.shape[2]
    x0, observed = pairs[..., :d], pairs[..., d:]
    gradient, circulatory = fields(parameters, fixed, torch.cat([x0, points], dim=1))
    middle = x0 + step / 2 * (circulatory - gradient)[:, :count]
    later_gradient, later_circulatory = fields(parameters, fixed, middle)
    dynamics = (later_circulatory - later_gradient - observed).square().sum(dim=-1).mean(dim=-1)
    gradient, circulatory = gradient[:, count:], circulatory[:, count:]
    tiny = torch.finfo(gradient.dtype).tiny
    steep, swift = (each.square().sum(dim=-1).clamp_min(tiny).sqrt() for each in (gradient, circulatory))
    cosine = (gradient * circulatory).sum(dim=-1) / (steep * swift)
    orthogonality = (torch.where(cosine < 0, asymmetry * cosine, cosine) * cosine).mean(dim=-1)
    return dynamics + weight * orthogonality


def potential(parameters: Parameters, fixed: Parameters, x: Tensor) -> Tensor:
    """V, shape ``(runs, n)``."""
    mean, scale, potential_scale, _ = fixed
    w1, b1, w2, b2, w3, b3, w4, b4 = parameters[:8]
    y = (x - mean) / scale
    h = torch.tanh(first_layer(y, w1, b1))
    h = torch.tanh(torch.baddbmm(b3, torch.tanh(torch.baddbmm(b2, h, w2)), w3))
    return (potential_scale * (torch.baddbmm(b4, h, w4) + y.square().sum(dim=-1, keepdim=True)))[..., 0]


class Training:
    """All runs on one device; groups of runs go through the card on streams of their own."""

    def __init__(
        self, data: Sequence[Data], *, options: TrainingOptions, step: float, group: int, device: str
    ) -> None:
        self.options, self.device = options, torch.device(device)
        self.first = [one.networks for one in data]
        self.groups = [slice(begin, begin + group) for begin in range(0, len(data), group)]

        def single(tensors: Parameters) -> Parameters:
            return tuple(tensor.to(self.device, torch.float32).contiguous() for tensor in tensors)

        parts = [flattened(self.first[part]) for part in self.groups]
        self.parameters = [single(parameters) for parameters, _ in parts]
        self.fixed = [single(fixed) for _, fixed in parts]
        flat = [tensor for group in self.parameters for tensor in group]
        self.done = torch.zeros((), device=self.device, dtype=torch.float64)
        self.rate = torch.tensor(options.learning_rate, device=self.device)
        on_card = self.device.type == "cuda"
        self.optimizer = torch.optim.Adam(flat, lr=self.rate, fused=on_card, capturable=on_card)
        self.pairs = torch.from_numpy(np.concatenate([one.pairs for one in data])).to(self.device)
        self.points = torch.from_numpy(np.concatenate([one.points for one in data])).to(self.device)
        self.counts = [
            torch.tensor([len(getattr(one, name)) for one in data], device=self.device)[:, None]
            for name in ("pairs", "points")
        ]
        self.held_out = [
            torch.from_numpy(np.stack([getattr(one, name) for one in data])).to(self.device)
            for name in ("held_out_pairs", "held_out_points")
        ]

        told: dict[str, Any] = {
            "step": step, "weight": float(options.orthogonality_weight), "asymmetry": float(options.asymmetry)
        }  # fmt: skip

        self.told = told

        def gradients(parameters: Parameters, fixed: Parameters, pairs: Tensor, points: Tensor) -> Parameters:
            # Parts of a batch go side by side with the runs: products over all rows keep few processors busy.
            def parts(tensor: Tensor) -> Tensor:
                return tensor[:, None].expand(-1, PARTS, -1, -1).reshape(-1, *tensor.shape[1:])

            def split(rows: Tensor) -> Tensor:
                return rows.reshape(len(rows) * PARTS, -1, rows.shape[2])

            kept, rows = tuple(map(parts, fixed)), (split(pairs), split(points))

            def total(*parameters: Tensor) -> Tensor:
                return loss(tuple(map(parts, parameters)), kept, *rows, **told).sum() / PARTS

            return torch.func.grad(total, argnums=tuple(range(len(parameters))))(*parameters)

        self.gradients: Callable[..., Parameters] = (
            torch.compile(gradients, dynamic=False) if on_card else gradients
        )
        self.streams = [torch.cuda.Stream() for _ in self.groups] if on_card else []

    def batch(self) -> tuple[Tensor, Tensor]:
        """Pairs and points of all runs, drawn with repetition: ``(runs, batch, ...)`` each."""
        rows = []
        for table, counts in zip((self.pairs, self.points), self.counts, strict=True):
            draw = torch.rand(len(counts), self.options.batch_size, device=self.device, dtype=torch.float64)
            begin = counts.cumsum(0) - counts
            rows.append(table[begin + torch.minimum((draw * counts).long(), counts - 1)])
        return rows[0], rows[1]

    def one_step(self) -> None:
        """A batch, its gradients, and a step of Adam."""
        options, pairs_and_points = self.options, self.batch()
        self.rate.copy_(options.learning_rate * options.decay_rate ** (self.done / options.decay_steps))
        main = torch.cuda.current_stream() if self.streams else None
        for place, part in enumerate(self.groups):
            batch = [rows[part] for rows in pairs_and_points]
            if main is None:
                made = self.gradients(self.parameters[place], self.fixed[place], *batch)
            else:
                self.streams[place].wait_stream(main)
                with torch.cuda.stream(self.streams[place]):
                    made = self.gradients(self.parameters[place], self.fixed[place], *batch)
            for parameter, gradient in zip(self.parameters[place], made, strict=True):
                parameter.grad = gradient
        for stream in self.streams:
            main.wait_stream(stream)  # type: ignore[union-attr]
        self.optimizer.step()
        self.done += 1

    def recorded(self) -> Callable[[], None]:
        """A step that is played back as one graph; the state is as if none had been made."""
        if not self.streams:
            return self.one_step
        kept = self.state()
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(3):
                self.one_step()
        torch.cuda.current_stream().wait_stream(side)
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self.one_step()
        self.restore(kept)
        self.graph = graph
        return graph.replay

    def state(self) -> list[Tensor]:
        """Everything that a step changes, copied: number of steps, parameters, moments."""
        tensors = [self.done]
        for group in self.parameters:
            for parameter in group:
                moments = self.optimizer.state.get(parameter, {})
                zeros = torch.zeros_like(parameter)
                tensors += [parameter, moments.get("exp_avg", zeros), moments.get("exp_avg_sq", zeros)]
        return [tensor.detach().clone() for tensor in tensors]

    def restore(self, tensors: Sequence[Tensor]) -> None:
        """Take a state, in place: a recorded graph goes on with it."""
        self.done.copy_(tensors[0])
        place = 1
        for group in self.parameters:
            for parameter in group:
                parameter.data.copy_(tensors[place])
                moments = self.optimizer.state[parameter]
                if not moments:
                    step = torch.zeros((), device=self.device, dtype=torch.float32)
                    moments.update(
                        step=step, exp_avg=parameter.data.clone(), exp_avg_sq=parameter.data.clone()
                    )
                moments["exp_avg"].copy_(tensors[place + 1])
                moments["exp_avg_sq"].copy_(tensors[place + 2])
                moments["step"].copy_(self.done)
                place += 3

    def networks(self) -> list[TrainedNetworks]:
        """Of every run, as they are."""
        return [
            one
            for part, parameters in zip(self.groups, self.parameters, strict=True)
            for one in restored(parameters, self.first[part])
        ]

    def measured(self, grid: Tensor, exact: Tensor) -> pd.DataFrame:
        """Published loss on held-out pairs, and relative error of U over Ω, by run."""
        losses, errors = [], []
        for part, parameters, fixed in zip(self.groups, self.parameters, self.fixed, strict=True):
            held_out = [rows[part] for rows in self.held_out]
            losses += loss(parameters, fixed, *held_out, **self.told).tolist()
            level = 2 * potential(parameters, fixed, grid.expand(len(parameters[0]), -1, -1)).double()
            level = level - level.min(dim=1, keepdim=True).values
            errors += ((level - exact).norm(dim=1) / exact.norm()).tolist()
        rows = {"run": range(len(losses)), "step": int(self.done), "held_out_loss": losses, "error": errors}
        return pd.DataFrame(rows)


def train(
    folder: Path, *, runs: int, seconds: float, groups: Sequence[int], device: str, steps: int | None
) -> None:
    """Train as far as the time goes."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    torch.backends.cuda.matmul.allow_tf32 = False
    kept, table = folder / "state.npz", folder / "curves.csv"
    system = load_system(CARD)
    settings = settings_of(load_study(STUDY), system)
    options = settings.training
    assert options is not None and system.domain is not None and settings.sampling.pair_step is not None
    with ProcessPoolExecutor() as pool:
        data = list(pool.map(drawn, range(runs)))
    print(f"drawn after {time.perf_counter() - began:.0f} s", flush=True)
    _, points = _domain_grid(system.domain, points=GRID_POINTS)
    exact = compile_formulas([load_exact(CARD)], system.symbols)(points)[0]
    grid = torch.from_numpy(points.T.astype(np.float32)).to(device)
    level = torch.from_numpy(exact - exact.min()).to(device)

    step = settings.sampling.pair_step

    def made(group: int) -> tuple[Training, Callable[[], None]]:
        training = Training(data, options=options, step=step, group=group, device=device)
        return training, training.recorded()

    def wait() -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    times = {}
    for group in groups if len(groups) > 1 else ():
        training, advance = made(group)
        wait()
        before = time.perf_counter()
        for _ in range(30):
            advance()
        wait()
        times[group] = (time.perf_counter() - before) / 30
        print(
            f"groups of {group}: {1e3 * times[group]:.2f} ms a step, {time.perf_counter() - began:.0f} s",
            flush=True,
        )
        del training, advance
    training, advance = made(min(times, key=times.__getitem__) if times else groups[0])
    tables = []
    if kept.is_file():
        with np.load(kept, allow_pickle=False) as archive:
            training.restore([torch.from_numpy(archive[name]).to(device) for name in sorted(archive.files)])
        tables.append(pd.read_csv(table))
    last = options.steps if steps is None else steps
    done = int(training.done)
    spent = float(tables[0]["seconds"].iloc[-1]) if tables else 0.0
    resumed, wall = spent, time.perf_counter()

    def keep() -> None:
        tensors = [tensor.cpu().numpy() for tensor in training.state()]
        write_archive(folder / "new.npz", {f"{place:04d}": tensor for place, tensor in enumerate(tensors)})
        (folder / "new.npz").replace(kept)
        pd.concat(tables, ignore_index=True).to_csv(table, index=False)

    while done < last and time.perf_counter() - began < seconds:
        mark = min([mark for mark in (*MARKS, last) if mark > done])
        while done < mark and time.perf_counter() - began < seconds:
            for _ in range(min(100, mark - done)):
                advance()
                done += 1
            wait()
        spent = resumed + time.perf_counter() - wall
        if done == mark:
            with torch.no_grad():
                tables.append(training.measured(grid, level).assign(seconds=spent))
            now = tables[-1]
            print(
                f"step {done}: {spent:.0f} s, loss {now['held_out_loss'].median():.2e}, error of U"
                f" {now['error'].median():.2e} (worst {now['error'].max():.2e})", flush=True,
            )  # fmt: skip
    keep()
    write_networks(folder / "networks.npz", training.networks())
    print(f"step {done} of {last}, {time.perf_counter() - began:.0f} s", flush=True)


def write_networks(path: Path, networks: Sequence[TrainedNetworks]) -> None:
    """Networks of all runs in single precision, as they were trained."""
    arrays = pack(networks)
    write_archive(path, {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in arrays.items()})


def scored(number: int, networks: TrainedNetworks) -> dict[str, object]:
    """The networks of a run and their published regression against the exact U."""
    system, exact = load_system(CARD), load_exact(CARD)
    settings = settings_of(load_study(STUDY), system)
    recordings = draw_run(settings, system, number=number).result
    trained = StepResult(networks, Outcome(number, Step.TRAIN))
    formulas = regress_run(settings, recordings, trained)
    answer = exact_answer(CARD)
    row: dict[str, object] = {"run": number, "regression": formulas.outcome.status.value}
    if formulas.result is not None:
        found = {str(Method.REGRESSION): formulas.result}
        tables = score_run(settings, found, {}, networks, number=number, exact=answer)
        row |= {name: tables["rrmse"].iloc[0][name] for name in ("rrmse", "support_correct")}
    assert system.domain is not None
    _, grid = _domain_grid(system.domain, points=GRID_POINTS)
    true, level = compile_formulas([exact], system.symbols)(grid)[0], 2 * networks.potential_at(grid.T)
    below = true - true.min() < LEVEL
    return row | {
        "error": relative_error(level, true),
        "error_in_wells": relative_error(level[below], true[below]),
    }


def score(folder: Path) -> None:
    """The two tables that are kept; runs that were scored before are not scored again."""
    archive = read_archive(folder / "networks.npz")
    curves = pd.read_csv(folder / "curves.csv")
    with np.load(folder / "state.npz", allow_pickle=False) as state:
        steps = int(state["0000"])
    kept = folder / f"scores_{steps}.csv"
    rows: list[dict[Any, Any]] = pd.read_csv(kept).to_dict("records") if kept.exists() else []
    for number in range(len(rows), int(archive["count"])):
        rows.append({"steps": steps, **scored(number, unpack(archive, number))})
        print(rows[-1], flush=True)
        pd.DataFrame(rows).to_csv(kept, index=False, float_format="%.4g")
    pd.DataFrame(rows).to_csv(TABLE, index=False, float_format="%.4g")
    curves.to_csv(CURVES, index=False, float_format="%.4g")


def main() -> None:
    """Train on a card, or score what was trained."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("train", "score"))
    parser.add_argument("--folder", type=Path, default=ROOT / "results" / "published-settings")
    parser.add_argument(
        "--seconds", type=float, default=1e9, help="after which training stops and keeps its state"
    )
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--steps", type=int, help="instead of the study's 150,000")
    parser.add_argument(
        "--groups", type=int, nargs="+", default=[50], help="runs of a group; the fastest is taken"
    )
    parser.add_argument("--device", default="cuda")
    asked = parser.parse_args()
    if asked.what == "train":
        train(
            asked.folder, runs=asked.runs, seconds=asked.seconds, groups=asked.groups, device=asked.device,
            steps=asked.steps,
        )  # fmt: skip
    else:
        score(asked.folder)


if __name__ == "__main__":
    main()
