"""Items loaded on a second thread while the caller works."""

import threading

import pytest

from shared.compute import read_ahead as module
from shared.compute.read_ahead import read_ahead, work_ahead


def test_results_come_in_order_and_loading_runs_ahead():
    begun, second = [], threading.Event()

    def load(item):
        begun.append(item)
        if item == 1:
            second.set()
        return 10 * item

    found = []
    for result in read_ahead(map(load, range(4))):
        if not found:
            assert second.wait(timeout=300.0)  # the second is loaded while the first is held
        found.append(result)
    assert found == [0, 10, 20, 30] and begun == [0, 1, 2, 3]
    assert list(read_ahead([])) == []


def test_at_most_one_waits():
    begun = []
    results = read_ahead(begun.append(item) or item for item in range(100))
    next(results)
    results.close()
    assert len(begun) <= 3


def test_a_fault_is_raised_at_its_turn():
    results = read_ahead(1 / item for item in (2, 0, 4))
    assert next(results) == 0.5
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_work_on_several_items_at_once_comes_in_order(monkeypatch):
    monkeypatch.setattr(module, "thread_count", lambda: 2)
    both = threading.Barrier(2)

    def work(item):
        if item < 2:
            both.wait(timeout=300.0)  # the first two are under way together
        return 10 * item

    assert list(work_ahead(work, range(7))) == [0, 10, 20, 30, 40, 50, 60]
    assert list(work_ahead(work, [])) == []


def test_work_runs_no_further_ahead_than_there_are_threads(monkeypatch):
    monkeypatch.setattr(module, "thread_count", lambda: 2)
    asked = []
    results = work_ahead(lambda item: item, (asked.append(item) or item for item in range(100)))
    assert next(results) == 0
    results.close()
    assert asked == [0, 1, 2]


def test_a_fault_of_the_work_is_raised_at_its_turn():
    results = work_ahead(lambda item: 1 / item, (2, 0, 4))
    assert next(results) == 0.5
    with pytest.raises(ZeroDivisionError):
        next(results)
