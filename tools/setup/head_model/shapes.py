"""Identity and expression components from MakeHuman's targets.

Identity: principal components of random plausible adults. MakeHuman blends a person from macro targets
(ethnicity x gender x age, and gender x age x muscle x weight, weighted by products of the single weights) and
adds local modifiers; both are drawn here, the heads are aligned rigidly, and their covariance is decomposed.
"""

from dataclasses import dataclass

import numpy as np

from shared.geometry.transforms import similarity_from_points
from tools.setup.head_model.makehuman import MakeHuman
from tools.setup.head_model.topology import EYE_LEFT, EYE_RIGHT, MOUTH, SKIN, SOCKET_LEFT, SOCKET_RIGHT, HeadTopology

IDENTITY_COUNT = 50
SAMPLE_COUNT = 1500
SEED = 20250
INTERPUPILLARY_MM = 63.0
HEAD_SIZE_DEVIATION = 0.035
MOUTH_CLOSING = 0.02
"""Share of a full jaw opening taken off the mean: MakeHuman's lips stand apart once subdivision has rounded
them.
"""
EAR_CANAL_LEFT = (68.0, 706.0, 55.0)
"""Bottom of the concha on the base mesh, mm."""

# Standard deviations of the local modifiers in units of their full effect.
LOCAL_DEVIATION = {
    "cheek": 0.35,
    "chin": 0.3,
    "ears": 0.3,
    "eyebrows": 0.35,
    "eyes": 0.25,
    "forehead": 0.35,
    "head": 0.2,
    "mouth": 0.3,
    "neck": 0.2,
    "nose": 0.3,
    "asym": 0.12,
}
# The skull's height and depth, which MakeHuman lets grow far beyond people.
SKULL_DEVIATION = {
    "head/head-scale": 0.1,
    "head/head-back": 0.12,
    "head/head-age": 0.1,
    "forehead/forehead-scale-vert": 0.12,
    "forehead/forehead-nubian": 0.2,
}
# These move or tilt the head as a whole, or stylise it beyond the plausible.
LEFT_OUT = (
    "head/head-trans",
    "head/head-angle",
    "neck/neck-trans",
    "ears/l-ear-shape-pointed",
    "ears/r-ear-shape-pointed",
    "asym/asymm-",
)
SIDE_CORRELATION = 0.92
OPPOSITES = {
    "incr": "decr",
    "up": "down",
    "out": "in",
    "forward": "backward",
    "convex": "concave",
    "compress": "uncompress",
}

EXPRESSIONS = {
    "eye_blink_left": ("eyeBlinkLeft",),
    "eye_blink_right": ("eyeBlinkRight",),
    "eye_squint_left": ("eyeSquintLeft",),
    "eye_squint_right": ("eyeSquintRight",),
    "eye_wide_left": ("eyeWideLeft",),
    "eye_wide_right": ("eyeWideRight",),
    "brow_inner_up": ("browInnerUp",),
    "brow_down_left": ("browDownLeft",),
    "brow_down_right": ("browDownRight",),
    "brow_outer_up_left": ("browOuterUpLeft",),
    "brow_outer_up_right": ("browOuterUpRight",),
    "cheek_puff": ("cheekPuff",),
    "nose_sneer": ("noseSneerLeft", "noseSneerRight"),
    "jaw_open": ("jawOpen",),
    "jaw_forward": ("jawForward",),
    "jaw_left": ("jawLeft",),
    "mouth_smile_left": ("mouthSmileLeft",),
    "mouth_smile_right": ("mouthSmileRight",),
    "mouth_frown_left": ("mouthFrownLeft",),
    "mouth_frown_right": ("mouthFrownRight",),
    "mouth_pucker": ("mouthPucker",),
    "mouth_press": ("mouthPressLeft", "mouthPressRight"),
    "mouth_roll_lower": ("mouthRollLower",),
    "mouth_roll_upper": ("mouthRollUpper",),
    "mouth_stretch": ("mouthStretchLeft", "mouthStretchRight"),
}


@dataclass(frozen=True)
class HeadShapes:
    """template [V, 3] mm in head space, identity [50, V, 3] mm per standard deviation, expression [25, V, 3]
    mm.
    """

    template: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    explained: float


