"""Loops as machine code, where numpy has no word for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def machine_code(function: Function) -> Function:
    """The function as machine code, kept on disk where there is a folder to write to."""
    try:
        return cast(Function, numba.njit(cache=True)(function))
    except RuntimeError:  # neither beside the module nor in the user's own folder
        return cast(Function, numba.njit(function))
