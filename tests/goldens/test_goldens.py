"""Every stage, from inputs of its own, against its golden file, under several kernels and thread counts.

`python -m tools.goldens write` makes the files; tolerances are multiples of the spread over those ways to run.
"""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from slow import SLOW

from tools.goldens.chain import chain_differences
from tools.goldens.golden import differences, distance, midway, read_golden, run_all, run_from_inputs
from tools.goldens.inputs import kept_folder, stage_of
from tools.goldens.kernels import LEAST, OWN, WAYS
from tools.goldens.measures import Measure
from tools.goldens.mutations import MUTATIONS, mutated_text, noticed_by
from tools.goldens.tiny import SETTINGS, STAGES

RUN = [(stage, way) for way in WAYS for stage in STAGES
       if SLOW or way is OWN or (way is LEAST and stage != "export_usd")]
"""The processor that tests run on, and for what is solved the one that differs most from all others."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """{(stage, way): run}; two stages at once, each a process of its own."""
    return run_all(RUN, tmp_path_factory.mktemp("goldens"), at_once=2)


@pytest.mark.parametrize("stage", STAGES)
def test_versions_of_the_golden_file_are_the_stages(stage):
    golden = read_golden(stage)
    assert golden["version"] == stage_of(stage).version
    assert all(stage_of(name).version == number for name, number in golden["before"].items())


@pytest.mark.parametrize(("stage", "way"), [(stage, way.name) for stage, way in RUN])
def test_the_same_comes_out(stage, way, runs):
    golden, run = read_golden(stage), runs[stage, way]
    assert list(run.files) == golden["files"]
    assert not list(differences(stage, run.measures, golden))


def test_the_chain_is_as_good_as_it_was(tiny_scores):
    assert not list(chain_differences(tiny_scores))


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.name)
def test_constants_of_the_list_stand_where_it_says(mutation):
    assert mutation.after in mutated_text(mutation)


def test_highlights_five_percent_stronger_are_noticed(runs):
    """What the mutations of inverse_render ask of its golden file, without another run of it."""
    name, found = "specular intensity, roughness", runs["inverse_render", OWN.name].measures
    changed = dict(found) | {name: replace(found[name], values=1.05 * found[name].values)}
    assert [line for line in differences("inverse_render", changed, read_golden("inverse_render")) if name in line]


@pytest.mark.parametrize("mutation", [m for m in MUTATIONS if m.quick or SLOW], ids=lambda m: m.name)
def test_a_changed_constant_is_noticed(mutation):
    assert noticed_by(mutation)


def test_inputs_stay_small():
    sizes = [sum(path.stat().st_size for path in kept_folder(stage).rglob("*") if path.is_file())
             for stage in STAGES[:-1]]
    assert min(sizes) > 0 and sum(sizes) < 3e6


def test_differences_are_told_from_the_same():
    reference = Measure(np.array([1.0, 2.0]), np.array([0.1, 1.0]))
    assert distance(reference, reference) == 0.0
    assert np.isclose(distance(Measure(np.array([1.05, 2.1])), reference), 0.5)
    assert distance(Measure(np.array([1.0])), reference) == np.inf
    assert distance(Measure(np.array([np.nan, 2.0])), reference) == np.inf
    words = Measure(np.array(["a", "b"]), exact=True)
    assert distance(words, words) == 0.0 and distance(Measure(np.array(["a", "c"]), exact=True), words) == np.inf


def test_golden_values_lie_midway_between_those_farthest_apart():
    ways = [Measure(np.array([1.0, 5.0]), 2.0), Measure(np.array([3.0, 4.0]), 2.0), Measure(np.array([2.0, 4.5]), 2.0)]
    middle = midway(ways[0], ways)
    assert middle.values.tolist() == [2.0, 4.5] and middle.scale == 2.0
    assert max(distance(way, middle) for way in ways) < distance(ways[1], ways[0])
    words = Measure(np.array(["a"]), exact=True)
    assert midway(words, [words, words]) is words
    assert midway(ways[0], [ways[0], Measure(np.array([1.0]))]) is ways[0]


def test_a_kernel_reaches_the_libraries(tmp_path):
    """What the environment says is what they use: a switch that nobody reads would make all ways one."""
    words = ("import torch, numpy, cv2, llvmlite.binding, numba; from numpy._core._multiarray_umath import "
             "__cpu_features__ as f; print(torch.backends.cpu.get_cpu_capability(), f['X86_V3'], "
             "numba.config.CPU_NAME, "
             "'*AVX2?' in cv2.getCPUFeaturesLine().split() or 'AVX2' not in cv2.getCPUFeaturesLine())")
    told = {}
    for way in (OWN, LEAST):
        done = subprocess.run([sys.executable, "-c", words], env=way.variables(), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        told[way.name] = done.stdout.split()
    assert told[LEAST.name][0] == "DEFAULT" and told[LEAST.name][1:] == ["False", "generic", "True"]
    assert told[OWN.name][2] == "None"


def test_a_stage_that_fails_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(SETTINGS, "init_albedo", ("size=7",))
    with pytest.raises(RuntimeError, match="init_albedo .own. ended with exit code 2"):
        run_from_inputs("init_albedo", tmp_path)
