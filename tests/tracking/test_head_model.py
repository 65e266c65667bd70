"""The head model: the arithmetic on a toy, and the properties that the built model must have."""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from toy_head import toy_head

from shared.capture.landmarks import BROW_LEFT, BROW_RIGHT, CHIN, EYE_CORNERS_LEFT, EYE_CORNERS_RIGHT, OVAL
from shared.geometry.mesh import Mesh, interpolate, midpoint_subdivision, rasterize_uv, vertex_normals
from shared.geometry.raycast import RayScene
from shared.tracking.head_model import HeadModel, child_location, parent_location

INTERPUPILLARY_MM = 63.0


def _face_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def _vertices_of(model: HeadModel, *names: str) -> np.ndarray:
    return np.unique(model.faces[model.segment(*names)])


class TestArithmetic:
    def test_shape_is_linear_in_the_codes(self):
        toy = toy_head(2)
        expected = toy.template + 2.0 * toy.identity_basis[0] - toy.identity_basis[1] + 0.5 * toy.expression_basis[0]
        assert np.allclose(toy.shape([2.0, -1.0], [0.5]), expected, atol=1e-12)
        assert np.allclose(toy.shape([2.0]), toy.template + 2.0 * toy.identity_basis[0], atol=1e-12)

    def test_arrays_bring_the_model_back(self):
        toy = toy_head(2)
        again = HeadModel.from_arrays(toy.to_arrays())
        assert again.segment_names == toy.segment_names and again.expression_names == toy.expression_names
        assert np.array_equal(again.template, toy.template)
        assert np.allclose(again.identity_basis, toy.identity_basis, atol=1e-5)
        assert all(array.dtype != object for array in toy.to_arrays().values())

    def test_subdivision_commutes_with_the_codes(self):
        toy = toy_head(2)
        code, activation = [1.5, -0.5], [0.7]
        coarse = HeadModel.from_arrays({**toy.to_arrays(), "template": toy.shape(code, activation)})
        assert np.allclose(toy.subdivided().shape(code, activation), coarse.subdivided().template, atol=1e-4)

    def test_children_lie_where_their_parents_did(self):
        rng = np.random.default_rng(4)
        toy = toy_head(2)
        face = rng.integers(0, len(toy.faces), 500).astype(np.int32)
        bary = rng.dirichlet((1, 1, 1), 500)
        middle, fine_faces = midpoint_subdivision(toy.faces, len(toy.template))
        child, child_bary = child_location(face, bary)
        expected = interpolate(toy.template, toy.faces, face, bary)
        got = interpolate(middle @ toy.template, fine_faces, child, child_bary)
        assert np.allclose(got, expected, atol=1e-9)
        assert child_bary.min() > -1e-12 and np.allclose(child_bary.sum(1), 1)
        back, back_bary = parent_location(child, child_bary)
        assert np.array_equal(back, face) and np.allclose(back_bary, bary, atol=1e-12)

    def test_landmarks_that_lie_nowhere(self):
        toy = toy_head(2)
        toy.landmark_face[7] = -1
        assert np.isnan(toy.landmarks(toy.template)[7]).all()
        assert toy.subdivided().landmark_face[7] == -1


class TestForm:
    def test_counts(self, model):
        assert 4000 < len(model.template) < 5000
        assert model.identity_basis.shape == (50, len(model.template), 3)
        assert model.expression_basis.shape == (25, len(model.template), 3)
        assert len(model.expression_names) == 25 and len(set(model.expression_names)) == 25
        assert model.landmark_face.shape == (468,) and model.landmark_face.min() >= 0
        assert model.faces.dtype == model.face_uvs.dtype == np.int32 and model.face_segment.dtype == np.uint8

    def test_levels(self, model):
        middle = model.subdivided()
        fine = middle.subdivided()
        assert len(fine.faces) == 16 * len(model.faces) and 65_000 < len(fine.template) < 80_000
        for level in (middle, fine):
            assert np.linalg.norm(level.landmarks(level.template) - model.landmarks(model.template), axis=1).max() < 2.5
            assert np.array_equal(np.unique(level.face_segment), np.unique(model.face_segment))
            assert level.uvs.min() >= 0 and level.uvs.max() <= 1

    def test_is_one_sound_surface(self, model):
        """pymeshlab's own measures: skin with cavities and two eyeballs, one rim, no flaw."""
        pymeshlab = pytest.importorskip("pymeshlab")
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=model.template, face_matrix=model.faces))
        measures = meshes.get_topological_measures()
        assert measures["is_mesh_two_manifold"] and measures["non_two_manifold_edges"] == 0
        assert measures["connected_components_number"] == 3 and measures["number_holes"] == 1
        assert measures["unreferenced_vertices"] == 0 and measures["genus"] == 0
        assert _face_area(model.template, model.faces).min() > 1e-4

    def test_normals_point_outwards(self, model):
        skin = _vertices_of(model, "forehead", "cheek_left", "cheek_right", "scalp", "chin")
        outward = model.template[skin] / np.linalg.norm(model.template[skin], axis=1, keepdims=True)
        assert (vertex_normals(model.template, model.faces)[skin] * outward).sum(1).mean() > 0.8

    def test_rays_from_outside_never_pass_through(self, model):
        """From the front and the sides, whatever is hit is hit on its outer face."""
        scene = RayScene(model.template, model.faces)
        up, across = np.meshgrid(np.linspace(-70, 110, 60), np.linspace(-60, 60, 50))
        origins = np.stack([across.ravel(), up.ravel(), np.full(up.size, 400.0)], axis=1)
        face, _, _ = scene.intersect(origins, np.tile([0.0, 0.0, -1.0], (len(origins), 1)))
        corners = model.template[model.faces[face[face >= 0]]]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
        assert (face >= 0).mean() > 0.85 and (facing > 0).mean() > 0.999


