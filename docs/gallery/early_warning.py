"""A lake is measured while its inflow rises, and nobody knows its equation: how soon will it turn turbid?

The record alone tells, with an interval. Here it comes from the equation of the lake that tips, so that the
probability from the equation can be drawn beside it.
"""

# %% What a laboratory would have: phosphorus, every day for 2000 weeks, and no equation
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import sympy

import siq

step, fine, noise = 0.1, 5, 0.004
time = np.arange(0, 2000, step)
kicks = np.sqrt(noise * step / fine) * np.random.default_rng(1).normal(size=(len(time), fine))


def inflow(week):
    return 0.565 + 0.035 / 2000 * week


state, level = 0.577, []
for week, row in zip(time, kicks, strict=True):
    for kick in row:
        state += (inflow(week) - state + state**8 / (1 + state**8)) * step / fine + kick
    level.append(state)
record = pd.DataFrame({"t [weeks]": time, "P [g/m3]": level})

# %% The warning: barrier and mean time along the record, and the probability by week 3000
warning = siq.early_warning(record, until=3000)
table = warning.probability.iloc[::10]
print(f"the barrier falls with a probability of {warning.falling:.2f}")
print(f"contradictions: {', '.join(warning.notes) or 'none'}")
for week in (2250, 2500, 2750, 3000):
    said = warning.probability.iloc[(warning.probability["time"] - week).abs().argmin()]
    print(
        f"left by week {week}: {said['probability']:.2f}, with 90 % from {said['lower']:.2f} to {said['upper']:.2f}"
    )

# %% The same from the equation, by the rates of the moment
P, rate = sympy.symbols("P rate", real=True)
lake = siq.Dynamics.of((P,), (rate - P + P**8 / (1 + P**8),), domain=[(0, 2.5)], parameters={rate: 0.565})
found = siq.sweep(lake, "rate", np.arange(0.56, 0.621, 0.005).round(3), noise=noise)
weeks = np.linspace(2000, 3000, 41)
known = siq.probability_of_tipping(found, inflow, weeks, well=0, noise=noise)
ways = found.ways[found.ways["well"] == 0]
print(f"from the equation, left by week 2500: {known['probability'].iloc[20]:.2f}")

# %% The picture
figure, (above, middle, below) = plt.subplots(3, 1, sharex=True, figsize=(6.4, 6.4), layout="constrained")
above.plot(time, level, linewidth=0.3)
above.set_ylabel("phosphorus P")
course = warning.course
middle.fill_between(
    course["time"], course["barrier_lower"], course["barrier_upper"].clip(upper=99), alpha=0.2
)
middle.plot(course["time"], course["barrier_over_noise"], label="from the record")
middle.plot((ways["value"] - 0.565) * 2000 / 0.035, ways["barrier"] / noise, "k--", label="from the equation")
middle.set(ylim=(0, 20), ylabel="barrier over noise", xlim=(0, 3000))
middle.legend(frameon=False)
said = warning.probability
below.fill_between(said["time"], said["lower"], said["upper"], color="C3", alpha=0.2)
below.plot(said["time"], said["probability"], color="C3")
below.plot(weeks, known["probability"].where(known["valid"]), "k--")
below.set(ylim=(0, 1), ylabel="probability of\nhaving left", xlabel="week")
plt.show()
