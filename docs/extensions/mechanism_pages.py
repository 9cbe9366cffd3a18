"""The dictionary of mechanisms as a page, written from its file when the pages are built.

`{mechanisms}` becomes a table of all entries, and then what the file says of each: where it applies, what it
changes, its parameters, what it is easily taken for, and the source.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from siq.diagnosis import dictionary
from siq.diagnosis.dictionary import Form, Mechanism, MechanismParameter, Shape, standard_dictionary


def page(mechanisms: Sequence[Mechanism]) -> str:
    """All entries in Markdown."""
    lines = ["| name | what it is |", "|---|---|"]
    lines += [f"| {link(each.name)} | {each.sentence} |" for each in mechanisms]
    for each in mechanisms:
        lines += ["", *entry(each)]
    return "\n".join(lines)


def entry(mechanism: Mechanism) -> Iterator[str]:
    """What the file says of one entry."""
    yield from ("```{rubric} " + mechanism.name, f":name: {anchor(mechanism.name)}", "```", "")
    yield from (mechanism.sentence, "", "| applies to | what changes |", "|---|---|")
    for form in mechanism.forms:
        yield f"| {', '.join(f'{kind} `{role}`' for role, kind in form.roles.items())} | {changes(form)} |"
    parameters = {
        (name, parameter.unit, parameter.sign, looked_for(parameter)): None
        for form in mechanism.forms
        for name, parameter in form.parameters.items()
    }
    if parameters:
        yield from ("", "| parameter | unit | sign | where it is looked for |", "|---|---|---|---|")
    for name, unit, sign, where in parameters:
        yield f"| `{name}` | `{unit}` | {sign} | {where} |"
    yield from ("", f"Family: {mechanism.family or mechanism.name}, weight {mechanism.weight:g}.", "")
    of_forms = (name for form in mechanism.forms for name in form.generalises)
    special = tuple(dict.fromkeys((*mechanism.generalises, *of_forms)))
    for words, names in (
        ("Special cases of it", special),
        ("Easily taken for it", mechanism.look_alikes),
    ):
        if names:
            yield from (f"{words}: {', '.join(map(link, names))}.", "")
    yield f"Source: {mechanism.reference}."


def changes(form: Form) -> str:
    """What a form does to a simulation, in a cell of a table."""
    said = [f"`{role}' = … + {one_line(text)}`" for role, text in form.terms.items()]
    said += [f"`{role}` becomes `{one_line(text)}`" for role, text in form.replace.items()]
    said += [
        f"in the equation of `{role}`, `{other}` becomes `{one_line(text)}`"
        for role, texts in form.within.items()
        for other, text in texts.items()
    ]
    said += [f"the sensor reads `{one_line(text)}`" for text in form.outputs.values()]
    said += [
        f"`{name}' = {one_line(state.equation)}`, from `{name} = {state.begin}` on"
        for name, state in form.states.items()
    ]
    if form.noise:
        said.append(f"process noise on `{form.noise}`")
    words = "; ".join(said)
    return f"{words} ({form.variant})" if form.variant else words


def looked_for(parameter: MechanismParameter) -> str:
    """Where a search begins, in words."""
    shape = parameter.shape
    if shape is None:
        return "from zero, where the mechanism is absent"
    at = ", ".join(f"{value:g}" for value in shape.at)
    return {
        "scale_of": f"{at} times the size of `{shape.scale_of}`",
        "inverse_scale_of": f"{at} over the size of `{shape.inverse_scale_of}`",
        "quantiles_of": f"quantiles {at} of `{shape.quantiles_of}`",
        "time_of": f"{at} times the time in which `{shape.time_of}` changes by its own spread",
        "lattice_of": "known: the step in which recorded values lie",
        "top_of": "where recorded values end above in a plateau",
        "bottom_of": "where recorded values end below in a plateau",
        "magnitude_of": "one: recorded values never fall below zero, and those of the simulation do",
        "samples": f"{at} times the time between samples",
        "frequencies": f"{shape.frequencies} frequencies that the recordings resolve",
    }[way(shape)]


def way(shape: Shape) -> str:
    """The one key of a shape that says how it is looked for."""
    return next(key for key in shape.model_fields_set if key != "at")


def one_line(text: object) -> str:
    """A formula that may stand in a cell of a table."""
    return re.sub(r"\s+", " ", str(text)).replace("|", "∣")


def anchor(name: str) -> str:
    """Where the page tells of an entry."""
    return "mechanism-" + re.sub(r"\W+", "-", name.lower())


def link(name: str) -> str:
    """An entry's name, leading to it."""
    return f"[{name}](#{anchor(name)})"


class Mechanisms(SphinxDirective):
    """The dictionary of mechanisms that comes with the library."""

    def run(self) -> list[nodes.Node]:
        """Write it from `siq/diagnosis/mechanisms.yaml`."""
        self.env.note_dependency(dictionary.__file__)
        self.env.note_dependency(dictionary.__file__.replace("dictionary.py", "mechanisms.yaml"))
        return self.parse_text_to_nodes(page(standard_dictionary()))


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the directive known."""
    app.add_directive("mechanisms", Mechanisms)
    return {"parallel_read_safe": True}
