"""Landmarks and poses of another tracker: read where they are sound, refused with the file's name where not."""

import numpy as np
import pytest
from shapes import turned

from shared.errors import InputError
from shared.io.arrays import save_arrays
from shared.tracking.given_tracking import read_given_landmarks, read_given_poses

FRAME_INDEX = np.array([3, 5, 8, 9, 12])
CROP = (100.0, 40.0, 0.5)


def landmarks(count=5):
    return np.random.default_rng(0).uniform(100, 900, size=(count, 468, 2))


def poses(count=5):
    vectors = 0.2 * np.random.default_rng(1).normal(size=(count, 3))
    return turned(vectors, (0.0, 10.0, 700.0))


def given_file(folder, **arrays):
    """An .npz of these arrays for the frames of FRAME_INDEX; what is None is left out."""
    arrays = {"frame_index": FRAME_INDEX} | arrays
    save_arrays(folder / "given.npz", **{name: array for name, array in arrays.items() if array is not None})
    return folder / "given.npz"


def landmark_file(folder, **changes):
    return given_file(folder, **{"landmarks_px": landmarks()} | changes)


def pose_file(folder, **changes):
    return given_file(folder, **{"camera_from_head": poses()} | changes)


def test_landmarks_come_into_the_crop(tmp_path):
    found, have = read_given_landmarks(landmark_file(tmp_path), FRAME_INDEX, CROP)
    assert have.all() and found.shape == (5, 468, 2)
    assert np.allclose(found, (landmarks() - [100.0, 40.0]) * 0.5)


def test_frames_are_matched_by_their_index(tmp_path):
    order = np.array([4, 0, 2, 1, 3])
    path = landmark_file(tmp_path, landmarks_px=landmarks()[order], frame_index=FRAME_INDEX[order])
    found, have = read_given_landmarks(path, np.array([1, 3, 8, 12, 40]), CROP)
    assert have.tolist() == [False, True, True, True, False]
    assert np.allclose(found[[1, 2, 3]], (landmarks()[[0, 2, 4]] - [100.0, 40.0]) * 0.5)
    assert np.all(found[[0, 4]] == 0)


def test_poses_are_matched_by_their_index(tmp_path):
    order = np.array([2, 1, 0, 4, 3])
    path = pose_file(tmp_path, camera_from_head=poses()[order], frame_index=FRAME_INDEX[order])
    found, have = read_given_poses(path, np.array([3, 4, 5, 9]))
    assert have.tolist() == [True, False, True, True]
    assert np.array_equal(found[have], poses()[[0, 1, 3]])
    assert np.array_equal(found[1], np.eye(4))


def test_single_precision_poses_are_rigid_enough(tmp_path):
    found, _ = read_given_poses(pose_file(tmp_path, camera_from_head=poses().astype(np.float32)), FRAME_INDEX)
    assert found.dtype == np.float64
    assert np.abs(found - poses()).max() < 1e-3


def with_nan(values):
    values = values.copy()
    values[2, 1] = np.nan
    return values


TWICE = np.array([3, 5, 8, 8, 12])
ELSEWHERE = np.array([3, 5, 80, 90, 120])


@pytest.mark.parametrize("changes, hint", [
    ({"landmarks_px": None}, "no landmarks_px"), ({"frame_index": None}, "no frame_index"),
    ({"landmarks_px": landmarks()[:, :68]}, "another shape"), ({"landmarks_px": landmarks()[..., 0]}, "another shape"),
    ({"landmarks_px": np.zeros((5, 468, 3))}, "another shape"), ({"frame_index": np.arange(4)}, "another shape"),
    ({"landmarks_px": with_nan(landmarks())}, "not finite"), ({"frame_index": TWICE}, "named twice"),
    ({"landmarks_px": landmarks() / 1000.0}, "span no face"), ({"frame_index": ELSEWHERE}, "too few")])
def test_bad_landmarks_are_refused(tmp_path, changes, hint):
    path = landmark_file(tmp_path, **changes)
    with pytest.raises(InputError, match=hint) as error:
        read_given_landmarks(path, FRAME_INDEX, CROP)
    assert str(path) in str(error.value)


def changed(place, value):
    result = poses()
    result[place] = value
    return result


MIRRORED = poses() @ np.diag([1.0, 1, -1, 1])


@pytest.mark.parametrize("changes, hint", [
    ({"camera_from_head": None}, "no camera_from_head"), ({"frame_index": None}, "no frame_index"),
    ({"camera_from_head": poses()[:, :3]}, "another shape"), ({"camera_from_head": poses()[0]}, "another shape"),
    ({"camera_from_head": changed((slice(None), slice(3), slice(3)), 2 * poses()[:, :3, :3])}, "not rigid"),
    ({"camera_from_head": MIRRORED}, "not rigid"), ({"camera_from_head": changed((2, 3, 0), 0.1)}, "not rigid"),
    ({"camera_from_head": with_nan(poses())}, "not finite"), ({"camera_from_head": changed((1, 2, 3), -5.0)}, "behind"),
    ({"frame_index": np.array(3)}, "another shape"), ({"frame_index": FRAME_INDEX[:, None]}, "another shape"),
    ({"frame_index": FRAME_INDEX + 0.6}, "no whole numbers"),
    ({"camera_from_head": np.zeros((0, 4, 4)), "frame_index": np.zeros(0, int)}, "too few"),
    ({"camera_from_head": np.full((5, 4, 4), "x")}, "not finite"),
    ({"frame_index": TWICE}, "named twice"), ({"frame_index": ELSEWHERE}, "too few")])
def test_bad_poses_are_refused(tmp_path, changes, hint):
    path = pose_file(tmp_path, **changes)
    with pytest.raises(InputError, match=hint) as error:
        read_given_poses(path, FRAME_INDEX)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04 cut off"])
def test_files_that_are_no_npz_are_refused(tmp_path, content):
    path = tmp_path / "given.npz"
    path.write_bytes(content)
    for read in (lambda: read_given_poses(path, FRAME_INDEX), lambda: read_given_landmarks(path, FRAME_INDEX, CROP)):
        with pytest.raises(InputError, match="not a readable .npz of plain arrays") as error:
            read()
        assert str(path) in str(error.value)


def test_single_array_in_a_file_is_refused(tmp_path):
    np.save(tmp_path / "given.npy", poses())
    with pytest.raises(InputError, match="not a readable .npz of plain arrays"):
        read_given_poses(tmp_path / "given.npy", FRAME_INDEX)
