"""Where set-up leaves the networks of face and iris and the head model, and how a stage reads them.

Its `models.json` lists each file with SHA-256, source and licence; a file is read only if its hash is the listed one.
A stage that reads a model declares it: its hash is in the stage's manifest.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

from shared.capture.iris import IrisNetwork
from shared.capture.landmarks import FaceNetworks
from shared.contract.hashing import hash_file
from shared.contract.models import HEAD_MODEL_FILE, NETWORK_FILES, models_folder
from shared.errors import InputError
from shared.io.arrays import load_arrays, read_json

if TYPE_CHECKING:
    from shared.tracking.head_model import HeadModel

LIST_FILE = "models.json"
_HINT = "run make setup"


def network_path(name: str) -> Path:
    """Path of one network: face_detector, face_landmarks, person_mask or iris. InputError where missing or damaged."""
    return checked_path(NETWORK_FILES[name])


def load_face_networks() -> FaceNetworks:
    """The three networks of the face, ready to run."""
    return FaceNetworks(*(network_path(name) for name in ("face_detector", "face_landmarks", "person_mask")))


_of_thread = threading.local()
_one_at_a_time = threading.Lock()
"""OpenCV sets up its table of layers when the first network is read: a second thread finds a part of it."""


def own_face_networks() -> FaceNetworks:
    """The networks of the calling thread, loaded at its first call: each runs one picture at a time."""
    if not hasattr(_of_thread, "networks"):
        with _one_at_a_time:
            _of_thread.networks = load_face_networks()
    return _of_thread.networks


def own_iris_network() -> IrisNetwork:
    """The network of the iris of the calling thread, loaded at its first call. InputError where missing or damaged."""
    if not hasattr(_of_thread, "iris"):
        with _one_at_a_time:
            _of_thread.iris = IrisNetwork(network_path("iris"))
    return _of_thread.iris


def load_head_model() -> HeadModel:
    """The head model of set-up, at its coarsest level. InputError where missing or damaged."""
    from shared.tracking.head_model import HeadModel  # with all that meshes need; the face networks do without

    return HeadModel.from_arrays(load_arrays(checked_path(HEAD_MODEL_FILE)))


def checked_path(file_name: str) -> Path:
    """Path of a file in the models folder whose content is what `models.json` says."""
    folder = models_folder()
    path, list_path = folder / file_name, folder / LIST_FILE
    for needed in (list_path, path):
        if not needed.is_file():
            raise InputError("the models are not set up", where=str(needed), got="no such file", hint=_HINT)
    listed = {entry["file"]: entry["sha256"] for entry in _read_list(list_path)}
    expected, got = listed.get(file_name, "no entry in models.json"), hash_file(path)
    if got != expected:
        raise InputError(
            "a model file is damaged", where=str(path), got=f"SHA-256 {got[:16]}", expected=expected[:16], hint=_HINT
        )
    return path


def _read_list(path: Path) -> list[dict]:
    try:
        return read_json(path)["models"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError("the list of models is damaged", where=str(path), got=error, hint=_HINT) from error
