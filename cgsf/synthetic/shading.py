"""From hits to colours: textures, light, shadows, highlights, mirrors, haze.

Colours are linear radiance, BGR. A pixel inside a smooth surface is shaded once, at its centre, with the texture
filtered to the pixel's footprint. A pixel at an edge casts more rays and is shaded once for each surface they meet.
"""

import math
from typing import NamedTuple

import numpy as np

from cgsf.synthetic.caster import Caster
from variational.jit import rowwise

#: Share of the pixel over which textures are averaged: a little less than all keeps pictures crisp.
_SHARPNESS = 0.85


#: Where a texture lies in the atlas, its pixels, whether it repeats mirrored.
TEXTURE = np.dtype([("start", np.int64), ("size", np.int64), ("mirrored", np.bool_)], align=True)

_VECTOR = (np.float64, (3,))
#: Light and surroundings of one moment; see `scene.Light` and `scene.Sky`.
ILLUMINATION = np.dtype(
    [
        ("position", *_VECTOR), ("color", *_VECTOR), ("above", *_VECTOR), ("below", *_VECTOR), ("horizon", *_VECTOR),
        ("zenith", *_VECTOR), ("falloff_m", np.float64), ("cloud_strength", np.float64), ("haze_per_m", np.float64),
        ("shadow_pose", np.float64, (4, 4)), ("shadow_focal", np.float64), ("shadow_bias_m", np.float64),
        ("gloss", np.float64),
    ],
    align=True,
)  # fmt: skip


class Surfaces(NamedTuple):
    """What the shading of an image reads of the triangles; see `scene.Soup`. Corners and normals are the world's."""

    corners: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    materials: np.ndarray
    textures: np.ndarray
    atlas: np.ndarray


@rowwise
def _texel(atlas: np.ndarray, place: int) -> np.int64:
    """The three channels of a texel, 21 bits apart, so that one multiplication weighs all of them."""
    packed = np.int64(atlas[place])
    return (packed & 0xFF) | ((packed & 0xFF00) << 13) | ((packed & 0xFF0000) << 26)


@rowwise
def _level(atlas: np.ndarray, start: int, size: int, mirrored: bool, u: float, v: float, weight: float, out: np.ndarray) -> None:
    """Add `weight` times the bilinear value of one texture copy at (u, v) in repeats, pixel centres at halves."""
    x, y = u * size - 0.5, v * size - 0.5
    fx, fy = math.floor(x), math.floor(y)
    x0, y0 = int(fx), int(fy)
    x1, y1 = x0 + 1, y0 + 1
    if mirrored:
        period = 2 * size - 1
        x0, x1, y0, y1 = x0 & period, x1 & period, y0 & period, y1 & period
        x0, x1 = min(x0, period - x0), min(x1, period - x1)
        y0, y1 = min(y0, period - y0), min(y1, period - y1)
    else:
        x0, x1, y0, y1 = x0 & (size - 1), x1 & (size - 1), y0 & (size - 1), y1 & (size - 1)
    ax, ay = 4096.0 * (x - fx), y - fy
    w11 = int(ax * ay)
    w01, w10 = int(ax) - w11, int(4096.0 * ay) - w11
    w00 = max(4096 - w01 - w10 - w11, 0)
    upper, lower = start + y0 * size, start + y1 * size
    total = w00 * _texel(atlas, upper + x0) + w01 * _texel(atlas, upper + x1)
    total += w10 * _texel(atlas, lower + x0) + w11 * _texel(atlas, lower + x1)
    scale = weight / (255.0 * 4096.0)
    out[0] += scale * (total & 0x1FFFFF)
    out[1] += scale * ((total >> 21) & 0x1FFFFF)
    out[2] += scale * (total >> 42)


@rowwise
def _texture(
    atlas: np.ndarray, start: int, size: int, mirrored: bool, u: float, v: float, texels: float, smooth: bool,
    weight: float, out: np.ndarray,
) -> None:  # fmt: skip
    """Add `weight` times a texture's value; `texels` of the largest copy lie under the pixel, and choose the copy.

    If `smooth`, two copies are mixed, linearly in the texels: close to a logarithm's mix and much cheaper.
    """
    while texels >= 2.0 and size > 1:
        texels *= 0.5
        start += size * size
        size >>= 1
    mix = texels - 1.0
    if size == 1 or mix < 0.2 or (not smooth and mix < 0.5):
        _level(atlas, start, size, mirrored, u, v, weight, out)
    elif mix > 0.8 or not smooth:
        _level(atlas, start + size * size, size >> 1, mirrored, u, v, weight, out)
    else:
        _level(atlas, start, size, mirrored, u, v, weight * (1.0 - mix), out)
        _level(atlas, start + size * size, size >> 1, mirrored, u, v, weight * mix, out)


