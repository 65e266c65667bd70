"""A solved head from where no camera stood, and under light that no clip had; what it covers of itself.

The transfer is traced once; a view needs a camera, a relit picture a light. Everything happens in head space: the light
is turned into it, and the head stays where it is ("moves: camera" to the shading).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from shared.compute.threads import share_out
from shared.geometry.blend_shapes import LidActions
from shared.geometry.eyeballs import gaze_between, pitch_from_rest
from shared.geometry.mesh import Mesh, interpolate, normalised
from shared.geometry.raycast import RAY_START_MM, camera_hits
from shared.geometry.transforms import camera_centres, rigid, world_from_head
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.texture import sample_bilinear
from shared.imaging.turning_eyes import TurningEyes
from shared.rendering.envmap import cube_from_latlong, latlong_directions, latlong_lookup
from shared.rendering.near_lamp import NearLamp
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.rendering.render import LookingEyes, SurfaceMaps, head_coverage, render_frame, render_lights, solid_viewer
from shared.rendering.shading import DEEP, Material, VertexShading
from shared.rendering.split_sum import SplitSum
from shared.rendering.studio_lights import STUDIO_LIGHTS, studio_light
from shared.rendering.transfer import Transfer, mesh_points
from shared.rendering.view_set import NOVEL_VIEWS, ROUGHNESSES, ViewCamera, ViewSet

DISTANCE_MM, FILLED = 900.0, 1.1
"""The virtual camera's distance from the head's middle, and the head's half diagonal in half pictures."""
LIGHT_RESOLUTION, VIEW_SIZES = 16, Sizes(directions=640, nodes=500)
ORIENTATION_MM = 40.0
EDGE_COSINE = -0.1
"""Vertices that turn away from a camera by more than this show in no triangle that it sees."""
RELIT_YAW_DEG = -15.0
HELD_OUT_SHOWN = 4
"""Held-out frames that the report re-renders beside the others."""


def make_views(
    mesh: Mesh,
    maps: Mapping[str, np.ndarray],
    envmap: np.ndarray,
    camera_from_head: np.ndarray,
    moves: str,
    pixels: int,
    held_out: Mapping[int, ViewCamera],
    progress: Callable | None = None,
    lamp: NearLamp | None = None,
    eyes: TurningEyes | None = None,
    lids: LidActions | None = None,
    head_faces: int | None = None,
) -> ViewSet:
    """All of them, pixels wide. maps and progress as for HeadViews; envmap [H, 2 H, 3], camera_from_head [F, 4, 4] and
    moves of the clip; held_out: frames of the clip to re-render, with their cameras; lamp: of its light, where it
    stands near: for those frames, while from elsewhere the head is seen under the light as its mean place has it;
    eyes: those of the mesh, which turn with the cameras' gaze; lids: see HeadViews."""
    around = [orbit_camera(mesh, *place, pixels) for place in NOVEL_VIEWS.values()]
    camera, front = orbit_camera(mesh, RELIT_YAW_DEG, 0.0, pixels), orbit_camera(mesh, 0.0, 0.0, pixels)
    cameras = [*around, camera, front, *held_out.values()]
    views = HeadViews(mesh, maps, VIEW_SIZES, cameras, progress, eyes=eyes, lids=lids, head_faces=head_faces)
    novel = views.render(clip_light(envmap, camera_from_head, moves), around)
    again = views.render(envmap, list(held_out.values()), moves, fade=False, lamp=lamp) if held_out else []
    covered = share_out(len(ROUGHNESSES), lambda k: views.visibility(front, ROUGHNESSES[k]))
    return ViewSet(
        dict(zip(NOVEL_VIEWS, novel, strict=True)),
        dict(zip(STUDIO_LIGHTS, views.relit([studio_light(name) for name in STUDIO_LIGHTS], camera), strict=True)),
        dict(zip(ROUGHNESSES, covered, strict=True)),
        dict(zip(held_out, again, strict=True)),
        camera,
    )


