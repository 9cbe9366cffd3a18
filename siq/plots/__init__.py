"""Figures: pure functions from tables and arrays to matplotlib figures.

Every figure is drawn without pyplot and without any setting of the machine, is legible at the width of a
column in print, and tells its groups apart for colour-blind readers too.
"""

from siq.plots.accuracy import plot_error_distribution
from siq.plots.coefficients import plot_coefficient_distributions
from siq.plots.components import ComponentFields, plot_components
from siq.plots.dataset import Dataset, plot_dataset
from siq.plots.inclusion import plot_inclusion
from siq.plots.invariant import InvariantPanel, plot_invariant_distribution
from siq.plots.prediction import plot_prediction
from siq.plots.saving import save_figure
from siq.plots.training import plot_training

__all__ = [
    "ComponentFields",
    "Dataset",
    "InvariantPanel",
    "plot_coefficient_distributions",
    "plot_components",
    "plot_dataset",
    "plot_error_distribution",
    "plot_inclusion",
    "plot_invariant_distribution",
    "plot_prediction",
    "plot_training",
    "save_figure",
]