@rowwise
def _sky(atlas: np.ndarray, size: int, illumination: np.ndarray, dx: float, dy: float, dz: float, out: np.ndarray) -> None:
    """Radiance (3,) from direction (dx, dy, dz), unit length, y down; the clouds are the atlas's first texture."""
    light = illumination[0]
    if dy > 0.0:  # below the horizon: the ground's mean colour, for mirrors
        share = min(1.0, 3.0 * dy)
        for c in range(3):
            out[c] = (1.0 - share) * light.horizon[c] + share * 0.35 * light.below[c]
        return
    mix = min(1.0, 1.4 * math.sqrt(-dy))
    out[0] = out[1] = out[2] = 0.0
    reach = 0.25 / (0.12 - dy)
    _texture(atlas, 0, size, True, dx * reach, dz * reach, 2.0 + 6.0 * (1.0 - mix), False, 1.0, out)
    for c in range(3):
        cloud = 1.0 + light.cloud_strength * mix * (2.0 * out[c] - 1.0)
        out[c] = ((1.0 - mix) * light.horizon[c] + mix * light.zenith[c]) * max(cloud, 0.05)


@rowwise
def _lit(depth: np.ndarray, illumination: np.ndarray, px: float, py: float, pz: float) -> float:
    """Share of the light's four nearest shadow-map rays that reach the world point."""
    light = illumination[0]
    pose, size = light.shadow_pose, depth.shape[0]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    if z <= 0.0:
        return 1.0
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    middle = 0.5 * (size - 1)
    u, v = light.shadow_focal * x / z + middle, light.shadow_focal * y / z + middle
    if u < 0.0 or v < 0.0 or u >= size - 1 or v >= size - 1:
        return 1.0
    i, j = int(v), int(u)
    a, b = u - j, v - i
    limit = z - light.shadow_bias_m
    top = (1.0 - a) * (depth[i, j] > limit) + a * (depth[i, j + 1] > limit)
    bottom = (1.0 - a) * (depth[i + 1, j] > limit) + a * (depth[i + 1, j + 1] > limit)
    return (1.0 - b) * top + b * bottom


@rowwise
def find_edges(hit: np.ndarray, inverse_depth: np.ndarray, surface: np.ndarray, edge: np.ndarray) -> None:
    """Mark in `edge` (H, W) bool the pixels beside which another surface, or another part of the same one, begins."""
    height, width = hit.shape
    for row in range(height):
        for column in range(width):
            here, near = hit[row, column], inverse_depth[row, column]
            for down, right in ((0, 1), (1, 0)):
                y, x = row + down, column + right
                if y < height and x < width and hit[y, x] != here:
                    there, other = hit[y, x], inverse_depth[y, x]
                    if here < 0 or there < 0 or surface[here] != surface[there] or abs(near - other) > 0.1 * max(near, other):
                        edge[row, column] = edge[y, x] = True


@rowwise
def merge_rays(hit: np.ndarray, surface: np.ndarray, count: int, weight: np.ndarray) -> None:
    """Of each pixel's `count` consecutive rays keep the first on every surface, with its share of the pixel."""
    for first in range(0, hit.size, count):
        for k in range(first, first + count):
            own = surface[hit[k]] if hit[k] >= 0 else -1
            weight[k] = 0.0
            for j in range(first, k + 1):
                if (surface[hit[j]] if hit[j] >= 0 else -1) == own:
                    weight[j] += 1.0 / count
                    break


