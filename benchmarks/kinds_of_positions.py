"""Are barriers right, and their errors, for particles and records of many kinds, seen by positions alone?

    python -m benchmarks.kinds_of_positions [--kinds NAME ...] [--seed 5]

One laboratory of each kind: weak and strong damping, a single record, coarse steps, a force that is no
polynomial, other units, two positions, and ring-downs without process noise. Barriers are compared with
``2γ ΔΦ``, and as ΔU/ε with ΔΦ/T where process noise are seen, in stated errors. One laboratory says little of
an error; `benchmarks.hidden_velocities` asks a hundred.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from siq.data.recordings import Recordings
from siq.quasipotential.landscape import Landscape, NoLandscape

Force = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Kind:
    """A damped particle of d positions, and how it is recorded.

    Attributes
    ----------
    force
        Of positions ``(n, d)``, the negative gradient of Φ.
    wells, saddle
        Where Φ has its two minima, and between them: shapes ``(2, d)`` and ``(d,)``, nearly.
    friction, temperature
        γ and T; without temperature the particle runs down from anywhere.
    records, samples, step
        How many, how long, and how far apart.
    sensor
        Its standard deviation.
    length, duration
        Units of position and time in which the record is written.
    """

    force: Force
    wells: tuple[tuple[float, ...], tuple[float, ...]]
    saddle: tuple[float, ...]
    friction: float
    temperature: float
    records: int
    samples: int
    step: float
    sensor: float
    length: float = 1.0
    duration: float = 1.0

    def heights(self) -> np.ndarray:
        """ΔΦ over both wells: the work along straight lines between the places where the force vanishes."""
        places = [self._rest(np.array(place)) for place in (*self.wells, self.saddle)]
        share = np.linspace(0.0, 1.0, 4001)[:, None]
        along = [places[2] + share * (place - places[2]) for place in places[:2]]
        return np.array(
            [
                np.trapezoid(self.force(line) @ (place - places[2]), share[:, 0])
                for line, place in zip(along, places[:2], strict=True)
            ]
        )

    def _rest(self, place: np.ndarray) -> np.ndarray:
        for _ in range(20):
            moved = 1e-6 * np.eye(len(place))
            slopes = (self.force(place + moved) - self.force(place - moved)).T / 2e-6
            place = place - np.linalg.solve(slopes, self.force(place[None])[0])
        return place

    def recorded(self, seed: int) -> Recordings:
        """Its record, by the splitting BAOAB (Leimkuhler and Matthews 2013)."""
        draw = np.random.default_rng(seed)
        within = max(round(self.step / 0.002), 1)
        step = self.step / within
        kept = np.exp(-self.friction * step)
        spread = np.sqrt(self.temperature * (1 - kept**2))
        x = np.array(self.wells)[np.arange(self.records) % 2]
        v = np.sqrt(self.temperature) * draw.standard_normal(x.shape)
        if not self.temperature:
            x, v = draw.uniform(-1.5, 1.5, (2, *x.shape))
        seen = np.empty((self.samples, *x.shape))
        for sample in seen:
            sample[:] = x
            for _ in range(within):
                v = v + step / 2 * self.force(x)
                x = x + step / 2 * v
                v = kept * v + spread * draw.standard_normal(x.shape)
                x = x + step / 2 * v
                v = v + step / 2 * self.force(x)
        seen += self.sensor * draw.standard_normal(seen.shape)
        names = ["x", "y"][: x.shape[1]]
        t = self.duration * self.step * np.arange(self.samples)
        return Recordings.from_arrays(t, self.length * seen.swapaxes(0, 1), names=names)


def double_well(x: np.ndarray) -> np.ndarray:
    """``x - x³``."""
    return x - x**3


def tilted(x: np.ndarray) -> np.ndarray:
    """``x - x³ + 0.1``."""
    return x - x**3 + 0.1


def traps(x: np.ndarray) -> np.ndarray:
    """Two Gaussian traps of unequal depth in a weak spring."""
    left, right = (
        depth * np.exp(-((x - at) ** 2) / 0.6) * (x - at) / 0.3 for depth, at in ((0.25, -1), (0.35, 1))
    )
    return -left - right - 0.1 * x


def coupled(x: np.ndarray) -> np.ndarray:
    """A double well in x, coupled to a spring in y."""
    return np.stack([x[:, 0] - x[:, 0] ** 3 - 0.3 * x[:, 1], -1.5 * x[:, 1] - 0.3 * x[:, 0]], axis=1)


SIDES = ((-1.0,), (1.0,))
KINDS = {
    "weak damping": Kind(double_well, SIDES, (0.0,), 0.1, 0.08, 4, 20_000, 0.02, 0.02),
    "damping 1": Kind(double_well, SIDES, (0.0,), 1.0, 0.08, 4, 20_000, 0.02, 0.02),
    "strong damping": Kind(double_well, SIDES, (0.0,), 3.0, 0.08, 4, 20_000, 0.02, 0.01),
    "one short record": Kind(double_well, SIDES, (0.0,), 0.5, 0.1, 1, 6_000, 0.05, 0.02),
    "one record in SI units": Kind(tilted, SIDES, (-0.1,), 0.5, 0.1, 1, 40_000, 0.03, 0.01, 2e-7, 3e-6),
    "coarse steps": Kind(double_well, SIDES, (0.0,), 0.3, 0.1, 2, 8_000, 0.2, 0.02),
    "Gaussian traps": Kind(traps, SIDES, (-0.1,), 0.5, 0.06, 4, 30_000, 0.03, 0.02),
    "two positions": Kind(coupled, ((-1.0, 0.2), (1.0, -0.2)), (0.0, 0.0), 0.6, 0.1, 3, 12_000, 0.04, 0.01),
    "ring-downs": Kind(double_well, SIDES, (0.0,), 0.3, 0.0, 12, 1_500, 0.02, 0.005),
}


def line(name: str, kind: Kind, seed: int) -> str:
    """A row of the table: truth, found, and how far off in stated errors."""
    recordings = kind.recorded(seed)
    began = time.process_time()
    try:
        landscape = Landscape.from_recordings(recordings, hidden_velocities=True)
    except NoLandscape as none:
        return f"| {name} | {none} |"
    seconds = time.process_time() - began
    rows = landscape.barriers().dropna(subset=["end"])
    certified = landscape.certificate is not None and landscape.certificate.certified
    truth = kind.heights() / kind.temperature if kind.temperature else 2 * kind.friction * kind.heights()
    cells = []
    order = np.argsort([landscape.attractors[int(start)].position[0] for start in rows["start"]])
    for height, (_, row) in zip(truth, rows.iloc[order].iterrows(), strict=True):
        found, error = float(row["barrier"]), float(row["standard_error"])
        if landscape.noise is not None:
            strength, own = landscape.noise.intensity, landscape.noise.standard_error
            found, error = found / strength, np.hypot(error, found / strength * own) / strength
        cells.append(f"{height:.4g} | {found:.4g} ± {error:.2g} | {(found - height) / error:+.1f}")
    return f"| {name} | {' | '.join(cells)} | {'yes' if certified else 'no'} | {seconds:.0f} s |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.kinds_of_positions")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seed", type=int, default=5)
    given = parser.parse_args()
    print("| record | left well | found | errors | right well | found | errors | certified | CPU |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in given.kinds:
        print(line(name, KINDS[name], given.seed), flush=True)


if __name__ == "__main__":
    main()
