"""Camera, light, motion and pictures of a clip in USD.

The camera sits in the asset as filmed: lens and film back from the intrinsics, a shifted principal point as
aperture offsets. UsdGeomCamera counts focal length and apertures in tenths of a scene unit, here tenths of a
millimetre. Its axes are x right, y up, looking along -z, so it is the OpenCV camera turned half around x. The
dome light needs no transform: UsdLuxDomeLight's lat-long layout (OpenEXR's: longitude +pi at the left edge, 0
towards +z, pi/2 towards +x) is the layout of Limn's environment maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from shared.geometry.eyeballs import gaze_rotation
from shared.geometry.transforms import WORLD_FROM_CAMERA, invert_rigid
from shared.io.usd_material import TextureFile, define_plate_material

DEFAULT_FILM_WIDTH_MM = 36.0
"""Film back assumed where only the focal length in pixels is known; the picture is the same for any."""
_TENTHS = 10.0


@dataclass(frozen=True)
class BallLamp:
    """A lamp that stands near as a ball: position [3] mm in the world in which the light stands still, radius_mm, and
    radiance [3], linear Rec.709, as colours of lights in USD are unless it is said otherwise."""

    position: tuple[float, float, float]
    radius_mm: float
    radiance: tuple[float, float, float]


@dataclass(frozen=True)
class UsdCapture:
    """What was filmed: camera_from_head [F, 4, 4] mm, frame_index [F], intrinsics [3, 3] px of a width x
    height frame.

    moves: "head" or "camera", what turned while the light stood still. film_width_mm: width of the sensor
    that the full frame shows. light_with_camera: the camera moved and carried the light along. eye_turn [F, 2, 2]
    radians: how the right and the left eyeball are turned (shared/geometry/eyeballs.py), NaN while shut; None where it
    is not known. action_weights {name: [F] in [0, 1]}: of the facial actions that move; empty where none does.
    """

    camera_from_head: np.ndarray
    frame_index: np.ndarray
    fps: float
    intrinsics: np.ndarray
    width: int
    height: int
    moves: str
    film_width_mm: float = DEFAULT_FILM_WIDTH_MM
    light_with_camera: bool = False
    eye_turn: np.ndarray | None = None
    action_weights: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def moves_actions(self) -> bool:
        """Does the face itself move in the clip?"""
        return any(weights.any() for weights in self.action_weights.values())

    def weights_of(self, names: Sequence[str]) -> np.ndarray:
        """[F, len(names)] weights of the actions of these names, 0 of those that do not move."""
        still = np.zeros(len(self.frame_index))
        return np.stack([self.action_weights.get(name, still) for name in names], axis=1)


@dataclass(frozen=True)
class Plate:
    """The clip's pictures: files {frame: sRGB picture, path relative to the layer}, all showing one rectangle of the
    frame: (left, top, right, bottom) in px, 0 at the frame's own edge."""

    files: Mapping[int, str]
    rectangle: tuple[float, float, float, float]


def define_camera(stage: Usd.Stage, path: str, capture: UsdCapture) -> UsdGeom.Camera:
    """The camera with the clip's lens and film back; animated when it was the camera that moved."""
    camera = UsdGeom.Camera.Define(stage, path)
    focal_x, focal_y = capture.intrinsics[0, 0], capture.intrinsics[1, 1]
    width, height = capture.width, capture.height
    aperture_x = _TENTHS * capture.film_width_mm
    focal = aperture_x * focal_x / width
    aperture_y = focal * height / focal_y
    camera.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    camera.CreateFocalLengthAttr(float(focal))
    camera.CreateHorizontalApertureAttr(float(aperture_x))
    camera.CreateVerticalApertureAttr(float(aperture_y))
    # The film window is [offset - aperture / 2, offset + aperture / 2] around the optical axis, y up.
    camera.CreateHorizontalApertureOffsetAttr(
        float((width / 2 - capture.intrinsics[0, 2]) * aperture_x / width)
    )
    camera.CreateVerticalApertureOffsetAttr(
        float((capture.intrinsics[1, 2] - height / 2) * aperture_y / height)
    )
    distance = float(np.linalg.norm(capture.camera_from_head[:, :3, 3], axis=1).mean())
    camera.CreateClippingRangeAttr(Gf.Vec2f(distance / 100.0, distance * 100.0))
    camera.CreateFocusDistanceAttr(distance)
    camera.CreateFStopAttr(0.0)
    if capture.moves == "camera":
        animate(camera, world_from_usd_camera(capture), capture.frame_index)
    return camera


def world_from_usd_camera(capture: UsdCapture) -> np.ndarray:
    """[F, 4, 4]: from the axes of a USD camera (y up, looking along -z) to the world in which the light
    stands."""
    turn = np.diag([*np.diag(WORLD_FROM_CAMERA), 1.0])
    if capture.moves == "camera":
        return invert_rigid(capture.camera_from_head) @ turn
    return np.broadcast_to(np.eye(4), capture.camera_from_head.shape).copy()


def world_from_head_rigid(capture: UsdCapture) -> np.ndarray:
    """[F, 4, 4]: the head's motion in the world in which the light stands still."""
    turn = np.diag([*np.diag(WORLD_FROM_CAMERA), 1.0])
    if capture.moves == "camera":
        return np.broadcast_to(np.eye(4), capture.camera_from_head.shape).copy()
    return turn @ capture.camera_from_head


