"""What do the figures of a study show, and in which part of the page do they stand?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from siq.report.page import ReportFigure


class Part(StrEnum):
    """Where a figure stands."""

    LEAD = "lead"
    EVIDENCE = "evidence"
    RECORD = "record"
    LANDSCAPE = "landscape"
    RUNS = "runs"
    PUBLISHED = "published"
    WORKINGS = "workings"


@dataclass(frozen=True)
class Caption:
    """Of one figure.

    Attributes
    ----------
    part
        Where it stands.
    text
        What it shows, panel by panel.
    paper
        The figure of the paper that it answers to; said only where a study is set beside the paper.
    """

    part: Part
    text: str
    paper: str = ""


CAPTIONS: Mapping[str, Caption] = {
    "quasipotential": Caption(
        Part.LEAD,
        "The quasipotential U where it is known, with the stable states (letters), the saddles between them"
        " (crosses), the most likely ways from one to the other, and recorded states (dots).",
    ),
    "landscape": Caption(
        Part.LANDSCAPE,
        "U over all wells where its formulas hold, with stable states, saddles, and the ways of least"
        " action: solid"
        " on the way up, dashed on the way down.",
    ),
    "residuals": Caption(
        Part.EVIDENCE,
        "What f leaves of the recorded increments, a panel for each state. Without a trend, nothing in f is"
        " missing.",
    ),
    "prediction": Caption(
        Part.EVIDENCE,
        "Prediction of recordings that were held out: trajectories, recorded and computed from the same first"
        " states by f; and the relative errors at their ends, with the median.",
        "Fig. 4a",
    ),
    "record": Caption(
        Part.RECORD,
        "The record beside what f, D and ε say of it: (a) mean visits to each well, counted on all recordings"
        " and predicted; below, how a state is spread during the visits to a well, on held-out recordings.",
    ),
    "escape": Caption(
        Part.EVIDENCE,
        "Mean escape times against the strength of the noise: lines by the law of Eyring and Kramers,"
        " points by"
        " direct simulation of the card, with standard errors.",
    ),
    "landscape_errors": Caption(
        Part.EVIDENCE,
        "U by every source, and below each its difference from U along characteristics of the exact vector"
        " field.",
        "fig2b, c to e, and Appendix E",
    ),
    "invariant": Caption(
        Part.LANDSCAPE,
        "The density of states exp(−U/ε) that follows from U, a panel for each ε; below each, a long"
        " simulation"
        " with lines of the same density.",
        "fig1b and fig2c, b to d",
    ),
    "degrees": Caption(
        Part.WORKINGS,
        "How well formulas of rising degree solve the equation of U about each stable state, on points"
        " that took no"
        " part in the fit, against their number of terms. The ring marks the degree that was chosen.",
    ),
    "sweep": Caption(
        Part.LANDSCAPE,
        "Equilibria against the parameter, stable ones as lines of the colour of their well, and where they"
        " begin and end; below, the lowest barrier of each stable state, and, for the noise that the study"
        " gives, how long each lasts and its share of time in the long run. Against two parameters, maps of"
        " the number of stable states and of the lowest barrier.",
    ),
    "error_distribution": Caption(
        Part.RUNS, "Relative error of the coefficients of U, one dot for each run and method.", "Fig. 3"
    ),
    "coefficients_refined": Caption(
        Part.RUNS,
        "Coefficients of U over the runs, a panel for each term that belongs there; the last panel shows"
        " the terms"
        " that do not.",
        "Fig. 2",
    ),
    "inclusion_refined": Caption(Part.RUNS, "How often each term was found, by component."),
    "coefficients_regression": Caption(
        Part.PUBLISHED,
        "Coefficients of U over the runs by the published regression, from the networks as they are; a"
        " panel for"
        " each term that belongs there, and one for those that do not.",
    ),
    "inclusion_regression": Caption(
        Part.PUBLISHED, "How often the published regression found each term, by component."
    ),
    "landscape_published": Caption(
        Part.PUBLISHED,
        "What was published of U, as a formula and, where it is at hand, on a mesh; below each, its"
        " difference from U"
        " along characteristics of the exact vector field.",
    ),
    "training": Caption(
        Part.PUBLISHED,
        "The networks' training, one line for each run: loss on training pairs and on held-out pairs, its"
        " two parts,"
        " and the learning rate.",
    ),
    "dataset": Caption(
        Part.WORKINGS,
        "The recordings: some trajectories; all recorded states; and, where networks were regressed, the"
        " states below"
        " the level of the regression.",
        "fig2a; fig1_noisy a",
    ),
    "components": Caption(
        Part.WORKINGS,
        "The decomposition of f on the plane of the first two states: trajectories, the downhill part"
        " −D∇V, the"
        " circulatory part g, and U; where it is known, the exact U beside it.",
        "Fig. 1",
    ),
}

OF_INSPECTION = ("record", "visited", "memory")
"""Figures of the first section, see `siq.report.inspection_section`."""

OF_NETWORKS = ("coefficients_regression", "inclusion_regression", "training")
"""Figures that say nothing where no networks were asked for."""

OF_RUNS = ("coefficients_refined", "inclusion_refined", "coefficients_regression", "inclusion_regression",
           "error_distribution")  # fmt: skip
"""Figures of a scatter over runs, of which there is none in one."""

OF_ONE_STATE = (
    "The quasipotential U where it is known, with a band of two standard errors; the stable states (letters),"
    " the saddles between them (crosses), the depth of each (arrows), and recorded states (ticks)."
)
"""What the first picture shows where there is one state: a curve, and no ways beside it."""

OF_EQUATIONS = (
    "The quasipotential U where it is known, with the stable states (letters), the saddles between them"
    " (crosses), and the most likely ways from one to the other."
)
"""What it shows of given equations: nothing was recorded."""

OF_ONE_EQUATION = (
    "The quasipotential U where it is known; the stable states (letters), the saddles between them (crosses)"
    " and the depth of each (arrows)."
)
"""The same of one state."""

LEADING = ("quasipotential", "landscape")
"""Figures that a page can open with, the best first."""


def shown_figures(names: set[str], *, runs: int, networks: bool, published: bool) -> set[str]:
    """Which figures a page shows of those that exist.

    Parameters
    ----------
    names
        Of the figures that were drawn.
    runs
        Number of runs.
    networks
        Whether networks were asked for.
    published
        Whether the study names published figures.
    """
    names = names - set(OF_INSPECTION)
    if not published:
        names = names - {"landscape_published"}
    if not networks:
        names = names - set(OF_NETWORKS)
    if runs == 1:
        names = names - set(OF_RUNS)
    return names - {"landscape"} if "quasipotential" in names else names


def figure_place(name: str) -> Part:
    """In which part of the page a figure stands; one that nobody described, with the workings."""
    return CAPTIONS[name].part if name in CAPTIONS else Part.WORKINGS


def figures_of(
    part: Part, images: Mapping[str, bytes], vectors: Mapping[str, bytes], *, beside_paper: bool
) -> list[ReportFigure]:
    """The figures of a part of the page, in the order of `CAPTIONS`; one that nobody described comes last.

    Parameters
    ----------
    part
        Of the page; figures without a caption stand with the workings.
    images, vectors
        PNG and SVG by name.
    beside_paper
        Whether to name the figures of the paper.
    """
    names = [name for name, caption in CAPTIONS.items() if caption.part == part and name in images]
    if part == Part.WORKINGS:
        names += sorted(set(images) - set(CAPTIONS))
    return [figure_of(name, images, vectors, beside_paper=beside_paper) for name in names]


def figure_of(
    name: str, images: Mapping[str, bytes], vectors: Mapping[str, bytes], *, beside_paper: bool
) -> ReportFigure:
    """One figure with its caption."""
    caption = CAPTIONS.get(name, Caption(Part.WORKINGS, f"{name.replace('_', ' ').capitalize()}."))
    text = caption.text
    if beside_paper and caption.paper:
        text += f" In the paper: {caption.paper}."
    return ReportFigure(text, caption.text, images[name], "png", vectors.get(name))
