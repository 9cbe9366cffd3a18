"""What is a kind of record, and what can a refusal say of it?

A kind makes a record from a random generator, a strength between 0 and 1, and how many times the recordings
are to be made: more of them tell what is true of the process. What is drawn for the scene is drawn first, so
that it is the same however many are made.

What a refusal may name are the claims of a certificate: ``state_complete``, ``unchanged``, ``one_system``,
``gaussian_increments``, ``connected``, ``prediction`` (f and D are right where the path runs) and ``record``
(times and histogram are as foreseen), of which ``times`` is a part. A flaw that cannot be told from another
one in a single state allows both.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.hostile.records import Law, Record, Scene, double_wells

Maker = Callable[[np.random.Generator, float, int], Record]
KINDS: dict[str, Kind] = {}


@dataclass(frozen=True)
class Kind:
    """A kind of record.

    Attributes
    ----------
    name, about
        Its own, and what it is.
    make
        Makes a record.
    honest
        Makes one that looks alike and is a diffusion in one or two wells: of the strength that the flaw has.
    named
        Claims of which a refusal names the flaw.
    """

    name: str
    about: str
    make: Maker
    honest: Maker
    named: frozenset[str]

    def generator(self, seed: int, *, honest: bool = False) -> np.random.Generator:
        """The random numbers of one seed: each kind has its own, and so have its honest records."""
        return np.random.default_rng([zlib.crc32(self.name.encode()), seed, int(honest)])

    def record(self, seed: int, strength: float, *, honest: bool = False, copies: int = 1) -> Record:
        """One case; the same scene and process for every number of copies."""
        make = self.honest if honest else self.make
        return make(self.generator(seed, honest=honest), strength, copies)


def plain(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """An honest double well, in one recording or several."""
    scene = Scene.drawn(draw)
    return Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))


def several(draw: np.random.Generator, strength: float, copies: int) -> Record:
    """The same in four recordings, or eight."""
    scene = Scene.drawn(draw, recordings=(4, 8))
    return Record.sampled(scene, double_wells(draw, scene, copies), law=Law.of(scene))


def kind(*named: str, twin: Maker | None = None) -> Callable[[Maker], Maker]:
    """Enter a function as a kind under its name; without a twin strength 0 is the honest one."""

    def entered(make: Maker) -> Maker:
        def faultless(draw: np.random.Generator, strength: float, copies: int) -> Record:
            return make(draw, 0.0, copies)

        name = make.__name__
        claims = {*named, "times"} if "record" in named else set(named)
        about = (make.__doc__ or "").splitlines()[0].rstrip(".")
        KINDS[name] = Kind(name, about, make, twin or faultless, frozenset(claims))
        return make

    return entered
