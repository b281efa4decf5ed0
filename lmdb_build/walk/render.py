"""A small renderer for the synthetic house: textured rectangles in perspective, nearest first, with a depth buffer.

Camera: pinhole, x to the right, y down, z forward; the center of pixel (column, row) is at exactly those coordinates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdb_build.walk.house import HEIGHT_M, House, Quad, Room
from lmdb_build.walk.textures import Image
from netspec.files.opencv import cv2

Array = NDArray[np.float64]

NEAR_M = 0.05
LIGHT_GRID_M = 0.1  # light varies slowly: it is computed on this grid and interpolated
SUBPIXEL_BITS = 4
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
    """The light of a lap: BGR factors of the ambient light, of daylight at the windows and of each room's lamp."""

    ambient: Array  # (3,)
    daylight: Array  # (3,)
    lamps: Array  # (rooms, 3)


class Renderer:
    """Draws a house as one camera sees it. :meth:`relight` takes about 0.1 s, :meth:`draw` a few milliseconds."""

    def __init__(self, house: House, camera: Camera, light: Light) -> None:
        self.house, self.camera = house, camera
        quads = house.quads
        self._origins = np.array([quad.origin for quad in quads])
        rights = np.array([quad.right for quad in quads])
        downs = np.array([quad.down for quad in quads])
        self._corners = np.stack(
            [self._origins, self._origins + rights, self._origins + rights + downs, self._origins + downs], axis=1
        )
        self._normals = np.cross(downs, rights)
        self._across = rights / (rights**2).sum(axis=1, keepdims=True)
        self._along = downs / (downs**2).sum(axis=1, keepdims=True)
        u, v = camera.center
        self._rays = np.array(
            [[1 / camera.focal, 0, -u / camera.focal], [0, 1 / camera.focal, -v / camera.focal], [0, 0, 1]]
        )
        self.depth = np.zeros((camera.height, camera.width), np.float32)
        self.relight(light)

    def relight(self, light: Light) -> None:
        """Change the light: all textures are lit again."""
        self._pyramids = [_pyramid(_lit(quad, self.house.rooms[quad.room], light)) for quad in self.house.quads]

    def draw(self, position: Array, rotation: Array) -> Image:
        """Return the picture (H, W, 3), BGR, seen from ``position`` (3,) with camera-to-world ``rotation`` (3, 3).

        ``depth`` then holds the depth (H, W) of its pixels along the camera's axis, in meters, 0 where nothing is.
        """
        height, width = self.camera.height, self.camera.width
        picture = np.zeros((height, width, 3), np.uint8)
        nearness = np.zeros((height, width), np.float32)  # 1 / z: linear in the picture, unlike z
        facing = ((position - self._origins) * self._normals).sum(axis=1) > 0
        corners = (self._corners - position) @ rotation
        visible = np.flatnonzero(facing & self._touches_view(corners))
        visible = visible[np.argsort((corners[visible].mean(axis=1) ** 2).sum(axis=1))]  # nearest first: less to paint
        corners = corners[visible]

        # A ray r through a pixel meets the plane n.X = n.o at z = n.o / n.r, so 1 / z is linear in the pixel.
        normals = self._normals[visible] @ rotation
        planes = normals / (normals * corners[:, 0]).sum(axis=1, keepdims=True)
        # Pixel -> (across, along), 0..1 on the rectangle, homogeneous: from X = z r and (X - o).right / right.right.
        across, along = self._across[visible] @ rotation, self._along[visible] @ rotation
        to_unit = np.stack(
            [
                across - (across * corners[:, 0]).sum(axis=1, keepdims=True) * planes,
                along - (along * corners[:, 0]).sum(axis=1, keepdims=True) * planes,
                planes,
            ],
            axis=1,
        )
        to_unit = to_unit @ self._rays
        for index, outline, unit in zip(visible, corners, to_unit, strict=True):
            self._draw_quad(picture, nearness, self._pyramids[index], _clip_near(outline), unit)
        self.depth = np.divide(1, nearness, out=np.zeros_like(nearness), where=nearness > 0)
        return picture

    def _touches_view(self, corners: Array) -> NDArray[np.bool_]:
        """Return which of the (Q, 4, 3) rectangles are not entirely behind or beside the view."""
        x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
        side, top = self.camera.width / 2 / self.camera.focal, self.camera.height / 2 / self.camera.focal
        outside = [z < NEAR_M, x > side * z, x < -side * z, y > top * z, y < -top * z]
        return ~np.any([part.all(axis=1) for part in outside], axis=0)

    def _draw_quad(
        self, picture: Image, nearness: NDArray[np.float32], pyramid: list[Image], corners: Array, to_unit: Array
    ) -> None:
        """Paint one rectangle, of ``corners`` (n, 3) in front of the camera, where it is nearer than what is there."""
        outline = self.camera.project(corners)
        (left, top), (right, bottom) = outline.min(axis=0), outline.max(axis=0)
        x0, y0 = max(int(left), 0), max(int(top), 0)
        x1, y1 = min(int(right) + 2, self.camera.width), min(int(bottom) + 2, self.camera.height)
        if x1 <= x0 or y1 <= y0:
            return
        slope = to_unit[2]
        near = (slope[0] * np.arange(x0, x1))[None] + (slope[1] * np.arange(y0, y1) + slope[2])[:, None]
        # A filled polygon covers its border pixels entirely: there the plane must not be nearer than the rectangle.
        near = np.minimum(near, 1 / corners[:, 2].min()).astype(np.float32)
        mask = np.zeros(near.shape, np.uint8)
        fixed_point = np.round((outline - [x0, y0]) * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillConvexPoly(mask, fixed_point, 1, shift=SUBPIXEL_BITS)
        behind = nearness[y0:y1, x0:x1]
        mask &= near > behind * AHEAD
        seen = cv2.moments(mask, binaryImage=True)
        if not seen["m00"]:
            return
        center = np.array([x0 + seen["m10"] / seen["m00"], y0 + seen["m01"] / seen["m00"], 1])
        texture = pyramid[_level(to_unit, center, pyramid)]
        to_texture = np.array([[texture.shape[1], 0, -0.5], [0, texture.shape[0], -0.5], [0, 0, 1]]) @ to_unit
        patch = cv2.warpPerspective(
            texture,
            to_texture @ np.array([[1, 0, x0], [0, 1, y0], [0, 0, 1]]),
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(patch, mask, picture[y0:y1, x0:x1])
        cv2.copyTo(near, mask, behind)


def _clip_near(corners: Array) -> Array:
    """Cut a polygon (4, 3) at the near plane; return the part in front of it (n, 3)."""
    depth = corners[:, 2] - NEAR_M
    if (depth >= 0).all():
        return corners
    kept = []
    for index in range(len(corners)):
        following = (index + 1) % len(corners)
        if depth[index] >= 0:
            kept.append(corners[index])
        if (depth[index] >= 0) != (depth[following] >= 0):
            share = depth[index] / (depth[index] - depth[following])
            kept.append(corners[index] + share * (corners[following] - corners[index]))
    return np.array(kept).reshape(-1, 3)


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


def _lit(quad: Quad, room: Room, light: Light) -> Image:
    """Return the rectangle's texture as the room's lamp and windows light it."""
    if quad.glow:
        glow = light.daylight if quad.glow == "daylight" else np.maximum(light.lamps[room.index], 0.35)
        return np.clip(quad.texture * glow, 0, 255).astype(np.uint8)
    wide, tall = np.linalg.norm(quad.right), np.linalg.norm(quad.down)
    across = np.linspace(0, 1, max(2, round(wide / LIGHT_GRID_M)))
    along = np.linspace(0, 1, max(2, round(tall / LIGHT_GRID_M)))
    points = quad.origin + along[:, None, None] * quad.down + across[None, :, None] * quad.right
    normal = np.cross(quad.down, quad.right)
    normal /= np.linalg.norm(normal)
    power = np.broadcast_to(light.ambient, points.shape).copy()
    for source, strength in [(room.lamp, light.lamps[room.index])] + [
        (at, 0.8 * light.daylight) for at in room.windows
    ]:
        towards = source - points
        distance = np.linalg.norm(towards, axis=-1)
        cosine = np.clip(towards @ normal / np.maximum(distance, 0.01), 0.15, None)  # walls also reflect light
        power += (cosine / (0.6 + 0.35 * distance**2))[..., None] * strength
    if quad.shell:
        power *= _corner_shade(points, room)[..., None]
    factor = cv2.resize(power.astype(np.float32), quad.texture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.clip(quad.texture * factor, 0, 255).astype(np.uint8)


def _corner_shade(points: Array, room: Room) -> Array:
    """Return factors that darken points (..., 3) of the shell near another of its surfaces, as in corners."""
    x0, y0, x1, y1 = room.bounds
    x, y, z = np.moveaxis(points, -1, 0)
    gaps = np.sort(np.abs(np.stack([x - x0, x1 - x, y - y0, y1 - y, z, HEIGHT_M - z])), axis=0)
    return 1 - 0.3 * np.exp(-gaps[1] / 0.3)  # gaps[0] is the surface itself