@rowwise
def shade(
    corners: np.ndarray, normals: np.ndarray, uv: np.ndarray, material_of: np.ndarray, materials: np.ndarray,
    textures: np.ndarray, atlas: np.ndarray, illumination: np.ndarray, depth_map: np.ndarray, plane: np.ndarray,
    pose: np.ndarray, intrinsics: np.ndarray, x_of: np.ndarray, y_of: np.ndarray, hit: np.ndarray, weight: np.ndarray,
    image: np.ndarray,
) -> None:  # fmt: skip
    """Add the radiance along rays to an image.

    Parameters
    ----------
    corners, ..., atlas
        `Surfaces`.
    illumination : ndarray (1,) of ILLUMINATION
    depth_map : ndarray (S, S) float32
        Depth along the light's rays, metres.
    plane : ndarray (N, 3, 3)
        From `caster.setup_triangles` for this camera.
    pose : ndarray (4, 4)
        World to camera.
    intrinsics : ndarray (4,)
        fx, fy, cx, cy in pixels.
    x_of, y_of : ndarray (R,)
        Rays in pixels.
    hit : ndarray (R,) int32
        What they meet.
    weight : ndarray (R,)
        Their shares of the pixels that they fall in; rays of weight 0 are skipped.
    image : ndarray (H, W, 3) float32, written
    """
    light = illumination[0]
    out, work, eye = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        eye[i] = -(pose[0, i] * pose[0, 3] + pose[1, i] * pose[1, 3] + pose[2, i] * pose[2, 3])
    for ray in range(hit.size):
        n, share, x, y = hit[ray], weight[ray], x_of[ray], y_of[ray]
        if share == 0.0:
            continue
        row, column = int(y + 0.5), int(x + 0.5)
        if n < 0:
            rx, ry = (x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1]
            scale = 1.0 / math.sqrt(rx * rx + ry * ry + 1.0)
            dx = (pose[0, 0] * rx + pose[1, 0] * ry + pose[2, 0]) * scale
            dy = (pose[0, 1] * rx + pose[1, 1] * ry + pose[2, 1]) * scale
            dz = (pose[0, 2] * rx + pose[1, 2] * ry + pose[2, 2]) * scale
            _sky(atlas, textures[0].size, illumination, dx, dy, dz, out)
            for channel in range(3):
                image[row, column, channel] += share * out[channel]
            continue

        # the point: its place, normal, direction to the eye
        p00, p01, p10, p11 = plane[n, 0, 0], plane[n, 0, 1], plane[n, 1, 0], plane[n, 1, 1]
        p20, p21 = plane[n, 2, 0], plane[n, 2, 1]
        b0, b1 = p00 * x + p01 * y + plane[n, 0, 2], p10 * x + p11 * y + plane[n, 1, 2]
        b2 = p20 * x + p21 * y + plane[n, 2, 2]
        inverse = 1.0 / (b0 + b1 + b2)
        t0, t1, t2 = b0 * inverse, b1 * inverse, b2 * inverse
        px = t0 * corners[n, 0, 0] + t1 * corners[n, 1, 0] + t2 * corners[n, 2, 0]
        py = t0 * corners[n, 0, 1] + t1 * corners[n, 1, 1] + t2 * corners[n, 2, 1]
        pz = t0 * corners[n, 0, 2] + t1 * corners[n, 1, 2] + t2 * corners[n, 2, 2]
        nx = t0 * normals[n, 0, 0] + t1 * normals[n, 1, 0] + t2 * normals[n, 2, 0]
        ny = t0 * normals[n, 0, 1] + t1 * normals[n, 1, 1] + t2 * normals[n, 2, 1]
        nz = t0 * normals[n, 0, 2] + t1 * normals[n, 1, 2] + t2 * normals[n, 2, 2]
        ex, ey, ez = eye[0] - px, eye[1] - py, eye[2] - pz
        distance = math.sqrt(ex * ex + ey * ey + ez * ez)
        ex, ey, ez = ex / distance, ey / distance, ez / distance
        length = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
        facing = nx * ex + ny * ey + nz * ez
        if facing < 0.0:
            length = -length
        nx, ny, nz, facing = nx * length, ny * length, nz * length, abs(facing * length)

        # texture coordinates and how fast they change over the pixel
        q00, q01, q10, q11, q20, q21 = uv[n, 0, 0], uv[n, 0, 1], uv[n, 1, 0], uv[n, 1, 1], uv[n, 2, 0], uv[n, 2, 1]
        u, v = t0 * q00 + t1 * q10 + t2 * q20, t0 * q01 + t1 * q11 + t2 * q21
        wx, wy = p00 + p10 + p20, p01 + p11 + p21
        ux, uy = (
            (p00 * q00 + p10 * q10 + p20 * q20 - u * wx) * inverse,
            (p01 * q00 + p11 * q10 + p21 * q20 - u * wy) * inverse,
        )
        vx, vy = (
            (p00 * q01 + p10 * q11 + p20 * q21 - v * wx) * inverse,
            (p01 * q01 + p11 * q11 + p21 * q21 - v * wy) * inverse,
        )
        across, down = math.sqrt(ux * ux + vx * vx), math.sqrt(uy * uy + vy * vy)
        major, minor = max(across, down), min(across, down)

        material = materials[material_of[n]]
        texture = textures[material.texture]
        a = material.uv
        tu, tv = a[0, 0] * u + a[0, 1] * v + a[0, 2], a[1, 0] * u + a[1, 1] * v + a[1, 2]
        stretch = math.sqrt(a[0, 0] * a[0, 0] + a[1, 0] * a[1, 0])
        taps = 1 if major < 2.0 * minor else (2 if major < 5.0 * minor else 3)
        texels = _SHARPNESS * max(major / taps, minor) * stretch * texture.size
        du, dv = (ux, vx) if across >= down else (uy, vy)
        step_u, step_v = a[0, 0] * du + a[0, 1] * dv, a[1, 0] * du + a[1, 1] * dv
        work[0] = work[1] = work[2] = 0.0
        for tap in range(taps):
            along = (tap + 0.5) / taps - 0.5
            _texture(
                atlas, texture.start, texture.size, texture.mirrored,
                tu + along * step_u, tv + along * step_v, texels, taps == 1, 1.0 / taps, work,
            )  # fmt: skip
        blue, green, red = work[0], work[1], work[2]
        grain = 1.0
        if material.detail_strength > 0.0:
            texture, fine = textures[material.detail], material.detail_scale
            texels = _SHARPNESS * math.sqrt(major * minor) * fine * texture.size
            fade = min(1.0, 2.0 - texels / 64.0)  # far away the fine texture is below the pixel
            if fade > 0.0:
                work[0] = work[1] = work[2] = 0.0
                _texture(atlas, texture.start, texture.size, texture.mirrored, u * fine, v * fine, texels, False, 1.0, work)
                grain = max(1.0 + fade * material.detail_strength * (2.0 * work[1] - 1.0), 0.0)

        # light
        lx, ly, lz = light.position[0] - px, light.position[1] - py, light.position[2] - pz
        reach = math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / reach, ly / reach, lz / reach
        cosine = nx * lx + ny * ly + nz * lz
        direct, highlight = 0.0, 0.0
        if cosine > 0.0:
            lit = _lit(depth_map, illumination, px + 0.02 * nx, py + 0.02 * ny, pz + 0.02 * nz)
            lit /= 1.0 + (reach / light.falloff_m) ** 2
            direct = lit * cosine
            strength = material.specular * light.gloss
            if strength > 0.0 and lit > 0.0:
                hx, hy, hz = lx + ex, ly + ey, lz + ez
                half = (nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz + 1e-12)
                fall = material.shininess * (1.0 - half)
                if fall < 7.0:  # a Gaussian on the sphere, close to half ** shininess
                    highlight = strength * lit * math.exp(-fall)
        up = 0.5 - 0.5 * ny
        bgr = material.color
        for channel in range(3):
            albedo = bgr[channel, 0] * blue + bgr[channel, 1] * green + bgr[channel, 2] * red + bgr[channel, 3]
            albedo = min(max(albedo, 0.0), 1.0) * grain
            ambient = up * light.above[channel] + (1.0 - up) * light.below[channel]
            sun = light.color[channel]
            out[channel] = albedo * albedo * (ambient + sun * direct + 2.0 * material.glow) + highlight * sun
        mirror = material.mirror * light.gloss
        if mirror > 0.0:
            mirror *= 0.15 + 0.85 * (1.0 - facing) ** 3
            dx, dy, dz = 2 * facing * nx - ex, 2 * facing * ny - ey, 2 * facing * nz - ez
            _sky(atlas, textures[0].size, illumination, dx, dy, dz, work)
            for channel in range(3):
                out[channel] = (1.0 - mirror) * out[channel] + mirror * work[channel]
        clear = math.exp(-light.haze_per_m * distance) if light.haze_per_m > 0.0 else 1.0
        for channel in range(3):
            image[row, column, channel] += share * (clear * out[channel] + (1.0 - clear) * light.horizon[channel])


