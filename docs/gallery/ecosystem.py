"""Two algae that compete in a tank: which one wins depends on who was there first.

Each species grows, shades the other, and drifts in with the inflow. There are two stable states, one for each
winner. The recordings are 100 experiments under steady light, each begun with other amounts. How long a state
would last under changing weather follows from them, once you say how strong the weather is.
"""

# %% The recordings: amounts in g/l, every 0.1 days, over 15 days
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import siq


def growth(t, algae):
    a, b = algae
    return [0.03 + a * (1 - a - 1.8 * b), 0.03 + 0.9 * b * (1 - b - 1.9 * a)]


rng = np.random.default_rng(3)
days = np.linspace(0, 15, 151)
samples = np.stack([
    solve_ivp(growth, (0, 15), start, t_eval=days, rtol=1e-10, atol=1e-12).y.T
    for start in rng.uniform(0.0, 1.3, size=(100, 2))
])  # fmt: skip
recordings = siq.Recordings.from_arrays(
    days, samples, names=["a", "b"], units=["g/l", "g/l"], time_unit="day"
)

# %% The landscape
landscape = siq.Landscape.from_recordings(recordings)
print(landscape.report())

# %% How long each species holds the tank, in days, under weather of ε = 0.004 (g/l)²/day
table = landscape.escape_times(noise=0.004)[["start", "end", "mean_time"]]
print()
print(table.round(0).to_string(index=False))

# %% The picture
siq.plot_quasipotential(landscape, recordings=recordings)
plt.show()