def eye_turns(capture: UsdCapture, eye: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames [n] in which an eye (0 right, 1 left) is open, and the rotations [n, 3, 3] from straight ahead.
    Who plays them turns evenly from one such frame to the next, also through a blink, and holds the first and
    the last."""
    if capture.eye_turn is None:
        return np.zeros(0, int), np.zeros((0, 3, 3))
    known = np.isfinite(capture.eye_turn[:, eye]).all(-1)
    return np.asarray(capture.frame_index)[known], gaze_rotation(capture.eye_turn[known, eye])


def animate(prim: UsdGeom.Xformable, world_from_local: np.ndarray, time_codes: np.ndarray) -> None:
    """Time samples [F, 4, 4] of a rigid motion as translate and orient.

    Quaternions, unlike matrices, stay rotations when a reader interpolates between samples. Neighbours are kept in one
    hemisphere so that it takes the short way. world_from_local [F, 4, 4] mm; time_codes [F]: numbers of frames.
    """
    translate = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    for transform, time in zip(world_from_local, time_codes, strict=True):
        translate.Set(Gf.Vec3d(*(float(value) for value in transform[:3, 3])), float(time))
    turn(orient.GetAttr(), world_from_local[:, :3, :3], time_codes)


def turn(orient: Usd.Attribute, rotations: np.ndarray, time_codes: np.ndarray) -> None:
    """Time samples of an orient op: rotations [F, 3, 3] as quaternions of one hemisphere; time_codes [F]: numbers of
    frames."""
    last = Gf.Quatd(1.0)
    for matrix, time in zip(rotations, time_codes, strict=True):
        # Gf matrices act on row vectors.
        rotation = Gf.Matrix3d(*(float(value) for value in matrix.T.ravel())).ExtractRotation().GetQuat()
        if Gf.Dot(rotation, last) < 0.0:
            rotation = -rotation
        orient.Set(rotation, float(time))
        last = rotation


def define_lamp(stage: Usd.Stage, path: str, lamp: BallLamp, capture: UsdCapture) -> UsdLux.SphereLight:
    """A lamp at its place, its radiance as colour times intensity; at rest unless the camera carried the light."""
    light = UsdLux.SphereLight.Define(stage, path)
    intensity = max(lamp.radiance)
    light.CreateRadiusAttr(float(lamp.radius_mm))
    light.CreateIntensityAttr(float(intensity))
    light.CreateColorAttr(Gf.Vec3f(*(float(value / intensity) for value in lamp.radiance)))
    if capture.light_with_camera:
        animate(light, world_from_usd_camera(capture), capture.frame_index)
    light.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble, "place").Set(Gf.Vec3d(*map(float, lamp.position)))
    return light


def define_dome_light(stage: Usd.Stage, path: str, envmap: TextureFile, capture: UsdCapture) -> UsdLux.DomeLight:
    """The recovered light: a dome with the lat-long map, intensity 1, at rest unless the camera carried it."""
    light = UsdLux.DomeLight.Define(stage, path)
    light.CreateIntensityAttr(1.0)
    light.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    texture = light.CreateTextureFileAttr(Sdf.AssetPath(envmap.path))
    texture.SetColorSpace(envmap.colour_space)
    if capture.light_with_camera:
        animate(light, world_from_usd_camera(capture), capture.frame_index)
    return light


def define_plate(stage: Usd.Stage, path: str, capture: UsdCapture, plate: Plate) -> UsdGeom.Xform:
    """The clip on a card behind the head, as far away as twice the head, filling the camera's view of its rectangle.

    Purpose guide: a viewer shows it when asked to display guides; renders, bounds and lighting leave it out.
    """
    holder = UsdGeom.Xform.Define(stage, path)
    distance = 2.0 * float(np.linalg.norm(capture.camera_from_head[:, :3, 3], axis=1).mean())
    left, top, right, bottom = plate.rectangle
    pixels = np.array([[left, bottom, 1.0], [right, bottom, 1.0], [right, top, 1.0], [left, top, 1.0]])
    rays = pixels @ np.linalg.inv(capture.intrinsics).T
    card = define_card(stage, f"{path}/card", distance * rays @ WORLD_FROM_CAMERA)
    material = define_plate_material(stage, f"{path}/material", plate.files)
    UsdShade.MaterialBindingAPI.Apply(card.GetPrim()).Bind(material)
    if capture.moves == "camera":
        animate(holder, world_from_usd_camera(capture), capture.frame_index)
    return holder


def define_card(stage: Usd.Stage, path: str, corners: np.ndarray) -> UsdGeom.Mesh:
    """A textured quadrilateral of purpose guide: tools show it on request, renders and bounds leave it out.

    corners [4, 3]: bottom left, bottom right, top right, top left of the picture.
    """
    prim = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(corners, np.float32))
    prim.CreatePointsAttr(points)
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray([0, 1, 2, 3]))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray([4]))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    prim.CreatePurposeAttr(UsdGeom.Tokens.guide)
    coordinates = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set(Vt.Vec2fArray([Gf.Vec2f(0, 0), Gf.Vec2f(1, 0), Gf.Vec2f(1, 1), Gf.Vec2f(0, 1)]))
    return prim
