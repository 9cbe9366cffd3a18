"""The next experiment, on concealed cases: is the right mechanism named once the proposed recording is there?

    python -m benchmarks.next_experiment 24 --seed 1

A case is an oscillator whose card lacks a damping or a stiffness, drawn at random. It swings twice, so little
and under so much noise that members of a family look alike. Where the diagnosis proposes a recording, it is
simulated from the truth, noise and all, added, and the diagnosis is asked again. SciPy integrates, and shares
nothing with siq.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

import numpy as np
import pandas as pd
import scipy.integrate
import sympy

import siq
from siq.diagnosis.diagnosis import Diagnosis
from siq.systems.dynamics import Parameter

SAMPLES, STEP = 150, 0.1
TRUTHS: dict[str, Callable[[float, float], float]] = {
    "linear damping": lambda x, v: -v,
    "quadratic drag": lambda x, v: -v * abs(v),
    "cubic damping": lambda x, v: -(v**3),
    "dry friction": lambda x, v: -float(np.tanh(v / 1e-3)),
    "quadratic stiffness": lambda x, v: -(x**2),
    "cubic stiffness": lambda x, v: -(x**3),
    "quintic stiffness": lambda x, v: -(x**5),
}
SIZES = {"dry friction": 0.05, "quintic stiffness": 0.2}


class Case:
    """A truth drawn at random, its card, and recordings of it."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.name = str(self.rng.choice(list(TRUTHS)))
        self.k = float(self.rng.uniform(3.0, 6.0))
        self.size = SIZES.get(self.name, 0.12) * float(self.rng.uniform(0.7, 1.4))
        self.noise = float(self.rng.uniform(0.02, 0.04))
        x, v, k = sympy.symbols("x v k", real=True)
        self.card = siq.Dynamics(
            ("x", "v"), (v, -k * x), siq.Diffusion.identity(2), outputs=(("x", x),),
            units=("m", "m/s"), time_unit="s", domain=np.array([[-3.0, 3.0], [-6.0, 6.0]]),
            parameters=(Parameter("k", self.k, "1/s**2", fixed=self.name.endswith("stiffness")),),
        )  # fmt: skip

    def recording(self, label: str, begin: tuple[float, float]) -> pd.DataFrame:
        """The truth from first states, with the sensor's noise."""
        t = STEP * np.arange(SAMPLES)
        force = TRUTHS[self.name]

        def rate(_: float, y: np.ndarray) -> list[float]:
            return [y[1], -self.k * y[0] + self.size * force(y[0], y[1])]

        solved = scipy.integrate.solve_ivp(
            rate, (0, t[-1]), begin, t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.02
        )
        x = solved.y[0] + self.noise * self.rng.normal(size=SAMPLES)
        return pd.DataFrame({"recording": label, "t": t, "x": x})


def answer_of(diagnosis: Diagnosis) -> tuple[str, set[str]]:
    """The first mechanism that is named, or best describes; and what is not told from it."""
    statement = diagnosis.statement
    by = statement.mechanisms or (statement.description.by if statement.description else ())
    alike = {each.name for part in by[:1] for each in part.rivals if each.standing == "same"}
    return (statement.mechanisms[0].name if statement.mechanisms else ""), alike


def main() -> None:
    """Ask so many cases, and print what became of each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", type=int)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    outcome: Counter[str] = Counter()
    for seed in range(options.seed, options.seed + options.cases):
        case = Case(seed)
        begins = case.rng.uniform(0.5, 0.9, size=3)
        table = pd.concat([case.recording(f"r{k}", (begin, 0.0)) for k, begin in enumerate(begins)])
        settings = siq.MismatchStudy(held_out=("r2",))
        first = siq.diagnose(case.card, table, settings=settings)
        plan = next((r for r in first.statement.remarks if r.code == "inference.next_experiment"), None)
        named, alike = answer_of(first)
        if plan is None:
            outcome["decided" if named == case.name else "decided wrongly" if named else "no name"] += 1
            print(seed, case.name, "| not undecided:", named or first.statement.outcome, flush=True)
            continue
        begin = plan.values["states"]
        further = case.recording("next", (begin["x"], begin["v"]))
        again = siq.diagnose(case.card, pd.concat([table, further]), settings=settings)
        now, still = answer_of(again)
        known = case.name in {now, *still}
        result = (
            "right"
            if now == case.name and not still
            else "in the set"
            if known
            else "wrong"
            if now
            else "lost"
        )
        outcome[result] += 1
        odds = f"odds {plan.values['odds']:.3g}"
        print(seed, case.name, "|", named or "no name", sorted(alike), "| begin", begin, odds, end=" | ")
        print(now or again.statement.outcome, sorted(still), "|", result, flush=True)
    undecided = sum(outcome[each] for each in ("right", "in the set", "wrong", "lost"))
    print(dict(outcome), f"right in {outcome['right']} of {undecided} that were undecided")


if __name__ == "__main__":
    main()