def orbit_camera(mesh: Mesh, yaw_deg: float, pitch_deg: float, pixels: int) -> ViewCamera:
    """A camera that looks at the head's middle from yaw (90: its left, the picture's right seen from the front) and
    pitch (90: above), a square picture of the given size."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm((high - low)[:2]))
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    back = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    rotation = np.stack([right, np.cross(right, back), -back])  # x right, y down, z forward
    focal = FILLED * pixels / 2 * DISTANCE_MM / radius
    intrinsics = np.array([[focal, 0.0, pixels / 2], [0.0, focal, pixels / 2], [0.0, 0.0, 1.0]])
    return ViewCamera(rigid(rotation, -rotation @ (middle + DISTANCE_MM * back)), intrinsics, (pixels, pixels))


def held_out_cameras(
    poses: Mapping[str, np.ndarray], intrinsics: np.ndarray, size: tuple[int, int], solve: Mapping
) -> dict[int, ViewCamera]:
    """{frame: Camera} of a few held-out frames that inverse_render did not re-render.

    poses: its poses.npz; intrinsics [3, 3] and size of the crop, where that does not hold the former; solve: its
    solve.json.
    """
    place = {int(frame): f for f, frame in enumerate(poses["frame_index"])}
    done = set(solve["render_frames"])
    rest = [frame for frame in solve.get("held_out_frames", ()) if frame in place and frame not in done]
    chosen = [rest[i] for i in spread_frames(len(rest), HELD_OUT_SHOWN)] if rest else []
    lens = poses.get("intrinsics_crop", intrinsics)
    return {frame: clip_camera(poses, place[frame], lens, size) for frame in chosen}


def clip_camera(poses: Mapping[str, np.ndarray], f: int, lens: np.ndarray, size: tuple[int, int]) -> ViewCamera:
    """Camera f of a poses.npz with a lens [3, 3] and a picture's size (width, height), px, with gaze, gain and lids if
    it has them. Shut eyes, which the lids may leave open a little, look as they do before and after."""
    gain, lids = (poses[name][f] if name in poses else None for name in ("gain", "lids"))
    gaze = gaze_between(poses["eye_turn"])[f] if "eye_turn" in poses else None
    pitch = pitch_from_rest(poses["gaze"])[f] if "gaze" in poses else None
    return ViewCamera(poses["camera_from_head"][f], lens, size, gaze, gain, lids, pitch)


def frontal_frame(camera_from_head: np.ndarray) -> int:
    """Index of the frame in which the face looks most directly into the camera. camera_from_head [F, 4, 4]."""
    towards = -camera_from_head[:, :3, 3] / np.linalg.norm(camera_from_head[:, :3, 3], axis=1, keepdims=True)
    return int(np.argmax((camera_from_head[:, :3, 2] * towards).sum(1)))


def light_in_head_space(envmap: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Lat-long radiance in the world [H, 2 H, 3], turn [3, 3] world_from_head -> the same light as the head sees it."""
    return latlong_lookup(envmap, latlong_directions(len(envmap)) @ turn.T)


