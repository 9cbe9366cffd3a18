"""The documents name what there is: modules and tests by their paths, keys of studies with their defaults."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from siq.certificate.tests import CertificateOptions
from siq.dynamics.sampling import SimulationEntry
from siq.identify.identification import IdentificationOptions
from siq.landscape.options import LandscapeOptions
from siq.networks.options import CheckOptions, TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.potential.refinement import RefinementOptions
from siq.study.study import RecordingsOptions, Study

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SECTIONS = {
    "Study: `config/studies/NAME.yaml`": Study,
    "`recordings`": RecordingsOptions,
    "`simulation`": SimulationEntry,
    "`identification`": IdentificationOptions,
    "`training`": TrainingOptions,
    "`training.check`": CheckOptions,
    "`regression`": RegressionOptions,
    "`refinement`": RefinementOptions,
    "`certificate`": CertificateOptions,
    "`landscape`": LandscapeOptions,
}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_paths_of_the_sources_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = set(re.findall(r"\b(?:siq|tests|workflow|benchmarks|config)/[\w/.-]*\.(?:py|yaml|smk)\b", text))
    assert not {path for path in named if "NAME" not in path and not (ROOT / path).exists()}


def documented(heading: str) -> dict[str, str]:
    """The first table below a heading: default by key."""
    text = (ROOT / "docs" / "system-cards-and-studies.md").read_text(encoding="utf-8")
    section = re.split(r"^#+ ", text.split(f"# {heading}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]
    rows = re.findall(r"^\| (`.+?`) \| .+? \| (.*?) ?\| .*\|$", section, flags=re.MULTILINE)
    return {
        key: default
        for keys, defaults in rows
        for key, default in zip(
            keys.replace("`", "").split(", "), spread(defaults, keys.count(",") + 1), strict=True
        )
    }


def spread(defaults: str, count: int) -> list[str]:
    """What a row says of several keys: a default for each, or one for all."""
    return [defaults] * count if count == 1 or ", " not in defaults else defaults.split(", ")


def defaults_of(schema: Any) -> dict[str, Any]:
    """Defaults by key, as a YAML file would have them; none where a key has to be given."""
    if issubclass(schema, BaseModel):
        return {name: None if one.is_required() else one.default for name, one in schema.model_fields.items()}
    return {one.name: one.default for one in dataclasses.fields(schema)}


@pytest.mark.parametrize(("heading", "schema"), SECTIONS.items(), ids=SECTIONS)
def test_keys_of_studies_stand_with_their_defaults(heading: str, schema: Any) -> None:
    said, there = documented(heading), defaults_of(schema)
    assert set(said) == set(there)
    # What holds where the default is nothing, or the options of a step, is said in words.
    plain = {
        key: one for key, one in there.items() if isinstance(one, int | float | tuple | str) and one != ""
    }
    read = {key: yaml.safe_load(re.sub(r"(\d)e-", r"\1.0e-", said[key].replace("`", ""))) for key in plain}
    assert read == {key: list(one) if isinstance(one, tuple) else one for key, one in plain.items()}
