"""Lights that no clip had, to see a head under: soft window, low sun, overcast sky, two coloured lamps from behind.

Lat-long maps in the layout of shared.rendering.envmap: +y on top, +z, towards the camera, in the middle. A lamp is a
von Mises-Fisher lobe exp(k (cos - 1)), wide enough for a few hundred directions to hold it.
"""

from __future__ import annotations

import numpy as np

from shared.rendering.envmap import latlong_directions

HEIGHT = 64
STUDIO_LIGHTS = {
    "window": "a large window on the left, weak light from the room",
    "low_sun": "a low, warm sun on the right under a blue sky",
    "overcast": "an overcast sky over grey ground",
    "two_lamps": "an orange and a teal lamp from behind, a faint one in front",
}
"""name -> what it is. The sides are those of the picture: a lamp on the left lights the picture's left."""


def lamp(yaw_deg: float, pitch_deg: float, colour: tuple[float, float, float], spread_deg: float) -> np.ndarray:
    """[HEIGHT, 2 HEIGHT, 3]: a lobe of the standard width spread_deg, of unit radiant flux times colour.

    yaw_deg: 0 is the camera's side, 90 the picture's right; pitch_deg: up.
    """
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    axis = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    sharpness = 1.0 / np.radians(spread_deg) ** 2
    lobe = np.exp(sharpness * (latlong_directions(HEIGHT) @ axis - 1.0))
    lobe *= sharpness / (2.0 * np.pi * (1.0 - np.exp(-2.0 * sharpness)))
    return lobe[..., None] * np.array(colour)


def sky(zenith: tuple[float, float, float], ground: tuple[float, float, float]) -> np.ndarray:
    """[HEIGHT, 2 HEIGHT, 3]: radiance from straight above to straight below, linear in the height."""
    share = 0.5 + 0.5 * latlong_directions(HEIGHT)[..., 1:2]
    return share * np.array(zenith) + (1.0 - share) * np.array(ground)


def studio_light(name: str) -> np.ndarray:
    """[HEIGHT, 2 HEIGHT, 3] float64 radiance of a light of STUDIO_LIGHTS, scaled by facing_irradiance to 1."""
    lights = {
        "window": lambda: lamp(-65, 20, (2.6, 2.5, 2.4), 22) + sky((0.10, 0.10, 0.11), (0.08, 0.07, 0.06)),
        "low_sun": lambda: lamp(55, 18, (3.4, 2.3, 1.3), 9) + sky((0.16, 0.24, 0.42), (0.10, 0.09, 0.07)),
        "overcast": lambda: sky((1.0, 1.02, 1.06), (0.14, 0.13, 0.12)),
        "two_lamps": lambda: (
            lamp(-130, 15, (6.0, 2.4, 0.6), 14) + lamp(130, 15, (0.5, 2.6, 3.6), 14) + lamp(10, 10, (0.5, 0.5, 0.5), 25)
            + sky((0.05, 0.05, 0.06), (0.03, 0.03, 0.03))
        ),
    }
    radiance = lights[name]()
    return radiance / facing_irradiance(radiance)


def facing_irradiance(radiance: np.ndarray) -> float:
    """Irradiance over pi, mean of the channels, on the sides of a head: the mean over facets facing yaw -50, 0, 50.
    radiance [H, W, 3] linear, lat-long."""
    height = len(radiance)
    directions = latlong_directions(height)
    solid = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None] * (np.pi / height) ** 2
    angles = np.radians([-50.0, 0.0, 50.0])
    normals = np.stack([np.sin(angles), 0 * angles, np.cos(angles)])
    cosines = np.maximum(directions @ normals, 0.0).mean(-1)
    return float((cosines * solid * radiance.mean(-1)).sum() / np.pi)
