"""What each place of the head shows: the probability of skin, lips, brow and lash, hair, eye, cloth, or unknown.

A mixture model over the clip's own statistics (material_features): the skin's distribution starts from the middle of
the face, hair and cloth from what differs from it where the head's topology lets them be, and each is then fitted to
the places that are most likely its own (expectation maximisation, [Dempster1977]). Places that neighbour each other and
look alike are most likely of one material: a Markov random field over the mesh's edges, in mean field
([Krahenbuhl2011], with edges in place of a dense kernel). Brows, lips and eyes are known by the topology, and are hair
where they look like it. What too few frames show is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from shared.appearance.material_features import SurfaceFeatures
from shared.compute.robust import ROBUST_SCALE
from shared.geometry.mesh import diffused, mesh_edges
from shared.geometry.surface import Surface
from shared.imaging.material_labels import BROW, CLOTH, CLOTH_BELOW_MM, EYE, HAIR, LABELS, LIPS, SKIN, UNKNOWN

SEEDS = ("nose", "cheek_left", "cheek_right", "forehead")
"""Mostly skin: where its distribution starts, at those of their vertices that look most alike."""
PRIORS = {
    "forehead": (0.9, 0.1, 0.0), "brows": (0.3, 0.7, 0.0), "lids": (0.9, 0.1, 0.0), "nose": (0.999, 0.001, 0.0),
    "cheek_left": (0.96, 0.04, 0.0), "cheek_right": (0.96, 0.04, 0.0), "upper_lip_skin": (0.75, 0.25, 0.0),
    "lips": (0.97, 0.03, 0.0), "chin": (0.7, 0.3, 0.0), "jaw": (0.75, 0.25, 0.0), "ears": (0.75, 0.25, 0.0),
    "neck": (0.65, 0.2, 0.15), "scalp": (0.3, 0.7, 0.0), "eyes": (1.0, 0.0, 0.0), "inner_mouth": (1.0, 0.0, 0.0),
    "eye_sockets": (1.0, 0.0, 0.0),
}
"""Skin, hair, cloth by segment, before the clip is looked at."""
PRIOR_MM, BROW_MM, LIP_MM = 12.0, 3.0, 2.0
"""Over which the borders of segments are uncertain, and those of brows and lips."""
LOWEST_CLOTH, LEAST_CLOTH = 0.6, 0.02
"""Its probability down there, and what is left of the table's above."""
FLOOR = np.array([0.22, 0.07, 0.07, 0.32, 0.45])
"""Least standard deviations of brightness, two differences of channels, texture and reduced chi-square."""
SKIN_SHARES = (0.5, 0.2, 0.1, 0.2)
SKIN_SHIFTS = ((0.0,) * 5, (-0.1, 0, 0, 0.8, 1.2), (0.15, 0, 0, 0.3, 0.5), (-1.8, 0, 0, 0.5, 0.8))
SKIN_FACTORS = ((1.0,) * 5, (1.6,) * 5, (1.3,) * 5, (5.0, 1.5, 1.5, 1.3, 2.0))
"""Means beside typical skin, and standard deviations over its own."""
HAIR_START = (np.array([-0.9, 0.1, 0.1, 0.9, 1.2]), np.array([0.7, 0.25, 0.25, 0.8, 1.3]))
CLOTH_START = (np.array([-0.5, 0.0, 0.0, 0.3, 0.8]), np.array([1.0, 0.5, 0.5, 0.9, 1.5]))
"""Beside skin: means and standard deviations of any hair and of any cloth."""
BRIGHTER = (-0.5, 0.0, 0.6)
"""By how much the distributions that hair and cloth are mixtures of start out brighter than that."""
ANY = 0.1
"""Share of any hair and any cloth in what the clip's own is taken for."""
ROUNDS, FIELD_STEPS, COUPLING, CONTRAST = 8, 3, 4.0, 0.25
"""How often distributions are fitted, and the field to them each time; weight of the mean of a place's neighbours; and
difference in log brightness from which on a neighbour counts less."""
LEAST_PRIOR, MOST_WEIGHT = 1e-4, 4.0
"""What no topology rules out, and how many frames' worth count of any one place, since all frames show the same."""
STRENGTH = 0.08
"""Of all places: what the start of hair, cloth and lips counts as. Skin stays as it started: what a beard's thin border
adds to it would let it take the beard."""
SEEN = 0.4
"""Frames' worth of looking straight at a place from which on it is rather known than not."""
DEEP_IN_SCALP = 0.9
"""Share of scalp around a place from which on nothing shades it but its own hair: what is dark there and as red as skin
is hair."""
STARTING_DISTANCE = 9.0
"""Squared Mahalanobis distance from skin from which on a place is rather something else."""
MOST_PLACES = 20_000
"""That distributions are fitted to."""
LEAST_SEEDS = 30
"""Vertices of the face that frames have to show for its skin to have a distribution."""


