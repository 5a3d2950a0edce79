"""From hits to colours: textures, light, shadows, highlights, mirrors, haze.

Colours are linear radiance, BGR. A pixel whose rays all meet one smooth surface is shaded once, at its centre, with a
texture filtered to the pixel's footprint; any other pixel is shaded once for each surface that its rays meet.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit


class Surfaces(NamedTuple):
    """What the shading of one image reads of the triangles; see `scene.Soup` and `caster.setup_triangles`."""

    plane: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    surface: np.ndarray
    material: np.ndarray
    materials: np.ndarray
    atlas: np.ndarray
    atlas_start: np.ndarray
    atlas_size: np.ndarray
    atlas_mirrored: np.ndarray


class Illumination(NamedTuple):
    """Light and surroundings; see `scene.Light` and `scene.Sky`."""

    position: np.ndarray
    color: np.ndarray
    falloff_m: float
    above: np.ndarray
    below: np.ndarray
    horizon: np.ndarray
    zenith: np.ndarray
    cloud_strength: float
    haze_per_m: float
    shadow_depth: np.ndarray
    shadow_pose: np.ndarray
    shadow_focal: float
    shadow_bias_m: float
    gloss: float


@njit(cache=True)
def _level(atlas: np.ndarray, start: int, size: int, mirrored: bool, u: float, v: float, weight: float, out: np.ndarray) -> None:
    """Add `weight` times the bilinear value of one texture copy at (u, v) in repeats, pixel centres at halves."""
    x, y = u * size - 0.5, v * size - 0.5
    fx, fy = math.floor(x), math.floor(y)
    ax, ay = x - fx, y - fy
    x0, y0 = int(fx), int(fy)
    x1, y1 = x0 + 1, y0 + 1
    if mirrored:
        period = 2 * size - 1
        x0, x1, y0, y1 = x0 & period, x1 & period, y0 & period, y1 & period
        x0, x1 = min(x0, period - x0), min(x1, period - x1)
        y0, y1 = min(y0, period - y0), min(y1, period - y1)
    else:
        x0, x1, y0, y1 = x0 & (size - 1), x1 & (size - 1), y0 & (size - 1), y1 & (size - 1)
    p00, p01 = start + 3 * (y0 * size + x0), start + 3 * (y0 * size + x1)
    p10, p11 = start + 3 * (y1 * size + x0), start + 3 * (y1 * size + x1)
    w11 = ax * ay
    w01, w10 = ax - w11, ay - w11
    w00 = 1.0 - ax - w10
    scale = weight / 255.0
    for c in range(3):
        out[c] += scale * (w00 * atlas[p00 + c] + w01 * atlas[p01 + c] + w10 * atlas[p10 + c] + w11 * atlas[p11 + c])


@njit(cache=True)
def _texture(s: Surfaces, index: int, u: float, v: float, lod: float, weight: float, out: np.ndarray) -> None:
    """Add `weight` times a texture's value, interpolated between its two copies nearest to level `lod`."""
    size, start, mirrored = s.atlas_size[index], s.atlas_start[index], s.atlas_mirrored[index]
    lod = max(lod, 0.0)
    level = int(lod)
    mix = lod - level
    for _ in range(level):
        if size > 1:
            start += 3 * size * size
            size >>= 1
    if mix < 0.02 or size == 1:
        _level(s.atlas, start, size, mirrored, u, v, weight, out)
    else:
        _level(s.atlas, start, size, mirrored, u, v, weight * (1.0 - mix), out)
        _level(s.atlas, start + 3 * size * size, size >> 1, mirrored, u, v, weight * mix, out)


@njit(cache=True)
def _sky(s: Surfaces, light: Illumination, dx: float, dy: float, dz: float, out: np.ndarray) -> None:
    """Radiance (3,) from direction (dx, dy, dz), unit length, y down."""
    height = max(-dy, 0.0)
    mix = min(1.0, 1.4 * math.sqrt(height))
    if dy > 0.0:  # below the horizon: the ground's mean colour, for mirrors
        ground = min(1.0, 3.0 * dy)
        for c in range(3):
            out[c] = (1.0 - ground) * light.horizon[c] + ground * 0.35 * light.below[c]
        return
    out[0] = out[1] = out[2] = 0.0
    reach = 0.25 / (height + 0.12)
    _texture(s, 0, dx * reach, dz * reach, 1.0 + 2.0 * (1.0 - mix), 1.0, out)
    for c in range(3):
        cloud = 1.0 + light.cloud_strength * mix * (2.0 * out[c] - 1.0)
        out[c] = ((1.0 - mix) * light.horizon[c] + mix * light.zenith[c]) * max(cloud, 0.05)


