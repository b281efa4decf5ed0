"""A small renderer for the synthetic house: textured rectangles in perspective, nearest first, with a depth buffer.

A camera looks along z, x is to the right, y is down.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lmdb_build.walk.house import House, Image
from loopclosure.places.intrinsics import Intrinsics
from netspec.files.opencv import cv2

Array = NDArray[np.float64]

FINER = 2  # pictures are drawn this much larger, and reduced
NEAR_M = 0.05
SUN = np.array([0.5, 0.3, 0.8])  # surfaces that face along this direction, either way, are brightest
AHEAD = np.float32(1.0005)  # a new pixel must be nearer by this factor, or faces that touch would flicker


class Renderer:
    """Draws a house as one camera sees it; ``light`` (rooms, 3) are the BGR factors of each room's light."""

    def __init__(self, house: House, camera: Intrinsics, light: Array) -> None:
        assert camera.size is not None
        self._width, self._height = (FINER * pixels for pixels in camera.size)
        fine = camera.of_size(self._width, self._height)
        self._origins, rights, downs = (
            np.array([getattr(quad, edge) for quad in house.quads]) for edge in ("origin", "right", "down")
        )
        self._corners = self._origins[:, None] + np.stack([0 * rights, rights, rights + downs, downs], axis=1)
        self._normals = np.cross(downs, rights)
        facing = np.abs(self._normals @ SUN) / np.linalg.norm(self._normals, axis=1)
        self._textures = [
            np.clip(quad.texture * (light[quad.room] * (0.6 + 0.5 * lit)), 0, 255).astype(np.uint8)
            for quad, lit in zip(house.quads, facing, strict=True)
        ]
        self._across = rights / (rights**2).sum(axis=1, keepdims=True)
        self._along = downs / (downs**2).sum(axis=1, keepdims=True)
        self._matrix = np.array([[fine.fx, 0, fine.cx], [0, fine.fy, fine.cy], [0, 0, 1]])
        self._rays = np.linalg.inv(self._matrix)

    def draw(self, position: Array, rotation: Array) -> tuple[Image, NDArray[np.float32]]:
        """Return what is seen from ``position`` (3,) with camera-to-world ``rotation`` (3, 3).

        A picture (H, W, 3) uint8, BGR, and the depth (H, W) of its pixels along the camera's axis, in meters, 0 where
        there is nothing.
        """
        shape = self._height, self._width
        picture, nearness = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32)  # 1 / z: linear, unlike z
        facing = ((position - self._origins) * self._normals).sum(axis=1) > 0
        corners = (self._corners - position) @ rotation
        visible = np.flatnonzero(facing & (corners[..., 2] > NEAR_M).any(axis=1))
        visible = visible[np.argsort((corners[visible].mean(axis=1) ** 2).sum(axis=1))]  # nearest first: less to paint
        corners = corners[visible]

        # A ray r through a pixel meets the plane n.X = n.o at z = n.o / n.r, so 1 / z is linear in the pixel.
        normals = self._normals[visible] @ rotation
        planes = normals / (normals * corners[:, 0]).sum(axis=1, keepdims=True)
        # Pixel -> (across, along), 0..1 on the rectangle, homogeneous: from X = z r and (X - o).right / right.right.
        across, along = self._across[visible] @ rotation, self._along[visible] @ rotation
        at_corner = [(edge * corners[:, 0]).sum(axis=1, keepdims=True) * planes for edge in (across, along)]
        to_unit = np.stack([across - at_corner[0], along - at_corner[1], planes], axis=1) @ self._rays
        for index, outline, unit in zip(visible, corners, to_unit, strict=True):
            self._draw_quad(picture, nearness, self._textures[index], outline, unit)
        nearness = nearness.reshape(shape[0] // FINER, FINER, shape[1] // FINER, FINER).max(axis=(1, 3))
        depth = np.divide(1, nearness, out=np.zeros_like(nearness), where=nearness > 0)
        return cv2.resize(picture, depth.shape[::-1], interpolation=cv2.INTER_AREA), depth

    def _draw_quad(
        self, picture: Image, nearness: NDArray[np.float32], texture: Image, corners: Array, to_unit: Array
    ) -> None:
        """Paint a rectangle with ``corners`` (4, 3) where it is nearer than the picture so far."""
        x0, y0, x1, y1 = 0, 0, self._width, self._height
        if (corners[:, 2] > NEAR_M).all():  # otherwise it may be anywhere in the picture
            outline = (corners @ self._matrix.T)[:, :2] / corners[:, 2:]
            (left, top), (right, bottom) = outline.min(axis=0), outline.max(axis=0)
            x0, y0, x1, y1 = max(x0, int(left)), max(y0, int(top)), min(x1, int(right) + 2), min(y1, int(bottom) + 2)
        if x1 <= x0 or y1 <= y0:
            return
        columns, rows = np.arange(x0, x1), np.arange(y0, y1)[:, None]
        u, v, near = (a * columns + (b * rows + c) for a, b, c in to_unit)
        behind = nearness[y0:y1, x0:x1]
        mask = (u >= 0) & (u <= near) & (v >= 0) & (v <= near) & (near > behind * AHEAD) & (near < 1 / NEAR_M)
        if not mask.any():
            return
        to_texture = np.array([[texture.shape[1], 0, -0.5], [0, texture.shape[0], -0.5], [0, 0, 1]]) @ to_unit
        patch = cv2.warpPerspective(
            texture,
            to_texture @ np.array([[1, 0, x0], [0, 1, y0], [0, 0, 1]]),
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        picture[y0:y1, x0:x1][mask], behind[mask] = patch[mask], near[mask]