@dataclass(frozen=True)
class Mixture:
    """Normal distributions: share [K], mean [K, D], covariance [K, D, D]."""

    share: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def log_density(self, values: np.ndarray) -> np.ndarray:
        """[N, D] -> [N]."""
        return np.logaddexp.reduce(self._parts(values), axis=1)

    def first(self, count: int) -> Mixture:
        """That of the first distributions alone."""
        share = self.share[:count]
        return Mixture(share / share.sum(), self.mean[:count], self.covariance[:count])

    def _parts(self, values: np.ndarray) -> np.ndarray:
        parts = []
        for share, mean, covariance in zip(self.share, self.mean, self.covariance, strict=True):
            factor = np.linalg.cholesky(covariance)
            off = np.linalg.solve(factor, (values - mean).T)
            parts.append(np.log(share) - 0.5 * (off**2).sum(0) - np.log(np.diag(factor)).sum()
                         - 0.5 * len(mean) * np.log(2 * np.pi))
        return np.stack(parts, 1)

    def fitted(self, values: np.ndarray, weight: np.ndarray, start: Mixture, strength: float) -> Mixture:
        """One step of expectation maximisation for values [N, D] of some weight [N]; start: what counts as strength
        more values, so that no distribution collapses or walks far on little."""
        parts = self._parts(values)
        belongs = np.exp(parts - np.logaddexp.reduce(parts, axis=1, keepdims=True)) * weight[:, None]
        count = belongs.sum(0)
        share = (count + strength * start.share) / (count.sum() + strength)
        mean = (belongs.T @ values + strength * start.share[:, None] * start.mean) / (
            count + strength * start.share)[:, None]
        covariance = np.empty_like(self.covariance)
        for k, own in enumerate(belongs.T):
            off, shift = values - mean[k], start.mean[k] - mean[k]
            known = strength * start.share[k]
            covariance[k] = ((off * own[:, None]).T @ off + known * (start.covariance[k] + np.outer(shift, shift))) / (
                count[k] + known) + np.diag(FLOOR**2) * 0.25
        return Mixture(share, mean, covariance)


def material_probabilities(surface: Surface, features: SurfaceFeatures) -> np.ndarray:
    """[V, len(LABELS)] of the surface's vertices, rows that sum to 1: all unknown where the surface has not the head
    model's segments or frames show too little of the face."""
    values, known = _descriptors(features), features.weight > 0
    skin = _skin_of(surface, features, values) if set(surface.segment_names) == set(PRIORS) else None
    if skin is None:
        unknown = np.zeros((len(values), len(LABELS)))
        unknown[:, UNKNOWN] = 1.0
        return unknown
    own = known & surface.vertices_of(("lips",))
    lips = _one_start(values[own]) if own.any() else skin.first(1)
    starts = (_start_beside(skin, *HAIR_START), _start_beside(skin, *CLOTH_START), lips)
    lit = skin.first(len(skin.share) - 1)
    of_skin = np.where(_inside(surface, ("scalp",), PRIOR_MM) > DEEP_IN_SCALP, lit.log_density(values),
                       skin.log_density(values))
    seen = features.weight / (features.weight + SEEN)
    belief = _belief(_prior(surface), values, features.weight, seen, _neighbours(surface, features), of_skin,
                     _likeness(skin, values), starts)
    return _with_parts(surface, belief, seen)


