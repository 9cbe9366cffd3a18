"""A pendulum whose simulation lacks nothing.

The simulation knows gravity and a friction that grows with the speed, and that is all there is. Eight swings
were filmed; the camera errs by a milliradian. A good diagnosis has to say so, and by how much each mechanism
could still be there unseen.
"""

# %% What was recorded
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import siq

rng = np.random.default_rng(2)
times = np.arange(0, 12, 0.05)


def swing(t, state):
    angle, speed = state
    return [speed, -9.81 / 0.6 * np.sin(angle) - 0.08 * speed]


tables = []
for number, start in enumerate(np.linspace(0.3, 1.3, 8)):
    run = solve_ivp(swing, (0, 12), [start, 0.0], t_eval=times, rtol=1e-9, atol=1e-9)
    film = run.y[0] + 0.001 * rng.normal(size=len(times))
    tables.append(pd.DataFrame({"recording": f"swing-{number}", "t": times, "angle": film}))
recordings = pd.concat(tables)

# %% What the simulation believes: a system card
card = """
name: pendulum
time_unit: s
states: {angle: {unit: rad}, speed: {unit: rad/s}}
parameters:
  g: {value: 9.81, unit: m/s^2, fixed: true}
  L: {value: 0.6, unit: m}
  c: {value: 0.08, unit: 1/s}
equations:
  angle: speed
  speed: "-g/L*sin(angle) - c*speed"
outputs: {angle: angle}
"""
Path("pendulum.yaml").write_text(card)
pendulum = siq.load_system("pendulum.yaml")

# %% What is missing?
diagnosis = siq.diagnose(pendulum, recordings)
print(diagnosis.report())
error = diagnosis.held_out.errors
table = pd.DataFrame(
    {
        "simulation": ["as it was", "with new parameters", "with what was found", "noise of the camera"],
        "error on held-out swings": [error.before, error.recalibrated, error.augmented, error.noise_floor],
    }
)
print()
print(table.to_string(index=False, float_format="{:.4f}".format))

# %% The pictures: a swing that had no part in the fit, and what the simulations leave of it
siq.plot_diagnosis(diagnosis)
siq.plot_residuals(diagnosis)
plt.show()
