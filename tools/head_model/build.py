"""Puts the head model together from the wheel that carries MakeHuman's data."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from shared.head_model import HeadModel
from shared.landmarks import LANDMARK_COUNT, FaceNetworks
from tools.head_model.embedding import embed_landmarks
from tools.head_model.layout import texture_layout
from tools.head_model.makehuman import MakeHuman
from tools.head_model.segments import SEGMENT_NAMES, face_segments
from tools.head_model.shapes import EXPRESSIONS, head_shapes
from tools.head_model.topology import head_topology


def build_head_model(wheel: Path, networks: FaceNetworks) -> HeadModel:
    """The whole model at level 0; deterministic."""
    source = MakeHuman(wheel)
    topology = head_topology(source.base, source.mirror())
    shapes = head_shapes(source, topology)
    bare = HeadModel(
        template=shapes.template,
        identity_basis=shapes.identity,
        expression_basis=shapes.expression,
        expression_names=tuple(EXPRESSIONS),
        faces=topology.faces,
        uvs=np.zeros((len(shapes.template), 2)),
        face_uvs=topology.faces,
        face_segment=np.zeros(len(topology.faces), np.uint8),
        segment_names=SEGMENT_NAMES,
        landmark_face=np.full(LANDMARK_COUNT, -1, np.int32),
        landmark_bary=np.zeros((LANDMARK_COUNT, 3)),
        landmark_weight=np.zeros(LANDMARK_COUNT),
    )
    embedding = embed_landmarks(bare, topology, networks)
    ear_motion = sum(np.linalg.norm(source.target(f"ears/{side}-ear-wing-incr"), axis=1) for side in "lr")
    segment = face_segments(shapes.template, topology, embedding, ear_motion[topology.base_index])
    uvs, face_uvs = texture_layout(shapes.template, topology, segment)
    return replace(
        bare,
        uvs=uvs,
        face_uvs=face_uvs,
        face_segment=segment,
        landmark_face=embedding.face,
        landmark_bary=embedding.bary,
        landmark_weight=embedding.weight,
    )