def _skin_of(surface: Surface, features: SurfaceFeatures, values: np.ndarray) -> Mixture | None:
    """The skin's distribution by the face's places that frames see best; None where they show too few."""
    seeds = (features.weight > 0) & surface.vertices_of(SEEDS)
    if seeds.sum() < LEAST_SEEDS:
        return None
    return _skin_start(values[seeds & (features.weight >= np.median(features.weight[seeds]))])


def _belief(prior: np.ndarray, values: np.ndarray, weight: np.ndarray, seen: np.ndarray, neighbours: sparse.csr_matrix,
            of_skin: np.ndarray, likeness: np.ndarray, starts: tuple[Mixture, ...]) -> np.ndarray:
    """[V, 4] probabilities of skin, hair, cloth and lips: distributions are fitted to where each is likely, then the
    field to these, in turn.

    prior [V, 4]; values [V, 5]; weight, seen [V]: how often each is seen, and its share that counts; of_skin [V]: the
    skin's log density; likeness [V]: to skin, 0 to 1; starts: of hair, cloth and lips.
    """
    prior = np.maximum(prior, LEAST_PRIOR)
    belief = prior * np.stack([likeness, 1.0 - likeness, 1.0 - likeness, np.ones(len(prior))], 1)
    belief /= belief.sum(1, keepdims=True)
    some = np.nonzero(weight > 0)[0]
    some = some[:: -(-len(some) // MOST_PLACES)]
    count, others = weight[some].clip(max=MOST_WEIGHT), starts
    for _ in range(ROUNDS):
        others = [mixture.fitted(values[some], count * own[some], start, strength=STRENGTH * count.sum())
                  for mixture, start, own in zip(others, starts, belief.T[1:], strict=True)]
        density = np.stack([of_skin, *(_with_any(mixture, start, values) for mixture, start in
                                       zip(others, starts, strict=True))], 1)
        told = seen[:, None] * density + np.log(prior)
        for _ in range(FIELD_STEPS):
            belief = _softmax(told + COUPLING * (neighbours @ belief - 1.0))
    return belief


def _descriptors(features: SurfaceFeatures) -> np.ndarray:
    """[V, 5]: brightness, red over green, green over blue, texture, reduced chi-square."""
    colour = features.colour
    return np.stack([colour.mean(1), colour[:, 0] - colour[:, 1], colour[:, 1] - colour[:, 2], features.texture,
                     features.chi_square], 1)


def _one_start(values: np.ndarray) -> Mixture:
    """One normal distribution by median and median absolute deviation, which outliers leave as they are."""
    middle = np.median(values, axis=0)
    spread = np.maximum(ROBUST_SCALE * np.median(np.abs(values - middle), axis=0), FLOOR)
    return Mixture(np.ones(1), middle[None], np.diag(spread**2)[None])


def _skin_start(values: np.ndarray) -> Mixture:
    """From mostly skin: as it is there, then at a slant or an edge, in highlights, and in a shadow that the mesh does
    not know of, such as that of hair."""
    one = _one_start(values)
    spread = np.sqrt(np.diag(one.covariance[0]))
    shift, factor = np.array(SKIN_SHIFTS), np.array(SKIN_FACTORS)
    return Mixture(np.array(SKIN_SHARES), one.mean + shift, np.stack([np.diag((f * spread)**2) for f in factor]))


def _start_beside(skin: Mixture, offset: np.ndarray, spread: np.ndarray) -> Mixture:
    """Three broad distributions beside the skin's first: dark, like any, and bright ones."""
    count = len(BRIGHTER)
    shifts = np.outer(BRIGHTER, [1.0, 0.0, 0.0, 0.0, 0.0])
    return Mixture(np.full(count, 1 / count), skin.mean[0] + offset + shifts, np.stack([np.diag(spread**2)] * count))


def _likeness(skin: Mixture, values: np.ndarray) -> np.ndarray:
    """[N] 0 to 1 by the squared Mahalanobis distance from the nearest of the skin's distributions."""
    off = [(((values - mean) ** 2) / np.diag(covariance)).sum(1) for mean, covariance in
           zip(skin.mean, skin.covariance, strict=True)]
    return 1.0 / (1.0 + np.exp(0.5 * np.clip(np.min(off, axis=0) - STARTING_DISTANCE, -50, 50)))


def _with_any(mixture: Mixture, start: Mixture, values: np.ndarray) -> np.ndarray:
    """[N] log density of the clip's own with a share of any."""
    return np.logaddexp(np.log(1 - ANY) + mixture.log_density(values), np.log(ANY) + start.log_density(values))


def _softmax(logits: np.ndarray) -> np.ndarray:
    raised = np.exp(logits - logits.max(1, keepdims=True))
    return raised / raised.sum(1, keepdims=True)


def _inside(surface: Surface, names: tuple[str, ...], width_mm: float) -> np.ndarray:
    """[V] share of the named segments around each vertex."""
    return _spread(surface, surface.vertices_of(names)[:, None].astype(float), width_mm)[:, 0]


def _spread(surface: Surface, values: np.ndarray, width_mm: float) -> np.ndarray:
    """Vertex values [V, C] diffused over the surface by about width_mm."""
    mesh, edges = surface.mesh, mesh_edges(surface.mesh.faces)[0]
    step = np.median(np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1))
    return diffused(values, mesh.faces, max(1, round((width_mm / step) ** 2)))


def _prior(surface: Surface) -> np.ndarray:
    """[V, 4] of skin, hair, cloth and lips, by the segments around each vertex and its height below the chin."""
    mesh = surface.mesh
    table = np.array([PRIORS[name] for name in surface.segment_names])[surface.face_segment]
    sums, count = np.zeros((len(mesh.vertices), 3)), np.zeros((len(mesh.vertices), 1))
    for k in range(3):
        np.add.at(sums, mesh.faces[:, k], table)
        np.add.at(count, mesh.faces[:, k], 1.0)
    prior = _spread(surface, sums / np.maximum(count, 1.0), PRIOR_MM)
    chin = mesh.vertices[mesh.faces[surface.faces_of(("chin",))], 1].min()
    start, end = CLOTH_BELOW_MM
    low = np.clip((chin - mesh.vertices[:, 1] - start) / (end - start), 0.0, 1.0)
    neck = surface.vertices_of(("neck",)) & (low > 0)
    cloth = np.where(neck, LOWEST_CLOTH * low, LEAST_CLOTH * prior[:, 2])
    prior = np.concatenate([prior[:, :2] * ((1 - cloth) / prior[:, :2].sum(1))[:, None], cloth[:, None]], 1)
    lips = 0.95 * _inside(surface, ("lips",), LIP_MM)[:, None]
    return np.concatenate([prior * (1.0 - lips), lips], 1)


def _neighbours(surface: Surface, features: SurfaceFeatures) -> sparse.csr_matrix:
    """[V, V] rows that sum to 1: neighbours, those most that look alike."""
    edges = mesh_edges(surface.mesh.faces)[0]
    off = (features.colour[edges[:, 0]] - features.colour[edges[:, 1]]).mean(1)
    alike = np.exp(-0.5 * (off / CONTRAST) ** 2) + 0.02
    count = len(surface.mesh.vertices)
    matrix = sparse.coo_matrix((alike, edges.T), shape=(count, count)).tocsr()
    matrix = matrix + matrix.T
    return sparse.diags(1.0 / np.maximum(np.asarray(matrix.sum(1)).ravel(), 1e-9)) @ matrix


def _with_parts(surface: Surface, belief: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """[V, len(LABELS)]: skin, hair, cloth and lips [V, 4], with brows and eyes by the topology, as far as it is
    seen."""
    found = np.zeros((len(belief), len(LABELS)))
    found[:, [SKIN, HAIR, CLOTH, LIPS]] = belief
    brow = np.clip(2.0 * _inside(surface, ("brows", "lids"), BROW_MM), 0.0, 1.0)
    found[:, BROW] = brow * found[:, HAIR]
    found[:, HAIR] *= 1.0 - brow
    for names, label in ((("inner_mouth", "eye_sockets"), UNKNOWN), (("eyes",), EYE)):
        inside = surface.vertices_of(names) & ~surface.vertices_of(("lips", "lids"))
        found[inside] = 0.0
        found[inside, label] = 1.0
    found *= seen[:, None]
    found[:, UNKNOWN] += 1.0 - found.sum(1)
    return found
