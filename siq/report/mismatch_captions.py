"""What do the figures of a diagnosis show?"""

from __future__ import annotations

CAPTIONS = {
    "curves": "What is missing, as a function of one coordinate in each panel: before anything was added"
    " (blue) and after (orange, dashed). What the simulation's own parameters can do is taken off. Where a"
    " blue band stays clear of zero, something is missing. Bands are cut off at the edge of the panel, and"
    " left out where they would fill it.",
    "map": "What is missing, over the two states along which most of it can be seen, averaged over cells;"
    " one panel for each equation. Grey: no recordings.",
    "described": "What was added, as a function of one coordinate with a band of 95 % (dots: the values that"
    " were fitted, or where a formula was evaluated), or of two in colours (dotted: it may as well be zero).",
    "candidates": "How much each mechanism explains. Fitted: what was found, and what was fitted in its"
    " place. Grey bars are estimates for mechanisms that were not fitted.",
    "held_out": "Held-out recordings with all three simulations. For each recording above: the course in"
    " time; below: simulation minus recording. Of long recordings the last part is shown.",
    "escapes": "Mean escape times from well to well against the inverse noise intensity, by the law of Eyring"
    " and Kramers: without what was found (dashed) and with it (solid), one colour for each way out.",
}
