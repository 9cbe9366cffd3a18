"""A lake is measured while its inflow rises, and nobody knows its equation: how soon will it turn turbid?

The record alone tells, with an interval. Here it comes from the equation of the lake that tips, so that the
probability from the equation can be drawn beside it.
"""

# %% What a laboratory would have: phosphorus, ten times a year for 800 years, and no equation
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import sympy

import siq

step, fine, noise = 0.1, 5, 0.004
time = np.arange(0, 800, step)
kicks = np.sqrt(noise * step / fine) * np.random.default_rng(1).normal(size=(len(time), fine))


def inflow(years):
    return 0.54 + 0.06 / 800 * years


state, level = 0.548, []
for year, row in zip(time, kicks, strict=True):
    for kick in row:
        state += (inflow(year) - state + state**8 / (1 + state**8)) * step / fine + kick
    level.append(state)
record = pd.DataFrame({"t [years]": time, "P [g/m3]": level})

# %% The warning: barrier and mean time along the record, and the probability by the year 1200
warning = siq.early_warning(record, until=1200)
table = warning.probability.iloc[::10]
print(f"the barrier falls with a probability of {warning.falling:.2f}")
print(f"contradictions: {', '.join(warning.notes) or 'none'}")
for year in (900, 1000, 1100, 1200):
    said = warning.probability.iloc[(warning.probability["time"] - year).abs().argmin()]
    print(
        f"left by {year}: {said['probability']:.2f}, with 90 % from {said['lower']:.2f} to {said['upper']:.2f}"
    )

# %% The same from the equation, by the rates of the moment
P, rate = sympy.symbols("P rate", real=True)
lake = siq.Dynamics.of((P,), (rate - P + P**8 / (1 + P**8),), domain=[(0, 2.5)], parameters={rate: 0.54})
found = siq.sweep(lake, "rate", np.arange(0.54, 0.651, 0.01).round(2), noise=noise)
years = np.linspace(800, 1200, 41)
known = siq.probability_of_tipping(found, inflow, years, well=0, noise=noise)
ways = found.ways[found.ways["well"] == 0]
print(f"from the equation, left by 1000: {known['probability'].iloc[20]:.2f}")

# %% The picture
figure, (above, middle, below) = plt.subplots(3, 1, sharex=True, figsize=(6.4, 6.4), layout="constrained")
above.plot(time, level, linewidth=0.3)
above.set_ylabel("phosphorus P")
course = warning.course
middle.fill_between(
    course["time"], course["barrier_lower"], course["barrier_upper"].clip(upper=99), alpha=0.2
)
middle.plot(course["time"], course["barrier_over_noise"], label="from the record")
middle.plot((ways["value"] - 0.54) * 800 / 0.06, ways["barrier"] / noise, "k--", label="from the equation")
middle.set(ylim=(0, 25), ylabel="barrier over noise", xlim=(0, 1200))
middle.legend(frameon=False)
said = warning.probability
below.fill_between(said["time"], said["lower"], said["upper"], color="C3", alpha=0.2)
below.plot(said["time"], said["probability"], color="C3")
below.plot(years, known["probability"].where(known["valid"]), "k--")
below.set(ylim=(0, 1), ylabel="probability of\nhaving left", xlabel="year")
plt.show()
