"""Figures: functions from tables, arrays and summaries to matplotlib figures or axes.

Every figure is drawn without pyplot and without any setting of the machine, is legible at the width of a
column in print, and tells its groups apart for colour-blind readers too.
"""

from siq.errors import needs_extra

with needs_extra("plots"):
    from siq.report.plots.style import save_figure

__all__ = ["save_figure"]
