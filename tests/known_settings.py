"""The paper's settings, for tests of what the paper describes."""

from __future__ import annotations

from siq.networks.decomposition import TrainingOptions

PAPER = TrainingOptions(
    widths=(50, 50, 50),
    steps=150_000,
    check=None,
    batch_size=5000,
    representative_share=0.0,
    learning_rate=5e-3,
    decay_rate=0.95,
    decay_steps=1000,
    orthogonality_weight=10.0,
    asymmetry=0.1,
    matching="explicit",
    matching_order=2,
    relative_dynamics=False,
    normalise_on="pairs",
    potential_gain=1.0,
    training_share=0.7,
    precision="float64",
)
