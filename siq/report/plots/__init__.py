"""Figures: pure functions from tables and arrays to matplotlib figures.

Every figure is drawn without pyplot and without any setting of the machine, is legible at the width of a
column in print, and tells its groups apart for colour-blind readers too.
"""

from siq.errors import needs_extra

with needs_extra("plots"):
    from siq.report.plots.invariant import plot_invariant_distribution
    from siq.report.plots.prediction import plot_prediction
    from siq.report.plots.recordings import ComponentFields, Dataset, plot_components, plot_dataset
    from siq.report.plots.runs import (
        plot_coefficient_distributions,
        plot_error_distribution,
        plot_inclusion,
        plot_training,
    )
    from siq.report.plots.style import save_figure

__all__ = [
    "ComponentFields",
    "Dataset",
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
