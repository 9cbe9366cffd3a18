"""Draw the packages of `siq` and their imports: `docs/images/architecture.svg`.

An arrow leads from a package to one that it imports. Those that follow from others (a imports b, and b
imports c) are left out, and so are imports that are made when a function is called.
"""

from __future__ import annotations

import ast
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
# From the top down, as tests/test_imports.py has them from the ground up.
PACKAGES = ("report", "workflow", "diagnosis", "quasipotential", "networks", "inference", "systems",
            "data", "numerics", "validation")  # fmt: skip
ROW, BOX, LEFT, TEXT = 46, 34, 12, 168


def imports_of(package: str) -> set[str]:
    """The packages that a package imports when it is loaded."""
    found: set[str] = set()
    for file in sorted((ROOT / "siq" / package).rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("siq."):
                found.add(str(node.module).split(".")[1])
    return found & set(PACKAGES) - {package}


def reduced(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The graph without the arrows that follow from others."""

    def reached(start: str) -> set[str]:
        below = set(graph[start])
        for each in graph[start]:
            below |= reached(each)
        return below

    return {
        package: {each for each in below if not any(each in reached(other) for other in below - {each})}
        for package, below in graph.items()
    }


def topic(package: str) -> str:
    """The first sentence of a package's docstring."""
    text = (ROOT / "siq" / package / "__init__.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").split("\n")[0].rstrip(".")


def picture() -> str:
    """The picture as SVG."""
    packages = [each for each in PACKAGES if (ROOT / "siq" / each).is_dir()]
    arrows = reduced({package: imports_of(package) for package in packages})
    place = {package: index for index, package in enumerate(packages)}
    width, height = 980, len(packages) * ROW + 12
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"'
        f' height="{height}" font-family="sans-serif" font-size="13">',
        '<defs><marker id="head" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#0072B2"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for package, index in place.items():
        top = index * ROW + 8
        parts.append(
            f'<rect x="{LEFT}" y="{top}" width="{TEXT - LEFT - 28}" height="{BOX}" rx="5" fill="#DFECF4"'
            f' stroke="#1B4F8A"/><text x="{LEFT + 10}" y="{top + 22}" font-weight="bold">{package}</text>'
            f'<text x="{TEXT + 150}" y="{top + 22}">{escape(topic(package))}</text>'
        )
    for package, below in arrows.items():
        for target in sorted(below, key=place.__getitem__):
            start, end = place[package] * ROW + 8 + BOX / 2, place[target] * ROW + 8 + BOX / 2
            edge = TEXT - 28
            bend = edge + 18 + 22 * (abs(place[target] - place[package]) - 1)
            start += 7 if end > start else -7
            end += -7 if end > start else 7
            parts.append(
                f'<path d="M{edge} {start}C{bend} {start} {bend} {end} {edge} {end}" fill="none"'
                ' stroke="#0072B2" stroke-width="1.3" marker-end="url(#head)"/>'
            )
    return "\n".join([*parts, "</svg>\n"])


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
