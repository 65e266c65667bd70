"""The models that set-up leaves on the machine: which there are and where. What a stage reads of them is an input."""

from __future__ import annotations

import os
from pathlib import Path

NETWORK_FILES = {
    "face_detector": "face_detection_short_range.tflite",
    "face_landmarks": "face_landmark.tflite",
    "person_mask": "selfie_segmentation.tflite",
    "iris": "iris_landmark.tflite",
}
FACE_NETWORKS = tuple(NETWORK_FILES[name] for name in ("face_detector", "face_landmarks", "person_mask"))
IRIS_NETWORK = NETWORK_FILES["iris"]
HEAD_MODEL_FILE = "head_model.npz"


def models_folder() -> Path:
    """The folder that set-up fills: LIMN_MODELS, or `.models` in the repository."""
    chosen = os.environ.get("LIMN_MODELS")
    return Path(chosen) if chosen else Path(__file__).resolve().parents[2] / ".models"
