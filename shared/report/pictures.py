"""Arrays as pictures inside a page: tone, colour maps and data URIs."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from shared.imaging.color import encode_srgb

ERROR_RANGE = 0.05
"""The error map runs from -ERROR_RANGE to +ERROR_RANGE of linear radiance, clip maximum 1."""
CHEQUERS, _BOARD = 32, (0.25, 0.4)
"""Squares along an edge of what is seen through a map, and their radiances."""
_DARKER, _BRIGHTER = np.float32([33, 102, 172]), np.float32([178, 24, 43])
_EQUAL, _NOTHING = np.float32([247, 247, 247]), np.float32([200, 200, 200])


def srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """[...] linear radiance, 1 = white -> uint8 sRGB codes, clipped."""
    return (encode_srgb(linear) * 255.0 + 0.5).astype(np.uint8)


def grey_bytes(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """[H, W] -> uint8, low black, high white, linear between."""
    return (np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def viridis_bytes(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """[H, W] -> [H, W, 3] uint8 RGB in the viridis colour map (even in lightness, safe for colour blindness). low,
    high: the values at its ends."""
    coloured = cv2.applyColorMap(grey_bytes(values, low, high), cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(coloured[..., ::-1])


def error_bytes(clip: np.ndarray, render: np.ndarray, clipped: np.ndarray) -> np.ndarray:
    """Signed error of a re-render: [H, W, 3] linear clip and render, [H, W] bool clipped -> [H, W, 3] uint8.

    Blue: the render is darker; red: brighter; white: equal; grey: nothing was rendered. Where the sensor was full
    (clipped) the truth is "at least that bright", so a brighter render counts as equal.
    """
    error = (render - clip).mean(-1)
    error = np.where(clipped & (error > 0.0), 0.0, error)
    amount = np.clip(error / ERROR_RANGE, -1.0, 1.0)[..., None]
    colour = np.where(amount < 0.0, _DARKER, _BRIGHTER)
    picture = _EQUAL + (colour - _EQUAL) * np.abs(amount)
    picture = np.where((render > 0.0).any(-1, keepdims=True), picture, _NOTHING)
    return (picture + 0.5).astype(np.uint8)


def over_chequers(linear: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """[S, S, 3] linear, seen as far as alpha [S, S] says over a board of greys -> [S, S, 3] linear."""
    square = np.arange(len(alpha)) * CHEQUERS // len(alpha)
    board = np.where((square[:, None] + square) % 2, *_BOARD)
    return (board + alpha * (np.moveaxis(linear, -1, 0) - board)).transpose(1, 2, 0)


def shrunk(picture: np.ndarray, longest: int) -> np.ndarray:
    """[H, W] or [H, W, 3], any type -> the same averaged down so that no side exceeds longest pixels."""
    scale = longest / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    width, height = (max(1, round(side * scale)) for side in picture.shape[1::-1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def jpeg_uri(picture: np.ndarray, quality: int = 85) -> str:
    """uint8 [H, W] or [H, W, 3] RGB -> data URI."""
    return _uri("jpeg", ".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])


def _uri(kind: str, suffix: str, picture: np.ndarray, options: list[int]) -> str:
    ordered = np.ascontiguousarray(picture[..., ::-1] if picture.ndim == 3 else picture)
    _, encoded = cv2.imencode(suffix, ordered, options)
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode('ascii')}"
