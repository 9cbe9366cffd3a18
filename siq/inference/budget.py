"""Budgets: the work that a case may take, and an account of what it took.

Work is counted, not timed, so that the same case gives the same answer on every machine. The unit is what the
likelihood takes for one sample, one state and one column of its derivatives; evaluations of f between samples
count once for each substep. On one core of today it takes about 20 ns from 5,000 samples on, and less of
fewer. The clock is a safety net only: a machine may be slower than anybody thinks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Literal

from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics

DEFAULT_WORK = 1.5e10  # about five minutes of a core
DEFAULT_SECONDS = 1800.0  # by the clock; a core that is shared by several still ends by its work
OVERHEAD = 100  # samples whose work numpy's own for each evaluation is like
COMPILATION = 5e6  # what it takes to derive and compile the formulas of a model, in the same unit


class BudgetSpent(Exception):
    """The budget is spent; what was found so far is the answer, and is said to be partial."""


@dataclass(frozen=True)
class Account:
    """The work that a case was allowed and spent, and the seconds by the clock.

    It was stopped by what ran out before all was done; by nothing where nothing was left undone.
    """

    allowed: float
    spent: float
    seconds: float
    stopped_by: Literal["work", "clock"] | None = None

    @property
    def partial(self) -> bool:
        """Whether something was left undone."""
        return self.stopped_by is not None


UNLIMITED = Account(float("inf"), 0.0, 0.0)
"""Of work that is not counted."""


@dataclass
class Budget:
    """Work that is allowed, and work that was done."""

    #: Allowed: in the unit of this module, and by the clock
    work: float = float("inf")
    seconds: float = float("inf")
    #: Called with what is being done, in words, whenever something new begins
    tell: Callable[[str], None] | None = None
    #: Seconds of any clock that does not go back
    clock: Callable[[], float] = time.monotonic
    #: Work done so far; and what ran out before all was done, None as long as nothing had to be left
    spent: float = 0.0
    stopped_by: Literal["work", "clock"] | None = None
    _begun: float = field(default=0.0, init=False)
    _exempt: int = field(default=0, init=False)
    _limit: float = field(default=float("inf"), init=False)

    def __post_init__(self) -> None:
        self._begun = self.clock()

    @property
    def elapsed(self) -> float:
        """Seconds since it was made."""
        return self.clock() - self._begun

    def charge(self, work: float) -> None:
        """Count work that is about to be done.

        Raises
        ------
        BudgetSpent
            When nothing is left of what is allowed, unless what is done is exempt.
        """
        done = self.spent >= min(self.work, self._limit)
        if not self._exempt and (done or self.elapsed >= self.seconds):
            self.stopped_by = "work" if done else "clock"
            raise BudgetSpent("the budget of this case is spent")
        self.spent += work

    @contextmanager
    def exempt(self) -> Iterator[None]:
        """Work that is counted, and done in any case: without it there is no answer at all."""
        self._exempt += 1
        try:
            yield
        finally:
            self._exempt -= 1

    @contextmanager
    def _limited(self, limit: float) -> Iterator[None]:
        before, self._limit = self._limit, min(limit, self._limit)
        try:
            yield
        finally:
            self._limit = before

    def keeping(self, share: float) -> AbstractContextManager[None]:
        """Work that leaves a share of what is allowed to what comes after it."""
        return self._limited(self.work * (1 - share))

    def part(self, share: float) -> AbstractContextManager[None]:
        """Work that may take a share of what is left, and no more: one fit does not take all of it."""
        return self._limited(self.spent + share * max(min(self.work, self._limit) - self.spent, 0.0))

    def account(self) -> Account:
        """An account until now, as a verdict records it."""
        return Account(self.work, self.spent, self.elapsed, self.stopped_by)

    def says(self, what: str) -> None:
        """Tell what is being done, and how much was spent."""
        if self.tell is not None:
            share = f"; {self.spent / self.work:.0%} of the budget spent" if self.work < float("inf") else ""
            self.tell(f"{what}{share}")


def evaluation(model: Dynamics, data: Measurements, *, columns: int = 0) -> float:
    """The work of one evaluation of the likelihood: samples, times states, times columns of derivatives.

    There may be further columns than those of states and free parameters, such as those of candidates.
    """
    return (len(data.t) + OVERHEAD) * model.dimension * (1 + model.dimension + len(model.free) + columns)
