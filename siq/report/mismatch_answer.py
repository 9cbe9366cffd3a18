"""What a terminal prints at the end of a diagnosis, and another program reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from siq.report.mismatch_findings import final_simulation


def mismatch_answer(verdict: Mapping[str, Any], *, title: str) -> dict[str, Any]:
    """The content of ``answer.json``: the sentence that the page opens with, and the number beside it.

    Parameters
    ----------
    verdict
        The content of ``verdict.json``.
    title
        What the page is headed.

    Returns
    -------
    dict
        ``title``, ``sentence``, ``verdict``, ``compared`` (false where no fit of the simulation has a
        result), ``held_out_before`` (the simulation as given), ``held_out_after`` (the one that the verdict
        ends with) and ``held_out_noise``. The errors are root mean squares on recordings held out, as a share
        of the spread of what was measured; null where a simulation ran away.
    """
    fit = verdict["fit"]
    return {
        "title": title,
        "sentence": verdict["sentence"],
        "verdict": verdict["verdict"],
        "compared": fit["noise_floor"] is not None,
        "held_out_before": fit["before"],
        "held_out_after": fit[final_simulation(verdict)],
        "held_out_noise": fit["noise_floor"],
    }
