"""A colloidal bead in an optical trap with two wells, released from many places.

The bead moves in a plane, pushed by the trap, by a force that circulates, and by the water's thermal noise.
Its recordings are simulated here, so that you can compare the answer with the truth; replace the first
part by `siq.read_recordings("your-file.csv")`.
"""

# %% The recordings: 200 releases, each followed for 4 seconds
import matplotlib.pyplot as plt
import numpy as np

import siq

rng = np.random.default_rng(1)
step, noise = 0.02, 0.08  # s; ε in µm²/s
bead = rng.uniform([-1.6, -1.2], [1.6, 1.2], size=(200, 2))
track = [bead]
for _ in range(4000):  # Euler–Maruyama with a twentieth of the step
    x, y = bead.T
    slope = np.stack([x**3 - x, y], axis=1)  # of Φ = x⁴/4 - x²/2 + y²/2
    swirl = np.stack([-0.8 * slope[:, 1], 0.8 * slope[:, 0]], axis=1)
    bead = bead + (swirl - slope) * step / 20 + np.sqrt(noise * step / 20) * rng.normal(size=bead.shape)
    track.append(bead)
samples = np.stack(track[::20], axis=1)
recordings = siq.Recordings.from_arrays(
    step * np.arange(201), samples, names=["x", "y"], units=["um", "um"], time_unit="s"
)

# %% The landscape
landscape = siq.Landscape.from_recordings(recordings)
print(landscape.report())

# %% How long the bead stays in each well
table = landscape.escape_times(noise=noise)[["start", "end", "mean_time"]]
print()
print(table.round(1).to_string(index=False))
print("\nExact: wells at x = -1 and 1 µm, barriers of U of 0.5 µm²/s")

# %% The picture
siq.plot_quasipotential(landscape, recordings=recordings)
plt.show()