class TestAnatomy:
    def test_adult_size(self, model):
        eyes = model.template[_vertices_of(model, "eyes")]
        distance = eyes[eyes[:, 0] > 0, 0].mean() - eyes[eyes[:, 0] < 0, 0].mean()
        assert distance == pytest.approx(INTERPUPILLARY_MM, abs=0.5)
        face_height = model.landmarks(model.template)[168, 1] - model.landmarks(model.template)[CHIN, 1]
        assert 105 < face_height < 130
        scalp = model.template[_vertices_of(model, "scalp")]
        assert 140 < np.ptp(scalp[:, 0]) < 168

    def test_axes_and_origin(self, model):
        points = model.landmarks(model.template)
        assert points[EYE_CORNERS_LEFT[0], 0] > 30 and points[EYE_CORNERS_RIGHT[0], 0] < -30
        assert points[10, 1] > points[CHIN, 1] + 120 and points[1, 2] > 100
        ears = model.template[_vertices_of(model, "ears")]
        assert np.all(np.abs((ears.max(0) + ears.min(0))[1:] / 2) < (14, 14)) and abs(ears[:, 0].mean()) < 0.01

    def test_template_is_symmetric(self, model):
        assert cKDTree(model.template).query(model.template * (-1, 1, 1))[0].max() < 1e-6

    def test_identity_is_ordered_and_plausible(self, model):
        area = np.bincount(model.faces.ravel(), np.repeat(_face_area(model.template, model.faces), 3))
        front = area * (model.template[:, 2] > 20) * (model.template[:, 1] > -90)
        strength = np.einsum("kvi,v->k", model.identity_basis.astype(np.float64) ** 2, front)
        assert np.argmax(strength) == 0
        assert np.corrcoef(np.arange(50), np.log(strength))[0, 1] < -0.9
        rng = np.random.default_rng(1)
        breadth = [np.ptp(model.shape(rng.standard_normal(50))[_vertices_of(model, "scalp"), 0]) for _ in range(20)]
        assert 125 < min(breadth) and max(breadth) < 195

    def test_head_size_is_within_reach(self, model):
        """A head 3 % larger all over is a plausible code (up to a shift, which the pose takes)."""
        face = _vertices_of(model, "forehead", "nose", "cheek_left", "cheek_right", "chin", "lips", "jaw")
        basis = model.identity_basis[:, face].reshape(50, -1).astype(np.float64)
        basis = np.concatenate([basis, np.tile(np.eye(3), len(face))])
        wanted = (0.03 * model.template[face]).ravel()
        code = np.linalg.lstsq(basis.T, wanted, rcond=None)[0]
        assert np.sqrt(((basis.T @ code - wanted) ** 2).mean()) < 0.1 and np.abs(code[:50]).max() < 2.0

    @pytest.mark.parametrize("identity", [None, 3])
    def test_closed_eyes_are_closed(self, model, identity):
        code = None if identity is None else np.random.default_rng(identity).standard_normal(50)
        blink = np.array([name.startswith("eye_blink") for name in model.expression_names], float)
        assert self._eye_hits(model, model.shape(code)) > 150
        assert self._eye_hits(model, model.shape(code, blink)) == 0

    @staticmethod
    def _eye_hits(model: HeadModel, vertices: np.ndarray) -> int:
        """How many of a millimetre grid of rays from the front meet an eyeball first."""
        x, y = np.meshgrid(np.arange(-55.0, 56.0), np.arange(5.0, 60.0))
        origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 400.0)], axis=1)
        face, _, _ = RayScene(vertices, model.faces).intersect(origins, np.tile([0.0, 0.0, -1.0], (len(origins), 1)))
        return int(model.segment("eyes")[face[face >= 0]].sum())

    def test_expressions_stay_in_their_region(self, model):
        motion = np.linalg.norm(model.expression_basis, axis=2)
        for name, where in (("eye_blink_left", "lids"), ("jaw_open", "chin"), ("mouth_pucker", "lips")):
            moved = motion[model.expression_names.index(name)]
            assert moved[_vertices_of(model, where)].max() > 3.0
            assert moved[_vertices_of(model, "forehead")].max() < 1.5
        left = motion[model.expression_names.index("eye_blink_left")]
        assert model.template[left > 1.0, 0].min() > -1


