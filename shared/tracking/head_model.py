"""A linear model of adult heads: one topology for everyone, identity and expression components.

    vertices = template + sum_i identity_i B_i + sum_j expression_j E_j        (mm, head space)

The bases are displacements: B_i for one standard deviation, E_j for one full facial action. Built at set-up
from MakeHuman's CC0 data (tools.setup.head_model); the form is that of [Blanz1999].
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.sparse as sparse

from shared.geometry.mesh import Mesh, interpolate, loop_subdivision, midpoint_subdivision
from shared.geometry.surface import Surface


@dataclass(frozen=True)
class HeadModel:
    """The model at one level of subdivision; level 0 has about 4500 vertices.

    template [V, 3] mm, the mean adult, origin between the ear canals; identity_basis [I, V, 3] mm per
    standard deviation, by variance; expression_basis [E, V, 3] mm per unit activation (0 to 1);
    expression_names [E]; faces [F, 3]; uvs [T, 2]; face_uvs [F, 3]; face_segment [F] index into
    segment_names; landmark_face [468] (-1: none) and landmark_bary [468, 3]: where each landmark of
    shared.capture.landmarks lies; landmark_weight [468] in [0, 1], 0 where it slides over the skin.
    from_coarser [V, V0]: the Loop step from the level before, None at level 0.
    """

    template: np.ndarray
    identity_basis: np.ndarray
    expression_basis: np.ndarray
    expression_names: tuple[str, ...]
    faces: np.ndarray
    uvs: np.ndarray
    face_uvs: np.ndarray
    face_segment: np.ndarray
    segment_names: tuple[str, ...]
    landmark_face: np.ndarray
    landmark_bary: np.ndarray
    landmark_weight: np.ndarray
    from_coarser: sparse.csr_matrix | None = None

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> HeadModel:
        """From the arrays of `to_arrays`, which are of level 0. KeyError where one is missing."""
        values = {name: arrays[name] for name in _array_names()}
        for name in ("expression_names", "segment_names"):
            values[name] = tuple(str(item) for item in values[name])
        return HeadModel(**values)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, without pickled objects; the bases as float32 (rounding below 1e-5 mm)."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _array_names()}
        for name in ("identity_basis", "expression_basis"):
            arrays[name] = arrays[name].astype(np.float32)
        return arrays

    def segment(self, *names: str) -> np.ndarray:
        """[F] bool: does a face belong to one of the named segments? ValueError for an unknown name."""
        return np.isin(self.face_segment, [self.segment_names.index(name) for name in names])

    @property
    def landmark_segments(self) -> np.ndarray:
        """[468] the name of the segment that each landmark lies on, "" where the model has none."""
        names = np.array(self.segment_names)[self.face_segment[self.landmark_face]]
        return np.where(self.landmark_face >= 0, names, "")

    def shape(self, identity: np.ndarray | None = None, expression: np.ndarray | None = None) -> np.ndarray:
        """[V, 3] float64 vertices in mm. identity [<=I] standard deviations, expression [<=E] activations;
        None: 0.
        """
        vertices = np.array(self.template, np.float64)
        for code, basis in ((identity, self.identity_basis), (expression, self.expression_basis)):
            if code is not None:
                code = np.asarray(code, np.float64)
                vertices += np.tensordot(code, basis[: len(code)], axes=1)
        return vertices

    def mesh(self, identity: np.ndarray | None = None, expression: np.ndarray | None = None) -> Mesh:
        """The surface with its texture coordinates for codes identity [<=I], expression [<=E], as in shape."""
        return Mesh(self.shape(identity, expression), self.faces, self.uvs, self.face_uvs)

    def surface(self, vertices: np.ndarray) -> Surface:
        """Vertices [V, 3] mm with this topology and its segments."""
        return Surface(Mesh(vertices, self.faces, self.uvs, self.face_uvs), self.face_segment, self.segment_names)

    def landmarks(self, vertices: np.ndarray) -> np.ndarray:
        """[468, 3] places of the landmarks on vertices [V, 3] of this topology; NaN where landmark_face is -1."""
        points = interpolate(np.asarray(vertices, np.float64), self.faces, self.landmark_face, self.landmark_bary)
        points[self.landmark_face < 0] = np.nan
        return points

    def subdivided(self) -> HeadModel:
        """One level finer: a Loop step for template and bases, midpoints for uvs; landmarks keep their place."""
        smooth, faces = loop_subdivision(self.faces, len(self.template))
        middle, face_uvs = midpoint_subdivision(self.face_uvs, len(self.uvs))
        landmark_face, landmark_bary = child_location(self.landmark_face, self.landmark_bary)
        return replace(
            self,
            template=smooth @ self.template,
            identity_basis=_apply(smooth, self.identity_basis),
            expression_basis=_apply(smooth, self.expression_basis),
            faces=faces.astype(np.int32),
            uvs=middle @ self.uvs,
            face_uvs=face_uvs.astype(np.int32),
            face_segment=np.repeat(self.face_segment, 4),
            landmark_face=landmark_face,
            landmark_bary=landmark_bary,
            from_coarser=smooth,
        )


def _array_names() -> list[str]:
    return [field.name for field in fields(HeadModel) if field.name != "from_coarser"]


def child_location(face: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points of a mesh lie after each face was split in four: face [N], bary [N, 3] -> the same, one
    level down.

    The split of shared.geometry.mesh: children 4 f + k, k = 0..2 at corner k as (corner, next middle, last middle)
    turned so that slot k keeps corner k; k = 3 in the middle as (ab, bc, ca). Faces of -1 stay -1.
    """
    bary = np.asarray(bary, np.float64)
    a, b, c = bary.T
    # Slots of the children in _split: [a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca].
    candidates = np.stack(
        [
            np.stack([a - b - c, 2 * b, 2 * c], axis=1),
            np.stack([2 * a, b - a - c, 2 * c], axis=1),
            np.stack([2 * a, 2 * b, c - a - b], axis=1),
            np.stack([a + b - c, b + c - a, c + a - b], axis=1),
        ],
        axis=1,
    )
    child = np.argmax(candidates.min(-1), axis=1)
    chosen = candidates[np.arange(len(child)), child]
    return np.where(face < 0, -1, 4 * face + child).astype(np.int32), chosen


def parent_location(face: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of `child_location`: one level up. face [N] int; bary [N, 3]."""
    middles = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]])  # ab, bc, ca
    corners = np.eye(3)
    slots = np.stack(
        [
            np.stack([corners[0], middles[0], middles[2]]),
            np.stack([middles[0], corners[1], middles[1]]),
            np.stack([middles[2], middles[1], corners[2]]),
            middles,
        ]
    )
    return np.where(face < 0, -1, face // 4).astype(np.int32), np.einsum("ni,nij->nj", bary, slots[face % 4])


def _apply(matrix, basis: np.ndarray) -> np.ndarray:
    """Sparse [V2, V] on displacements [K, V, 3] -> [K, V2, 3], keeping the type."""
    count, vertices, _ = basis.shape
    stacked = matrix.astype(basis.dtype) @ basis.transpose(1, 0, 2).reshape(vertices, -1)
    return np.ascontiguousarray(stacked.reshape(-1, count, 3).transpose(1, 0, 2))
