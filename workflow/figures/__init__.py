"""Figures of a study that our workflow draws: many runs, networks, comparisons, components, densities."""
