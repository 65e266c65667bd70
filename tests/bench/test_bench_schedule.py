"""The schedule's simulation against cases whose answer is known."""

import pytest

from tools.bench.schedule import MeasuredStage, serial_share, simulate
from tools.bench.throughput import around_stages, compared

STAGES = [MeasuredStage("a", 10.0, 0.0, 100.0), MeasuredStage("b", 30.0, 0.5, 400.0)]


def test_serial_shares_give_back_the_wall_time():
    for serial in (0.0, 0.3, 1.0):
        cost = MeasuredStage("a", 12.0, serial, 0.0)
        assert serial_share(cost.seconds(2), 12.0, 2) == pytest.approx(serial)


def test_one_core_does_all_work_one_after_another():
    done = simulate(STAGES, subjects=3, cores=1, memory_mb=1e6, start_s=2.0)
    assert done.seconds == pytest.approx(2.0 + 3 * 40.0)


def test_as_many_cores_as_subjects_take_one_chain():
    done = simulate(STAGES, subjects=4, cores=4, memory_mb=1e6, start_s=0.0)
    assert done.seconds == pytest.approx(40.0) and done.busy == pytest.approx(1.0)
    assert done.peak_mb == pytest.approx(1600.0)


def test_a_subject_alone_is_limited_by_its_serial_share():
    done = simulate(STAGES, subjects=1, cores=16, memory_mb=1e6, start_s=0.0)
    assert done.seconds == pytest.approx(10.0 / 16 + 30.0 * (0.5 + 0.5 / 16))
    assert done.limits["processor time"] < done.limits["serial shares"] == pytest.approx(done.seconds)


def test_memory_limits():
    done = simulate(STAGES, subjects=4, cores=4, memory_mb=400.0, start_s=0.0)
    assert done.peak_mb <= 400.0 and done.seconds >= 4 * 30.0 and done.limited_by == "memory"


def test_no_schedule_beats_a_limit():
    for subjects in (1, 3, 20):
        for cores in (1, 2, 16):
            done = simulate(STAGES, subjects, cores, 1000.0, 1.0)
            lower = {name: value for name, value in done.limits.items() if name != "longest chain"}
            assert all(done.seconds >= value - 1e-9 for value in lower.values())


def test_measured_and_simulated_stand_side_by_side():
    alone = [{"preset": "draft", "subjects": 1, "cores": 2, "stage": "", "wall_s": 12.0, "cpu_s": 22.0},
             {"preset": "draft", "subjects": 1, "cores": 2, "stage": "a", "wall_s": 10.0, "cpu_s": 20.0,
              "booked_mb": 100.0}]  # fmt: skip
    many = [{"preset": "draft", "subjects": 4, "cores": 1, "stage": "", "wall_s": 85.0, "cpu_s": 82.0},
            {"preset": "draft", "subjects": 4, "cores": 1, "stage": "a", "wall_s": 20.0, "cpu_s": 20.0}]
    one, four, simulated = compared(alone + many, "draft", 16, 64000.0)
    assert one["measured, s"] == 12.0 == pytest.approx(one["simulated, s"])
    assert four["measured, s"] == 85.0 and four["simulated, s"] == pytest.approx(82.0)
    assert simulated["measured, s"] is None and simulated["simulated, s"] == pytest.approx(2.0 + 20.0 / 4)
    assert compared(many, "draft", 16, 64000.0) == [] == compared(alone, "standard", 16, 64000.0)


def test_what_goes_on_around_the_stages_is_of_the_workflow_and_of_each_job():
    """Three seconds once, two for each subject, shared by its two stages."""
    rows = [{"subjects": count, "cores": cores, "stage": stage, "cpu_s": 3.0 + 12.0 * count if not stage else 5.0}
            for count, cores in ((1, 2), (4, 1)) for stage in ("", "a", "b")]  # fmt: skip
    assert around_stages(rows) == pytest.approx((3.0, 1.0))
    assert around_stages(rows[:3]) == pytest.approx((5.0, 0.0))
