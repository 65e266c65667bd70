"""Poses of another tracker for inverse_render: which of the clip's frames they are, and what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from shared.errors import InputError
from shared.inverse.clip_inputs import _match

FRAMES = SimpleNamespace(frame_index=np.array([0, 5, 10, 15]))


def poses(count=4, **changes):
    return {"camera_from_head": np.tile(np.eye(4), (count, 1, 1)), "frame_index": np.array([0, 7, 10, 15])} | changes


def test_poses_are_matched_by_their_frame():
    found, place, kept = _match(FRAMES, poses(), "poses.npz")
    assert found.shape == (3, 4, 4) and place.tolist() == [0, 2, 3] and kept == [0, 2, 3]
    halves = _match(FRAMES, poses(frame_index=np.array([15.0, 10.0, 5.0, 0.0])), "poses.npz")
    assert halves[1].tolist() == [3, 2, 1, 0]


@pytest.mark.parametrize("changes, message", [
    ({"camera_from_head": np.array(["a", "b", "c", "d"])}, "no poses"),
    ({"camera_from_head": np.float64(1.0)}, "no poses"),
    ({"camera_from_head": np.zeros((4, 3, 4))}, "no poses"),
    ({"camera_from_head": np.full((4, 4, 4), np.nan)}, "no poses"),
    ({"frame_index": np.arange(5)}, "names no frames"),
    ({"frame_index": np.array(["a", "b", "c", "d"])}, "names no frames"),
    ({"frame_index": np.array([0.0, 5.0, np.nan, 10.0])}, "names no frames"),
    ({"frame_index": np.array([0.0, 5.0, 7.5, 10.0])}, "names no frames"),
    ({"frame_index": np.zeros((4, 1))}, "names no frames"),
    ({"frame_index": np.array([0, 5, 5, 10])}, "none twice"),
    ({"frame_index": np.array([1, 2, 3, 4])}, "too few poses"),
])
def test_what_names_no_frames_is_one_line(changes, message):
    with pytest.raises(InputError, match=message):
        _match(FRAMES, poses(**changes), "poses.npz")
