"""The recorder of what functions return, and where two recordings part."""

import json
import sys
from dataclasses import dataclass

import numpy as np
import torch

from shared.geometry.transforms import rotation_from_vector
from tools.goldens.parting import Recorder, compare, digest, distance, numbers_of

TURN = "shared.geometry.transforms.rotation_from_vector"


@dataclass
class Pair:
    first: np.ndarray
    second: tuple


def test_numbers_are_found_within_what_is_returned():
    value = Pair(np.arange(3), (2.5, "words", None, torch.ones(2, dtype=torch.bfloat16), [np.float32(4.0)]))
    assert [array.tolist() for array in numbers_of(value)] == [[0.0, 1.0, 2.0], [2.5], [1.0, 1.0], [4.0]]
    assert not list(numbers_of(("text", True, {"a": 1.0})))


def test_digests_lie_as_far_apart_as_their_arrays():
    values = np.array([3.0, -4.0, np.nan, 0.0])
    assert digest(values)["rms"] == 2.5
    assert distance(digest(values), digest(values)) == 0.0
    assert np.isclose(distance(digest(values), digest(values + [0, 0.25, 0, 0])), 0.1, rtol=0.05)
    assert distance(digest(values), digest(values[:3])) == np.inf


def test_functions_of_the_library_are_recorded_in_order_and_compared(tmp_path):
    def recording(noise):
        recorder = Recorder()
        sys.setprofile(recorder)
        rotation_from_vector(np.array([[0.1, 0.2, 0.3]]))
        rotation_from_vector(np.array([[0.1, 0.2 + noise, 0.3]]))
        sys.setprofile(None)
        return recorder.calls

    calls = recording(0.0)
    assert [(name, number) for name, number, _ in calls if name == TURN] == [(TURN, 0), (TURN, 1)]
    for name, noise in (("a", 0.0), ("b", 1e-6)):
        (tmp_path / name).write_text(json.dumps(recording(noise)))
    rows = {name: (count, at, apart) for name, count, at, apart in compare(tmp_path / "a", tmp_path / "b")}
    count, at, apart = rows[TURN]
    assert (count, at) == (2, 1) and 1e-7 < apart < 1e-5
