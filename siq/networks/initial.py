"""Networks before training: random, normalised and rescaled to the data (paper, Eqs. eta_v and eta_g)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.errors import needs_extra
from siq.networks.data import TrainingData
from siq.networks.networks import Networks, evaluate, initial_layers, select_run
from siq.networks.options import TrainingOptions

with needs_extra("networks"):
    import torch


def initial_networks(
    data: Sequence[TrainingData],
    *,
    options: TrainingOptions,
    diffusion: Diffusion,
    generators: Sequence[np.random.Generator],
) -> Networks:
    """Random networks, normalised and rescaled to the data of each run (paper, Eqs. eta_v, eta_g).

    η_v and η_g bring the initial ∣∇V∣ and ∣g∣ to the size of the observed velocities.
    """
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
        one = select_run(networks, run)
        # A few thousand pairs fix a single number well; the whole data would only cost memory.
        rows = np.linspace(0, len(pairs.h) - 1, min(len(pairs.h), 20_000)).astype(int)
        components = evaluate(one, torch.from_numpy(pairs.x0[rows]).to(dtype)[None])
        velocity = (pairs.xh[rows] - pairs.x0[rows]) / pairs.h[rows, None]
        speed = np.linalg.norm(velocity, axis=1)
        # ∇ with respect to y = (x - μ)/σ, as the paper writes it. Where the σ differ this makes V several
        # times larger than ∇ with respect to x would, and V then learns as fast as g does; with the
        # smaller scale training ends in a V that is flat along x.
        downhill = torch.linalg.norm(components.gradient * one.scale, dim=-1)[0].numpy()
        circulatory = torch.linalg.norm(components.circulatory, dim=-1)[0].numpy()
        along = float(downhill @ speed / (downhill @ downhill))
        if options.potential_from == "descent":
            along = (
                _descent(pairs.x0[rows], components.gradient[0].double().numpy(), velocity, diffusion)
                or along
            )
        potential_scales.append(along)
        circulatory_scales.append(float(circulatory @ speed / (circulatory @ circulatory)))
    return replace(
        networks,
        potential_scale=options.potential_gain * torch.tensor(potential_scales, dtype=dtype)[:, None, None],
        circulatory_scale=torch.tensor(circulatory_scales, dtype=dtype)[:, None, None],
    )


def _descent(x: np.ndarray, gradient: np.ndarray, velocity: np.ndarray, diffusion: Diffusion) -> float:
    """The factor on V with which -D∇V comes closest to the velocities; 0 where these go up V on the whole."""
    size = diffusion.steepness(x, gradient).sum()
    return max(float(-(gradient * velocity).sum() / size), 0.0)
