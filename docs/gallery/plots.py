"""Every plot of siq, on one landscape and one diagnosis.

Each function takes matplotlib axes, or makes new ones, and returns them: add to the picture what you like. The
landscape is that of a bead in two optical traps, the diagnosis that of a swing whose simulation lacks drag.
"""

# %% A landscape: 200 releases of a bead that also feels a force that circulates
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

import siq

rng = np.random.default_rng(1)
step, noise = 0.02, 0.08  # s; ε in µm²/s
bead = rng.uniform([-1.6, -1.2], [1.6, 1.2], size=(200, 2))
track = [bead]
for _ in range(4000):  # Euler–Maruyama with a twentieth of the step
    x, y = bead.T
    slope = np.stack([x**3 - x, y], axis=1)
    swirl = np.stack([-0.8 * slope[:, 1], 0.8 * slope[:, 0]], axis=1)
    bead = bead + (swirl - slope) * step / 20 + np.sqrt(noise * step / 20) * rng.normal(size=bead.shape)
    track.append(bead)
samples = np.stack(track[::20], axis=1)
recordings = siq.Recordings.from_arrays(
    step * np.arange(201), samples, names=["x", "y"], units=["um", "um"], time_unit="s"
)
landscape = siq.Landscape.from_recordings(recordings)

# %% U, with wells, saddle, paths and recorded points
siq.plot_quasipotential(landscape, recordings=recordings)

# %% Which recorded states belong to which well
siq.plot_wells(landscape, recordings=recordings)

# %% U along the likeliest way out
siq.plot_paths(landscape)

# %% How deep each well is, and where it joins the next
siq.plot_barriers(landscape)

# %% What f leaves of the recordings
siq.plot_residuals(landscape, recordings)

# %% A diagnosis: a pendulum was filmed six times, and its simulation lacks the drag of the air
times = np.arange(0, 12, 0.05)


def swing(t, state):
    angle, speed = state
    return [speed, -16 * np.sin(angle) - 0.08 * speed - 0.05 * abs(speed) * speed]


films = []
for number, start in enumerate(np.linspace(0.3, 1.3, 6)):
    run = solve_ivp(swing, (0, 12), [start, 0.0], t_eval=times, rtol=1e-9, atol=1e-9)
    film = run.y[0] + 0.001 * rng.normal(size=len(times))
    films.append(pd.DataFrame({"recording": f"swing-{number}", "t": times, "angle": film}))
card = """
name: pendulum
time_unit: s
states: {angle: {unit: rad}, speed: {unit: rad/s}}
parameters: {k: {value: 15.5, unit: 1/s^2}, c: {value: 0.1, unit: 1/s}}
equations: {angle: speed, speed: "-k*sin(angle) - c*speed"}
outputs: {angle: angle}
"""
Path("pendulum.yaml").write_text(card)
diagnosis = siq.diagnose(siq.load_system("pendulum.yaml"), pd.concat(films))

# %% A recording that was held out, before and after
siq.plot_diagnosis(diagnosis)
plt.show()

# %% The barriers, as a table
table = landscape.barriers()
print(table.to_string(index=False))
