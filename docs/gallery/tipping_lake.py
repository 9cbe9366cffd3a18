"""A shallow lake whose inflow of phosphorus rises: where does it tip, and when?

Its sediment releases phosphorus once there is much of it in the water. The lake is then clear or turbid,
and between two folds of the inflow it can be both. Weather pushes it out of the clear state before this ends.
"""

# %% The equation: phosphorus P, inflow per year, and weather of ε = 0.004
import matplotlib.pyplot as plt
import numpy as np
import sympy

import siq

P, inflow = sympy.symbols("P inflow", real=True)
lake = siq.Dynamics.of((P,), (inflow - P + P**8 / (1 + P**8),), domain=[(0, 2.5)], parameters={inflow: 0.3})
noise = 0.004

# %% The landscape against the inflow
found = siq.sweep(lake, "inflow", np.arange(0.30, 0.751, 0.03).round(2), noise=noise)
table = found.table[["value", "well", "attractor", "barrier", "mean_time", "weight"]]
print(found.bifurcations[["kind", "value", "position"]].to_string(index=False))

# %% The inflow rises from 0.30 by 0.0002 a year: has the lake turned turbid?
years = np.linspace(0, 2000, 401)
told = siq.probability_of_tipping(found, lambda t: 0.30 + 0.0002 * t, years, well=0, noise=noise)
print()
for share in (0.05, 0.5, 0.95):
    first = told[told["probability"] >= share].iloc[0]
    but = f", and no more than an order of magnitude: {first['note']}" if first["note"] else ""
    print(f"left with a probability of {share:.0%} after {first['time']:.0f} years{but}")

# %% The picture
figure, (above, below) = plt.subplots(2, 1, sharex=True, layout="constrained")
for well, rows in found.branches.groupby("well", sort=True):
    style = {-1: ("--", "grey", "unstable"), 0: ("-", "C0", "clear"), 1: ("-", "C1", "turbid")}[well]
    state = [float(text.strip("[]")) for text in rows["position"]]
    above.plot(rows["value"], state, style[0], color=style[1], label=style[2])
for fold in found.bifurcations["value"]:
    above.axvline(fold, color="grey", linewidth=0.6, linestyle=":")
    below.axvline(fold, color="grey", linewidth=0.6, linestyle=":")
above.set_ylabel("phosphorus P")
above.legend(frameon=False)
below.plot(
    told["value"], told["probability"].where(told["valid"]), color="C0", label="by the rates of the moment"
)
below.plot(
    told["value"], told["probability"].where(~told["valid"]), ":", color="C0", label="an order of magnitude"
)
below.set_xlabel("inflow (1/year), rising by 0.0002 a year")
below.set_ylabel("probability of\nhaving left the clear state")
below.legend(frameon=False)
plt.show()
