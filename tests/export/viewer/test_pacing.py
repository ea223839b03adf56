"""When a moving camera is worked for: at rest, and not too often."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.export.viewer.session import Pace


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def test_a_camera_that_moves_on_is_waited_for(clock):
    pace = Pace(clock)
    assert pace.wait() is None
    for _ in range(5):
        pace.moved()
        clock.now += 0.15
        assert pace.wait() == pytest.approx(0.05)
    clock.now += 0.05
    assert pace.wait() == 0.0


def test_a_change_of_options_needs_no_rest_but_work_pauses_after_work(clock):
    pace = Pace(clock)
    pace.want()
    assert pace.wait() == 0.0
    pace.begin()
    assert pace.wait() is None
    clock.now += 3.0
    pace.end()
    pace.want()
    assert pace.wait() == pytest.approx(0.5)


def test_a_movement_during_the_work_is_not_lost(clock):
    pace = Pace(clock)
    pace.want()
    pace.begin()
    pace.moved()
    pace.end()
    assert pace.wait() == pytest.approx(0.5)


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans()), max_size=40))
def test_work_never_follows_work_too_soon(events):
    clock = Clock()
    pace = Pace(clock)
    ended, last_move = -1e9, -1e9
    for passed, moves in events:
        clock.now += passed
        if moves:
            pace.moved()
            last_move = clock.now
        if pace.wait() == 0.0:
            assert clock.now >= ended + 0.5 - 1e-9 and clock.now >= last_move + 0.2 - 1e-9
            pace.begin()
            clock.now += 0.1
            pace.end()
            ended = clock.now
