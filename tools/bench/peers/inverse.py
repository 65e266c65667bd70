"""Mitsuba 3's gradient-based inverse rendering of a tracked clip: the peer in the chart of
tools/bench/chart/bench.py.

    python -m tools.bench.peers.inverse SUBJECT RUN OUT --at 60 120

RUN: a run's folder whose work/ holds sample_frames and track_landmarks; their frames, mesh and poses are the ones that
Limn solves from. Writes OUT/<seconds>/ with maps/, envmap.exr, poses.npz, mesh.obj, solve.json and cost.json, each
after so many seconds of the solve (start-up and compilation count, writing does not). Unknown: albedo, specular
intensity, roughness and the light, in the model that Limn solves. Method: path replay backpropagation [Vicini2021] with
one bounce; Adam on one frame per step, the light's radiance in the logarithm; the result is the iterates' running mean.
Needs mitsuba with its LLVM variant (DRJIT_LIBLLVM_PATH names libLLVM where it is not found).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from shared.compute.run_context import SILENT
from shared.contract.provenance import own_peak_bytes
from shared.errors import InputError
from shared.geometry.transforms import world_from_head
from shared.imaging.frame_index import spread_frames
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.clip_inputs import read_inputs
from shared.inverse.problem import FACE_SKIN
from shared.inverse.published_clip import START_FRAMES, Start, average_texture, make_start
from shared.io.arrays import save_arrays, write_json
from shared.io.images import write_exr
from shared.io.meshes import write_obj
from shared.rendering.views import ViewCamera
from tools.bench.peers import mitsuba

VARIANT = "llvm_ad_rgb"
STAGES = ("sample_frames", "track_landmarks")
MAP_SIZE, SPECULAR_SIZE, LIGHT_HEIGHT = 512, 128, 32
START_SPECULAR, START_ROUGHNESS = 0.7, 0.45
"""Where Limn starts from, too."""
WHITE_SIGMA, CLIPPED = 0.15, 0.99
RATES = {"light": 0.05, "albedo": 0.02, "specular_intensity": 0.02, "roughness": 0.01}
AVERAGING = 8.0
"""The result is the mean of the iterates, later ones weighing more, so that their noise does not stay in it (Shamir and
Zhang, ICML 2013)."""
RANGES = {"albedo": (0.0, 1.0), "specular_intensity": (0.0, 2.0), "roughness": (0.08, 1.0)}


class PeerSolver:
    """The descent. inputs: see shared.inverse.clip_inputs; samples: paths per pixel for the picture and again for its
    gradient; scale: of the pictures, for cheaper steps."""

    def __init__(self, inputs, start: Start, samples: int, scale: float, depth: int):
        self.inputs, self.samples, self.iteration = inputs, samples, 0
        self.views, mesh = inputs.views, inputs.surface.mesh
        width, height = (round(edge * scale) for edge in self.views.size)
        self.size = width, height
        lens = np.diag([width / self.views.size[0], height / self.views.size[1], 1.0]) @ inputs.lens
        self.turns = world_from_head(self.views.camera_from_head, self.views.moves)
        self.mi = mitsuba.mitsuba()
        light = np.broadcast_to(np.asarray(start.radiance, np.float32), (LIGHT_HEIGHT, 2 * LIGHT_HEIGHT, 3))
        camera = ViewCamera(self.views.camera_from_head[0], lens, self.size)
        integrator = {"type": "prb", "max_depth": depth, "rr_depth": 1000, "hide_emitters": True}
        self.scene = mitsuba.load_scene(mesh, light, camera, self._bsdf(start), integrator, samples)
        self.params = self.mi.traverse(self.scene)
        self.keys = {name: f"shape.bsdf.{name}.data" for name in RANGES}
        self.optimiser = self.mi.ad.Adam(lr=RATES["albedo"])
        import drjit as dr

        self.dr = dr
        self.optimiser["light"] = dr.log(self.params["light.data"])[:, 1:-1]
        for name, key in self.keys.items():
            self.optimiser[name] = self.params[key]
        self.optimiser.set_learning_rate(dict(RATES))
        self.average = {name: self.dr.detach(self.optimiser[name]) for name in RATES}
        self._pictures: dict[int, tuple] = {}

    def _bsdf(self, start: Start) -> dict:
        specular = np.full((SPECULAR_SIZE, SPECULAR_SIZE, 1), START_SPECULAR, np.float32)
        rough = np.full((2, 2, 1), START_ROUGHNESS, np.float32)
        albedo = np.ascontiguousarray(start.albedo, np.float32)
        maps = {"albedo": albedo, "specular_intensity": specular, "roughness": rough}
        return {"type": "limn_skin_maps"} | {
            name: {"type": "bitmap", "bitmap": self.mi.Bitmap(array), "raw": True, "wrap_mode": "clamp"}
            for name, array in maps.items()
        }

    def picture(self, f: int) -> tuple:
        """Frame f at the solver's size: colours, weight of each pixel, and where the clip is overexposed."""
        if f not in self._pictures:
            picture = self.views.picture(f)
            colours = np.ascontiguousarray(picture.levels[0], np.float32)
            clipped = (colours >= CLIPPED).astype(np.float32)
            inside = (picture.inside > 0).astype(np.float32)
            small = [cv2.resize(image, self.size, interpolation=cv2.INTER_AREA) for image in (colours, inside, clipped)]
            weight = np.repeat((small[1] > 0.999)[..., None], 3, axis=2).astype(np.float32)
            arrays = small[0], weight / weight.sum(), (small[2] > 0.0).astype(np.float32)
            self._pictures[f] = tuple(self.mi.TensorXf(array) for array in arrays)
        return self._pictures[f]

    def render(self, f: int, seed: int):
        """Frame f with the present parameters; gradients pass."""
        mi, params = self.mi, self.params
        params["sensor.to_world"] = mi.Transform4f(mitsuba.head_from_camera(self.views.camera_from_head[f]))
        turn = np.eye(4)
        turn[:3, :3] = self.turns[f].T
        params["light.to_world"] = mi.Transform4f(turn)
        light = self.dr.exp(self.optimiser["light"])
        # Mitsuba keeps a column more on either side, so that it need not wrap around.
        params["light.data"] = self.dr.concat([light[:, -1:], light, light[:, :1]], axis=1)
        for name, key in self.keys.items():
            params[key] = self.optimiser[name]
        params.update()
        return mi.render(self.scene, params, spp=self.samples, seed=2 * seed, seed_grad=2 * seed + 1)

    def step(self) -> float:
        """One iteration on one frame -> its loss: weighted mean squared error, overexposed pixels one-sided."""
        dr, frames = self.dr, len(self.views.camera_from_head)
        f = int(np.random.default_rng(self.iteration // frames).permutation(frames)[self.iteration % frames])
        colours, weight, clipped = self.picture(f)
        error = self.render(f, self.iteration) - colours
        error = dr.select(clipped > 0.0, dr.minimum(error, 0.0), error)
        loss = dr.sum(weight * dr.square(error))
        dr.backward(loss)
        self.optimiser.step()
        for name, (low, high) in RANGES.items():
            self.optimiser[name] = dr.clip(self.optimiser[name], low, high)
        self.iteration += 1
        share = (AVERAGING + 1.0) / (self.iteration + AVERAGING)
        for name, mean in self.average.items():
            self.average[name] = mean + share * (dr.detach(self.optimiser[name]) - mean)
        dr.eval(self.average)
        return float(np.array(loss).ravel()[0])

    def maps(self) -> dict[str, np.ndarray]:
        """diffuse_albedo [S, S, 3], specular_intensity and roughness [S, S] float32."""
        found = {name: np.array(self.average[name]) for name in RANGES}
        albedo = found["albedo"].astype(np.float32)
        size = (len(albedo), len(albedo))
        specular, rough = (cv2.resize(found[name][..., 0], size) for name in ("specular_intensity", "roughness"))
        return {"diffuse_albedo": albedo, "specular_intensity": specular, "roughness": rough}

    def set_light(self, latlong: np.ndarray) -> None:
        """Starts from a light [LIGHT_HEIGHT, 2 LIGHT_HEIGHT, 3] in the layout of shared.rendering.envmap."""
        ends = np.arange(LIGHT_HEIGHT) / (LIGHT_HEIGHT - 1) * LIGHT_HEIGHT - 0.5
        data = _rows_at(np.clip(ends, 0.0, LIGHT_HEIGHT - 1.0), latlong)
        self.average["light"] = self.mi.TensorXf(np.log(np.maximum(data, 1e-6)).astype(np.float32))
        self.optimiser["light"] = self.average["light"]

    def light(self) -> np.ndarray:
        """Lat-long radiance in the layout of shared.rendering.envmap, whose rows end half a row before the poles."""
        middles = (np.arange(LIGHT_HEIGHT) + 0.5) / LIGHT_HEIGHT * (LIGHT_HEIGHT - 1)
        return _rows_at(middles, np.exp(np.array(self.average["light"])))


def _rows_at(rows: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Linear interpolation between the rows of an image [H, W, C] at rows [N] from 0 to H - 1."""
    low = np.minimum(rows.astype(int), len(image) - 2)
    share = (rows - low)[:, None, None]
    return ((1.0 - share) * image[low] + share * image[low + 1]).astype(np.float32)


def write_result(folder: Path, solver: PeerSolver, frame_index: np.ndarray, intrinsics: np.ndarray) -> None:
    """What tools.score and tools.relight read."""
    (folder / "maps").mkdir(parents=True)
    for name, image in solver.maps().items():
        colour_space = "lin_rec709_scene" if name == "diffuse_albedo" else "data"
        write_exr(folder / "maps" / f"{name}.exr", np.ascontiguousarray(image), colour_space=colour_space)
    write_exr(folder / "envmap.exr", solver.light(), colour_space="lin_rec709_scene", latlong=True)
    write_obj(folder / "mesh.obj", solver.inputs.surface.mesh)
    poses = solver.views.camera_from_head
    save_arrays(folder / "poses.npz", camera_from_head=poses, frame_index=frame_index, intrinsics=intrinsics)
    write_json(folder / "solve.json", {"model": {"moves": solver.views.moves}, "iterations": solver.iteration})


def descend(solver: PeerSolver, seconds: list[float], began: float, write) -> None:
    """Steps until the last of the seconds; write(at, seconds, cpu) at each, the clock standing still meanwhile."""
    paused = paused_cpu = 0.0
    for at in sorted(seconds):
        while (passed := time.perf_counter() - began - paused) < at:
            loss = solver.step()
            if solver.iteration % 20 == 1:
                print(f"{passed:.1f} s, iteration {solver.iteration}: loss {loss:.6f}", flush=True)
        now, cpu = time.perf_counter(), time.process_time()
        write(at, now - began - paused, cpu - paused_cpu)
        paused, paused_cpu = paused + time.perf_counter() - now, paused_cpu + time.process_time() - cpu


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 2 when the input is at fault."""
    began = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--at", type=float, nargs="+", default=[120.0], help="seconds after which to write the result")
    parser.add_argument("--samples", type=int, default=8, help="paths per pixel")
    parser.add_argument("--scale", type=float, default=0.5, help="of the pictures")
    parser.add_argument("--depth", type=int, default=mitsuba.ONE_BOUNCE, help="Mitsuba's max_depth")
    options = parser.parse_args(arguments)
    os.environ.setdefault(mitsuba.VARIABLE, VARIANT)
    try:
        inputs = read_inputs(*(options.run / "work" / name for name in STAGES))
        viewer = SurfaceViewer.of(inputs.surface.mesh)
        some = spread_frames(len(inputs.frame_index), START_FRAMES)
        average = average_texture(inputs.views.take(some), viewer, MAP_SIZE, SILENT)
        start = make_start(average, inputs.surface.vertices_of(FACE_SKIN), WHITE_SIGMA, specular=True)
        solver = PeerSolver(inputs, start, options.samples, options.scale, options.depth)
    except InputError as error:
        print(f"tools.bench.peers.inverse: {error}", file=sys.stderr)
        return 2

    def write(at: float, seconds: float, cpu: float) -> None:
        folder = options.out / f"{at:g}"
        write_result(folder, solver, inputs.frame_index, inputs.frames.intrinsics_source)
        write_json(folder / "cost.json", {"wall_s": seconds, "cpu_s": cpu, "peak_mb": own_peak_bytes() / 2**20})

    descend(solver, options.at, began, write)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
