"""A nanomechanical resonator with two vibrating states.

A driven, clamped beam can vibrate weakly or strongly at the same drive. P and Q are the two quadratures of
the vibration. Thermal noise makes the resonator jump between the two states; U tells how rarely. The equations
are those of Lin and Belardinelli's paper; here they make 400 ring-downs, and are then forgotten.
"""

# %% The equations, as a system card
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import siq

card = """
name: resonator
states: {P: {domain: [-0.02, 0.02]}, Q: {domain: [-0.02, 0.02]}}
parameters:
  w0: {value: 1}
  wF: {value: 1.0018}
  zeta: {value: 4.5e-4}
  alpha: {value: 33}
  F: {value: 1.4e-5}
equations:
  P: "(w0**2 - wF**2)/(2*wF)*Q - zeta*P + 3*alpha/(8*wF)*Q*(P**2 + Q**2)"
  Q: "-(w0**2 - wF**2)/(2*wF)*P - zeta*Q - 3*alpha/(8*wF)*P*(P**2 + Q**2) - F/(2*wF)"
"""
Path("resonator.yaml").write_text(card)
resonator = siq.load_system("resonator.yaml")

# %% The recordings: ring-downs from random vibrations
sampling = siq.SimulationOptions(trajectories=1000, pairs=100, pair_step=10.0, interval=100.0)
recordings = siq.simulate_snapshots(resonator, options=sampling, generator=np.random.default_rng(0))

# %% The landscape
landscape = siq.Landscape.from_recordings(recordings)
print(landscape.report())

# %% How long each state lasts, for a noise of 2·10⁻⁹
table = landscape.escape_times(noise=2e-9)
print()
print(table.to_string(index=False))
print("\nBy minimum action paths of the exact equations: 1.047e-08 and 8.16e-09")

# %% The picture
siq.plot_quasipotential(landscape, recordings=recordings)
plt.show()
