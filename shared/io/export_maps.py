"""The texture maps as they are handed over: precision, colour space, attributes, copies for simple viewers."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from shared.imaging.color import encode_srgb
from shared.io.images import read_exr, write_exr, write_png
from shared.io.material_maps import material_errors, read_material, write_material

# name -> (colour, data or materials, what one unit is)
MAPS = {
    "diffuse_albedo": ("colour", "share of light scattered back, per channel"),
    "specular_intensity": ("data", "multiple of the Fresnel reflection with F0 = 0.04"),
    "roughness": ("data", "square root of GGX alpha"),
    "normal": ("data", "tangent space, n * 0.5 + 0.5"),
    "confidence": ("data", "0 to 1: how well the clip determines the texel"),
    "material": ("materials", "0 to 1: probability of each material; Y: number of the likeliest"),
    "specular_ior": ("data", "index of refraction that shows the specular intensity, for UsdPreviewSurface"),
    "displacement": ("data", "mm along the normal of the subdivided base mesh"),
    "hair_albedo": ("colour", "share of light scattered back, per channel"),
    "hair_alpha": ("data", "0 to 1: how much of a place is hair"),
}
DISPLACEMENT = "displacement"
HAIR_MAPS = HAIR_ALBEDO, HAIR_ALPHA = "hair_albedo", "hair_alpha"
"""Of the surface of hair that stands off the head, where there is one; they have texture coordinates of their own."""
SOLVED_MAPS = tuple(name for name in MAPS if name not in ("material", "specular_ior", DISPLACEMENT, *HAIR_MAPS))
"""Those that inverse_render solves; specular_ior follows from specular_intensity, displacement from the mesh, material
from what texels look like."""
LARGEST_HEIGHT_MM = 10.0
"""A displacement beyond it joins what are different parts of a head."""
_UP_TO_ONE = ("diffuse_albedo", "confidence", "normal", "roughness", "material", *HAIR_MAPS)
UDIM_TILE = 1001
WORKING_SPACE, ACESCG = "lin_rec709_scene", "lin_ap1_scene"


def acescg_from_rec709(rgb: np.ndarray) -> np.ndarray:
    """[..., 3] linear Rec.709 -> linear ACEScg, white adapted by Bradford so that grey stays grey."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses matplotlib, which only its plots need
        import colour  # takes a second to load and only this needs it

    matrix = colour.matrix_RGB_to_RGB("ITU-R BT.709", "ACEScg", chromatic_adaptation_transform="Bradford")
    return (np.asarray(rgb, np.float64) @ matrix.T).astype(np.float32)


def map_file(name: str, udim: bool) -> str:
    """Name of a map's file; udim: as a tile of a set."""
    return f"{name}.{UDIM_TILE}.exr" if udim else f"{name}.exr"


def map_path(folder: Path, name: str) -> str:
    """A map's file in a result's folder, from there: maps/NAME.exr, or the tile of that name where there is one."""
    tile = f"maps/{map_file(name, udim=True)}"
    return tile if (folder / tile).is_file() else f"maps/{map_file(name, udim=False)}"


