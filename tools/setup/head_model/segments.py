"""Names the faces of the head: skin regions from landmark outlines, edge loops and a few lines in profile."""

import cv2
import numpy as np

from shared.geometry.mesh import interpolate
from tools.setup.head_model.embedding import Embedding
from tools.setup.head_model.topology import (
    EYE_LEFT,
    EYE_RIGHT,
    LIP_RINGS,
    MOUTH,
    SOCKET_LEFT,
    SOCKET_RIGHT,
    HeadTopology,
    rings_around,
)

SEGMENT_NAMES = tuple(
    "forehead brows lids nose cheek_left cheek_right upper_lip_skin lips chin jaw ears neck scalp eyes inner_mouth "
    "eye_sockets".split()
)
# Where regions overlap the later name wins.
PRECEDENCE = (
    "cheek_left cheek_right forehead scalp neck chin upper_lip_skin nose lids brows ears lips inner_mouth eye_sockets "
    "eyes".split()
)

# Outlines by landmark, the subject's right half; mirrored for the left. Frontal projection.
BROW = (46, 53, 52, 65, 55, 107, 66, 105, 63, 70)
ORBIT = (226, 113, 225, 224, 223, 222, 221, 189, 244, 233, 232, 231, 230, 229, 228, 31)
NOSE = (168, 193, 122, 196, 236, 198, 49, 129, 98, 97, 2)
UPPER_LIP = (2, 97, 98, 206, 216, 61, 40, 39, 37, 0)
OVAL_HALF = (10, 109, 67, 103, 54, 21, 162, 127, 234, 93, 132, 58, 172, 136, 150, 149, 176, 148, 152)
BROW_MARGIN_MM = 2.0
LID_RINGS = 9
EAR_SHARE = 0.12
"""Share of the largest displacement by MakeHuman's modifier for protruding ears that counts as ear."""
CHIN_HALF_WIDTH, CHIN_DEPTH, CHIN_DROP = 27.0, 16.0, 5.0
# Where throat and lower jaw meet on the middle line, seen from the chin's lowest point: y, z.
THROAT = (-12.0, -62.0)
# Hairline at the nape, from the ear canal: y, z.
NAPE = (-40.0, -110.0)


def face_segments(
    template: np.ndarray, topology: HeadTopology, embedding: Embedding, ear_motion: np.ndarray
) -> np.ndarray:
    """[F] uint8 index into SEGMENT_NAMES for each face of the template [V, 3].

    ear_motion [V]: how far MakeHuman's modifier for protruding ears moves each vertex.
    """
    centre = template[topology.faces].mean(1)
    places = interpolate(template, topology.faces, embedding.face, embedding.bary)
    named = {name: np.zeros(len(centre), bool) for name in SEGMENT_NAMES}
    named["inner_mouth"] = topology.part == MOUTH
    named["eye_sockets"] = np.isin(topology.part, (SOCKET_LEFT, SOCKET_RIGHT))
    named["eyes"] = np.isin(topology.part, (EYE_LEFT, EYE_RIGHT))
    named["ears"] = ear_motion[topology.faces].mean(1) > EAR_SHARE * ear_motion.max()
    named["lips"] = rings_around(topology, (MOUTH,), LIP_RINGS) >= 0
    lid_loops = rings_around(topology, (SOCKET_LEFT, SOCKET_RIGHT), LID_RINGS) >= 0
    named["brows"] = _in_outline(centre, places, BROW, margin=BROW_MARGIN_MM) & ~lid_loops
    named["nose"] = _in_outline(centre, places, NOSE, closed_on_middle=True)
    named["upper_lip_skin"] = _in_outline(centre, places, UPPER_LIP, closed_on_middle=True)
    named |= _by_lines(centre, places, centre[named["ears"]])
    named["lids"] |= lid_loops | _in_outline(centre, places, ORBIT)
    segment = np.full(len(centre), SEGMENT_NAMES.index("jaw"))
    for name in PRECEDENCE:
        segment[named[name]] = SEGMENT_NAMES.index(name)
    return segment.astype(np.uint8)


def _by_lines(centre: np.ndarray, places: np.ndarray, ear: np.ndarray) -> dict[str, np.ndarray]:
    """The large regions: the face oval in profile parts face from scalp and jaw, straight lines part the rest."""
    x, y, z = centre.T
    oval = places[list(OVAL_HALF)]
    order = np.argsort(oval[:, 1])
    face_side = (z > np.interp(y, oval[order, 1], oval[order, 2])) & (y < oval[0, 1]) & (y > oval[-1, 1])
    # Over the root of the nose, the inner, middle and outer brow.
    over = places[[8, 55, 105, 70]]
    above_brows = y > np.interp(np.abs(x), np.abs(over[:, 0]), over[:, 1])
    chin, lip = places[152], places[17]
    lobe = ear[np.argmin(ear[:, 1]), 1:]
    throat = chin[1:] + THROAT
    eye_outer, eye_inner = places[33], places[133]
    over_eye = (np.abs(x) > abs(eye_inner[0])) & (np.abs(x) < abs(eye_outer[0]) + 4) & (y > eye_outer[1])
    # Below the line from throat over the ear lobe to the nape lies the neck; above and behind it hair grows.
    line = np.interp(z, [NAPE[1], lobe[1], throat[1]], [NAPE[0], lobe[0], throat[0]])
    return {
        "forehead": face_side & above_brows,
        "cheek_left": face_side & ~above_brows & (x > 0),
        "cheek_right": face_side & ~above_brows & (x <= 0),
        "lids": face_side & ~above_brows & over_eye,
        "chin": (np.abs(x) < CHIN_HALF_WIDTH) & (y < lip[1]) & (y > chin[1] - CHIN_DROP) & (z > chin[2] - CHIN_DEPTH),
        "scalp": ~face_side & (y > line) & ((z < lobe[1]) | (y > places[234, 1])),
        "neck": ((y < line) & (z < throat[1] + 2)) | (y < throat[0] - 8),
    }


def _in_outline(
    centre: np.ndarray,
    places: np.ndarray,
    outline: tuple[int, ...],
    margin: float = 0.0,
    closed_on_middle: bool = False,
) -> np.ndarray:
    """[F] bool: inside a landmark outline or its mirror image, seen from the front; margin in mm around it.

    closed_on_middle: the outline starts and ends on the middle line, and its mirrored half completes the
    region.
    """
    half = places[list(outline), :2]
    mirrored = half[::-1] * (-1, 1)
    rings = [np.concatenate([half, mirrored])] if closed_on_middle else [half, mirrored]
    front = centre[:, 2] > places[list(outline), 2].min() - 25
    inside = np.zeros(len(centre), bool)
    for ring in rings:
        contour = ring.astype(np.float32)[:, None]
        inside |= np.array([cv2.pointPolygonTest(contour, (float(p[0]), float(p[1])), True) for p in centre]) > -margin
    return inside & front
