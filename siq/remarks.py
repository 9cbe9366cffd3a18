"""Remarks: what a result has to say about itself, as a code with values, and the sentences of codes.

`sentence` makes what a reader sees from the code, by one template for each code in
`siq/report/templates/remarks/`. Code that wants to know whether something was remarked asks for the code,
never for words.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
import yaml

from siq.numerics.text import number_text, p_equation, percent, range_text, span_text, unit_text, value_text


@dataclass(frozen=True)
class Remark:
    """A statement about a result, such as a limit of its validity.

    Parameters
    ----------
    code
        Its name, ``"package.subject"``, such as ``"quasipotential.no_escape_time"``: a key of the templates
        in `siq/report/templates/remarks/`.
    values
        The numbers and names that the sentence quotes, by the names that its template has for them.

    Examples
    --------
    >>> Remark("inference.few_samples", {"count": 12}).as_data()
    {'code': 'inference.few_samples', 'values': {'count': 12}}
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def as_data(self) -> dict[str, Any]:
        """As it is stored: plain data, which `from_data` reads back."""
        return {"code": self.code, "values": dict(self.values)}

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Remark:
        """A remark as it was stored by `as_data`."""
        return cls(data["code"], data["values"])


@cache
def templates() -> dict[str, jinja2.Template]:
    """The templates of all remarks, by code, from the files of all packages.

    In a template ``{{ value | number }}`` writes a number for readers, ``{{ value | share }}`` a share in
    per cent, ``{{ value | p_equation }}`` a p-value, ``{{ value | value(digits=2) }}`` a number to so many
    digits, ``{{ limits | range }}`` an interval, ``{{ three | span }}`` the least, usual and greatest of
    something, ``{{ text | unit }}`` a unit. A value that a template names and a remark lacks is an error.
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False)
    environment.filters |= {
        "number": number_text, "share": percent, "p_equation": p_equation, "value": value_text,
        "range": lambda limits: range_text(*limits), "span": span_text, "unit": unit_text,
    }  # fmt: skip
    found: dict[str, jinja2.Template] = {}
    for file in files("siq.report").joinpath("templates", "remarks").iterdir():
        entries = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
        found |= {code: environment.from_string(str(text)) for code, text in entries.items()}
    return found


def sentence(remark: Remark) -> str:
    """A remark as a sentence.

    Raises
    ------
    KeyError
        If no template has its code.
    """
    return templates()[remark.code].render(remark.values)
