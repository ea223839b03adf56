"""Remaining time: none before it means something, and then from what units take now and how that grows."""

from __future__ import annotations

import pytest

from coliags_plugin.engine import pace as module
from coliags_plugin.engine.pace import Pace


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on by hand."""
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def after(clock, pace, durations, start=0):
    """The time to go after units of these durations."""
    for done, seconds in enumerate(durations, start + 1):
        clock[0] += seconds
        pace.update(done)
    return pace.left


def test_nothing_is_said_of_the_first_step(clock):
    """Kernels are compiled in it: 25.4 s then would promise 25,429 s for 1000 steps of 0.1 s."""
    pace = Pace(1001)
    assert after(clock, pace, [25.4]) is None
    assert after(clock, pace, [0.1] * 14, start=1) is None
    assert after(clock, pace, [0.1] * 15, start=15) == pytest.approx(97.1)


def test_one_slow_step_does_not_count(clock):
    assert after(clock, Pace(1000), [1.0] * 10 + [300.0] + [1.0] * 9) == pytest.approx(980.0)


def test_a_job_of_few_units(clock):
    pace = Pace(4)
    assert after(clock, pace, [30.0]) is None
    assert after(clock, pace, [10.0], start=1) == pytest.approx(20.0)


def test_units_that_end_in_bursts(clock):
    """Of four threads, units end four at a time."""
    assert after(clock, Pace(400), [2.0, 0.0, 0.0, 0.0] * 50) == pytest.approx(100.0, rel=0.1)


def test_growing_steps_and_the_time_they_take(clock):
    """Steps from 1 to 2 s: half way, 500 are left that take 875 s, not the 625 s of the mean so far."""
    durations = [1.0 + step / 1000 for step in range(1000)]
    pace = Pace(1000)
    assert after(clock, pace, durations[:500]) == pytest.approx(sum(durations[500:]), rel=0.03)
    assert after(clock, pace, durations[500:999], start=500) == pytest.approx(2.0, rel=0.2)
    assert after(clock, pace, durations[999:], start=999) == 0.0


def test_growth_has_an_end(clock):
    """Of 100,000 steps, 100 that grow by half do not let the last one take 500 s."""
    left = after(clock, Pace(100_000), [1.0 + step / 200 for step in range(100)])
    assert left < 1.5 * 1.5 * 99_900


def test_a_resumed_job_counts_its_own_units(clock):
    pace = Pace(1000, start=900)
    assert after(clock, pace, [1.0] * 50, start=900) == pytest.approx(50.0)


def test_memory_is_bounded(clock):
    pace = Pace(100_000)
    assert after(clock, pace, [1.0] * 50_000) == pytest.approx(50_000.0)
    assert len(pace._averages) <= 120
