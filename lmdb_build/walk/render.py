"""A small renderer for the synthetic house: textured rectangles in perspective, nearest first, with a depth buffer.

Camera: pinhole, x to the right, y down, z forward; the center of pixel (column, row) is at exactly those coordinates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdb_build.walk.house import House, Quad
from lmdb_build.walk.textures import Image
from netspec.files.opencv import cv2

Array = NDArray[np.float64]

NEAR_M = 0.05
LIGHT_GRID_M = 0.1  # light varies slowly: it is computed on this grid and interpolated
AHEAD = np.float32(1.0005)  # a new pixel must be nearer by this factor, or faces that touch would flicker


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: picture size and focal length in pixels."""

    width: int
    height: int
    focal: float

    @property
    def center(self) -> tuple[float, float]:
        """The principal point (column, row): the center of the picture."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    def project(self, points: Array) -> Array:
        """Project points (..., 3) in camera coordinates, in front of the camera, to pixels (..., 2)."""
        return points[..., :2] / points[..., 2:] * self.focal + np.array(self.center)


@dataclass(frozen=True)
class Light:
    """The light of a lap: BGR factors of the ambient light and of one source per room, and the sources' positions."""

    ambient: Array  # (3,)
    sources: Array  # (rooms, 3)
    places: Array  # (rooms, 3), in meters


class Renderer:
    """Draws a house as one camera sees it. :meth:`relight` takes about 0.1 s, :meth:`draw` a few milliseconds."""

    def __init__(self, house: House, camera: Camera, light: Light) -> None:
        self.house, self.camera = house, camera
        self._origins, rights, downs = (
            np.array([getattr(quad, edge) for quad in house.quads]) for edge in ("origin", "right", "down")
        )
        self._corners = self._origins[:, None] + np.stack([0 * rights, rights, rights + downs, downs], axis=1)
        self._normals = np.cross(downs, rights)
        self._across = rights / (rights**2).sum(axis=1, keepdims=True)
        self._along = downs / (downs**2).sum(axis=1, keepdims=True)
        (u, v), f = camera.center, camera.focal
        self._rays = np.array([[1 / f, 0, -u / f], [0, 1 / f, -v / f], [0, 0, 1]])
        self.depth = np.zeros((camera.height, camera.width), np.float32)
        self.relight(light)

    def relight(self, light: Light) -> None:
        """Change the light, and compute all textures again."""
        self._pyramids = [_pyramid(_lit(quad, light)) for quad in self.house.quads]

    def draw(self, position: Array, rotation: Array) -> Image:
        """Return the picture (H, W, 3), BGR, seen from ``position`` (3,) with camera-to-world ``rotation`` (3, 3).

        ``depth`` then has the depth (H, W) of its pixels along the camera's axis, in meters, 0 where there is nothing.
        """
        shape = self.camera.height, self.camera.width
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
            self._draw_quad(picture, nearness, self._pyramids[index], outline, unit)
        self.depth = np.divide(1, nearness, out=np.zeros_like(nearness), where=nearness > 0)
        return picture

    def _draw_quad(
        self, picture: Image, nearness: NDArray[np.float32], pyramid: list[Image], corners: Array, to_unit: Array
    ) -> None:
        """Paint a rectangle with ``corners`` (4, 3) where it is nearer than the picture so far."""
        x0, y0, x1, y1 = 0, 0, self.camera.width, self.camera.height
        if (corners[:, 2] > NEAR_M).all():  # otherwise it may be anywhere in the picture
            outline = self.camera.project(corners)
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
        y, x = (inside.mean() for inside in np.nonzero(mask))
        texture = pyramid[_level(to_unit, np.array([x0 + x, y0 + y, 1]), pyramid)]
        to_texture = np.array([[texture.shape[1], 0, -0.5], [0, texture.shape[0], -0.5], [0, 0, 1]]) @ to_unit
        patch = cv2.warpPerspective(
            texture,
            to_texture @ np.array([[1, 0, x0], [0, 1, y0], [0, 0, 1]]),
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        picture[y0:y1, x0:x1][mask], behind[mask] = patch[mask], near[mask]


def _level(to_unit: Array, pixel: Array, pyramid: list[Image]) -> int:
    """Choose the pyramid level with about one texel per pixel, at ``pixel`` (column, row, 1)."""
    u, v, w = to_unit @ pixel
    (a, b), (c, d) = to_unit[:2, :2] * w - np.outer([u, v], to_unit[2, :2])
    tall, wide = pyramid[0].shape[:2]
    texels = abs(a * d - b * c) / w**4 * tall * wide  # a pixel's area on the finest level
    return min(max(round(0.5 * math.log2(max(texels, 1e-9))), 0), len(pyramid) - 1)


def _pyramid(texture: Image) -> list[Image]:
    levels = [texture]
    while min(levels[-1].shape[:2]) > 4:
        tall, wide = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (wide // 2, tall // 2), interpolation=cv2.INTER_AREA))
    return levels


def _lit(quad: Quad, light: Light) -> Image:
    """Return the rectangle's texture, lit by the light of its room."""
    wide, tall = np.linalg.norm(quad.right), np.linalg.norm(quad.down)
    across = np.linspace(0, 1, max(2, round(wide / LIGHT_GRID_M)))
    along = np.linspace(0, 1, max(2, round(tall / LIGHT_GRID_M)))
    towards = light.places[quad.room] - quad.origin
    towards = towards - along[:, None, None] * quad.down - across[None, :, None] * quad.right
    distance = np.linalg.norm(towards, axis=-1)
    cosine = towards @ np.cross(quad.down, quad.right) / (wide * tall) / np.maximum(distance, 0.01)
    cosine = np.maximum(cosine, 0.15)  # walls also reflect light
    power = light.ambient + (cosine / (0.6 + 0.35 * distance**2))[..., None] * light.sources[quad.room]
    factor = cv2.resize(power.astype(np.float32), quad.texture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip(quad.texture * factor, 0, 255).astype(np.uint8)
