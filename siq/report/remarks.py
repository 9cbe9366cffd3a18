"""The sentences of remarks: one template for each code, in `siq/report/templates/remarks/`."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import jinja2
import yaml

from siq.numerics.text import number_text, p_equation, percent, range_text, span_text, unit_text, value_text
from siq.remarks import Remark


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
