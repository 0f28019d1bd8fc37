"""What happens on the page happens one after the other, the newest wish first."""

import threading
import time

from vibrissa.viewer.page import Latest, Player


def test_a_newer_job_replaces_one_that_has_not_begun():
    faults, done = [], []
    begun, go_on = threading.Event(), threading.Event()
    work = Latest(faults.append)

    def first():
        begun.set()
        assert go_on.wait(10.0)
        done.append("first")

    work.put("drag", first)
    assert begun.wait(10.0)
    for number in range(100):
        work.put("drag", lambda number=number: done.append(number))
    work.put("other", lambda: done.append("other"))
    assert not work.wait(0.01)
    go_on.set()
    assert work.wait(10.0)
    assert done == ["first", 99, "other"]
    assert faults == []
    work.close()


def test_a_fault_is_told_and_the_thread_goes_on():
    faults, done = [], []
    work = Latest(faults.append)
    work.put("a", lambda: 1 / 0)
    work.put("b", lambda: done.append("b"))
    assert work.wait(10.0)
    assert [type(fault) for fault in faults] == [ZeroDivisionError]
    assert done == ["b"]
    work.close()
    work.put("c", lambda: done.append("c"))
    assert work.wait(0.0)  # nothing is pending that will never be done
    assert done == ["b"]


def test_a_player_tells_the_time_only_while_it_plays():
    ticked = threading.Event()
    passed = []

    def tick(seconds):
        passed.append(seconds)
        ticked.set()

    player = Player(tick)
    assert not player.playing
    assert not ticked.wait(0.15)
    player.play()
    assert ticked.wait(10.0)
    assert passed[0] > 0.0
    player.pause()
    assert not player.playing
    player.close()


def test_what_is_put_off_comes_in_its_time_and_after_what_is_due():
    faults, done = [], []
    work = Latest(faults.append)
    due = time.monotonic() + 0.05
    work.put("words", lambda: done.append(time.monotonic()), due)
    work.put("words", lambda: done.append(time.monotonic()), due)
    work.put("gone", lambda: done.append("gone"), due)
    work.put("drag", lambda: done.append("drag"))
    work.drop("gone")
    assert work.wait(10.0)
    assert done[0] == "drag"
    assert len(done) == 2
    assert done[1] >= due
    assert faults == []
    work.close()