def head_shapes(source: MakeHuman, topology: HeadTopology) -> HeadShapes:
    """Draw the heads, scale their mean to an adult's interpupillary distance, and decompose them."""
    heads = draw_heads(source, topology, SAMPLE_COUNT, np.random.default_rng(SEED))
    scale = INTERPUPILLARY_MM / _interpupillary(heads.mean(0), topology)
    heads = _aligned(scale * heads, topology)
    template = heads.mean(0)
    identity, explained = _components(heads - template, _vertex_weight(template, topology))
    units = {key: scale * _expression(source, topology, key) for key in EXPRESSIONS}
    template = template - MOUTH_CLOSING * units["jaw_open"]
    template = (template + template[topology.mirror] * (-1, 1, 1)) / 2
    template -= _ear_canals(source, topology, template)
    return HeadShapes(template, identity, np.stack(list(units.values())), explained)


def _expression(source: MakeHuman, topology: HeadTopology, key: str) -> np.ndarray:
    """[V, 3] displacement by one facial action, in MakeHuman's own size."""
    unit = sum(source.face_unit(name) for name in EXPRESSIONS[key])[topology.base_index]
    if key.startswith(("eye", "brow")):
        # The blinks of the asset also pull at the mouth bag and at the other eye's socket.
        other = {"left": (SOCKET_RIGHT, EYE_RIGHT), "right": (SOCKET_LEFT, EYE_LEFT)}.get(key.rpartition("_")[2], ())
        unit[topology.vertices_of(MOUTH, *other)] = 0
    return unit


