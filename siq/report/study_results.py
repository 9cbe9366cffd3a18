"""What did a study leave behind, and what of it does its page show?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from siq.data.record_states import RecordStates
from siq.identify.storage import FieldRecord
from siq.potential.symbolic import SymbolicDecomposition
from siq.report.page import ReportFigure
from siq.report.study_captions import Part, figures_of
from siq.steps.outcomes import Method
from siq.steps.shown import ModelFiles, Shown
from siq.study.study import Study


@dataclass(frozen=True)
class StudyResults:
    """What a study left behind.

    Attributes
    ----------
    tables
        By name, see `siq.study.tables.COLUMNS`; `landscape_errors` and `escape` with a card only,
        and `beside_equations` where the study asks for it.
    folder
        Where the whole tables are.
    models
        The formulas of all runs.
    shown
        The run whose formulas are printed.
    exact
        The exact ones, where they are known.
    images, vectors
        The figures that there are by name, as PNG and as SVG.
    overview
        The landscape that the page opens with, as plain data; None where there is none.
    record
        f and D of the run that is shown, None where there is none.
    interactive
        A view of U that can be turned, None where there is none.
    inspection
        What is in the recordings, line by line; None where they were simulated.
    seen
        The two states that they show by themselves; None where nothing is known of that.
    """

    tables: Mapping[str, pd.DataFrame]
    folder: Path
    models: ModelFiles
    shown: Shown
    exact: SymbolicDecomposition | None
    images: Mapping[str, bytes]
    vectors: Mapping[str, bytes]
    overview: Mapping[str, Any] | None = None
    record: FieldRecord | None = None
    interactive: Markup | None = None
    inspection: Sequence[str] | None = None
    seen: RecordStates | None = None


@dataclass(frozen=True)
class ShownStudy:
    """A study as its page shows it; `images` are the figures that are shown, with the `lead`."""

    study: Study
    results: StudyResults
    images: Mapping[str, bytes]
    lead: str | None
    beside_paper: bool

    def figures(self, part: Part) -> list[ReportFigure]:
        """Those that stand in a part of the page, but for the one that it opens with."""
        images = {name: image for name, image in self.images.items() if name != self.lead}
        return figures_of(part, images, self.results.vectors, beside_paper=self.beside_paper)

    @property
    def method(self) -> Method:
        """Whose formulas are shown."""
        return self.results.shown.method

    def certificate(self) -> Mapping[str, Any] | None:
        """Of the formulas that are shown; None where there are none."""
        shown = self.results.shown
        if shown.run is None:
            return None
        found: Mapping[str, Any] | None = self.results.models.certificates(shown.run).get(str(shown.method))
        return found
