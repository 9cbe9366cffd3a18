"""Leaving a limit cycle: a noisy oscillator beside a state of rest, and how long each lasts.

An unstable cycle parts both. Ways out of the oscillation cross it at any phase, at some more often than at
others; the law adds up all of them, and a simulation tells whether it is right.
"""

# %% Liénard's equation with noise on both states
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import sympy

import siq
from siq.systems.escapes import Neighbourhood, simulate_escapes

x, y = sympy.symbols("x y", real=True)
friction = sympy.Rational(2, 5) - x**2 + sympy.Rational(2, 5) * x**4
noises = [[1, 0], [0, sympy.Rational(1, 2)]]
system = siq.Dynamics.of((x, y), (y - x * friction, -x), diffusion=noises, domain=[(-2.2, 2.2)] * 2)
landscape = siq.Landscape.from_equations(system)
print(landscape.barriers().round(5).to_string(index=False))

# %% Mean times out of the oscillation by the law, and by direct simulation
rest, cycle = landscape.attractors
ways = {way.start: way for way in landscape.transitions}
core = Neighbourhood.about(system, rest.position, level=0.1 * ways[0].barrier)
rows = []
for height in (3, 4, 5, 6):
    noise = ways[1].barrier / height
    law = landscape.dwell_times(noise=noise).loc[1]
    found = simulate_escapes(
        system, cycle.points, [core], intensity=noise, longest=4 * law.mean_time,
        walkers=len(cycle.points), generator=np.random.default_rng(1),
    )  # fmt: skip
    rows.append((height, noise, law.mean_time, law.law_error, found.mean, found.standard_error))
columns = ["barrier_over_noise", "noise", "law", "law_error", "simulated", "standard_error"]
table = pd.DataFrame(rows, columns=columns)
print()
print(table.to_string(index=False, float_format="{:.4g}".format))

# %% The picture: both ways out, and times against 1/ε
figure, (left, right) = plt.subplots(1, 2, layout="constrained")
closed = {name: np.vstack([one.points, one.points[:1]]) for name, one in (
    ("stable cycle", cycle), ("unstable cycle", landscape.parting[0]))}  # fmt: skip
left.plot(*closed["stable cycle"].T, color="C0", label="stable cycle")
left.plot(*closed["unstable cycle"].T, color="C0", linestyle="--", linewidth=1, label="unstable cycle")
left.plot(*rest.position, "o", color="C2", label="rest")
left.plot(*ways[1].uphill.T, color="C3", linewidth=1, label="out of the cycle")
left.plot(*ways[0].uphill.T, color="C2", linewidth=1, label="out of rest")
left.set(xlabel="x", ylabel="y", aspect="equal")
figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8)
heights = np.linspace(2.5, 7, 40)
times = [ways[1].exit.mean_time(ways[1].barrier / one) for one in heights]
right.semilogy(heights, times, color="C3", label="law")
right.errorbar(
    table.barrier_over_noise, table.simulated, 2 * table.standard_error, fmt="ko", label="simulated"
)
right.set(xlabel="ΔU/ε", ylabel="mean time in the oscillation")
right.legend()
plt.show()
