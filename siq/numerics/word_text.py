"""How are words put into a sentence?"""

from __future__ import annotations

from collections.abc import Sequence


def capital(text: str) -> str:
    """The same with its first letter in upper case."""
    return text[:1].upper() + text[1:]


def listed(names: Sequence[str], word: str = "or") -> str:
    """One name or several, with a word before the last: ``friction, a spring or a delay``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"