class TestSegments:
    def test_all_regions_exist(self, model):
        wanted = "forehead brows lids nose cheek_left cheek_right upper_lip_skin lips chin jaw ears neck scalp eyes"
        for name in wanted.split():
            assert model.segment(name).sum() > 20, name

    def test_places(self, model):
        centre = {name: model.template[_vertices_of(model, name)].mean(0) for name in model.segment_names}
        heights = ["scalp", "forehead", "brows", "lids", "nose", "upper_lip_skin", "lips", "chin", "neck"]
        order = [centre[name][1] for name in heights]
        assert order[1:] == sorted(order[1:], reverse=True)
        assert centre["cheek_left"][0] > 25 and centre["cheek_right"][0] < -25
        assert abs(centre["ears"][0]) < 1 and centre["scalp"][2] < centre["forehead"][2]
        with pytest.raises(ValueError, match="not in tuple"):
            model.segment("forhead")


class TestTexture:
    def test_no_face_overlaps_another(self, model):
        """Every face is laid out face up, and the covered area equals the sum of the areas: nothing lies twice."""
        uv = model.uvs[model.face_uvs]
        edge_a, edge_b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        area = (edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]) / 2
        assert area.min() > 0
        face, _ = rasterize_uv(Mesh(model.template, model.faces, model.uvs, model.face_uvs), 1024)
        covered = (face >= 0).mean()
        assert area.sum() == pytest.approx(covered, rel=3e-3)
        assert covered > 0.88 and model.uvs.min() > 0 and model.uvs.max() < 1

    def test_islands_keep_their_distance(self, model):
        size = 1024
        face, _ = rasterize_uv(Mesh(model.template, model.faces, model.uvs, model.face_uvs), size)
        count, islands = cv2.connectedComponents((face >= 0).astype(np.uint8))
        assert count == 1 + 5
        for k in range(1, count):
            distance = cv2.distanceTransform((islands != k).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            assert distance[(islands > 0) & (islands != k)].min() >= 4

    def test_face_gets_the_texels_without_distortion(self, model):
        uv_area = _face_area(np.pad(model.uvs, ((0, 0), (0, 1))), model.face_uvs)
        area = _face_area(model.template, model.faces)
        face = model.segment("forehead", "brows", "lids", "nose", "cheek_left", "cheek_right", "lips", "chin")
        density = np.sqrt(uv_area / area) * 1024
        assert np.median(density[face]) > 3.0
        assert np.median(density[face]) > 1.8 * np.median(density[model.segment("scalp")])
        assert np.percentile(density[face], 95) / np.percentile(density[face], 5) < 2.5
        assert np.median(_anisotropy(model)[face]) < 1.4


def _anisotropy(model: HeadModel) -> np.ndarray:
    """[F] ratio of the two stretches from the surface to the texture."""
    a, b, c = (model.template[model.faces[:, k]] for k in range(3))
    x_axis = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    along = ((c - a) * x_axis).sum(1)
    across = np.linalg.norm((c - a) - along[:, None] * x_axis, axis=1)
    rest = np.zeros((len(a), 2, 2))
    rest[:, 0, 0], rest[:, 0, 1], rest[:, 1, 1] = np.linalg.norm(b - a, axis=1), along, across
    uv = model.uvs[model.face_uvs]
    stretches = np.linalg.svd(np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=2) @ np.linalg.inv(rest))[1]
    return stretches[:, 0] / stretches[:, 1]


class TestEmbedding:
    def test_weights(self, model):
        assert model.landmark_weight.min() >= 0 and model.landmark_weight.max() <= 1
        assert (model.landmark_weight[list(OVAL)] == 0).all() and (model.landmark_weight > 0.2).sum() > 300

    def test_landmarks_lie_on_their_features(self, model):
        names = np.array(model.segment_names)[model.face_segment[model.landmark_face]]
        assert names[1] == "nose" and names[CHIN] in ("chin", "jaw") and names[0] == "lips" and names[17] == "lips"
        assert all(names[k] == "lids" for k in (*EYE_CORNERS_LEFT, *EYE_CORNERS_RIGHT, 159, 145, 386, 374))
        assert all(names[k] in ("brows", "forehead") for k in (*BROW_LEFT, *BROW_RIGHT))
        assert not np.isin(names, ("eyes", "inner_mouth", "eye_sockets")).any()

    def test_landmarks_are_symmetric(self, model):
        points = model.landmarks(model.template)
        for right, left in ((33, 263), (133, 362), (61, 291), (105, 334), (129, 358)):
            assert np.allclose(points[right] * (-1, 1, 1), points[left], atol=1.0)