@njit(cache=True)
def _lit(light: Illumination, px: float, py: float, pz: float) -> float:
    """Share of the light's four nearest shadow-map rays that reach the world point."""
    pose, size = light.shadow_pose, light.shadow_depth.shape[0]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    if z <= 0.0:
        return 1.0
    middle = 0.5 * (size - 1)
    u, v = light.shadow_focal * x / z + middle, light.shadow_focal * y / z + middle
    if u < 0.0 or v < 0.0 or u >= size - 1 or v >= size - 1:
        return 1.0
    i, j = int(v), int(u)
    a, b = u - j, v - i
    depth, limit = light.shadow_depth, z - light.shadow_bias_m
    top = (1.0 - a) * (depth[i, j] > limit) + a * (depth[i, j + 1] > limit)
    bottom = (1.0 - a) * (depth[i + 1, j] > limit) + a * (depth[i + 1, j + 1] > limit)
    return (1.0 - b) * top + b * bottom


@njit(cache=True)
def _shade(s: Surfaces, light: Illumination, eye: np.ndarray, n: int, x: float, y: float, out: np.ndarray, work: np.ndarray) -> None:
    """Radiance (3,) of triangle `n` along the ray (x, y) as seen from `eye` (3,) m."""
    p = s.plane[n]
    b0, b1 = p[0, 0] * x + p[0, 1] * y + p[0, 2], p[1, 0] * x + p[1, 1] * y + p[1, 2]
    b2 = p[2, 0] * x + p[2, 1] * y + p[2, 2]
    w = b0 + b1 + b2
    inverse = 1.0 / w
    t0, t1, t2 = b0 * inverse, b1 * inverse, b2 * inverse
    c, m = s.corners[n], s.normals[n]
    px = t0 * c[0, 0] + t1 * c[1, 0] + t2 * c[2, 0]
    py = t0 * c[0, 1] + t1 * c[1, 1] + t2 * c[2, 1]
    pz = t0 * c[0, 2] + t1 * c[1, 2] + t2 * c[2, 2]
    nx = t0 * m[0, 0] + t1 * m[1, 0] + t2 * m[2, 0]
    ny = t0 * m[0, 1] + t1 * m[1, 1] + t2 * m[2, 1]
    nz = t0 * m[0, 2] + t1 * m[1, 2] + t2 * m[2, 2]
    ex, ey, ez = eye[0] - px, eye[1] - py, eye[2] - pz
    distance = math.sqrt(ex * ex + ey * ey + ez * ez)
    ex, ey, ez = ex / distance, ey / distance, ez / distance
    length = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
    facing = nx * ex + ny * ey + nz * ez
    if facing < 0.0:
        length = -length
    nx, ny, nz, facing = nx * length, ny * length, nz * length, abs(facing * length)

    # texture coordinates and how fast they change over the pixel
    q = s.uv[n]
    u, v = t0 * q[0, 0] + t1 * q[1, 0] + t2 * q[2, 0], t0 * q[0, 1] + t1 * q[1, 1] + t2 * q[2, 1]
    wx, wy = p[0, 0] + p[1, 0] + p[2, 0], p[0, 1] + p[1, 1] + p[2, 1]
    ux = (p[0, 0] * q[0, 0] + p[1, 0] * q[1, 0] + p[2, 0] * q[2, 0] - u * wx) * inverse
    uy = (p[0, 1] * q[0, 0] + p[1, 1] * q[1, 0] + p[2, 1] * q[2, 0] - u * wy) * inverse
    vx = (p[0, 0] * q[0, 1] + p[1, 0] * q[1, 1] + p[2, 0] * q[2, 1] - v * wx) * inverse
    vy = (p[0, 1] * q[0, 1] + p[1, 1] * q[1, 1] + p[2, 1] * q[2, 1] - v * wy) * inverse
    across, down = math.sqrt(ux * ux + vx * vx), math.sqrt(uy * uy + vy * vy)
    major, minor = max(across, down), min(across, down)

    material = s.materials[s.material[n]]
    a = material.uv
    tu, tv = a[0, 0] * u + a[0, 1] * v + a[0, 2], a[1, 0] * u + a[1, 1] * v + a[1, 2]
    stretch = math.sqrt(a[0, 0] * a[0, 0] + a[1, 0] * a[1, 0])
    taps = 1 if major < 1.6 * minor else (2 if major < 4.0 * minor else 4)
    footprint = max(major / taps, minor)
    size = s.atlas_size[material.texture]
    lod = math.log2(max(footprint * stretch * size, 1e-9)) - 0.2
    work[0] = work[1] = work[2] = 0.0
    du, dv = (ux, vx) if across >= down else (uy, vy)
    step_u, step_v = a[0, 0] * du + a[0, 1] * dv, a[1, 0] * du + a[1, 1] * dv
    for tap in range(taps):
        along = (tap + 0.5) / taps - 0.5
        _texture(s, material.texture, tu + along * step_u, tv + along * step_v, lod, 1.0 / taps, work)
    red, green, blue = work[2], work[1], work[0]
    grain = 1.0
    if material.detail_strength > 0.0:
        work[0] = work[1] = work[2] = 0.0
        fine = material.detail_scale
        lod = math.log2(max(math.sqrt(major * minor) * fine * s.atlas_size[material.detail], 1e-9)) - 0.2
        if lod < 8.0:
            _texture(s, material.detail, u * fine, v * fine, lod, 1.0, work)
            fade = min(1.0, 0.5 * (8.0 - lod))
            grain = 1.0 + fade * material.detail_strength * (2.0 * work[1] - 1.0)

    # light
    lx, ly, lz = light.position[0] - px, light.position[1] - py, light.position[2] - pz
    reach = math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx / reach, ly / reach, lz / reach
    cosine = nx * lx + ny * ly + nz * lz
    direct, highlight = 0.0, 0.0
    if cosine > 0.0:
        lit = _lit(light, px + 0.02 * nx, py + 0.02 * ny, pz + 0.02 * nz) / (1.0 + (reach / light.falloff_m) ** 2)
        direct = lit * cosine
        strength = material.specular * light.gloss
        if strength > 0.0 and lit > 0.0:
            hx, hy, hz = lx + ex, ly + ey, lz + ez
            half = (nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz + 1e-12)
            highlight = strength * lit * max(half, 0.0) ** material.shininess
    up = 0.5 - 0.5 * ny
    for channel in range(3):
        row = material.color[channel]
        albedo = max(row[0] * blue + row[1] * green + row[2] * red + row[3], 0.0)
        albedo = min(albedo, 1.0) * max(grain, 0.0)
        ambient = up * light.above[channel] + (1.0 - up) * light.below[channel]
        out[channel] = albedo * albedo * (ambient + light.color[channel] * direct + 2.0 * material.glow)
        out[channel] += highlight * light.color[channel]
    mirror = material.mirror * light.gloss
    if mirror > 0.0:
        share = mirror * (0.15 + 0.85 * (1.0 - facing) ** 3)
        _sky(s, light, 2 * facing * nx - ex, 2 * facing * ny - ey, 2 * facing * nz - ez, work)
        for channel in range(3):
            out[channel] = (1.0 - share) * out[channel] + share * work[channel]
    if light.haze_per_m > 0.0:
        clear = math.exp(-light.haze_per_m * distance)
        for channel in range(3):
            out[channel] = clear * out[channel] + (1.0 - clear) * light.horizon[channel]


