"""The schemas of configuration as files, `workflow/schemas/`, from the classes that check it.

    .venv/bin/python docs/make/schemas.py     # or: make schemas

Editors complete and check with them, and the catalogue of Snakemake workflows shows them. What a class
checks across keys is in no schema: the classes decide.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from siq.diagnosis.study import MismatchStudy
from siq.systems.cards import SystemCard
from siq.workflow.study import Study
from workflow.settings import Configuration

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "workflow" / "schemas"
MODELS: dict[str, type[BaseModel]] = {
    "config": Configuration,
    "study": Study,
    "system": SystemCard,
    "mismatch": MismatchStudy,
}
# `false` switches these off as null does, before the class looks at their types.
SWITCHES = {("Study", "training"), ("Study", "landscape")}
HEAD = "# Written by `make schemas` from `{}`.\n"


def schema(model: type[BaseModel]) -> dict[str, Any]:
    """The JSON schema of a class, with the meaning of each key as its description."""
    place = Path(__file__).resolve().parents[1] / "extensions" / "schemas.py"
    spec = importlib.util.spec_from_file_location("schemas_of_pages", place)
    assert spec is not None and spec.loader is not None
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    written: dict[str, Any] = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    written |= model.model_json_schema(by_alias=True)
    classes = {one.__name__: one for one in _nested(model)}
    for name, part in [(model.__name__, written), *written.get("$defs", {}).items()]:
        said = pages.meanings(classes[name]) if name in classes else {}
        if "description" in part:
            part["description"] = part["description"].split("\n\nAttributes\n")[0].split("\n\n")[0]
        for key, entry in part.get("properties", {}).items():
            entry.pop("title", None)
            if (name, key) in SWITCHES:
                entry["anyOf"].append({"const": False})
            if key in said:
                entry["description"] = pages.markdown(said[key])
    return written


def _nested(schema: type) -> set[type]:
    """A class of keys, and all that its keys lead to."""
    found, left = set(), [schema]
    while left:
        one = left.pop()
        if isinstance(one, type) and hasattr(one, "__pydantic_core_schema__") and one not in found:
            found.add(one)
            fields = getattr(one, "model_fields", None) or getattr(one, "__pydantic_fields__", {})
            left += [field.annotation for field in fields.values()]
        else:
            left += getattr(one, "__args__", ())
    return found


def text(name: str) -> str:
    """A schema as its file has it."""
    model = MODELS[name]
    document = yaml.safe_dump(schema(model), sort_keys=False, allow_unicode=True, width=110)
    return HEAD.format(f"{model.__module__}.{model.__name__}") + document


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in MODELS:
        (FOLDER / f"{name}.schema.yaml").write_text(text(name), encoding="utf-8")
