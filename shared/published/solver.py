"""The published algorithm [Xu2025]: mesh, textures and light by stochastic descent through a deferred renderer.

Each iteration renders one frame: primary visibility with blended silhouettes (raster), diffuse light by
multiple importance sampling with traced visibility and a visibility-modulated split sum (shading), under a
cubemap of free texels with prefiltered mips (light). Adam descends on

    L1 image + 0.1 mask + 10 Laplacian + 0.1 white light + 0.1 roughness variation + 0.01 squared diffuse albedo

with 0.1 for light and vertices (through large steps, shape) and 0.001 for textures. It is the yardstick of
the transfer solver. What the publication leaves open: colours are compared linearly; the mask counts within
MASK_REACH_PX of its border, so that clothes and hair, which the head lacks, do not pull; open borders of the mesh are
no silhouettes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from shared.appearance.light_models import make_light_model
from shared.geometry.mesh import Mesh
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import world_from_head
from shared.imaging.views import Views
from shared.published.raster import Hits, Raster, blend, torch_vertex_normals
from shared.published.settings import ReferenceSettings
from shared.published.shading import Shader, TorchMaterial
from shared.published.shape import LaplacianLoss, LargeSteps

MASK_REACH_PX = 8.0
MODEL_RESOLUTION = 32
"""Edge of the cubemap that light models of few numbers are drawn into."""
LEAST_ROUGHNESS, MOST_SPECULAR = 0.08, 2.0
_PICTURE_BYTES = 400e6


@dataclass(frozen=True)
class Start:
    """radiance [3] of a uniform light; albedo [S, S, 3] and specular_intensity [S, S] maps."""

    radiance: np.ndarray
    albedo: np.ndarray
    specular_intensity: np.ndarray


class ReferenceSolver:
    """Fits all views, which share one lens. Parameters are torch leaves by name: vertices (large-steps space), light,
    albedo, specular, roughness."""

    def __init__(self, mesh: Mesh, views: Views, start: Start, settings: ReferenceSettings):
        self.mesh, self.views, self.settings = mesh, views, settings
        few = settings.light_model != "cubemap"
        self.light_model = make_light_model(settings.light_model, MODEL_RESOLUTION) if few else None
        resolution = MODEL_RESOLUTION if few else settings.resolution
        self.raster = Raster(mesh, views.intrinsics[0], views.size)
        self.shader = Shader(resolution, settings.sampling, min(settings.smallest, resolution))
        self.steps = LargeSteps(mesh.faces, len(mesh.vertices), settings.smoothing)
        self.laplacian = LaplacianLoss(mesh.faces, len(mesh.vertices))
        self._faces = torch.from_numpy(mesh.faces.astype(np.int64))
        self.parameters = self._start(start, resolution)
        self.optimiser = torch.optim.Adam(self._groups())
        self.iteration = 0
        self._still: tuple | None = None
        self._pictures: dict[int, tuple] = {}
        self._seen: dict[int, Hits] = {}

    def _start(self, start: Start, resolution: int) -> dict[str, torch.Tensor]:
        uniform = np.tile(np.asarray(start.radiance, np.float64), (6 * resolution**2, 1))
        light = uniform if self.light_model is None else self.light_model.fit(uniform)
        arrays = {
            "vertices": self.steps.parameters(self.mesh.vertices),
            "light": light,
            "albedo": start.albedo,
            "specular": start.specular_intensity,
            "roughness": np.full(start.specular_intensity.shape, self.settings.roughness),
        }
        tensors = {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}
        fixed = () if self.settings.vertices else ("vertices",)
        fixed += () if self.settings.sampling.specular else ("specular", "roughness")
        return {name: tensor.requires_grad_(name not in fixed) for name, tensor in tensors.items()}

    def _groups(self) -> list[dict]:
        settings = self.settings
        rates = dict.fromkeys(self.parameters, settings.texture_rate)
        rates |= {"vertices": settings.vertex_rate, "light": settings.light_rate}
        return [{"params": [p], "lr": rates[name]} for name, p in self.parameters.items() if p.requires_grad]

    # ------------------------------------------------------------------ forward
    def light(self) -> torch.Tensor:
        """[6 n^2, 3] radiance of the present parameters."""
        light = self.parameters["light"]
        return light if self.light_model is None else _ModelLight.apply(light, self.light_model)

    def vertices(self) -> torch.Tensor:
        """[V, 3] mm."""
        return self.steps.vertices(self.parameters["vertices"])

    def texture(self, uv: torch.Tensor) -> TorchMaterial:
        """The maps at texture coordinates uv [P, 2], bilinear."""
        maps = self.parameters
        stacked = torch.cat([maps["albedo"], maps["specular"][..., None], maps["roughness"][..., None]], dim=-1)
        place = torch.stack([2.0 * uv[:, 0] - 1.0, 1.0 - 2.0 * uv[:, 1]], dim=-1)[None, None]
        source = stacked.permute(2, 0, 1)[None]
        found = torch.nn.functional.grid_sample(source, place, padding_mode="border", align_corners=False)[0, :, 0].T
        return TorchMaterial(found[:, :3], found[:, 3], found[:, 4].clamp(LEAST_ROUGHNESS, 1.0))

    def geometry(self) -> tuple[torch.Tensor, torch.Tensor, RayScene]:
        """Vertices and normals [V, 3] of the present parameters, and the scene for rays; made once where they rest."""
        if self._still is not None:
            return self._still
        vertices = self.vertices()
        scene = RayScene(vertices.detach().cpu().double().numpy(), self.mesh.faces)
        found = vertices, torch_vertex_normals(vertices, self._faces), scene
        if not self.settings.vertices:
            self._still = found
        return found

    def shade(
        self, camera_from_head: np.ndarray, pixels: np.ndarray, hits: Hits, geometry: tuple, generator: torch.Generator
    ) -> torch.Tensor:
        """Radiance [M, 3] of flat pixels [M] in a pose [4, 4]; black where they see the background."""
        vertices, normals, scene = geometry
        face = hits.face.ravel()[pixels]
        seen = np.nonzero(face >= 0)[0]
        points = self.raster.points(vertices, normals, camera_from_head, pixels[seen], face[seen])
        turn = world_from_head(camera_from_head[None], self.views.moves)[0]
        colours = self.shader(self.light(), points, self.texture(points.uv), scene, turn, generator)
        rows = torch.from_numpy(seen)
        return colours.new_zeros((len(pixels), 3)).index_add(0, rows, colours)

    # ------------------------------------------------------------------ losses
    def frame(self, f: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours [h w, 3], whether each pixel lies inside the mask, and where the mask's border is near [h w]."""
        if f not in self._pictures:
            picture = self.views.picture(f)
            inside = picture.inside > 0
            # `inside` ends a pixel within the mask.
            person = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8))
            away = np.maximum(*(cv2.distanceTransform(side, cv2.DIST_L2, 3) for side in (person, 1 - person)))
            colours = picture.levels[0].reshape(-1, 3)
            entry = colours, inside.ravel(), person.ravel() > 0, away.ravel() <= MASK_REACH_PX
            if (len(self._pictures) + 1) * colours.nbytes > _PICTURE_BYTES:
                self._pictures.clear()
            self._pictures[f] = entry
        return self._pictures[f]

    def losses(self, f: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Each loss of one frame by name, not yet weighted."""
        settings, maps = self.settings, self.parameters
        geometry = self.geometry()
        hits = self._hits(f, geometry[2])
        colours, inside, person, near_border = self.frame(f)
        visible = np.nonzero((hits.face.ravel() >= 0) & inside)[0]
        if settings.pixels and settings.pixels < len(visible):
            chosen = torch.randperm(len(visible), generator=generator)[: settings.pixels].numpy()
            visible = visible[np.sort(chosen)]
        result = self._image_losses(f, visible, hits, geometry, generator, colours, person, near_border)
        light = self.light()
        result["white_light"] = (light - light.mean(1, keepdim=True)).abs().mean()
        result["diffuse"] = maps["albedo"].square().mean()
        if settings.sampling.specular:
            rough = maps["roughness"]
            result["roughness_variation"] = rough.diff(dim=0).abs().mean() + rough.diff(dim=1).abs().mean()
        if settings.vertices:
            result["laplacian"] = self.laplacian(geometry[0])
        return result

    def _hits(self, f: int, scene: RayScene) -> Hits:
        if f in self._seen:
            return self._seen[f]
        hits = self.raster.hits(scene, self.views.camera_from_head[f])
        if self._still is not None and (len(self._seen) + 1) * hits.face.nbytes * 2 < _PICTURE_BYTES:
            self._seen[f] = hits
        return hits

    def _image_losses(self, f, visible, hits, geometry, generator, colours, person, near_border) -> dict:
        """image, and where vertices move mask; pixels at silhouettes are blended with their neighbours."""
        pose = self.views.camera_from_head[f]
        if not self.settings.vertices:
            found = self.shade(pose, visible, hits, geometry, generator)
            return {"image": (found - self._tensor(colours[visible])).abs().mean()}
        pairs = self.raster.pairs(geometry[0].detach().cpu().double().numpy(), pose, hits)
        crossing = self.raster.crossing(geometry[0], pose, pairs)
        drawn = np.zeros(hits.face.size, bool)
        drawn[visible] = True
        near_by = np.nonzero(drawn[pairs.near] | drawn[pairs.far])[0]
        pixels = np.unique(np.concatenate([visible, pairs.near[near_by], pairs.far[near_by]]))
        near, far = [
            torch.from_numpy(np.searchsorted(pixels, side[near_by])) for side in (pairs.near, pairs.far)
        ]
        found = self.shade(pose, pixels, hits, geometry, generator)
        found = blend(found, near, far, crossing[torch.from_numpy(near_by)])
        found = found[torch.from_numpy(np.searchsorted(pixels, visible))]
        image = (found - self._tensor(colours[visible])).abs().mean()
        return {"image": image, "mask": self._mask_loss(hits, pairs, crossing, person, near_border)}

    def _mask_loss(self, hits: Hits, pairs, crossing, person: np.ndarray, near_border: np.ndarray) -> torch.Tensor:
        """Mean absolute difference of the blended coverage from the mask, where its border is near."""
        covered = hits.face.ravel() >= 0
        outer = np.nonzero(~covered[pairs.far])[0]
        near, far = (torch.from_numpy(side[outer]) for side in (pairs.near, pairs.far))
        coverage = blend(self._tensor(covered.astype(np.float64))[:, None], near, far, crossing[outer])[:, 0]
        return ((coverage - self._tensor(person.astype(np.float64))).abs() * self._tensor(near_border * 1.0)).mean()

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(torch.float32)

    # ------------------------------------------------------------------ descent
    def total(self, losses: dict[str, torch.Tensor]) -> torch.Tensor:
        """The weighted sum."""
        return sum(value * getattr(self.settings.weights, name, 1.0) for name, value in losses.items())

    def step(self) -> dict[str, float]:
        """One iteration on one frame -> its losses."""
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + self.iteration)
        frames = len(self.views.camera_from_head)
        order = np.random.default_rng([self.settings.seed, self.iteration // frames]).permutation(frames)
        losses = self.losses(int(order[self.iteration % frames]), generator)
        self.optimiser.zero_grad(set_to_none=True)
        self.total(losses).backward()
        self.optimiser.step()
        self._keep_in_range()
        self.iteration += 1
        return {name: float(value.detach()) for name, value in losses.items()}

    @torch.no_grad()
    def _keep_in_range(self) -> None:
        maps = self.parameters
        maps["albedo"].clamp_(0.0, 1.0)
        maps["specular"].clamp_(0.0, MOST_SPECULAR)
        maps["roughness"].clamp_(LEAST_ROUGHNESS, 1.0)
        if self.light_model is None:
            maps["light"].clamp_min_(0.0)

    # ------------------------------------------------------------------ state
    def arrays(self) -> dict[str, np.ndarray]:
        """Everything that another solver needs to go on just as this one would."""
        found = {name: tensor.detach().cpu().numpy() for name, tensor in self.parameters.items()}
        for name, tensor in self.parameters.items():
            for key, value in self.optimiser.state.get(tensor, {}).items():
                found[f"{name}.{key}"] = value.detach().cpu().numpy()
        return found | {"iteration": np.array(self.iteration)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The opposite of arrays."""
        with torch.no_grad():
            for name, tensor in self.parameters.items():
                tensor.copy_(torch.from_numpy(arrays[name]))
        for name, tensor in self.parameters.items():
            keys = [key for key in arrays if key.startswith(f"{name}.")]
            state = {key.partition(".")[2]: torch.from_numpy(np.array(arrays[key])) for key in keys}
            if state:
                self.optimiser.state[tensor] = {k: v for k, v in state.items()}
        self.iteration, self._still = int(arrays["iteration"]), None
        self._seen.clear()


class _ModelLight(torch.autograd.Function):
    """A model of shared.appearance.light_models as a torch function of its parameters [M, 3]."""

    @staticmethod
    def forward(ctx, parameters, model):
        ctx.model, ctx.at = model, parameters.detach().cpu().double().numpy()
        return torch.from_numpy(model.radiance(ctx.at)).to(parameters.dtype)

    @staticmethod
    def backward(ctx, gradient):
        values = ctx.model.adjoint(ctx.at, gradient.detach().cpu().double().numpy())
        return torch.from_numpy(values).to(gradient.dtype), None