@njit(cache=True)
def shade_image(
    s: Surfaces, light: Illumination, pose: np.ndarray, intrinsics: np.ndarray, offsets: np.ndarray,
    hit: np.ndarray, inverse_depth: np.ndarray, image: np.ndarray,
) -> None:  # fmt: skip
    """Radiance of an image.

    Parameters
    ----------
    pose : ndarray (4, 4)
        World to camera.
    intrinsics : ndarray (4,)
        fx, fy, cx, cy in pixels.
    offsets : ndarray (K, 2)
        Rays of each pixel relative to its centre, (0, 0) first.
    hit, inverse_depth : ndarray (H, W, K)
        From `Caster.pattern` for these offsets.
    image : ndarray (H, W, 3) float32, written
    """
    height, width, count = hit.shape
    colors, work = np.empty((count, 3)), np.empty(3)
    eye = np.empty(3)
    for i in range(3):
        eye[i] = -(pose[0, i] * pose[0, 3] + pose[1, i] * pose[1, 3] + pose[2, i] * pose[2, 3])
    for row in range(height):
        for column in range(width):
            first, near = hit[row, column, 0], inverse_depth[row, column, 0]
            one_surface = True
            for k in range(1, count):
                other = hit[row, column, k]
                if other != first and (first < 0 or other < 0 or s.surface[other] != s.surface[first]):
                    one_surface = False
                if abs(inverse_depth[row, column, k] - near) > 0.1 * near:
                    one_surface = False
            begin = 0 if one_surface or count == 1 else 1
            end = 1 if one_surface else count
            for channel in range(3):
                image[row, column, channel] = 0.0
            for k in range(begin, end):
                here = hit[row, column, k]
                same = -1
                for j in range(begin, k):  # a surface that another ray of this pixel met is not shaded again
                    before = hit[row, column, j]
                    if before == here or (before >= 0 and here >= 0 and s.surface[before] == s.surface[here]):
                        same = j
                        break
                if same >= 0:
                    colors[k] = colors[same]
                else:
                    x, y = column + offsets[k, 0], row + offsets[k, 1]
                    if here >= 0:
                        _shade(s, light, eye, here, x, y, colors[k], work)
                    else:
                        rx, ry = (x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1]
                        scale = 1.0 / math.sqrt(rx * rx + ry * ry + 1.0)
                        dx = (pose[0, 0] * rx + pose[1, 0] * ry + pose[2, 0]) * scale
                        dy = (pose[0, 1] * rx + pose[1, 1] * ry + pose[2, 1]) * scale
                        dz = (pose[0, 2] * rx + pose[1, 2] * ry + pose[2, 2]) * scale
                        _sky(s, light, dx, dy, dz, colors[k])
                for channel in range(3):
                    image[row, column, channel] += colors[k, channel] / (end - begin)
