"""Remarks: what a result has to say about itself, as a code with values.

`siq.report.remarks.sentence` makes the sentence that a reader sees from the code. Code that wants to know
whether something was remarked asks for the code, never for words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


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


def has_code(remarks: Iterable[Remark], code: str) -> bool:
    """Whether any of these remarks has a code."""
    return any(remark.code == code for remark in remarks)
