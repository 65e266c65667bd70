"""What is known of skin before any clip: albedo of measured faces from very light to very dark, the line that their
tints follow, and how strongly skin's surface reflects.

Faces: the International Skin Spectra Archive [Lu2025] (CC BY 4.0), 4603 readings of cheeks and foreheads by
spectrophotometers that touch the skin. Median colour of the readings within 4 degrees of eleven individual typology
angles (62 to -75 degrees; 16, 352, 741, 762, 470, 227, 106, 71, 58, 38 and 36 readings), linear Rec.709 under D65, less
the reflection of the surface, 0.028, which these instruments count in. Light that leaves the skin beyond their aperture
makes them read somewhat dark, most in red; no correction is made.

The surface: its index of refraction. Renderings of skin take 1.38 to 1.4 [Weyrich2006]; excised epidermis has 1.42 to
1.45 in the visible [Ding2006], cheeks in vivo, by their critical angle, 1.51 to 1.53 [Yoshida2013].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.imaging.color import LUMINANCE

MEASURED_SKINS = np.array(
    [
        [0.498, 0.322, 0.271],
        [0.468, 0.286, 0.215],
        [0.429, 0.246, 0.170],
        [0.376, 0.204, 0.128],
        [0.322, 0.163, 0.093],
        [0.274, 0.132, 0.068],
        [0.213, 0.098, 0.048],
        [0.166, 0.073, 0.035],
        [0.128, 0.054, 0.028],
        [0.092, 0.040, 0.024],
        [0.061, 0.028, 0.019],
    ]
)
"""Linear Rec.709 albedo of measured faces, light to dark: see above."""

TYPICAL_SKIN = MEASURED_SKINS[3]
"""The median reading's: it lies among those about an angle of 25 degrees."""
MEDIAN_LOG_LUMINANCE = float(np.log(TYPICAL_SKIN @ LUMINANCE))
LUMINANCE_SIGMA = 1.5 * float(np.std(np.log(MEASURED_SKINS @ LUMINANCE), ddof=1))
"""Of log luminance, 1.2: half as wide again as all eleven alike are spread. As people were measured it would be 0.4. A
normal distribution that is narrower draws both ends to its middle: it darkens the fair and lightens the dark."""
PERSON_SIGMA = np.array([0.08, 0.10])
"""Of log R/G and log B/G between faces of one lightness, from the 10th and 90th percentiles of a* and b* there."""
BRIGHTEST_ALBEDO = 0.847
"""Of any channel, brighter than any measured face: red of the lightest preset that renderers use for skin (Skin I of
the Physically Based database, physicallybased.info, CC0)."""
SURFACE_INTENSITY, SURFACE_SPREAD = 0.84, 0.25
"""Specular intensity, 1 at a reflectance of 0.04 at normal incidence, for an index of 1.45, and the standard deviation
of its logarithm: one deviation to both sides is 1.38 to 1.53."""


@dataclass(frozen=True)
class SkinLocus:
    """log R/G and log B/G of skin: offset + slope * (log Y - mean_log_luminance), each [2], spread sigma [2]."""

    mean_log_luminance: float
    offset: np.ndarray
    slope: np.ndarray
    sigma: np.ndarray


def fit_skin_locus(skins: np.ndarray = MEASURED_SKINS) -> SkinLocus:
    """Least-squares line through skins [N, 3] of all tones, about the median luminance of measured people; the spread
    is that of the skins about the line, unbiased, and of people of one tone."""
    logs = np.log(skins)
    from_median = np.log(skins @ LUMINANCE) - MEDIAN_LOG_LUMINANCE
    chroma = logs[:, [0, 2]] - logs[:, [1]]
    design = np.stack([np.ones_like(from_median), from_median], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design, chroma, rcond=None)
    residual = chroma - design @ np.stack([offset, slope])
    about_line = (residual**2).sum(0) / (len(skins) - 2)
    return SkinLocus(MEDIAN_LOG_LUMINANCE, offset, slope, np.sqrt(about_line + PERSON_SIGMA**2))


SKIN_LOCUS = fit_skin_locus()
