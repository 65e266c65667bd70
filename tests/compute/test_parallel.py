"""Items worked on at once, results in order."""

import threading

import pytest

from shared.compute.parallel import THREADS, in_order, shared_out


def test_results_keep_the_order_however_long_each_takes():
    last = threading.Event()

    def work(item):
        if item == 0 and THREADS > 1:
            assert last.wait(timeout=300.0)  # the first ends after the second
        if item == 1:
            last.set()
        return 10 * item

    assert list(in_order(work, range(20))) == list(range(0, 200, 10))
    last.clear()
    assert shared_out(work, range(20)) == list(range(0, 200, 10))
    assert list(in_order(work, [])) == [] and shared_out(work, []) == []


def test_few_results_wait():
    taken = []
    results = in_order(lambda item: item, (taken.append(item) or item for item in range(1000)))
    assert next(results) == 0
    results.close()
    assert len(taken) <= 2 * THREADS + 1


def test_a_single_item_is_worked_on_here():
    assert shared_out(lambda item: threading.get_ident(), [0]) == [threading.get_ident()]


def test_a_fault_is_raised_at_its_turn():
    results = in_order(lambda item: 1 / item, (2, 0, 4))
    assert next(results) == 0.5
    with pytest.raises(ZeroDivisionError):
        next(results)
    with pytest.raises(ZeroDivisionError):
        shared_out(lambda item: 1 / item, (2, 0, 4))