class HeadViews:
    """Pictures of one solved head.

    maps: diffuse_albedo [S, T, 3], specular_intensity [S, T], roughness [S, T], perhaps alpha [S, T]. cameras: all that
    will look at it, so that only what they can see is traced; none: everything; only [V]: vertices that matter, all by
    default. progress(items, label) wraps the trace. light_resolution: edge of the cubemap that lights are seen through;
    deep: see VertexShading; over 1 where cavities are exact; eyes: those of the mesh, None: they do not turn; lids:
    actions of the mesh with which they move as cameras say, None: they do not. Light on them stays what it is on open
    ones. head_faces: so many of the mesh's faces are the head's, and those after them stand off it and cast no shadow
    on it; None: all are.
    """

    def __init__(
        self,
        mesh: Mesh,
        maps: Mapping[str, np.ndarray],
        sizes: Sizes | None = None,
        cameras: Sequence[ViewCamera] = (),
        progress: Callable | None = None,
        light_resolution: int = LIGHT_RESOLUTION,
        deep: float = DEEP,
        only: np.ndarray | None = None,
        eyes: TurningEyes | None = None,
        lids: LidActions | None = None,
        head_faces: int | None = None,
    ):
        self.light_resolution, self.deep, self.eyes, self.lids = light_resolution, deep, eyes, lids
        self.viewer = SurfaceViewer.of(mesh)
        self.maps = SurfaceMaps(maps["diffuse_albedo"], maps["specular_intensity"], maps.get("alpha"))
        self.solid = self.viewer if self.maps.alpha is None else solid_viewer(mesh, self.maps.alpha)
        head = self.viewer if head_faces is None else SurfaceViewer.of(_first_faces(mesh, head_faces))
        self.precomputed = precompute_transfer(head, sizes or Sizes())
        seen = np.ones(len(mesh.vertices), bool) if not cameras else self._seen(cameras)
        self.index = np.nonzero(seen if only is None else seen & only)[0]
        self.points = mesh_points(mesh, self.index)
        wrap = progress or (lambda items, label: items)
        count = len(head.mesh.vertices)
        on_head = np.nonzero(self.index < count)[0]
        self.transfer: Transfer = self.precomputed.trace(
            self.points.take(on_head), lambda items: wrap(items, "visibility"))
        if len(on_head) < len(self.index):
            standing = self.precomputed.with_standing(self.solid)
            off_head = self.points.take(np.nonzero(self.index >= count)[0])
            self.transfer = self.transfer.followed_by(standing.trace(off_head))
        self.material = self._material(head.mesh, maps)
        # What stands in for a point deep in a cavity is the nearest one in the open. Seen from inside the mouth that
        # can be the outside of the cheek, unless orientation counts as well.
        self._surface_place = np.concatenate([mesh.vertices, ORIENTATION_MM * self.viewer.normals], axis=1)
        self._lit: VertexShading | None = None

    def _seen(self, cameras: Sequence[ViewCamera]) -> np.ndarray:
        """[V] bool: vertices that some camera sees, and those around them, whose triangles reach into the open."""
        seen = np.zeros(len(self.viewer.mesh.vertices), bool)
        for camera in cameras:
            towards = self._towards(camera, self.viewer.mesh.vertices)
            front = np.nonzero((towards * self.viewer.normals).sum(1) > EDGE_COSINE)[0]
            starts = self.viewer.mesh.vertices[front] + RAY_START_MM * self.viewer.normals[front]
            seen[front[~self.solid.scene.occluded(starts, towards[front])]] = True
        return self.viewer.grown(seen)

    @staticmethod
    def _towards(camera: ViewCamera, positions: np.ndarray) -> np.ndarray:
        """[N, 3] unit vectors from the positions to the camera."""
        return normalised(camera_centres(camera.camera_from_head[None])[0] - positions)

    def _material(self, mesh: Mesh, maps: Mapping[str, np.ndarray]) -> Material:
        """The maps at the nodes, for light that bounces, and the roughness at the traced points; mesh: the head's."""
        whole = self.viewer.mesh
        uv = np.zeros((len(whole.vertices), 2))
        uv[whole.faces.ravel()] = whole.uvs[whole.face_uvs.ravel()]
        own = uv[: len(mesh.vertices)]
        nearest = cKDTree(mesh.vertices).query(self.precomputed.nodes.points.positions)[1]
        albedo = sample_bilinear(maps["diffuse_albedo"], uv[nearest])
        specular = float(np.median(sample_bilinear(maps["specular_intensity"], own)))
        roughness = sample_bilinear(maps["roughness"], uv).ravel()
        varies, usual = np.ptp(roughness) > 1e-3, float(np.median(roughness[: len(own)]))
        return Material(albedo, specular, usual, roughness[self.index] if varies else None)

    def render(
        self,
        light: np.ndarray,
        cameras: Sequence[ViewCamera],
        moves: str = "camera",
        fade: bool = True,
        lamp: NearLamp | None = None,
    ) -> list[np.ndarray]:
        """Lat-long radiance [H, 2 H, 3] -> a linear picture [h, w, 3] per camera, 0 beside the head; lamp: of the
        light, where it stands near the cameras' heads.

        moves "camera": the light is given in head space; "head": in the world of geometry.world_from_head. fade: pixels
        that the head covers in part are darker by the rest; else they show the mean of the part.
        """
        return self._pictures(self._shading([light], cameras, moves, lamp), cameras, fade)

    def relit(self, lights: Sequence[np.ndarray], camera: ViewCamera) -> list[np.ndarray]:
        """A picture, as of render, for each of several lights, given in head space."""
        shading = self._shading(lights, [camera] * len(lights), "camera")
        pictures, covered = render_lights(
            self.viewer, shading, self.maps, range(len(lights)), camera.camera_from_head, camera.intrinsics,
            camera.size, eyes=self._looking(camera),
        )
        return [picture * covered[..., None] for picture in pictures]

    def _pictures(self, shading: VertexShading, cameras: Sequence[ViewCamera], fade: bool) -> list[np.ndarray]:
        """A camera's picture in each of the shading's frames."""
        pictures = []
        for k, camera in enumerate(cameras):
            picture, covered = render_frame(
                self._with_lids(camera), shading, self.maps, k, camera.camera_from_head, camera.intrinsics, camera.size,
                eyes=self._looking(camera),
            )
            picture = picture if camera.gain is None else picture * camera.gain
            pictures.append(picture * covered[..., None] if fade else picture)
        return pictures

    def _with_lids(self, camera: ViewCamera) -> SurfaceViewer:
        """The head with its lids as they are before a camera."""
        if self.lids is None or camera.lids is None:
            return self.viewer
        pitch = np.zeros(2) if camera.pitch is None else camera.pitch
        if not (np.any(camera.lids) or np.any(pitch)):
            return self.viewer
        vertices = self.lids.moved(self.viewer.mesh.vertices, camera.lids, pitch)
        return SurfaceViewer.of(self.viewer.mesh.replace(vertices=vertices))

    def _looking(self, camera: ViewCamera) -> LookingEyes | None:
        gaze = np.full((2, 2), np.nan) if camera.gaze is None else camera.gaze
        return None if self.eyes is None else LookingEyes(self.eyes, gaze)

    def _shading(
        self, lights: Sequence[np.ndarray], cameras: Sequence[ViewCamera], moves: str, lamp: NearLamp | None = None
    ) -> VertexShading:
        """Under one light for all cameras, or one for each; what no light changes is made once."""
        poses = np.stack([camera.camera_from_head for camera in cameras])
        cubes = [np.maximum(cube_from_latlong(light, self.light_resolution), 0.0) for light in lights]
        light, light_index = np.concatenate(cubes), None if len(lights) == 1 else np.arange(len(lights))
        if self._lit is None:
            self._lit = VertexShading(
                self.index,
                self._surface_place,
                self.points,
                self.transfer,
                self.precomputed.node_transfer,
                self.material,
                light,
                self.precomputed.directions,
                poses,
                moves,
                key_step=0.0,
                deep=self.deep,
                light_index=light_index,
                lamp=lamp,
                node_points=self.precomputed.nodes.points,
            )
            return self._lit
        return self._lit.under(light, poses, moves, light_index, lamp)

    def coverage(self, camera: ViewCamera) -> np.ndarray:
        """[h, w] in 0 .. 1: how much of each pixel the head covers, as render counts it."""
        return head_coverage(self.viewer, self.maps.alpha, camera.camera_from_head, camera.intrinsics, camera.size)

    def visibility(self, camera: ViewCamera, roughness: float) -> np.ndarray:
        """[h, w]: share of a lobe of this roughness about the reflected direction that the head leaves open; NaN beside
        the head. 1 where nothing covers it; for rough lobes it nears the sky's open share."""
        normals = self.points.normals
        towards = self._towards(camera, self.points.positions)
        facing = np.nonzero(((towards * normals).sum(1) > 0.0) & self._seen([camera])[self.index])[0]
        share = np.ones(len(self.viewer.mesh.vertices))
        visible = self.transfer.visibility(facing)
        share[self.index[facing]] = SplitSum(self.precomputed.directions).visible_share(
            normals[facing], towards[facing], roughness, visible
        )
        face, bary, _ = camera_hits(self.viewer.scene, camera.camera_from_head, camera.intrinsics, *camera.size)
        hit = face >= 0
        picture = np.full(face.shape, np.nan)
        picture[hit] = interpolate(share, self.viewer.mesh.faces, face[hit], bary[hit])
        return picture


def _first_faces(mesh: Mesh, count: int) -> Mesh:
    """Of a mesh whose first faces use the first vertices."""
    faces = mesh.faces[:count]
    return Mesh(mesh.vertices[: faces.max() + 1], faces, mesh.uvs, mesh.face_uvs[:count])


def clip_light(envmap: np.ndarray, camera_from_head: np.ndarray, moves: str) -> np.ndarray:
    """The recovered light as the head saw it when it looked into the camera: lat-long in head space. envmap [H, W,
    3] linear."""
    turned = world_from_head(camera_from_head[None, frontal_frame(camera_from_head)], moves)[0]
    return light_in_head_space(envmap, turned)
