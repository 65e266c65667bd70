"""The profile: samples add up, phases are found, budgets follow their counts, the page names what is next."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from shared.errors import InputError
from tools.bench.budget import Least, RunCounts, budget, count_run
from tools.bench.machine_limits import MachineLimits
from tools.bench.marked import with_marked
from tools.bench.phases import COMPILED, IMPORTS, OTHER, SAMPLER, START, phase_of
from tools.bench.profile import next_thing
from tools.bench.sampler import Sampler

LIMITS = MachineLimits(cores=2, gflops=10.0, memory_gb_s=5.0, rays_per_core_s=1e6, disk_write_mb_s=100.0,
                       disk_read_mb_s=200.0)  # fmt: skip


def test_the_innermost_known_module_decides():
    light = [("shared.compute.threads", "share_out"), ("shared.appearance.products", "reflect"),
             ("shared.appearance.fit", "solve")]  # fmt: skip
    assert phase_of(light) == ("light and material products", "shared.appearance.products:reflect")
    assert phase_of([("shared.io.images", "write_png")])[0] == "encoding"
    assert phase_of([("shared.io.images", "read_png")])[0] == "reading pictures"
    assert phase_of([("numba.core.dispatcher", "_compile_for_args"), *light])[0] == COMPILED
    assert phase_of([("numba", "<module>"), ("importlib._bootstrap", "_find_and_load"), *light])[0] == IMPORTS
    assert phase_of([("json", "dumps"), ("__main__", "main")]) == (OTHER, "json:dumps")
    assert phase_of([])[0] == OTHER


def test_samples_add_up_to_the_whole_process():
    """Work of the main thread and of a second one; nothing is lost and nothing is counted twice."""
    values = np.random.default_rng(0).standard_normal(200_000)
    sampler = Sampler(interval_s=0.002)
    before, began = time.process_time(), time.perf_counter()
    sampler.start()
    other = threading.Thread(target=lambda: [np.sort(values) for _ in range(10)])
    other.start()
    for _ in range(10):
        np.sort(values)
    other.join()
    found = sampler.stop()
    cpu, wall = time.process_time() - before, time.perf_counter() - began
    own = {name: phase for name, phase in found["phases"].items() if name != START}
    assert sum(phase["cpu_s"] for phase in own.values()) <= cpu
    assert sum(phase["wall_s"] for phase in own.values()) <= wall
    assert sum(sum(phase["functions"].values()) for phase in own.values()) == pytest.approx(
        sum(phase["cpu_s"] for phase in own.values())
    )
    assert found["samples"] >= 1 and found["peak_mb"] > 1.0 and set(own) - {SAMPLER}


def test_the_slowest_limit_counts():
    assert Least(memory=5e9).seconds(LIMITS) == pytest.approx(1.0)
    assert Least(memory=5e9, flops=30e9).seconds(LIMITS) == pytest.approx(3.0)
    assert Least(rays=8e6).seconds(LIMITS) == pytest.approx(4.0)
    assert Least(disk_out=1e8, disk_in=4e8).seconds(LIMITS) == pytest.approx(2.0)


def test_counts_of_the_tiny_run_and_what_grows_with_them(tiny_run):
    run = count_run(tiny_run, clip_bytes=1000)
    assert isinstance(run, RunCounts) and run.frames == 12 and run.source_pixels == 144 * 144
    assert all(value > 0 for value in run.written.values()) and run.vertices > 100 and run.pictures
    least = budget(run)
    assert {stage: all(own.seconds(LIMITS) > 0 for own in phases.values()) for stage, phases in least.items()} == {
        stage: True for stage in run.parameters
    }
    parameters = {**run.parameters}
    own = parameters["inverse_render"]
    parameters["inverse_render"] = {**own, "directions": 2 * own["directions"]}
    twice = budget(replace(run, parameters=parameters))
    for phase in ("rays", "tables of lobes", "light and material products"):
        before, after = least["inverse_render"][phase], twice["inverse_render"][phase]
        assert after.seconds(LIMITS) == pytest.approx(2 * before.seconds(LIMITS))


def test_a_run_that_is_not_whole_is_refused(tmp_path):
    with pytest.raises(InputError, match="has not run"):
        count_run(tmp_path, 0)


def test_next_is_what_lies_most_seconds_above_its_least():
    rows = [
        {"case": "a", "phase": "", "wall_s": 99.0},
        {"case": "a", "phase": "bound", "wall_s": 10.0, "least_s": 9.0},
        {"case": "a", "phase": "slack", "wall_s": 4.0, "least_s": 0.5},
        {"case": "b", "phase": "small", "wall_s": 0.2, "least_s": 0.001},
    ]
    text = next_thing(rows)
    assert text.startswith("Next: slack of a, 3.50 s above") and "small of b, 200 times" in text
    assert next_thing(rows[:1]) == "Nothing takes noticeable time."


def test_tables_go_between_their_marks():
    text = "a\n<!-- growth: how -->\nold\n<!-- end of growth -->\nb\n"
    assert with_marked(text, "growth", "new\n", "x") == "a\n<!-- growth: how -->\nnew\n<!-- end of growth -->\nb\n"
    assert with_marked(text, "growth", "\\1\n", "x").splitlines()[2] == "\\1"
    with pytest.raises(InputError, match="no place"):
        with_marked(text, "profile", "new\n", "x")
