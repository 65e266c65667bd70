"""Packages a head as .usdz, the same bytes for the same content.

A .usdz is a zip whose members are stored uncompressed with their data aligned to 64 bytes, the root layer first.
USD's own packager stamps the files' modification times into it; this one stamps a constant. What viewers for
consumers ask beyond the format is kept too: one binary root layer that composes nothing from outside, y up, and
8-bit PNG textures for what UsdPreviewSurface reads; only what PNG cannot hold (indices of refraction, specular
weights beyond 1, the light) stays EXR, and a viewer that cannot read it falls back to skin's usual roughness.

Reference: Usdz file format specification 1.3.
"""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import UsdUtils

from shared.errors import LimnError
from shared.io.export_maps import HAIR_MAPS, MAPS, WORKING_SPACE, integer_codes
from shared.io.images import texture_png, write_exr
from shared.io.usd import HeadAsset, write_single_layer
from shared.io.usd_material import HAIR_INPUTS, SHADER_INPUTS, SRGB, TextureFile

PNG_MAPS = ("diffuse_albedo", "roughness", "normal", *HAIR_MAPS)
_ALIGNMENT = 64
_EPOCH = (1980, 1, 1, 0, 0, 0)
_LOCAL_HEADER = 30
_PADDING_ID = 0x1986


def write_head_usdz(
    path: Path | str, asset: HeadAsset, levels: Sequence[str], maps: Mapping[str, np.ndarray], envmap: np.ndarray
) -> None:
    """Packs the asset at these levels of detail, its maps {name of export_maps.MAPS: [S, S] or [S, S, 3]} and envmap
    [H, W, 3], linear Rec.709. The asset's own file names, its levels and the clip's pictures are left aside."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, textures = Path(scratch), {}
        (folder / "maps").mkdir()
        for name in (*SHADER_INPUTS, *(HAIR_INPUTS if asset.hair is not None else ())):
            is_colour = MAPS[name][0] == "colour"
            if name in PNG_MAPS:
                textures[name] = TextureFile(f"./maps/{name}.png", SRGB if is_colour else "data")
                (folder / textures[name].path).write_bytes(texture_png(integer_codes(name, maps[name], 8)))
            else:
                textures[name] = TextureFile(f"./maps/{name}.exr")
                write_exr(folder / textures[name].path, maps[name], colour_space="data", half=True)
        light = TextureFile("./envmap.exr", WORKING_SPACE)
        write_exr(folder / light.path, envmap, colour_space=WORKING_SPACE, half=True, latlong=True)
        layer = folder / "head.usdc"
        write_single_layer(layer, replace(asset, maps=textures, envmap=light, plate=None, levels=levels))
        package = folder / "head.usdz"
        write_usdz(package, layer)
        shutil.move(package, path)


def write_usdz(path: Path | str, layer: Path | str) -> None:
    """Packs layer and every file that it names, directly or through other layers, below the layer's folder.

    LimnError when a file is missing or lies outside of that folder.
    """
    layer = Path(layer).resolve()
    layers, assets, unresolved = UsdUtils.ComputeAllDependencies(str(layer))
    if unresolved:
        raise LimnError(f"{path}: files named in {layer.name} are missing: {', '.join(map(str, unresolved))}")
    files = [Path(found.realPath) for found in layers] + [Path(asset) for asset in assets]
    rest = sorted({file.resolve() for file in files} - {layer})
    outside = [file for file in rest if not file.is_relative_to(layer.parent)]
    if outside:
        raise LimnError(f"{path}: outside of the asset's folder: {', '.join(map(str, outside))}")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for file in (layer, *rest):
            _add_aligned(archive, file, file.relative_to(layer.parent).as_posix())


def _add_aligned(archive: zipfile.ZipFile, file: Path, name: str) -> None:
    member = zipfile.ZipInfo(name, _EPOCH)
    member.external_attr = 0o644 << 16
    used = archive.fp.tell() + _LOCAL_HEADER + len(name.encode())
    padding = -used % _ALIGNMENT
    if 0 < padding < 4:
        padding += _ALIGNMENT
    if padding:
        size = padding - 4
        member.extra = _PADDING_ID.to_bytes(2, "little") + size.to_bytes(2, "little") + bytes(size)
    archive.writestr(member, file.read_bytes())
