"""The documents name what there is, quote what was measured, and show what was really run."""

from __future__ import annotations

import argparse
import ast
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

import siq
from siq.diagnosis.dictionary import Form, Mechanism, MechanismParameter, standard_dictionary
from siq.diagnosis.study import MismatchStudy
from siq.networks.decomposition import TrainingOptions
from siq.systems.cards import SystemCard
from siq.workflow.study import RecordingsOptions, Study

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
WRITTEN = [page for page in sorted(DOCS.rglob("*.md")) if "_build" not in page.parts]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "config" / "README.md", *WRITTEN]
FIGURES = json.loads((DOCS / "figures.json").read_text(encoding="utf-8"))
EXAMPLES = sorted((DOCS / "gallery").glob("*.py"))
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.py"))
MARK = re.compile(r"<!--=([\w.]+)-->(.*?)<!--/-->", re.DOTALL)


def loaded(path: Path) -> ModuleType:
    """A script of the documentation as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_paths_of_the_sources_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = set(
        re.findall(
            r"\b(?:siq|tests|workflow|benchmarks|config|docs)/[\w/.-]*\.(?:py|yaml|smk|md|rst)\b", text
        )
    )
    assert not {path for path in named if "NAME" not in path and not (ROOT / path).exists()}


def parser_of(script: Path) -> argparse.ArgumentParser:
    """Its parser as far as its text shows it: imports of all benchmarks would take ten seconds."""
    types = {"int": int, "float": float}
    parser = argparse.ArgumentParser(prog=name_of(script), add_help=False)
    for call in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        if not (isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "add_argument"):
            continue
        given: dict[str, Any] = {}
        for one in call.keywords:
            if one.arg == "type":
                given["type"] = types.get(getattr(one.value, "id", ""), str)
            elif one.arg in ("action", "nargs", "required"):
                given[one.arg] = ast.literal_eval(one.value)
            elif one.arg == "choices" and isinstance(one.value, ast.Tuple | ast.List):
                given["choices"] = ast.literal_eval(one.value)
        parser.add_argument(*map(ast.literal_eval, call.args), **given)
    return parser


def test_commands_of_benchmarks_are_understood() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    makefile = re.sub(r"(?<!-)(?<=\s)\$\(\w+\)", "", re.sub(r"(--[\w-]+) \$\(\w+\)", r"\1 1", makefile))
    named = set()
    for text in (makefile, *(page.read_text(encoding="utf-8") for page in PAGES)):
        named |= set(re.findall(r"python (?:-m )?((?:benchmarks|docs/make)[./][\w./]+)([^`#\n]*)", text))
    assert len(named) > 20
    for target, words in sorted(named):
        path = ROOT / (target if target.endswith(".py") else target.replace(".", "/"))
        script = next(
            (one for one in (path, path.with_suffix(".py"), path / "__main__.py") if one.is_file()), None
        )
        assert script is not None, f"there is no {target}"
        if "sys.argv[1" in (text := script.read_text(encoding="utf-8")):
            continue  # takes what there is
        if "add_argument" not in text:
            assert set(words.split()) <= set(re.findall(r'"(--[\w-]+)" in sys.argv', text)), (target, words)
            continue
        try:
            parser_of(script).parse_args(words.split())
        except SystemExit:
            pytest.fail(f"python {target}{words} is not understood")


def test_docstrings_and_templates_name_what_there_is() -> None:
    """A name such as `siq.data.recordings.Recordings` is a module, or a word in the source of one."""
    lost = []
    files = [file for folder in ("siq", "workflow") for file in sorted((ROOT / folder).rglob("*"))]
    for file in (file for file in files if file.suffix in (".py", ".j2", ".yaml", ".smk")):
        for name in re.findall(r"`((?:siq|workflow)(?:\.\w+)+)`", file.read_text(encoding="utf-8")):
            path, names = ROOT, name.split(".")
            while names and (path / names[0]).is_dir():
                path /= names.pop(0)
            if names and (path / f"{names[0]}.py").is_file():
                source = path / f"{names.pop(0)}.py"
            else:
                source = next(path.glob("__init__.pyi"), path / "__init__.py")
            if names and not re.search(rf"\b{names[0]}\b", source.read_text(encoding="utf-8")):
                lost.append(f"{file.relative_to(ROOT)}: {name}")
    assert not lost


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?://|#)([^)#]+)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


# Figures that were measured.


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_measured_figures_are_those_of_the_tables(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    known = {f"{group}.{name}": one["value"] for group, of in FIGURES.items() for name, one in of.items()}
    marked = MARK.findall(text)
    assert [(name, value) for name, value in marked if known.get(name) != value] == []
    named = set(re.findall(r"\{\{ *figures\.([\w.]+) *\}\}", text))
    assert not named - set(known)
    if page.name != "results.md":  # which has the tables that others quote from
        unmarked = MARK.sub("", text)
        long = {value for value in known.values() if len(value) > 6} - {
            "50 of 50"
        }  # which the paper has, too
        typed = {value for value in long if re.search(rf"(?<!\d){re.escape(value)}", unmarked)}
        assert not typed, f"quote these from docs/figures.json: {typed}"


def test_figures_are_read_from_tables(tmp_path: Path) -> None:
    import pandas as pd

    figures = loaded(DOCS / "make" / "figures.py")
    tables = tmp_path / "tables"
    tables.mkdir()
    kinds = ["null", "null", "mechanism", "mechanism", "mechanism"]
    pd.DataFrame(
        {"kind": kinds, "false_alarm": [True, *4 * [False]],
         "oracle_delta_chi2": [0.0, 0.0, 500.0, 500.0, 5.0],
         "truth_in_class": [False, False, True, False, False]}
    ).to_parquet(tables / "score.parquet")  # fmt: skip
    assert figures.proof(tables) == {
        "cases": "5", "quiet": "2", "false_alarms": "1", "knowable": "2", "named": "1"
    }  # fmt: skip
    scores = pd.DataFrame(
        {"run": [0, 0], "method": ["regression", "refined"], "rrmse": [0.1, 3.25e-11],
         "certified": [False, True], "support_correct": pd.array([False, True], dtype="boolean"),
         "network_error": [0.2, 0.2]}
    )  # fmt: skip
    scores.to_parquet(tables / "rrmse.parquet")
    errors = {
        "run": [0, 0],
        "method": ["regression", "refined"],
        "trajectory": [0, 0],
        "error": [0.05, 4e-11],
    }
    pd.DataFrame(errors).to_parquet(tables / "prediction.parquet")
    terms = {"method": ["refined"], "component": ["U"], "estimate": [1.0], "exact": [1.0 + 1e-10]}
    pd.DataFrame(terms).to_parquet(tables / "coefficients.parquet")
    found = figures.archetype3d(tables)
    assert set(found) == set(FIGURES["archetype3d"])
    assert found["rrmse_mean"] == "3.2·10⁻¹¹" and found["regression_right_terms"] == "0 of 1"
    both = {"run": [0, 0], "method": ["refined", "randomised network"], "test": 2 * ["agreement"]}
    pd.DataFrame(both | {"passed": [True, False]}).to_parquet(tables / "certificates.parquet")
    of_u = {"region": 2 * ["U < 1.2e-08"], "covered": [1.0, 0.9871], "error": [0.001, 0.052]}
    errors = pd.DataFrame({"run": [0, 1], "source": 2 * ["networks"], **of_u})
    errors.to_parquet(tables / "landscape_errors.parquet")
    assert figures.resonator(tables) == {
        "runs": "1", "certified": "1 of 1", "agree": "1 of 1", "control_agrees": "0 of 1",
        "networks_all": "0.026 (0.052)", "networks_all_covered": "98.7 %",
    }  # fmt: skip


def test_every_figure_says_where_it_comes_from() -> None:
    assert not [
        one for of in FIGURES.values() for one in of.values() if set(one) != {"value", "command", "source"}
    ]


def test_the_readme_is_filled_in_by_the_script() -> None:
    figures = loaded(DOCS / "make" / "figures.py")
    assert figures.filled("so <!--=a.b-->old<!--/-->!", {"a.b": "new"}) == "so <!--=a.b-->new<!--/-->!"


def test_the_picture_of_the_packages_is_that_of_the_imports() -> None:
    drawn = loaded(DOCS / "make" / "architecture.py")
    assert drawn.PICTURE.read_text(encoding="utf-8") == drawn.picture(), "run docs/make/architecture.py"


# Examples and notebooks that were run.


def test_every_example_has_a_page_and_every_page_an_example() -> None:
    pages = {page.stem for page in (DOCS / "gallery").glob("*.md")} - {"index"}
    assert pages == {script.stem for script in EXAMPLES}
    assert len(EXAMPLES) >= 5


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_outputs_of_examples_belong_to_their_text(script: Path) -> None:
    outputs = DOCS / "gallery" / "outputs" / script.stem
    made = json.loads((outputs / "made-from.json").read_text(encoding="utf-8"))
    assert made["sha256"] == loaded(DOCS / "make" / "gallery.py").digest(script), "run `make docs-full`"
    assert {"output.txt", "figure.png", "table.csv"} <= {file.name for file in outputs.iterdir()}
    assert (outputs / "output.txt").read_text(encoding="utf-8").strip()


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_figures_in_the_text_of_examples_are_those_of_their_outputs(script: Path) -> None:
    outputs = DOCS / "gallery" / "outputs" / script.stem
    shown = "".join((outputs / name).read_text(encoding="utf-8") for name in ("output.txt", "table.csv"))
    shown += script.read_text(encoding="utf-8")
    text = (script.with_suffix(".md")).read_text(encoding="utf-8")
    said = re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.DOTALL)
    for number in re.findall(r"(?<![\w.⁻])\d+\.\d+|\d{3,}", said):
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?!\d)", shown), number


def test_every_image_of_the_examples_is_there() -> None:
    for page in (DOCS / "gallery").glob("*.md"):
        for image in re.findall(r"(outputs/[\w/.-]+\.png)", page.read_text(encoding="utf-8")):
            assert (DOCS / "gallery" / image).is_file(), image


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda script: script.stem)
def test_notebooks_belong_to_their_text_and_ran_through(script: Path) -> None:
    notebook = json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))
    module = loaded(DOCS / "make" / "notebooks.py")
    assert notebook["metadata"]["made_from"]["sha256"] == module.digest(script), "run `make docs-full`"
    assert len(notebook["cells"]) == len(module.cells(script.read_text(encoding="utf-8")))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert code and all(cell["execution_count"] for cell in code)
    assert not [out for cell in code for out in cell["outputs"] if out["output_type"] == "error"]


@pytest.mark.parametrize(
    "text",
    [*EXAMPLES, *NOTEBOOKS, *sorted((DOCS / "how-to").glob("*.md")), DOCS / "start-here.md"],
    ids=name_of,
)
def test_names_of_the_library_exist(text: Path) -> None:
    blocks = [text.read_text(encoding="utf-8")]
    if text.suffix == ".md":
        blocks = re.findall(r"```python\n(.*?)```", blocks[0], flags=re.DOTALL)
    for block in blocks:
        for name in re.findall(r"(?<![\w.\"/])siq\.([A-Za-z_]\w*)", block):
            module = importlib.util.find_spec(f"siq.{name}") if name.islower() else None
            assert name in siq.__all__ or module is not None, f"siq.{name}"


# The reference.


SCHEMAS = re.findall(
    r"```\{schema\} ([\w.]+):(\w+)",
    "\n".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md")),
)


@pytest.mark.parametrize(("module", "name"), SCHEMAS, ids=lambda one: one.rpartition(".")[2])
def test_every_key_has_a_meaning(module: str, name: str) -> None:
    schemas = pytest.importorskip("docutils") and loaded(DOCS / "extensions" / "schemas.py")
    schema = getattr(importlib.import_module(module), name)
    said = schemas.meanings(schema)
    assert not [key for key in schemas.fields(schema) if not said.get(key)]
    assert len(schemas.rows(schema)) == len(schemas.fields(schema))


def nested(schema: Any) -> set[str]:
    """Names of all classes of options that a schema leads to."""
    found = {schema.__name__}
    items = schema.model_fields if issubclass(schema, BaseModel) else schema.__pydantic_fields__
    for field in items.values():
        for part in re.findall(r"\b[A-Z]\w+", str(field.annotation)):
            found.add(part)
    return found


@pytest.mark.parametrize(
    "schema",
    [
        Study,
        RecordingsOptions,
        TrainingOptions,
        SystemCard,
        MismatchStudy,
        Mechanism,
        Form,
        MechanismParameter,
    ],
)
def test_the_reference_has_every_class_of_keys(schema: Any) -> None:
    shown = {name for _, name in SCHEMAS}
    asked = {
        name for name in nested(schema) if name.endswith(("Options", "Entry", "Mechanism", "Form", "Shape"))
    }
    assert asked - {"DiffusionEntry"} <= shown


def test_types_and_defaults_stand_as_a_study_writes_them() -> None:
    schemas = loaded(DOCS / "extensions" / "schemas.py")
    rows = {row[0]: row for row in schemas.rows(Study)}
    assert rows["`runs`"][1:3] == ("whole number ≥ 1, ≤ 10,000", "`1`")
    assert rows["`name`"][2] == "required"
    assert rows["`invariant`"][1] == "list of: number > 0"
    rows = {row[0]: row for row in schemas.rows(TrainingOptions, "training.")}
    assert rows["`training.widths`"][2] == "`[20, 20]`"
    assert rows["`training.precision`"][1:3] == ("`float32` or `float64`", "`float32`")
    assert yaml.safe_load(rows["`training.relative_dynamics`"][2].strip("`")) is True


def test_the_reference_says_how_many_mechanisms_there_are_by_listing_them() -> None:
    assert len(standard_dictionary()) >= 20
    assert "```{mechanisms}" in (DOCS / "reference" / "mechanisms.md").read_text(encoding="utf-8")


def test_the_page_of_mechanisms_says_all_that_their_file_does() -> None:
    pages = loaded(DOCS / "extensions" / "mechanism_pages.py")
    text = pages.page(standard_dictionary())
    anchors = set(re.findall(r":name: (\S+)", text))
    assert set(re.findall(r"\(#(\S+?)\)", text)) == anchors
    assert len(anchors) == len(standard_dictionary())
    for mechanism in standard_dictionary():
        said = "\n".join(pages.entry(mechanism))
        assert mechanism.sentence in said and mechanism.reference in said
        for form in mechanism.forms:
            for name, parameter in form.parameters.items():
                assert f"| `{name}` | `{parameter.unit}` | {parameter.sign} |" in said
            for formula in (*form.terms.values(), *form.replace.values(), *form.outputs.values()):
                assert pages.one_line(formula) in said


# Snakemake's conventions.


def test_the_catalogue_of_workflows_finds_what_it_expects() -> None:
    catalogue = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text(encoding="utf-8"))
    assert catalogue["usage"]["software-stack-deployment"]
    assert (ROOT / "config" / "README.md").is_file()
    assert (ROOT / "workflow" / "report" / "workflow.rst").is_file()


@pytest.mark.workflow
def test_the_workflow_begins_where_the_catalogue_looks_too(tmp_path: Path) -> None:
    # In a folder without results, where everything is left to do.
    where = ["-s", "workflow/Snakefile", "--directory", str(tmp_path)]
    command = [sys.executable, "-m", "snakemake", "-n", *where, "statistics"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "archetype3d" in run.stdout + run.stderr


def test_every_caption_is_used_and_every_used_caption_exists() -> None:
    rules = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "workflow").rglob("*.smk"))
    rules += (ROOT / "Snakefile").read_text(encoding="utf-8")
    captions = {file.name for file in (ROOT / "workflow" / "report").glob("*.rst")}
    assert captions == set(re.findall(r"\b(\w+\.rst)\b", rules))


def test_the_configuration_is_described() -> None:
    told = (ROOT / "config" / "README.md").read_text(encoding="utf-8")
    config = yaml.safe_load((ROOT / "config" / "config.yaml").read_text(encoding="utf-8"))
    assert not [key for key in config if f"`{key}`" not in told]
