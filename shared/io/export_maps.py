"""The texture maps as they are handed over: precision, colour space, attributes, copies for simple viewers."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from shared.color import encode_srgb
from shared.io.images import write_exr, write_png

# name -> (colour or data, what one unit is)
MAPS = {
    "diffuse_albedo": ("colour", "share of light scattered back, per channel"),
    "specular_intensity": ("data", "multiple of the Fresnel reflection with F0 = 0.04"),
    "roughness": ("data", "square root of GGX alpha"),
    "normal": ("data", "tangent space, n * 0.5 + 0.5"),
    "confidence": ("data", "0 to 1: how well the clip determines the texel"),
}
WORKING_SPACE, ACESCG = "lin_rec709_scene", "lin_ap1_scene"


def acescg_from_rec709(rgb: np.ndarray) -> np.ndarray:
    """[..., 3] linear Rec.709 -> linear ACEScg, white adapted by Bradford so that grey stays grey."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it misses matplotlib, which only its plots need
        import colour  # takes a second to load and only this needs it

    matrix = colour.matrix_RGB_to_RGB("ITU-R BT.709", "ACEScg", chromatic_adaptation_transform="Bradford")
    return (np.asarray(rgb, np.float64) @ matrix.T).astype(np.float32)


class MapWriter:
    """Writes linear Rec.709 and data arrays with one choice of precision and colour space.

    half: 16-bit floats, values beyond +-65504 clamped. acescg: colours are converted. attributes go into each file.
    """

    def __init__(self, half: bool, acescg: bool, attributes: Mapping[str, str | int | float]):
        self.half, self.acescg, self.attributes = half, acescg, dict(attributes)

    @property
    def colour_space(self) -> str:
        """Colour space of what is written for colours."""
        return ACESCG if self.acescg else WORKING_SPACE

    def write_colour(self, path: Path, rgb: np.ndarray, unit: str, *, latlong: bool = False) -> None:
        """[H, W, 3] scene-linear Rec.709 -> EXR in colour_space."""
        converted = acescg_from_rec709(rgb) if self.acescg else rgb
        extra = {"layout": "+y top row, +z centre, +x left of it"} if latlong else {}
        self._write(path, converted, self.colour_space, {"unit": unit, **extra}, latlong)

    def write_data(self, path: Path, values: np.ndarray, unit: str) -> None:
        """[H, W] or [H, W, 3] numbers that are no colours -> EXR."""
        self._write(path, values, "data", {"unit": unit}, False)

    def _write(self, path, values, colour_space, attributes, latlong) -> None:
        attributes = {**self.attributes, **attributes}
        write_exr(path, values, colour_space=colour_space, half=self.half, attributes=attributes, latlong=latlong)

    def write_maps(self, folder: Path, maps: Mapping[str, np.ndarray]) -> None:
        """Each of maps, named as in MAPS, into folder."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, values in maps.items():
            kind, unit = MAPS[name]
            write = self.write_colour if kind == "colour" else self.write_data
            write(folder / f"{name}.exr", values, unit)


def write_png_copies(folder: Path, maps: Mapping[str, np.ndarray], bits: int) -> None:
    """Integer copies, 8 or 16 bits: colours sRGB-coded, data linear, both clipped to [0, 1]."""
    folder.mkdir(parents=True, exist_ok=True)
    maximum = 2**bits - 1
    for name, values in maps.items():
        coded = encode_srgb(values) if MAPS[name][0] == "colour" else np.clip(values, 0.0, 1.0)
        codes = (coded * maximum + 0.5).astype(np.uint8 if bits == 8 else np.uint16)
        write_png(folder / f"{name}.png", codes)


def paste_crop(crop: np.ndarray, placement: tuple[float, float, float], size: tuple[int, int]) -> np.ndarray:
    """Resamples a crop [h, w, 3] back into the full frame: float32 [height, width, 3], 0 outside of the crop.

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
