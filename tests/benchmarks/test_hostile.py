"""The records that nobody should certify: are they what they are said to be, and is the score right?"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hostile.__main__ import main, read
from benchmarks.hostile.catalogue import FAMILIES, HELD_OUT, KINDS, KNOWN
from benchmarks.hostile.kinds import plain
from benchmarks.hostile.records import Law, Record, Scene
from benchmarks.hostile.scores import Claim, counted, fault

CLAIMS = {
    "state_complete", "unchanged", "one_system", "gaussian_increments", "connected", "prediction", "record",
    "times",
}  # fmt: skip


@pytest.fixture(scope="module")
def honest() -> Record:
    """A double well in one recording, twenty times as long as a case."""
    return plain(np.random.default_rng(5), 0.0, 20)


def test_a_fifth_of_the_kinds_is_held_out_and_none_that_was_known_before() -> None:
    assert len(KINDS) >= 40
    assert len(HELD_OUT) == round(len(KINDS) / 5)
    assert not HELD_OUT & KNOWN
    assert KINDS.keys() > KNOWN
    assert FAMILIES.keys() == KINDS.keys()


@pytest.mark.parametrize("name", sorted(KINDS))
def test_a_refusal_can_name_the_flaw_of_every_kind(name: str) -> None:
    assert KINDS[name].named
    assert KINDS[name].named <= CLAIMS
    assert KINDS[name].about


@pytest.mark.parametrize("name", sorted(KINDS))
def test_records_are_finite_and_go_on_in_time(name: str) -> None:
    made = KINDS[name].record(0, 0.5)
    recordings = made.recordings()
    assert len(recordings.labels) == len(made.seen)
    assert np.isfinite(recordings.values).all()
    assert len(made.states) == len(made.seen) or name == "mirrored"


def test_a_seed_makes_the_same_scene_however_long_and_another_than_the_next_seed() -> None:
    kind = KINDS["gains"]
    first, longer, other = kind.record(3, 1.0), kind.record(3, 1.0, copies=2), kind.record(4, 1.0)
    assert first.scene == longer.scene
    assert first.scene != other.scene
    assert len(longer.seen) == 2 * len(first.seen)
    np.testing.assert_array_equal(first.seen[0], kind.record(3, 1.0).seen[0])


def test_quadrature_says_what_a_long_record_counts(honest: Record) -> None:
    law = honest.law
    assert law is not None
    for start, end in ((-0.9, 0.9), (0.9, -0.9)):
        mean, hops = counted(honest.states, start, end)
        assert hops > 200
        assert mean == pytest.approx(law.time(start, end), rel=3 / np.sqrt(hops))


def test_the_law_of_a_symmetric_double_well() -> None:
    scene = Scene(
        barrier=4.0, tilt=0.0, unit=1.0, offset=0.0, pace=1.0, recordings=1, samples=10
    )  # fmt: skip
    law = Law.of(scene)
    height = law.height
    top = float(np.interp(0.0, law.grid, height))
    assert top - float(np.interp(1.0, law.grid, height)) == pytest.approx(4.0, rel=1e-3)
    # Eyring and Kramers: 2π/√(f'(1) f'(0)) exp(ΔU/ε), up to terms of the order ε/ΔU.
    assert law.time(-1.0, 1.0) == pytest.approx(2 * np.pi / np.sqrt(2) * np.exp(4.0), rel=0.15)


def test_a_claim_is_off_beyond_its_interval_and_a_tenth(honest: Record) -> None:
    law = honest.law
    assert law is not None
    true = law.time(-1.0, 1.0)

    def said(value: float, factor: float) -> str:
        return fault(Claim("visit", -1.0, 1.0, value, value / factor, value * factor), honest)[0]

    assert not said(true, 1.01)
    assert not said(1.5 * true, 1.8)  # within its interval
    assert not said(1.05 * true, 1.01)  # beyond it, by less than a tenth
    assert "claimed" in said(1.5 * true, 1.2)
    assert said(0.5 * true, 1.2)


def test_no_barrier_is_true_where_no_passage_is_possible() -> None:
    record = KINDS["two_offsets"].record(0, 1.0)
    levels = sorted({float(np.median(one)) for one in record.states})
    assert counted(record.states, levels[0], levels[-1])[1] == 0
    claim = Claim("barrier", levels[0], levels[-1], 4.0, 3.5, 4.5)
    assert "inf" in fault(claim, record)[0]


def test_the_density_of_a_long_record_shows_the_barrier_of_the_law(honest: Record) -> None:
    law = honest.law
    assert law is not None
    without = Record(honest.scene, honest.seen, honest.times, honest.states)
    start = -1.0
    between = law.height[(law.grid > -1) & (law.grid < 1)].max()
    true = between - float(np.interp(start, law.grid, law.height))
    assert not fault(Claim("barrier", start, 1.0, true, 0.99 * true, 1.01 * true), without)[0]
    assert fault(Claim("barrier", start, 1.0, 1.5 * true, 1.4 * true, 1.6 * true), without)[0]


def test_a_run_goes_on_where_it_was(tmp_path, monkeypatch, capsys) -> None:
    from benchmarks.hostile import __main__ as runner

    asked = []

    class Here:
        def __init__(self, jobs: int) -> None: ...
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def submit(self, function, *one):
            from concurrent.futures import Future

            asked.append(one)
            done: Future = Future()
            name, seed, strength, honest = one
            row = dict.fromkeys(runner.COLUMNS, "") | {"kind": name, "seed": seed, "strength": strength}
            done.set_result(
                row | {"honest": honest, "certified": False, "false": False, "named": True, "seconds": 1.0}
            )
            return done

    monkeypatch.setattr(runner, "ProcessPoolExecutor", Here)
    options = ["--kinds", "gains", "gate", "--seeds", "0", "--strengths", "1", "--folder", str(tmp_path)]
    main(options)
    assert len(asked) == 2
    main([*options, "--honest"])
    assert len(asked) == 4
    main([*options])
    assert len(asked) == 4
    assert len(read(tmp_path / "cases.csv")) == 4
    assert "refusals that name the flaw: 2 of 2" in capsys.readouterr().out


def test_held_out_kinds_run_on_demand_alone(tmp_path) -> None:
    name = sorted(HELD_OUT)[0]
    with pytest.raises(SystemExit):
        main(["--kinds", name, "--folder", str(tmp_path)])
