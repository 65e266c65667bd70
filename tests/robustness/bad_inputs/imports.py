"""Landmarks and poses of another tracker, and a sound one among them."""

from __future__ import annotations

import io
import pickle
import zipfile

import numpy as np
from quick import TINY
from toy_video import write_video

from bad_inputs.cases import case, write_settings
from bad_inputs.clips import head
from bad_inputs.settings import CANARY
from shared.io.arrays import load_arrays, save_arrays

INDEX = np.arange(12)


class _Leaves:
    """What a pickle would execute."""

    def __reduce__(self):
        return open, (CANARY, "w")


def poses() -> np.ndarray:
    """The tiny subject's true poses."""
    return load_arrays(TINY / "gt" / "poses.npz")["camera_from_head"]


def header(shape, descr="<f8") -> bytes:
    """An .npy header that claims this shape, with nothing behind it."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
    return file.getvalue()


def archive(path, **members) -> None:
    """An .npz of raw members."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)


def imported(kind, write):
    """A maker of a sound clip with poses.npz or landmarks.npz by write(path)."""
    def make(folder):
        write_video(folder / "clip.mp4", head())
        write_settings(folder, "clip.mp4", f"tracking: {{{kind}: {kind}.npz}}\n")
        write(folder / f"{kind}.npz")
    return make


def spoilt(value):
    """Writes the true poses with one value replaced."""
    def write(path):
        values = poses()
        values[4, 1, 3] = value
        save_arrays(path, camera_from_head=values, frame_index=INDEX)
    return write


def with_object(path):
    """An array of objects, which only pickle can read."""
    data = header((1,), "|O") + pickle.dumps(_Leaves())
    archive(path, landmarks_px=data, frame_index=data)


def zip_bomb(path):
    """300 MB of zeros in 300 kB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("landmarks_px.npy", "w") as member:
        for _ in range(30):
            member.write(bytes(10_000_000))


def half_zip(path):
    """A sound file, cut."""
    save_arrays(path, camera_from_head=poses(), frame_index=INDEX)
    path.write_bytes(path.read_bytes()[:700])


IMPORTS = {
    "import: pickle": ("landmarks", with_object, "not plain numbers"),
    "import: a zip bomb": ("landmarks", zip_bomb, "too much in the file"),
    "import: a header that claims a terabyte": (
        "landmarks", lambda path: archive(path, landmarks_px=header((1 << 27, 468, 2)), frame_index=header((1,))),
        "another length"),
    "import: a header that is cut off": (
        "landmarks", lambda path: archive(path, landmarks_px=b"\x93NUMPY\x01\x00\x05\x00\x00\x01(\x00\x00",
                                          frame_index=b""), "not a readable"),
    "import: text": ("landmarks", lambda path: path.write_text("468 landmarks\n"), "not a readable"),
    "import: a cut file": ("poses", half_zip, "not a readable"),
    "import: NaN": ("poses", spoilt(np.nan), "not finite"),
    "import: infinity": ("poses", spoilt(np.inf), "not finite"),
    "import: 1e300": ("poses", spoilt(1e300), "nowhere near"),
    "import: a wrong shape": (
        "landmarks", lambda path: save_arrays(path, landmarks_px=np.zeros((12, 68, 2)), frame_index=INDEX), "shape"),
    "import: frames of another clip": (
        "poses", lambda path: save_arrays(path, camera_from_head=poses(), frame_index=INDEX + 1000), "too few"),
    "import: mirrored poses": (
        "poses", lambda path: save_arrays(path, camera_from_head=poses() * [[-1], [1], [1], [1]], frame_index=INDEX),
        "not rigid"),
}
for _name, (_kind, _write, _words) in IMPORTS.items():
    case(_name, _words, "track_landmarks")(imported(_kind, _write))


@case("import: sound poses")
def sound_poses(folder):
    imported("poses", lambda path: save_arrays(path, camera_from_head=poses(), frame_index=INDEX))(folder)
