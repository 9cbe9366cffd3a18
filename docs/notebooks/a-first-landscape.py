# %% [markdown]
# # A first landscape
#
# You have recordings of a system that can rest in two states. You want to know how deep the two wells are,
# how long the system stays in each, and by which way it leaves. This notebook goes there in six steps. It takes
# about half a minute.

# %%
import numpy as np
import pandas as pd

import siq

# %% [markdown]
# ## 1. A table of recordings
#
# One row a sample, with the columns `recording`, `t` and your states. Units stand in brackets. Here a simulation
# writes the file: 150 releases of a particle in a double well that also feels a force that circulates, and noise.

# %%
rng = np.random.default_rng(7)
step, noise = 0.02, 0.08
x = rng.uniform([-1.6, -1.2], [1.6, 1.2], size=(150, 2))
tracks = [x]
for _ in range(3000):
    slope = np.stack([x[:, 0] ** 3 - x[:, 0], x[:, 1]], axis=1)
    swirl = 0.5 * np.stack([-slope[:, 1], slope[:, 0]], axis=1)
    x = x + (swirl - slope) * step / 20 + np.sqrt(noise * step / 20) * rng.normal(size=x.shape)
    tracks.append(x)
samples = np.stack(tracks[::20], axis=1)
table = pd.concat(
    pd.DataFrame(
        {"recording": f"r{k}", "t [s]": step * np.arange(151), "x [um]": one[:, 0], "y [um]": one[:, 1]}
    )
    for k, one in enumerate(samples)
)
table.to_csv("recordings.csv", index=False)
table.head()

# %% [markdown]
# ## 2. Read and look
#
# Reading checks everything: names, times, gaps, units.

# %%
recordings = siq.read_recordings("recordings.csv")
len(recordings.labels), recordings.names, recordings.units

# %% [markdown]
# ## 3. The landscape
#
# One call finds the equations behind the recordings, the quasipotential about each stable state, the saddle and
# the paths of least action, and tests all of it.

# %%
landscape = siq.Landscape.from_recordings(recordings)
landscape

# %% [markdown]
# The first line is the most important one. *Certified* means that eight tests could not refute the formulas;
# the stated error says how far V may be off. See [what a certificate means](../concepts/certificate.md).

# %%
axes = landscape.plot()
# %% [markdown]
# ## 4. Barriers and times
#
# A barrier of U divided by the noise intensity ε tells how rare an escape is.

# %%
barriers = landscape.barriers()
barriers["over noise"] = barriers["barrier"] / noise
barriers.round(3)

# %%
landscape.escape_times(noise=noise).round(0)

# %% [markdown]
# ## 5. The formula
#
# About each stable state V is a polynomial. You can take it to LaTeX, sympy, numpy, C or Julia.

# %%
print(landscape.potential(well=0).to_latex(digits=3))

# %% [markdown]
# ## 6. Check it against what is known
#
# The simulation has V = (x² - 1)²/4 + y²/2, so that both barriers of U = 2V are 0.5.

# %%
(barriers["barrier"] - 0.5) / barriers["standard_error"]

# %% [markdown]
# Both are within two standard errors. Your own recordings come with no such check. That is what the certificate
# is for.
