"""Coverage-guided fuzzing of what reads files from strangers.

    pip install atheris
    python tests/robustness/fuzz_readers.py READER [--seconds 600] [--corpus DIR]

READER: subject, pipeline, manifest, events, landmarks, poses. A reader may refuse with InputError and nothing else;
every other exception, 10 s for one input or 2 GB of memory is a crash: libFuzzer writes the input to crash-* and stops.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import tempfile
import zipfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["shared", "tools", "yaml", "zipfile", "numpy.lib", "json"]):
    import numpy as np

    from shared.contract.drift import drift
    from shared.contract.hashing import HashMemory
    from shared.contract.manifest import Work, damage, outputs_digest, read_manifest
    from shared.contract.pipeline import load_pipeline
    from shared.contract.subject import load_subject
    from shared.errors import InputError
    from shared.io.arrays import save_arrays
    from shared.tracking.given_tracking import read_given_landmarks, read_given_poses
    from tools.cli.gates import check_gates
    from tools.cli.watch import Track

ROOT = Path(__file__).resolve().parents[2]
INDEX = np.arange(5)
FOLDER = Path(tempfile.mkdtemp(prefix="limn-fuzz-"))


def subject(data: bytes) -> None:
    """subject.yaml in a folder with a clip."""
    (FOLDER / "subject.yaml").write_bytes(data)
    (FOLDER / "clip.mp4").write_bytes(b"x")
    found = load_subject(FOLDER)
    assert found.video.resolve().is_relative_to(FOLDER.resolve())
    found.content()


def pipeline(data: bytes) -> None:
    """pipeline.yaml, its stages' declarations and presets."""
    (FOLDER / "pipeline.yaml").write_bytes(data)
    found = load_pipeline(FOLDER / "pipeline.yaml")
    assert found.root == ROOT
    check_gates(found)
    found.check()


def manifest(data: bytes) -> None:
    """manifest.json of a stage's folder that lies there."""
    (FOLDER / "manifest.json").write_bytes(data)
    (FOLDER / "provenance.json").write_text("{}")
    found = read_manifest(FOLDER)
    if found is not None:
        Work("read_text", 1, {"a": 1}, {"video": "0"}).reasons(found)
        outputs_digest(found)
        damage(FOLDER, found, HashMemory(FOLDER / "memory.json"))


def provenance(data: bytes) -> None:
    """provenance.json of a stage's folder that lies there."""
    (FOLDER / "provenance.json").write_bytes(data)
    damage(FOLDER, {"outputs": {"b": {"volatile": True}, "subject.yaml": {"volatile": True}}},
           HashMemory(FOLDER / "memory.json"))
    drift(FOLDER, (ROOT,))


def events(data: bytes) -> None:
    """A stage's event file, as `limn status` reads it."""
    (FOLDER / "events.jsonl").write_bytes(data)
    track = Track("anna", "read_text", FOLDER / "events.jsonl")
    for event in track.new_events():
        track.apply(event)
    str(track.progress)


def landmarks(data: bytes) -> None:
    """Landmarks of another tracker."""
    path = as_npz("landmarks.npz", "landmarks_px", data)
    points, have = read_given_landmarks(path, INDEX, (0.0, 0.0, 1.0))
    assert np.isfinite(points).all() and have.sum() >= 3


def poses(data: bytes) -> None:
    """Poses of another tracker."""
    path = as_npz("poses.npz", "camera_from_head", data)
    found, have = read_given_poses(path, INDEX)
    assert np.isfinite(found).all() and have.sum() >= 3


def as_npz(name: str, array: str, data: bytes) -> Path:
    """A file of these bytes; where they are no zip, two .npy members, so that the fuzzer need not learn checksums."""
    path = FOLDER / name
    if data.startswith(b"PK"):
        path.write_bytes(data)
        return path
    first, magic, second = data[6:].partition(b"\x93NUMPY")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{array}.npy", data[:6] + first)
        archive.writestr("frame_index.npy", magic + second)
    return path


READERS = {reader.__name__: reader for reader in (subject, pipeline, manifest, provenance, events, landmarks, poses)}


def seeds(name: str) -> list[bytes]:
    """Sound inputs to start from."""
    texts = {
        "subject": ["video: clip.mp4\ncamera: {focal_length_mm: 60, sensor_width_mm: 22.3}\n"
                    "colour: {transfer: srgb}\ncapture: {moves: head}\n",
                    "video: clip.mp4\ntracking: {landmarks: clip.mp4, poses: clip.mp4, hold_poses: true}\n"],
        "pipeline": [(ROOT / "pipeline.yaml").read_text(), "stages:\n  sample_frames: {needs: [], threads: 1}\n"],
        "manifest": ['{"schema": 1, "stage": "a", "version": 1, "parameters": {"a": 1}, "inputs": {}, '
                     '"outputs": {"subject.yaml": {"sha256": "0", "bytes": 3}, "b": {"volatile": true}}}'],
        "provenance": ['{"python": "3.11.7", "packages": {"numpy": "2.4.6"}, '
                       '"code": {"shared/rendering/brdf.py": "0"}, '
                       '"volatile": {"b": {"sha256": "0", "bytes": 3}, "subject.yaml": {"sha256": "0", "bytes": 3}}}'],
        "events": ['{"kind": "started", "time": 1}\n{"kind": "progress", "time": 2, "label": "a", "done": 1, '
                   '"total": 3}\n{"kind": "failed", "time": 3, "message": "m", "log": "l", "last": []}\n'],
    }
    if name in texts:
        return [text.encode() for text in texts[name]]
    file, members = io.BytesIO(), io.BytesIO()
    arrays = {"frame_index": INDEX, "landmarks_px": np.ones((5, 468, 2), np.float16),
              "camera_from_head": np.tile(np.diag([1.0, -1, -1, 1]), (5, 1, 1))}
    arrays["camera_from_head"][:, 2, 3] = 700
    kept = {key: arrays[key] for key in ("frame_index", "landmarks_px" if name == "landmarks" else "camera_from_head")}
    save_arrays(file, **kept)
    for key in sorted(kept, reverse=name == "landmarks"):
        np.lib.format.write_array(members, kept[key])
    return [file.getvalue(), members.getvalue()]


def main() -> None:
    """libFuzzer ends the process itself."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reader", choices=READERS)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--corpus", type=Path, default=None)
    options = parser.parse_args()
    corpus = options.corpus or FOLDER / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(seeds(options.reader)):
        (corpus / f"seed-{number}").write_bytes(data)
    reader = READERS[options.reader]

    def one_input(data: bytes) -> None:
        with contextlib.suppress(InputError):
            reader(data)

    for data in seeds(options.reader):
        reader(data)
    longest = "16384" if options.reader in ("landmarks", "poses") else "4096"
    atheris.Setup([sys.argv[0], f"-max_total_time={options.seconds}", f"-max_len={longest}", "-timeout=10",
                   "-rss_limit_mb=2048", "-print_final_stats=1", str(corpus)], one_input)
    os.chdir(FOLDER)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