def draw_heads(source: MakeHuman, topology: HeadTopology, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random adults [count, V, 3] in mm, each at MakeHuman's own place and size times a random head size."""
    weights, targets = [], []
    for names, drawn in (_macro_weights(count, rng), _local_weights(source, count, rng)):
        weights.append(drawn)
        targets += [source.target(name)[topology.base_index] for name in names]
    base = source.base.vertices[topology.base_index]
    stacked = np.stack(targets).reshape(len(targets), -1)
    heads = base + (np.concatenate(weights, axis=1) @ stacked).reshape(count, -1, 3)
    return heads * rng.normal(1.0, HEAD_SIZE_DEVIATION, count).clip(0.9, 1.1)[:, None, None]


def _macro_weights(count: int, rng: np.random.Generator) -> tuple[list[str], np.ndarray]:
    """Names [K] of the macro targets and their weights [count, K] for random adults between 25 and 70."""
    old = rng.beta(1.2, 2.2, count)
    male = np.where(rng.random(count) < 0.5, rng.beta(1, 6, count), rng.beta(6, 1, count))
    ethnicity = rng.dirichlet((0.6, 0.6, 0.6), count)
    muscle = _three_levels(rng.normal(0.5, 0.18, count))
    weight = _three_levels(rng.normal(0.5, 0.18, count))
    names, weights = [], []
    for gender, gender_weight in (("male", male), ("female", 1 - male)):
        for age, age_weight in (("young", 1 - old), ("old", old)):
            for k, people in enumerate(("african", "asian", "caucasian")):
                names.append(f"macrodetails/{people}-{gender}-{age}")
                weights.append(ethnicity[:, k] * gender_weight * age_weight)
            for m, muscle_level in enumerate(("min", "average", "max")):
                for w, weight_level in enumerate(("min", "average", "max")):
                    names.append(f"macrodetails/universal-{gender}-{age}-{muscle_level}muscle-{weight_level}weight")
                    weights.append(muscle[:, m] * weight[:, w] * gender_weight * age_weight)
    return names, np.stack(weights, axis=1)


def _three_levels(value: np.ndarray) -> np.ndarray:
    """[N] in 0..1 -> weights [N, 3] of the levels min, average, max."""
    value = value.clip(0, 1)
    return np.stack([(1 - 2 * value).clip(0, 1), 1 - np.abs(1 - 2 * value), (2 * value - 1).clip(0, 1)], axis=1)


def _local_weights(source: MakeHuman, count: int, rng: np.random.Generator) -> tuple[list[str], np.ndarray]:
    """Names [K] of the local modifiers and their weights [count, K], mostly alike on both sides of the face."""
    names, weights = [], []
    drawn: dict[str, np.ndarray] = {}
    for folder, deviation in LOCAL_DEVIATION.items():
        for name in source.targets(folder):
            if name.startswith(LEFT_OUT):
                continue
            stem, _, ending = name.rpartition("-")
            direction = -1.0 if ending in OPPOSITES.values() else 1.0
            signed = ending in OPPOSITES or ending in OPPOSITES.values()
            key = stem if signed else name
            if key not in drawn:
                drawn[key] = _modifier(key, drawn, count, rng)
            names.append(name)
            skull = [value for start, value in SKULL_DEVIATION.items() if name.startswith(start)]
            weights.append((direction * min([deviation, *skull]) * drawn[key]).clip(0, 1))
    return names, np.stack(weights, axis=1)


def _modifier(key: str, drawn: dict[str, np.ndarray], count: int, rng: np.random.Generator) -> np.ndarray:
    """A standard normal value per head, correlated with that of the same modifier on the other side."""
    own = rng.standard_normal(count)
    other = key.replace("/r-", "/l-")
    if other == key or other not in drawn:
        return own
    return SIDE_CORRELATION * drawn[other] + np.sqrt(1 - SIDE_CORRELATION**2) * own


def _interpupillary(vertices: np.ndarray, topology: HeadTopology) -> float:
    """Distance between the centres of the two eyeballs, mm."""
    centres = [vertices[topology.vertices_of(part)].mean(0) for part in (4, 5)]
    return float(np.linalg.norm(centres[0] - centres[1]))


def _aligned(heads: np.ndarray, topology: HeadTopology) -> np.ndarray:
    """Heads [N, V, 3] moved rigidly onto their common mean (generalised Procrustes without scale)."""
    # The neck bends with the posture: only what lies above the chin decides.
    skin = topology.vertices_of(SKIN)
    mean = heads.mean(0)
    above_chin = skin[mean[skin, 1] > np.percentile(mean[skin, 1], 25)]
    for _ in range(2):
        mean = heads.mean(0)
        for k, head in enumerate(heads):
            _, rotation, shift = similarity_from_points(head[above_chin], mean[above_chin], with_scale=False)
            heads[k] = head @ rotation.T + shift
    return heads


def _vertex_weight(template: np.ndarray, topology: HeadTopology) -> np.ndarray:
    """[V] importance in the decomposition: area, less for what a clip shows little of."""
    corners = template[topology.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    hidden = np.isin(topology.part, (MOUTH, SOCKET_LEFT, SOCKET_RIGHT))
    centre = corners.mean(1)
    face_side = centre[:, 2] > np.percentile(centre[topology.part == SKIN, 2], 35)
    area = area * np.where(hidden, 0.02, np.where(face_side, 1.0, 0.15))
    return np.bincount(topology.faces.ravel(), np.repeat(area / 3, 3), len(template))


def _components(deviations: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Principal components [50, V, 3] in mm per standard deviation, by variance, and the share they explain.

    The larger of the two extreme displacements along the dominant axis is positive: signs are reproducible.
    """
    count = len(deviations)
    weighted = (deviations * np.sqrt(weight)[:, None]).reshape(count, -1)
    variance, scores = np.linalg.eigh(weighted @ weighted.T / count)
    order = np.argsort(-variance)[:IDENTITY_COUNT]
    scores = scores[:, order] * np.sqrt(count)
    components = (scores.T @ deviations.reshape(count, -1) / count).reshape(IDENTITY_COUNT, -1, 3)
    for component in components:
        if component.ravel()[np.argmax(np.abs(component))] < 0:
            component *= -1
    return components, float(variance[order].sum() / variance.sum())


def _ear_canals(source: MakeHuman, topology: HeadTopology, vertices: np.ndarray) -> np.ndarray:
    """[3] the point between the two ear canals."""
    base = source.base.vertices[topology.base_index]
    left = int(np.argmin(np.linalg.norm(base - EAR_CANAL_LEFT, axis=1)))
    return (vertices[left] + vertices[topology.mirror[left]]) / 2
