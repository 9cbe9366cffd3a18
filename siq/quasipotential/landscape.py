"""The landscape of a vector field: attractors, wells, transitions, and U = 2V over all of them.

A `Landscape` is data with answers. `siq.quasipotential.landscape_assembly` finds it, and
`siq.quasipotential.landscape_files` stores it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import Recordings
from siq.data.states import RecordStates
from siq.errors import Fault, NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.quasipotential.certificate import Certificate
from siq.quasipotential.fokker_planck import CellProcess, Dissipation, ReactiveFlow, Rotation, cores_about
from siq.quasipotential.global_formula import GlobalQuasipotential
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.power_series import CycleFormula
from siq.quasipotential.rates import EscapeRate, NoiseStrength, mean_residence_time
from siq.quasipotential.transitions import Transition, missing_diffusion, progress_along
from siq.quasipotential.wells import Well
from siq.remarks import Remark, sentence
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium
from siq.systems.escapes import Neighbourhood, split_escapes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from siq.quasipotential.landscape_assembly import EquationSettings
    from siq.workflow.pipeline import PipelineSettings

DRAWS = 40  # of an estimated f: the ends of a 95 % interval are then two of them
MARGIN = 0.15  # of the states that were seen, on each side: there the density ends


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LandscapeOptions:
    """With what formulas are compared, and what is said of transitions."""

    #: U below which formulas are compared with the references, where there is a card; by default 1.1 of the
    #: highest saddle
    compare_below: Annotated[float, Field(gt=0)] | None = None
    #: Noise intensities ε, of √ε dW, for which mean escape times are given and held against a simulation
    #: where there is a card
    noise_intensities: tuple[Annotated[float, Field(gt=0)], ...] = ()
    #: Whether these times are checked by a simulation that splits (`siq.Landscape.verify_times`): seconds a
    #: well where ΔU/ε is 5, some ten where it is 20
    verify_times: bool = False


class NoLandscape(NumericalFailure):
    """Recordings that no landscape was found of; what they show by themselves is kept.

    The message says why, what would make it an answer, and what is known nevertheless.

    Parameters
    ----------
    reason
        Why there is none and what to do about it, without a full stop.
    states
        The two states between which the recordings hop by themselves; None where nothing is known of that.
    dynamics
        f and D, where these were identified and only their landscape is missing.
    """

    def __init__(
        self, reason: str, states: RecordStates | None = None, dynamics: Dynamics | None = None
    ) -> None:
        super().__init__(" ".join(sentences_without_landscape(reason, states)))
        self.reason, self.states, self.dynamics = reason, states, dynamics
        self.rung = Certificate.rung(None, states)


def sentences_without_landscape(reason: str, states: RecordStates | None) -> list[str]:
    """What is known without a landscape, on which rung that is, and why there is none."""
    rung = Certificate.rung(None, states)
    told = rung == 3 and states is not None and states.limit is not None  # why, without any f
    values = {"rung": rung, "reason": "" if told else reason}
    missing = sentence(Remark("quasipotential.without_landscape", values))
    seen = "" if states is None else states.sentence() or sentence(states.rest())
    return [seen, missing] if seen else [missing]


@dataclass(frozen=True, eq=False, repr=False)
class Landscape:
    """What is known of a landscape: wells, the ways out of them, and U = 2V over all of them.

    Main attributes
    ---------------
    attractors
        Those that recorded states lead to, in the order of everything below. Limit cycles follow after
        points; of equations alone.
    wells
        V about each attractor, None where none was found.
    transitions
        Every way out of every well.
    certificate
        Whether the wells may be believed; None where no test was made.
    dynamics
        f and D.

    Other attributes
    ----------------
    equilibria
        All that were found in the recorded region.
    basins
        Share of the evenly spread recorded states from which f leads to each attractor, shape ``(k,)``.
    heights
        U at the attractors, shape ``(k,)``; NaN where transitions do not connect them.
    remarks
        What could not be done.
    position_errors
        Standard error of each attractor's position, shape ``(k, d)``; None where not known.
    noise
        Strength of the noise that drives the system, None where it is unknown.
    field_estimate
        The identified f with its uncertainty; None where f is given, and after reading from a file.
    visits
        Mean residence times as counted on the recordings and as f and D say; empty where this was not
        compared.
    recorded_states
        The states between which the recordings hop by themselves, without any formula; None where nothing is
        known of them.
    given
        Whether f was given as equations: the region is their domain then, and nothing of f is uncertain.
    parting
        Unstable cycles, which part wells.
    checked_times
        What `verify_times` said, with a column ``noise``; None where it was not asked for.
    """

    dynamics: Dynamics
    equilibria: tuple[Equilibrium, ...]
    attractors: tuple[Equilibrium | Cycle, ...]
    basins: np.ndarray
    wells: tuple[Well | None, ...]
    transitions: tuple[Transition, ...]
    heights: np.ndarray
    remarks: tuple[Remark, ...] = ()
    certificate: Certificate | None = None
    position_errors: np.ndarray | None = None
    noise: NoiseStrength | None = None
    field_estimate: FieldEstimate | None = None
    visits: tuple[VisitTest, ...] = ()
    recorded_states: RecordStates | None = None
    given: bool = False
    parting: tuple[Cycle, ...] = ()
    checked_times: pd.DataFrame | None = None

    @classmethod
    def from_recordings(
        cls, recordings: str | Path | Recordings | pd.DataFrame, settings: PipelineSettings | None = None, *,
        hidden_velocities: bool | Literal["auto"] = "auto",
    ) -> Landscape:  # fmt: skip
        r"""The landscape that recordings show: f identified, V refined and certified, transitions found.

        Parameters
        ----------
        recordings
            Trajectories: a file, a folder of files, `siq.Recordings`, or a table as
            `siq.Recordings.from_frame` takes it.
        settings
            Of all steps; see `siq.workflow.pipeline.PipelineSettings`. By default V comes from f alone,
            without networks.
        hidden_velocities
            Whether the recorded states are positions whose velocities were not recorded; by default as
            ``identification.hidden_velocities`` of the settings says.

        Raises
        ------
        InputError
            For the first thing that cannot be read.
        NoLandscape
            When f cannot be identified, or it has no landscape. It says why, and what would make it an
            answer; its `states` are what the recordings show by themselves.

        Examples
        --------
        >>> from siq.data.recordings import Recordings
        >>> t, starts = np.linspace(0, 3, 61), np.random.default_rng(0).uniform(-1.5, 1.5, (2, 60, 1))
        >>> x = starts[0] / np.sqrt(starts[0] ** 2 + (1 - starts[0] ** 2) * np.exp(-2 * t))  # dx/dt = x - x³
        >>> y = starts[1] * np.exp(-t)  # dy/dt = -y
        >>> recordings = Recordings.from_arrays(t, np.stack([x, y], axis=2), names=["x", "y"])
        >>> landscape = Landscape.from_recordings(recordings)
        >>> landscape.barriers().round(3)[["start", "end", "barrier"]]
           start  end  barrier
        0      0    1      0.5
        1      1    0      0.5
        >>> print(landscape.potential(well=1).to_latex(digits=3))
        \begin{aligned}
        \Delta_{x} &= x - 1.0 \\
        V &= 0.25 \Delta_{x}^{4} + 1.0 \Delta_{x}^{3} + 1.0 \Delta_{x}^{2} + 0.5 y^{2}
        \end{aligned}
        """
        from siq.workflow.pipeline import landscape_from_recordings

        return landscape_from_recordings(recordings, settings, hidden_velocities=hidden_velocities)

    @classmethod
    def from_equations(
        cls, system: str | Path | Dynamics, settings: EquationSettings | None = None
    ) -> Landscape:
        """The landscape of given equations: no recordings, no sampling, no training.

        Parameters
        ----------
        system
            A system card, or `siq.Dynamics` with its domain.
        settings
            Of all steps; see `siq.quasipotential.landscape_assembly.EquationSettings`.

        Raises
        ------
        InputError
            For a card that cannot be read, or a system that has no quasipotential: driven, without a domain,
            or with a state that noise does not even reach by way of others.
        NoLandscape
            When there is no stable equilibrium in the domain. It says why.

        Examples
        --------
        >>> import sympy
        >>> x, y = sympy.symbols("x y", real=True)
        >>> wells = Dynamics.of((x, y), (x - x**3, -y), domain=[(-2, 2), (-1, 1)])
        >>> landscape = Landscape.from_equations(wells)
        >>> landscape.barriers().round(3)[["start", "end", "barrier"]]
           start  end  barrier
        0      0    1      0.5
        1      1    0      0.5
        >>> landscape.certificate.certified
        True
        """
        from siq.quasipotential.landscape_assembly import landscape_from_equations

        return landscape_from_equations(system, settings)

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks as sentences."""
        return tuple(map(sentence, self.remarks))

    @property
    def rung(self) -> int:
        """The rung of the ladder of answers, see `siq.quasipotential.certificate.Certificate.rung`."""
        hidden = self.field_estimate is not None and self.field_estimate.has_hidden_state
        return Certificate.rung(self.certificate, self.recorded_states, hidden=hidden)

    @property
    def cycles(self) -> tuple[Cycle, ...]:
        """The stable limit cycles among the attractors, with period and Floquet multipliers."""
        return tuple(one for one in self.attractors if isinstance(one, Cycle))

    def in_units(self, units: Sequence[str], *, time: str = "1") -> Landscape:
        """The landscape with the units of its states and of time named; nothing is converted."""
        dynamics = replace(self.dynamics, units=tuple(units), time_unit=time)
        wells = tuple(None if well is None else replace(well, dynamics=dynamics) for well in self.wells)
        return replace(self, dynamics=dynamics, wells=wells)

    @cached_property
    def global_quasipotential(self) -> GlobalQuasipotential | None:
        """U over all wells, None where a well has no formula or no height."""
        known = tuple(one for one in self.wells if one is not None)
        if not known or len(known) < len(self.wells) or not np.isfinite(self.heights).all():
            return None
        return GlobalQuasipotential(known, self.heights)

    def quasipotential(self, points: np.ndarray) -> np.ndarray:
        """U at points ``(n, d)``, zero at the deepest attractor: shape ``(n,)``, NaN where not known."""
        x = np.asarray(points, dtype=float)
        if x.ndim != 2 or x.shape[1] != self.dynamics.dimension:
            raise Fault(f"the points have the shape {x.shape}", f"give (n, {self.dynamics.dimension})")
        whole = self.global_quasipotential
        return np.full(len(x), np.nan) if whole is None else whole(x)

    def potential(self, well: int = 0) -> Well:
        """V about an attractor, zero there, as a formula with where it holds; U is 2V.

        Where no formula was found, it is a `NumericalFailure` that says why.
        """
        found = self.wells[well]
        if found is None:
            raise NumericalFailure(f"no formula was found about attractor {well}: {'; '.join(self.notes)}")
        return found

    def about_cycle(self, attractor: int, *, degree: int = 10, tolerance: float = 0.01) -> CycleFormula:
        """V about a limit cycle of two states as a formula in phase and distance, with its residual.

        Parameters
        ----------
        attractor
            A cycle by its place in `attractors`.
        degree, tolerance
            Highest power of the distance, and the relative residual up to which the formula is to hold.

        Raises
        ------
        NumericalFailure
            Where the attractor is a point, or there are more than two states.
        """
        cycle = self.attractors[attractor]
        if not isinstance(cycle, Cycle):
            raise NumericalFailure(f"attractor {attractor} is a point: ask for 'potential'")
        return CycleFormula.of(self.dynamics, cycle, degree=degree, tolerance=tolerance)

    def barriers(self) -> pd.DataFrame:
        """ΔU on every way out of every well, one row each.

        Returns
        -------
        pandas.DataFrame
            Columns ``start end barrier standard_error``: attractors by their place in `attractors`, the end
            missing where the way leads out of the recorded region; ΔU in the unit of ε with its standard
            error, NaN where it is not known, which is that of every page (`Transition.error`). Of every
            periodic state follows a column ``turns_NAME``: by how many periods the end is further on.
        """
        types: dict[str, Any] = {"start": int, "end": "Int64", "barrier": float, "standard_error": float}
        rows = [[way.start, way.end, way.barrier, way.error] for way in self.transitions]
        return self._with_turns(pd.DataFrame(rows, columns=list(types)).astype(types))

    def _with_turns(self, table: pd.DataFrame) -> pd.DataFrame:
        """A table of transitions with columns that tell the turns of periodic states."""
        for place, name in enumerate(self.dynamics.states):
            if name in self.dynamics.periodic:
                turns = [way.turns[place] if way.turns else None for way in self.transitions]
                table[f"turns_{name}"] = pd.array(turns, dtype="Int64")
        return table

    def dwell_times(self, *, noise: float | None = None) -> pd.DataFrame:
        """Mean residence times, one row for every attractor.

        Parameters
        ----------
        noise
            ε, in the unit of U; by default as the recordings show it.

        Returns
        -------
        pandas.DataFrame
            Columns ``attractor mean_time data_error law_error``: the time, NaN where it is not known, its
            relative standard error from the uncertainty of f and of the noise, and the relative error of the
            law itself (`siq.quasipotential.rates`).

        Raises
        ------
        ValueError
            When no noise is known.
        """
        strength = self._strength(noise)
        times = [mean_residence_time(self.exits(index), strength) for index in range(len(self.attractors))]
        rows = [
            (index, *((np.nan,) * 3 if one is None else (one.value, one.data_error, one.law_error)))
            for index, one in enumerate(times)
        ]
        return pd.DataFrame(rows, columns=["attractor", "mean_time", "data_error", "law_error"])

    def _strength(self, noise: float | None) -> NoiseStrength:
        """The noise that was given, or else that of the recordings."""
        strength = self.noise if noise is None else NoiseStrength(noise)
        if strength is None:
            raise Fault("no noise is known, and how long a well lasts follows from it", "give 'noise'")
        return strength

    def exits(self, well: int) -> list[EscapeRate]:
        """The laws of all ways out of a well, with their errors."""
        return [way.exit for way in self.transitions if way.start == well]

    def committor(self, start: int, end: int, *, noise: float | None = None) -> ReactiveFlow:
        """The probability of reaching one attractor before another, and what goes between them.

        Parameters
        ----------
        start, end
            Attractors by their place in `attractors`, in one to three states.
        noise
            ε, in the unit of U; by default as the recordings show it.

        Returns
        -------
        ReactiveFlow
            Committor, reactive density, current and rate on cells (`siq.quasipotential.fokker_planck`), for
            this ε and not for small ones only.

        Raises
        ------
        NumericalFailure
            When cells are no way to it: more than three states, noise on some states only, or wells that are
            narrower than cells.
        """
        strength = self._strength(noise).intensity
        cores = self._cores(strength)
        return CellProcess(self.dynamics, strength, self._box).between(cores[start], [cores[end]])

    def dissipation(self, *, noise: float | None = None, seed: int = 0) -> Dissipation:
        """The production of entropy in the stationary state, and where it is made.

        Parameters
        ----------
        noise
            ε, in the unit of U; by default as the recordings show it.
        seed
            Decides the draws of an estimated f.

        Returns
        -------
        Dissipation
            ``Σ̇ = (2/ε) ∫ u·D⁻¹u π dx`` (`siq.quasipotential.fokker_planck`) per unit of time with its 95 %
            interval. Of an estimated f it begins at zero where the record does not tell it from one with
            detailed balance. Σ̇ is then at most what stands above, as far as the terms of f go; not a number
            stands there where none of these can make a current.

        Raises
        ------
        NumericalFailure
            As for `committor`.
        """
        strength = self._strength(noise)
        draws = self._draws(strength, np.random.default_rng(seed))
        return Dissipation.of(self.dynamics, strength.intensity, self._box, draws=draws)

    def _draws(self, strength: NoiseStrength, generator: np.random.Generator) -> list[tuple[Dynamics, float]]:
        """f and ε drawn from the distribution of their estimates; none where f is given."""
        found, share = self.field_estimate, strength.standard_error / strength.intensity
        if found is None:
            return []
        return [
            (found.drawn(generator), strength.intensity * float(np.exp(share * generator.standard_normal())))
            for _ in range(DRAWS)
        ]

    def rotation(self, state: str | None = None, *, noise: float | None = None, seed: int = 0) -> Rotation:
        """The mean velocity and the effective diffusion of a periodic state, such as an angle.

        Parameters
        ----------
        state
            Its name; may be left out where there is but one.
        noise
            ε, in the unit of U; by default as the recordings show it.
        seed
            Decides the draws of an estimated f, of which the errors come.

        Returns
        -------
        Rotation
            See `siq.quasipotential.fokker_planck.Rotation.of`, which needs no landscape and no wells.
        """
        strength = self._strength(noise)
        draws = self._draws(strength, np.random.default_rng(seed))
        return Rotation.of(self.dynamics, strength.intensity, state, box=self._box, draws=draws)

    def verify_times(self, *, noise: float | None = None, seed: int = 0) -> pd.DataFrame:
        """Mean residence times by the law, by the operator, and checked by a simulation that splits.

        Parameters
        ----------
        noise
            ε, in the unit of U; by default as the recordings show it.
        seed
            Decides the noise of the simulation.

        Returns
        -------
        pandas.DataFrame
            One row for every attractor, times from it until the neighbourhood of another one is reached:
            ``attractor``; ``law`` and its relative ``law_error``, as `dwell_times` has them; ``operator``,
            which holds for any ε, and its relative ``operator_error``, NaN beyond three states and where
            wells are narrower than cells; ``check`` with its ``relative_error`` and its 95 % interval ``lower
            upper``. The check assumes neither (`siq.systems.escapes.split_escapes`), and takes seconds a
            well at ΔU/ε = 5, ten at 20. It has no rows where there is but one attractor; of periodic states
            that a turn further on is another one.

        Raises
        ------
        ValueError
            When no noise is known.
        NumericalFailure
            When the simulation fails.
        """
        intensity, rows = self._strength(noise).intensity, []
        cores, laws = self._cores(intensity), self.dwell_times(noise=noise)
        system, box, shifts = self.dynamics, self._box, self.dynamics.shifts
        if system.periodic:
            system, box = system.unwrapped(), box + np.stack([-system.periods, system.periods], axis=1)
        for index, core in enumerate(cores):
            others = [
                one.moved(shift)
                for one, shift in itertools.product(cores, shifts)
                if one is not core or shift.any()
            ]
            if not others:
                break
            operator = (np.nan, np.nan)
            try:
                process = CellProcess(system, intensity, box)
                progress = process.between(core, others).progress
            except (NumericalFailure, np.linalg.LinAlgError, RuntimeError):
                mine = [way for way in self.transitions if way.start == index]
                progress = progress_along(mine, self.attractors[index], self.dynamics, intensity)
            else:
                with suppress(NumericalFailure, np.linalg.LinAlgError, RuntimeError):
                    operator = process.mean_time(core, others)
            check = split_escapes(
                self.dynamics, core, others, intensity=intensity, progress=progress,
                generator=np.random.default_rng([seed, index]),
            )  # fmt: skip
            rows.append((index, *laws.loc[index, ["mean_time", "law_error"]], *operator, *check[:4]))
        columns = "attractor law law_error operator operator_error check relative_error lower upper"
        return pd.DataFrame(rows, columns=columns.split())

    def with_checked_times(self, options: LandscapeOptions | None, *, seed: int = 0) -> Landscape:
        """The landscape with its times checked, where the options ask for that; a remark where that fails.

        ε are those of the options, or else as the recordings show it.
        """
        if options is None or not options.verify_times:
            return self
        known = () if self.noise is None else (self.noise.intensity,)
        tables, remarks = [], list(self.remarks)
        for intensity in options.noise_intensities or known:
            try:
                tables.append(self.verify_times(noise=intensity, seed=seed).assign(noise=intensity))
            except (NumericalFailure, np.linalg.LinAlgError) as error:
                values = {"noise": intensity, "reason": str(error)}
                remarks.append(Remark("quasipotential.times_not_checked", values))
        checked = pd.concat(tables, ignore_index=True) if tables else None
        return replace(self, checked_times=checked, remarks=tuple(remarks))

    def _cores(self, intensity: float) -> list[Neighbourhood]:
        """The core of each attractor."""
        count = len(self.attractors)
        saddles = [[way.saddle for way in self.transitions if way.start == k] for k in range(count)]
        return cores_about(self.dynamics, self.attractors, saddles, intensity)

    @property
    def _box(self) -> np.ndarray:
        """Where the density is: the domain, or the states that V was found from and their surroundings."""
        limits = self.dynamics.limits
        if np.isfinite(limits).all():
            return limits
        turning = self.dynamics.periods > 0
        places = [*(one.position[None] for one in self.attractors), *(way.uphill for way in self.transitions)]
        points = np.concatenate([*places, *(one.points for one in self.wells if one is not None)])
        low, high = points.min(axis=0), points.max(axis=0)
        box = np.stack([low - MARGIN * (high - low), high + MARGIN * (high - low)], axis=1)
        return np.where(turning[:, None], limits, box)

    def escape_times(self, *, noise: float | None = None) -> pd.DataFrame:
        """Mean times until noise has led from each attractor to the next, one row for every way out.

        Parameters
        ----------
        noise
            ε of ``dx = f dt + √ε σ dW``, in the unit of U; by default as the recordings show it.

        Returns
        -------
        pandas.DataFrame
            Columns ``start end mean_time note``: the mean time by the law of Eyring and Kramers with its
            prefactor (`siq.quasipotential.rates`), NaN with a note that says why where the law does not hold.
            Turns of periodic states stand as in `barriers`.

        Raises
        ------
        ValueError
            When no noise is known; and when D is the unit matrix although a state is but the derivative of
            another: no noise drives ``dx/dt = v``, and the times follow from D.
        """
        strength = self._strength(noise).intensity
        if (missing := missing_diffusion(self.dynamics)) is not None:
            raise ValueError(missing)
        rows = []
        for way in self.transitions:
            time, note = np.nan, "; ".join(way.notes)
            try:
                time = np.nan if way.rate is None else way.rate.mean_time(strength)
            except NumericalFailure as error:
                note = str(error)
            rows.append((way.start, way.end, time, note))
        table = pd.DataFrame(rows, columns=["start", "end", "mean_time", "note"])
        return self._with_turns(table.astype({"start": int, "end": "Int64", "mean_time": float}))

    def compare_with(self, equations: Landscape, *, noise: float | None = None) -> pd.DataFrame:
        """Barriers, prefactors and mean times of trajectories beside those of the equations behind them.

        Parameters
        ----------
        equations
            From `from_equations`. States and D have to be the same, or it is a `ValueError`: U is in the unit
            of D. An estimated D may differ by its errors: tell the recordings that of the equations
            (`siq.workflow.study.StateSpace`), or read ΔU/ε of both.
        noise
            ε for which mean times are compared; left out, none are.

        Returns
        -------
        pandas.DataFrame
            One row for each number, with the columns ``item quantity noise equations trajectories
            standard_error relative_difference in_errors note`` (`siq.quasipotential.landscape_comparison`).
        """
        from siq.quasipotential.landscape_comparison import compare_with

        return compare_with(equations, self, noise=noise)

    def report(self) -> str:
        """What was found, as text."""
        from siq.report.landscape import landscape_report

        return landscape_report(self)

    def __repr__(self) -> str:
        """One line: a landscape holds thousands of numbers, which `report` makes readable."""
        named, ways = ", ".join(self.dynamics.states), len(self.transitions)
        return f"<Landscape of ({named}): {len(self.attractors)} attractors, {ways} ways out>"

    def _repr_html_(self) -> str:
        from siq.report.landscape import landscape_report

        return landscape_report(self, markup=True)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw U with its wells, saddles and paths; see `siq.plot_quasipotential`, which this calls.

        Parameters
        ----------
        ax
            Where; by default new axes.
        """
        from siq.report.plots.quasipotential import plot_quasipotential

        return plot_quasipotential(self, ax=ax)