class MapWriter:
    """Writes linear Rec.709 and data arrays with one choice of precision, colour space, layout and names.

    half: 16-bit floats, values beyond +-65504 clamped; the displacement has 32 bits in any case. acescg: colours are
    converted. attributes go into each file. layout: of the maps, one of images.LAYOUTS. udim: maps are named as tile
    1001 of a set of tiles.
    """

    def __init__(
        self,
        half: bool,
        acescg: bool,
        attributes: Mapping[str, str | int | float],
        layout: str = "scanline",
        udim: bool = False,
    ):
        self.half, self.acescg, self.attributes = half, acescg, dict(attributes)
        self.layout, self.udim = layout, udim

    @property
    def colour_space(self) -> str:
        """Colour space of what is written for colours."""
        return ACESCG if self.acescg else WORKING_SPACE

    def file_name(self, name: str) -> str:
        """The map's file."""
        return map_file(name, self.udim)

    def write_colour(self, path: Path, rgb: np.ndarray, unit: str, *, latlong: bool = False) -> None:
        """[H, W, 3] scene-linear Rec.709 -> EXR in colour_space; [H, W, 4]: premultiplied, and alpha."""
        colours, alpha = rgb[..., :3], rgb[..., 3:]
        converted = np.concatenate([acescg_from_rec709(colours) if self.acescg else colours, alpha], axis=-1)
        extra = {"layout": "+y top row, +z centre, +x left of it"} if latlong else {}
        extra |= {"alpha": "premultiplied"} if alpha.size else {}
        self._write(path, converted, self.colour_space, {"unit": unit, **extra}, latlong=latlong)

    def write_map(self, folder: Path, name: str, values: np.ndarray) -> None:
        """A map named as in MAPS, values [H, W], [H, W, 3] or of materials [H, W, len(LABELS)], into folder. The last
        always is in lines, without mipmaps: numbers of materials have no mean."""
        kind, unit = MAPS[name]
        if kind == "materials":
            attributes = {**self.attributes, "unit": unit, "content": name}
            write_material(folder / self.file_name(name), values, self.half, attributes)
            return
        is_colour = kind == "colour"
        converted = acescg_from_rec709(values) if is_colour and self.acescg else values
        space = self.colour_space if is_colour else "data"
        content = {"unit": unit, "content": name}
        if name == DISPLACEMENT:
            content |= {"scale": 1.0, "midpoint": 0.0}
        self._write(folder / self.file_name(name), converted, space, content, layout=self.layout,
                    half=self.half and name != DISPLACEMENT)

    def write_maps(self, folder: Path, maps: Mapping[str, np.ndarray]) -> None:
        """Each of maps, named as in MAPS, into folder."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, values in maps.items():
            self.write_map(folder, name, values)

    def _write(self, path, values, colour_space, attributes, latlong=False, layout="scanline", half=None) -> None:
        attributes, half = {**self.attributes, **attributes}, self.half if half is None else half
        write_exr(path, values, colour_space=colour_space, half=half, attributes=attributes, latlong=latlong,
                  layout=layout)


def read_map(path: Path, name: str) -> np.ndarray:
    """A map named as in MAPS, as stored: float32 [H, W], [H, W, 3] or of materials [H, W, len(LABELS)]. InputError."""
    return read_material(path) if name == "material" else read_exr(path)


def integer_codes(name: str, values: np.ndarray, bits: int) -> np.ndarray:
    """A map as 8- or 16-bit codes: colours sRGB-coded, data linear, both clipped to [0, 1]. values [H, W] or [H, W,
    3]."""
    coded = encode_srgb(values) if MAPS[name][0] == "colour" else np.clip(values, 0.0, 1.0)
    return (coded * (2**bits - 1) + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def write_png_copies(folder: Path, maps: Mapping[str, np.ndarray], bits: int) -> None:
    """Integer copies, as integer_codes says."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in maps.items():
        write_png(folder / f"{name}.png", integer_codes(name, values, bits))


def paste_crop(crop: np.ndarray, placement: tuple[float, float, float], size: tuple[int, int]) -> np.ndarray:
    """Resamples a crop [h, w, C] back into the full frame: float32 [height, width, C], 0 outside of the crop.

    placement: (x0, y0, scale) with u_crop = (u_source - x0) * scale, pixel centres at integer + 0.5; size: width,
    height of the full frame. Bilinear; a crop more than twice as fine as the frame is averaged first.
    """
    x0, y0, scale = placement
    crop = np.ascontiguousarray(crop, np.float32)
    if scale > 2.0:
        # About a pixel of the full frame wide; odd, so that it stays centred.
        crop = cv2.blur(crop, (2 * int(scale / 2.0) + 1,) * 2, borderType=cv2.BORDER_REPLICATE)
    # warpAffine counts pixel centres from 0: index + 0.5 is the coordinate.
    to_crop = np.array([[scale, 0.0, (0.5 - x0) * scale - 0.5], [0.0, scale, (0.5 - y0) * scale - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(crop, to_crop, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)


def map_errors(name: str, values: np.ndarray) -> list[str]:
    """Sentences about a map's shape and range. values [H, W], [H, W, 3] or of materials [H, W, len(LABELS)]."""
    height, width = values.shape[:2]
    errors = []
    if height != width or width & (width - 1):
        errors.append(f"{width} x {height} is not a square power of two")
    if not np.isfinite(values).all():
        return [*errors, f"{np.count_nonzero(~np.isfinite(values))} values are not finite"]
    lowest = {"specular_ior": 1.0, DISPLACEMENT: -LARGEST_HEIGHT_MM}.get(name, 0.0)
    if values.min() < lowest - 1e-3:
        errors.append(f"values down to {values.min():.4g}, expected at least {lowest:.0f}")
    if name == DISPLACEMENT and values.max() > LARGEST_HEIGHT_MM:
        errors.append(f"values up to {values.max():.4g}, expected at most {LARGEST_HEIGHT_MM:.0f}")
    if name in _UP_TO_ONE and values.max() > 1.0 + 1e-3:
        errors.append(f"values up to {values.max():.4g}, expected at most 1")
    return errors + (material_errors(values) if name == "material" else [])
