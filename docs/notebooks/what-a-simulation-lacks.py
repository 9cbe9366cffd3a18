# %% [markdown]
# # What does my simulation lack?
#
# You have a simulation and recordings that it does not follow. Are only its parameters wrong, or is physics
# missing? Which, and where? This notebook hides an effect from a simulation and finds it again.

# %%
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import siq

# %% [markdown]
# ## 1. What was recorded
#
# A mass on a spring, released six times. The true spring hardens: there is a cubic part.

# %%
rng = np.random.default_rng(5)
times = np.arange(0, 10, 0.04)


def mass(t, state):
    x, v = state
    return [v, -9.0 * x - 0.2 * v - 0.8 * x**3]


frames = []
for number, start in enumerate([0.4, 0.8, 1.2, 1.6, 2.0, 2.4]):
    run = solve_ivp(mass, (0, 10), [start, 0.0], t_eval=times, rtol=1e-9, atol=1e-9)
    measured = run.y[0] + 0.005 * rng.normal(size=len(times))
    frames.append(pd.DataFrame({"recording": f"release-{number}", "t": times, "x": measured}))
recordings = pd.concat(frames)
recordings.head()

# %% [markdown]
# ## 2. What the simulation believes
#
# A system card holds the equations. Only the position is measured; the velocity is hidden, which is no problem.

# %%
Path("mass.yaml").write_text("""
name: mass
time_unit: s
states: {x: {unit: mm}, v: {unit: mm/s}}
parameters:
  k: {value: 9.5, unit: 1/s^2}
  c: {value: 0.25, unit: 1/s}
equations: {x: v, v: "-k*x - c*v"}
outputs: {x: x}
""")
simulation = siq.load_system("mass.yaml")

# %% [markdown]
# ## 3. The diagnosis

# %%
diagnosis = siq.diagnose(simulation, recordings)
diagnosis

# %% [markdown]
# The verdict names the mechanism, with a number and its error. *Held out* are recordings that took no part.

# %%
errors = diagnosis.held_out.errors
pd.Series(
    {
        "as it was": errors.before,
        "best parameters": errors.recalibrated,
        "with what was missing": errors.augmented,
        "noise": errors.noise_floor,
    }
).round(4)

# %% [markdown]
# ## 4. The simulation, mended
#
# The result is a system card again. Use it in your own program, or diagnose it once more.

# %%
print(diagnosis.to_card())

# %%
again = siq.diagnose(diagnosis.augmented, recordings)
again.statement.sentence
