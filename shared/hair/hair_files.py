"""Hair's surface as a result's folder has it: its mesh, and maps/hair_albedo.exr and maps/hair_alpha.exr."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared.hair.joined import HairSurface
from shared.io.export_maps import HAIR_ALBEDO, HAIR_ALPHA, HAIR_MAPS, map_path
from shared.io.exr_picture import read_rec709
from shared.io.images import write_exr
from shared.io.meshes import load_mesh, read_obj, save_mesh

MESH, OBJ = "hair.npz", "hair.obj"


def write_hair(folder: Path, hair: HairSurface) -> None:
    """hair.npz and the maps, as inverse_render leaves them; folder has maps/ already."""
    save_mesh(folder / MESH, hair.mesh)
    write_exr(folder / "maps" / f"{HAIR_ALBEDO}.exr", hair.albedo, colour_space="lin_rec709_scene")
    write_exr(folder / "maps" / f"{HAIR_ALPHA}.exr", hair.alpha, colour_space="data")


def read_hair(folder: Path) -> HairSurface | None:
    """Of inverse_render's folder or of an export's; None where hair has no surface of its own. InputError for files
    that are none."""
    if (folder / MESH).is_file():
        mesh = load_mesh(folder / MESH)
    elif (folder / OBJ).is_file():
        mesh = read_obj(folder / OBJ)
    else:
        return None
    albedo, alpha = (read_rec709(folder / map_path(folder, name)) for name in HAIR_MAPS)
    return HairSurface(mesh, albedo, np.clip(alpha, 0.0, 1.0))
