"""What a browser sees of a page: what overflows, what fails, what is asked of other machines, what axe finds.

A page is opened as a reader opens it, from a file, in Chromium. Nothing here knows what a page says.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

LOCAL = ("file:", "data:", "blob:", "about:")
"""Addresses that ask nothing of another machine."""

SERIOUS = ("serious", "critical")
"""The two upper grades of axe-core's four."""

SMALLEST_TEXT = 7.0
"""CSS pixels; below it no reader reads a label of a figure on a phone."""

# An element sticks out if its box ends right of the window, and no element around it scrolls or clips.
STICKING_OUT = """
() => {
  const width = document.documentElement.clientWidth, found = [];
  const contained = element => {
    for (let one = element; one && one !== document.body; one = one.parentElement) {
      const style = getComputedStyle(one);
      if (style.position === 'fixed' || (one !== element && style.overflowX !== 'visible')) return true;
    }
    return false;
  };
  for (const element of document.body.querySelectorAll('*')) {
    const box = element.getBoundingClientRect();
    if (box.width && box.right > width + 1 && !contained(element))
      found.push(`${element.tagName}.${element.className || ''} ends at ${Math.round(box.right)}`
        + ` of ${width}: ${(element.textContent || '').trim().slice(0, 60)}`);
  }
  if (document.documentElement.scrollWidth > width + 1)
    found.push(`the page is ${document.documentElement.scrollWidth} wide in a window of ${width}`);
  return found;
}
"""

# Text in a picture shrinks with it. A vector picture names the size of its letters, in its own units.
SMALL_LETTERS = """
() => {
  const found = [];
  for (const image of document.images) {
    if (!image.src.startsWith('data:image/svg') || !image.getBoundingClientRect().width) continue;
    const bytes = Uint8Array.from(atob(image.src.split(',')[1]), letter => letter.charCodeAt(0));
    const drawing = new DOMParser().parseFromString(new TextDecoder().decode(bytes), 'image/svg+xml');
    const width = Number((drawing.documentElement.getAttribute('viewBox') || '').split(' ')[2]);
    const scale = image.getBoundingClientRect().width / width;
    const sizes = [...drawing.querySelectorAll('[style*="font"]')]
      .map(one => /(\\d+(?:\\.\\d+)?)px/.exec(one.getAttribute('style')))
      .filter(Boolean).map(match => Number(match[1]) * scale);
    if (sizes.length) found.push([image.alt.slice(0, 80), Math.min(...sizes)]);
  }
  return found;
}
"""

AXE = """
async () => (await axe.run(document, {resultTypes: ['violations']})).violations.map(
  one => [one.impact, one.id, one.help, one.nodes.map(node => node.html.slice(0, 160))])
"""


@dataclass(frozen=True)
class Seen:
    """What was seen of a page.

    Attributes
    ----------
    errors
        What the console says, and scripts that failed.
    requests
        Addresses on other machines that the page asked for.
    overflowing
        Elements that end right of the window.
    faults
        Faults of accessibility, serious and critical ones.
    letters
        Smallest letters of each vector picture, in CSS pixels, by its alternative text.
    first_screen
        The text in the window before anyone scrolls.
    """

    errors: list[str]
    requests: list[str]
    overflowing: list[str]
    faults: list[str]
    letters: dict[str, float] = field(default_factory=dict)
    first_screen: str = ""


def look_at(browser: Any, file: Path, *, width: int, height: int = 900, picture: Path | None = None) -> Seen:
    """Open a page in a window and say what is wrong with it.

    Parameters
    ----------
    browser
        A browser of Playwright.
    file
        The page.
    width, height
        Of the window, in CSS pixels.
    picture
        Where to keep a picture of the first screen; None keeps none.

    Returns
    -------
    Seen
    """
    context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
    page = context.new_page()
    errors: list[str] = []
    requests: list[str] = []
    page.on("console", lambda said: errors.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda one: None if one.url.startswith(LOCAL) else requests.append(one.url))
    try:
        page.goto(file.resolve().as_uri(), wait_until="load")
        if picture is not None:
            picture.parent.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=picture)
        first = page.evaluate(_IN_WINDOW)
        page.evaluate("() => document.querySelectorAll('details').forEach(one => { one.open = true; })")
        overflowing = page.evaluate(STICKING_OUT)
        letters = dict(page.evaluate(SMALL_LETTERS))
        errors_of_page = list(errors)  # axe may warn of its own
        # Given to the browser, not put into the page, whose own rules admit no script from elsewhere.
        page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text("utf-8"))
        faults = [
            f"{impact}: {name}, {said} {json.dumps(where[:3])}"
            for impact, name, said, where in page.evaluate(AXE)
            if impact in SERIOUS
        ]
    finally:
        context.close()
    return Seen(errors_of_page, requests, overflowing, faults, letters, first)


_IN_WINDOW = """
() => {
  const said = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const range = document.createRange();
    range.selectNodeContents(walker.currentNode);
    const box = range.getBoundingClientRect();
    if (box.height && box.top >= 0 && box.bottom <= innerHeight) said.push(walker.currentNode.data.trim());
  }
  return said.filter(Boolean).join(' ');
}
"""