def shade_image(
    surfaces: Surfaces, surface: np.ndarray, illumination: np.ndarray, depth_map: np.ndarray, caster: Caster,
    inverse_depth: np.ndarray, hit: np.ndarray, offsets: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Radiance (H, W, 3) float32 of an image.

    Parameters
    ----------
    surfaces, illumination, depth_map
        As in `shade`.
    surface : ndarray (N,)
        Smooth surface that each triangle belongs to.
    caster : Caster
        The camera.
    inverse_depth, hit : ndarray (H, W)
        From `Caster.centres`.
    offsets : ndarray (K, 2)
        Rays of a pixel at an edge relative to its centre; none for an image without anti-aliasing.
    """
    edge = np.zeros(hit.shape, bool)
    if len(offsets):
        find_edges(hit, inverse_depth, surface, edge)
    image = np.zeros((*hit.shape, 3), np.float32)
    inside = (~edge).ravel().astype(np.float32)
    y, x = np.divmod(np.arange(hit.size, dtype=np.int32), np.int32(hit.shape[1]))
    camera = (caster.plane, caster.pose, caster.intrinsics)
    shade(*surfaces, illumination, depth_map, *camera, x.astype(float), y.astype(float), hit.ravel(), inside, image)
    pixels = np.flatnonzero(edge)
    if len(pixels):
        x, y, hit = caster.within(pixels, offsets)
        weight = np.empty(hit.size, np.float32)
        merge_rays(hit, surface, len(offsets), weight)
        shade(*surfaces, illumination, depth_map, *camera, x, y, hit, weight, image)
    return image
