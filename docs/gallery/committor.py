"""Where transitions pass: the committor and the current of Maier and Stein's system at β = 10.

No potential describes it, the most probable way leaves the axis on both sides, and the law of Eyring and
Kramers has no prefactor. The committor and the times below need none: they hold for the noise as it is.
"""

# %% The equations, and noise of ε = 0.06, about a sixth of the barrier
import matplotlib.pyplot as plt
import numpy as np
import sympy

import siq

x, y = sympy.symbols("x y", real=True)
equations = (x - x**3 - 10 * x * y**2, -(1 + x**2) * y)
system = siq.Dynamics.of((x, y), equations, domain=[(-1.6, 1.6), (-0.9, 0.9)])
noise = 0.06
landscape = siq.Landscape.from_equations(system)
print(landscape.barriers().round(4).to_string(index=False))

# %% From the left state to the right one
flow = landscape.committor(0, 1, noise=noise)
made = landscape.dissipation(noise=noise)
print(f"\nMean time to the right state: {flow.mean_time:.4g}")
print(f"Entropy production: {made.value:.3f}, from {made.lower:.3f} to {made.upper:.3f}")

# %% The times, checked by a simulation that splits
table = landscape.verify_times(noise=noise)
print()
print(table[["attractor", "law", "operator", "check", "lower", "upper"]].round(1).to_string(index=False))

# %% The picture: current and committor over -ε ln p, which is U for weak noise
cells = flow.process
grid = np.meshgrid(np.linspace(-1.5, 1.5, 240), np.linspace(-0.8, 0.8, 160))
at = np.stack(grid)
height = cells.interpolated(-noise * np.log(cells.density))(at)
committor = cells.interpolated(flow.committor)(at)
current = np.stack([cells.interpolated(flow.current[:, k])(at) for k in (0, 1)])
strength = np.hypot(*current) / np.hypot(*current).max()
current[:, strength < 0.01] = np.nan

figure, axes = plt.subplots(layout="constrained")
filled = axes.contourf(*grid, height - height.min(), np.linspace(0, 0.6, 13), cmap="Blues_r", extend="max")
figure.colorbar(filled, label="−ε ln p")
axes.streamplot(*grid, *current, density=1.4, color="black", linewidth=2.5 * strength, arrowsize=0.8)
lines = axes.contour(*grid, committor, [0.1, 0.3, 0.5, 0.7, 0.9], colors="C1", linewidths=1.2)
axes.clabel(lines, fmt="%.1f", fontsize=9)
axes.plot(*landscape.transitions[0].uphill.T, color="C3", linewidth=1.5)  # the most probable way
axes.set_xlabel("x")
axes.set_ylabel("y")
plt.show()
