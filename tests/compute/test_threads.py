import threading

import pytest
import torch

from shared.compute.threads import share_out, single_thread, thread_count


@pytest.fixture(params=[1, 2, 5])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_each_piece_of_work_is_done_once_and_kept_in_order(threads):
    done = []

    def work(number: int) -> int:
        done.append(number)
        return number * number

    assert share_out(1000, work) == [number * number for number in range(1000)]
    assert sorted(done) == list(range(1000))
    assert share_out(0, work) == []


def test_as_many_threads_as_torch_may_use_work_at_once(threads):
    """Each piece waits for the others: with fewer threads the barrier would break."""
    barrier = threading.Barrier(threads)
    share_out(threads, lambda number: barrier.wait(timeout=300))


def test_what_a_piece_raises_reaches_the_caller(threads):
    def work(number: int) -> int:
        if number == 7:
            raise ValueError("seven")
        return number

    with pytest.raises(ValueError, match="seven"):
        share_out(20, work)


def test_a_single_thread_is_kept_to_and_the_count_comes_back():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(ValueError), single_thread():
            assert torch.get_num_threads() == thread_count() == 1
            assert len(set(share_out(20, lambda _: threading.get_ident()))) == 1
            raise ValueError
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
