"""From hits to colours: textures, light, shadows, highlights, mirrors, haze.

Colours are linear radiance, BGR. A pixel inside a smooth surface is shaded once, at its centre, with the texture
filtered to the pixel's footprint. A pixel at an edge casts more rays and is shaded once for each surface they meet.

Rays are shaded in chunks, one simple loop after another over arrays that stay in the cache: loops that compute run in
vectors, loops that branch are short.
"""

import math
from typing import NamedTuple

import numpy as np

from cgsf.synthetic.sampling import look_up
from variational.jit import rowwise, scalar

#: Share of the pixel over which textures are averaged: a little less than all keeps pictures crisp.
_SHARPNESS = 0.85
_LOG_2, _INVERSE_LOG_2 = math.log(2.0), 1.0 / math.log(2.0)
#: Rays that are shaded together.
_CHUNK = 512

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
    """What the shading of an image reads of the triangles; see `scene.Soup`. Normals are the world's."""

    normals: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    materials: np.ndarray
    textures: np.ndarray
    atlas: np.ndarray


@rowwise
def _interpolate(
    count: int, x: np.ndarray, y: np.ndarray, hit: np.ndarray, plane: np.ndarray, normals: np.ndarray, uv: np.ndarray,
    inverse: np.ndarray, u: np.ndarray, v: np.ndarray, ux: np.ndarray, uy: np.ndarray, vx: np.ndarray, vy: np.ndarray,
    nx: np.ndarray, ny: np.ndarray, nz: np.ndarray,
) -> None:  # fmt: skip
    """Depth, texture coordinates with their derivatives over the image, and normals where rays meet triangles.

    What a corner carries, times the inverse depth, is linear in x and y: the three factors of each are found once for
    neighbouring rays that meet the same triangle.
    """
    linear = np.zeros((6, 3))
    last = -1
    for i in range(count):
        n = hit[i]
        if n != last:
            last = n
            for k in range(3):
                p, q, r = plane[n, 0, k], plane[n, 1, k], plane[n, 2, k]
                linear[0, k] = p + q + r
                for j in range(2):
                    linear[1 + j, k] = p * uv[n, 0, j] + q * uv[n, 1, j] + r * uv[n, 2, j]
                for j in range(3):
                    linear[3 + j, k] = p * normals[n, 0, j] + q * normals[n, 1, j] + r * normals[n, 2, j]
        depth = 1.0 / (linear[0, 0] * x[i] + linear[0, 1] * y[i] + linear[0, 2])
        s = (linear[1, 0] * x[i] + linear[1, 1] * y[i] + linear[1, 2]) * depth
        t = (linear[2, 0] * x[i] + linear[2, 1] * y[i] + linear[2, 2]) * depth
        inverse[i], u[i], v[i] = depth, s, t
        ux[i], uy[i] = (linear[1, 0] - s * linear[0, 0]) * depth, (linear[1, 1] - s * linear[0, 1]) * depth
        vx[i], vy[i] = (linear[2, 0] - t * linear[0, 0]) * depth, (linear[2, 1] - t * linear[0, 1]) * depth
        nx[i] = (linear[3, 0] * x[i] + linear[3, 1] * y[i] + linear[3, 2]) * depth
        ny[i] = (linear[4, 0] * x[i] + linear[4, 1] * y[i] + linear[4, 2]) * depth
        nz[i] = (linear[5, 0] * x[i] + linear[5, 1] * y[i] + linear[5, 2]) * depth


@rowwise
def _footprint(
    count: int, material: np.ndarray, materials: np.ndarray, textures: np.ndarray, u: np.ndarray, v: np.ndarray,
    ux: np.ndarray, uy: np.ndarray, vx: np.ndarray, vy: np.ndarray, texture: np.ndarray, at_u: np.ndarray, at_v: np.ndarray,
    step_u: np.ndarray, step_v: np.ndarray, taps: np.ndarray, texels: np.ndarray, fine_texels: np.ndarray,
) -> None:  # fmt: skip
    """Lookups of the materials' textures, and the texels of the fine ones that lie under the pixel."""
    for i in range(count):
        m = material[i]
        across, down = math.sqrt(ux[i] * ux[i] + vx[i] * vx[i]), math.sqrt(uy[i] * uy[i] + vy[i] * vy[i])
        major, minor = max(across, down), min(across, down)
        long_u, long_v = (ux[i], vx[i]) if across >= down else (uy[i], vy[i])
        a, b, c = materials[m].uv[0, 0], materials[m].uv[0, 1], materials[m].uv[0, 2]
        d, e, f = materials[m].uv[1, 0], materials[m].uv[1, 1], materials[m].uv[1, 2]
        at_u[i], at_v[i] = a * u[i] + b * v[i] + c, d * u[i] + e * v[i] + f
        step_u[i], step_v[i] = a * long_u + b * long_v, d * long_u + e * long_v
        n = 1 if major < 2.0 * minor else (2 if major < 5.0 * minor else 3)
        texture[i] = materials[m].texture
        stretch = math.sqrt(np.float64(a) * a + np.float64(d) * d)
        taps[i] = n
        texels[i] = _SHARPNESS * max(major / n, minor) * stretch * textures[texture[i]].size
        fine_texels[i] = _SHARPNESS * math.sqrt(major * minor) * materials[m].detail_scale * textures[materials[m].detail].size


@rowwise
def _fine(
    count: int, material: np.ndarray, materials: np.ndarray, fine_texels: np.ndarray, u: np.ndarray, v: np.ndarray,
    owner: np.ndarray, amplitude: np.ndarray, texture: np.ndarray, at_u: np.ndarray, at_v: np.ndarray, taps: np.ndarray,
    texels: np.ndarray,
) -> int:  # fmt: skip
    """Lookups of the fine textures that are multiplied in, of the rays `owner`; far away they are below the pixel and fade."""
    place = 0
    for i in range(count):
        owner[place] = i
        amplitude[place] = max(min(1.0, 2.0 - fine_texels[i] / 64.0), 0.0) * materials[material[i]].detail_strength
        place += amplitude[place] > 0.0
    for k in range(place):
        i = owner[k]
        m = material[i]
        texture[k], taps[k], texels[k] = materials[m].detail, 1, fine_texels[i]
        at_u[k], at_v[k] = u[i] * materials[m].detail_scale, v[i] * materials[m].detail_scale
    return place


@rowwise
def _grain(count: int, lookups: int, owner: np.ndarray, amplitude: np.ndarray, fine: np.ndarray, grain: np.ndarray) -> None:
    """Factors of the rays: those of their fine textures, 1 for rays without."""
    for i in range(count):
        grain[i] = 1.0
    for k in range(lookups):
        grain[owner[k]] = max(1.0 + amplitude[k] * (2.0 * fine[1, k] - 1.0), 0.0)


@rowwise
def _light(
    count: int, x: np.ndarray, y: np.ndarray, inverse: np.ndarray, sight: np.ndarray, illumination: np.ndarray,
    nx: np.ndarray, ny: np.ndarray, nz: np.ndarray, dx: np.ndarray, dy: np.ndarray, dz: np.ndarray, distance: np.ndarray,
    facing: np.ndarray, cosine: np.ndarray, half: np.ndarray, strength: np.ndarray, map_x: np.ndarray, map_y: np.ndarray,
    map_z: np.ndarray,
) -> None:  # fmt: skip
    """Geometry of light and eye at the points: unit normals towards the eye, mirrored view, cosines, place in the shadow map.

    `sight` (4, 3): the world's direction of the ray (x, y) is ``sight[0] x + sight[1] y + sight[2]``; ``sight[3]`` is the eye.
    """
    light = illumination[0]
    pose = light.shadow_pose
    h00, h01, h02, h03 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    h10, h11, h12, h13 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    h20, h21, h22, h23 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    light_x, light_y, light_z, falloff = light.position[0], light.position[1], light.position[2], light.falloff_m
    focal, bias = light.shadow_focal, light.shadow_bias_m
    for i in range(count):
        rx = sight[0, 0] * x[i] + sight[1, 0] * y[i] + sight[2, 0]
        ry = sight[0, 1] * x[i] + sight[1, 1] * y[i] + sight[2, 1]
        rz = sight[0, 2] * x[i] + sight[1, 2] * y[i] + sight[2, 2]
        px, py, pz = sight[3, 0] + rx * inverse[i], sight[3, 1] + ry * inverse[i], sight[3, 2] + rz * inverse[i]
        size = math.sqrt(rx * rx + ry * ry + rz * rz)
        distance[i] = size * inverse[i]
        ex, ey, ez = -rx / size, -ry / size, -rz / size
        ax, ay, az = nx[i], ny[i], nz[i]
        length = 1.0 / math.sqrt(ax * ax + ay * ay + az * az + 1e-12)
        towards = ax * ex + ay * ey + az * ez
        length = -length if towards < 0.0 else length
        ax, ay, az, towards = ax * length, ay * length, az * length, towards * length
        nx[i], ny[i], nz[i], facing[i] = ax, ay, az, towards
        dx[i], dy[i], dz[i] = 2.0 * towards * ax - ex, 2.0 * towards * ay - ey, 2.0 * towards * az - ez
        lx, ly, lz = light_x - px, light_y - py, light_z - pz
        reach = math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / reach, ly / reach, lz / reach
        cosine[i] = ax * lx + ay * ly + az * lz
        strength[i] = 1.0 / (1.0 + (reach / falloff) * (reach / falloff))
        hx, hy, hz = lx + ex, ly + ey, lz + ez
        half[i] = (ax * hx + ay * hy + az * hz) / math.sqrt(hx * hx + hy * hy + hz * hz + 1e-12)
        qx, qy, qz = px + 0.02 * ax, py + 0.02 * ay, pz + 0.02 * az
        z = h20 * qx + h21 * qy + h22 * qz + h23
        map_x[i] = focal * (h00 * qx + h01 * qy + h02 * qz + h03) / z
        map_y[i] = focal * (h10 * qx + h11 * qy + h12 * qz + h13) / z
        map_z[i] = z - bias


@rowwise
def _shadow(
    count: int, depth: np.ndarray, bias: float, cosine: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray,
    lit: np.ndarray,
) -> None:  # fmt: skip
    """Multiply `lit` by the share of the light's four nearest shadow-map rays that reach the point."""
    size = depth.shape[0]
    middle = 0.5 * (size - 1)
    for i in range(count):
        u, v, limit = x[i] + middle, y[i] + middle, z[i]
        inside = (limit + bias > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < size - 1) & (v < size - 1)
        column, row = np.uint32(u if inside else 0.0), np.uint32(v if inside else 0.0)
        a, b = u - column, v - row
        top = (1.0 - a) * (depth[row, column] > limit) + a * (depth[row, np.uint32(column + 1)] > limit)
        row = np.uint32(row + 1)
        bottom = (1.0 - a) * (depth[row, column] > limit) + a * (depth[row, np.uint32(column + 1)] > limit)
        reached = lit[i] * ((1.0 - b) * top + b * bottom) if inside else lit[i]
        lit[i] = 0.0 if cosine[i] <= 0.0 else reached


@rowwise
def _color(
    count: int, material: np.ndarray, materials: np.ndarray, illumination: np.ndarray, texture: np.ndarray,
    grains: np.ndarray, ny: np.ndarray, cosine: np.ndarray, half: np.ndarray, lit: np.ndarray, owner: np.ndarray,
    highlight: np.ndarray, color: np.ndarray,
) -> None:  # fmt: skip
    """Radiance of the surfaces themselves."""
    light = illumination[0]
    gloss = light.gloss
    shiny = 0
    for i in range(count):
        m = material[i]
        owner[shiny] = i
        shiny += (materials[m].specular * gloss > 0.0) & (lit[i] > 0.0) & (materials[m].shininess * (1.0 - half[i]) < 7.0)
    for i in range(count):
        highlight[i] = 0.0
    for k in range(shiny):  # a Gaussian on the sphere, close to half ** shininess
        i = owner[k]
        m = material[i]
        highlight[i] = materials[m].specular * gloss * lit[i] * math.exp(-(materials[m].shininess * (1.0 - half[i])))
    sun_b, sun_g, sun_r = light.color[0], light.color[1], light.color[2]
    above_b, above_g, above_r = light.above[0], light.above[1], light.above[2]
    below_b, below_g, below_r = light.below[0], light.below[1], light.below[2]
    for i in range(count):
        m = material[i]
        grain = grains[i]
        b, g, r = texture[0, i], texture[1, i], texture[2, i]
        mix = materials[m].color
        blue = mix[0, 0] * b + mix[0, 1] * g + mix[0, 2] * r + mix[0, 3]
        green = mix[1, 0] * b + mix[1, 1] * g + mix[1, 2] * r + mix[1, 3]
        red = mix[2, 0] * b + mix[2, 1] * g + mix[2, 2] * r + mix[2, 3]
        blue, green = min(max(blue, 0.0), 1.0) * grain, min(max(green, 0.0), 1.0) * grain
        red = min(max(red, 0.0), 1.0) * grain
        up, direct, glow = 0.5 - 0.5 * ny[i], lit[i] * max(cosine[i], 0.0), 2.0 * materials[m].glow
        color[0, i] = blue * blue * (up * above_b + (1.0 - up) * below_b + sun_b * direct + glow) + highlight[i] * sun_b
        color[1, i] = green * green * (up * above_g + (1.0 - up) * below_g + sun_g * direct + glow) + highlight[i] * sun_g
        color[2, i] = red * red * (up * above_r + (1.0 - up) * below_r + sun_r * direct + glow) + highlight[i] * sun_r


@scalar
def _decay(x: float) -> float:
    """``exp(-x)`` for 0 <= x < 700 to fifteen digits, by operations that run in vectors."""
    halvings = np.floor(x * _INVERSE_LOG_2 + 0.5)
    rest = halvings * _LOG_2 - x
    value = 1.0
    for k in range(13, 0, -1):
        value = 1.0 + value * rest * (1.0 / k)
    return value * np.int64((1023 - np.int64(halvings)) << 52).view(np.float64)


@rowwise
def _haze(count: int, haze: float, horizon: np.ndarray, distance: np.ndarray, color: np.ndarray) -> None:
    """Mix the horizon into what is far away."""
    blue, green, red = horizon[0], horizon[1], horizon[2]
    for i in range(count):
        clear = _decay(min(haze * distance[i], 700.0))
        color[0, i] = clear * color[0, i] + (1.0 - clear) * blue
        color[1, i] = clear * color[1, i] + (1.0 - clear) * green
        color[2, i] = clear * color[2, i] + (1.0 - clear) * red


@rowwise
def _sky_lookups(
    count: int, cloud: int, dy: np.ndarray, dx: np.ndarray, dz: np.ndarray, texture: np.ndarray, at_u: np.ndarray,
    at_v: np.ndarray, taps: np.ndarray, texels: np.ndarray,
) -> None:  # fmt: skip
    """Lookups of the clouds' texture `cloud` in directions (dx, dy, dz), unit length, y down."""
    for i in range(count):
        up = max(-dy[i], 0.0)
        reach = 0.25 / (0.12 + up)
        texture[i], taps[i] = cloud, 1
        at_u[i], at_v[i] = dx[i] * reach, dz[i] * reach
        texels[i] = 2.0 + 6.0 * (1.0 - min(1.0, 1.4 * math.sqrt(up)))


@rowwise
def _sky_color(count: int, dy: np.ndarray, illumination: np.ndarray, color: np.ndarray) -> None:
    """Turn the clouds' texture values in `color` into radiance; below the horizon lies the ground's mean colour."""
    light = illumination[0]
    cloudy = light.cloud_strength
    for channel in range(3):
        horizon, zenith, below = light.horizon[channel], light.zenith[channel], light.below[channel]
        for i in range(count):
            mix = min(1.0, 1.4 * math.sqrt(max(-dy[i], 0.0)))
            cloud = 1.0 + cloudy * mix * (2.0 * color[channel, i] - 1.0)
            above = ((1.0 - mix) * horizon + mix * zenith) * max(cloud, 0.05)
            share = min(1.0, 3.0 * max(dy[i], 0.0))
            ground = (1.0 - share) * horizon + share * 0.35 * below
            color[channel, i] = ground if dy[i] > 0.0 else above


@rowwise
def shade(
    normals: np.ndarray, uv: np.ndarray, material_of: np.ndarray, materials: np.ndarray, textures: np.ndarray,
    atlas: np.ndarray, illumination: np.ndarray, depth_map: np.ndarray, plane: np.ndarray, sight: np.ndarray, rays: int,
    x_of: np.ndarray, y_of: np.ndarray, hit: np.ndarray, share: np.ndarray, image: np.ndarray,
) -> None:  # fmt: skip
    """Add the radiance along rays to an image.

    Parameters
    ----------
    normals, ..., atlas
        `Surfaces`; the last texture is that of the clouds.
    illumination : ndarray (1,) of ILLUMINATION
    depth_map : ndarray (S, S) float32
        Depth along the light's rays, metres.
    plane : ndarray (N, 3, 3)
        From `caster.setup_triangles` for this camera.
    sight : ndarray (4, 3)
        World direction of the ray (x, y), depth 1: ``sight[0] x + sight[1] y + sight[2]``; the eye.
    rays : int
        Number of rays; the arrays of rays are at least as long.
    x_of, y_of : ndarray (R,) float64
        Rays in pixels.
    hit : ndarray (R,) int32
        What they meet.
    share : ndarray (R,) float32
        Their shares of the pixels that they fall in.
    image : ndarray (H, W, 3) float32, written
    """
    light = illumination[0]
    bias, haze, cloud = light.shadow_bias_m, light.haze_per_m, textures.size - 1
    number, whole = np.zeros((28, _CHUNK + 1)), np.zeros((7, _CHUNK + 1), np.int32)
    space, whole_space = np.zeros((7, _CHUNK + 1)), np.zeros((6, _CHUNK + 1), np.int32)
    texture, fine, color, radiance = np.zeros((3, _CHUNK)), np.zeros((3, _CHUNK)), np.zeros((3, _CHUNK)), np.zeros((3, _CHUNK))
    x, y, depth, u, v, nx, ny, nz = (
        number[0], number[1], number[2], number[3], number[4], number[5], number[6], number[7]
    )  # fmt: skip
    ux, uy, vx, vy, at_u, at_v, step_u, step_v = (
        number[8], number[9], number[10], number[11], number[12], number[13], number[14], number[15]
    )  # fmt: skip
    texels, fine_texels, dx, dy, dz, distance, facing, cosine, half, lit = (
        number[16], number[17], number[18], number[19], number[20], number[21], number[22], number[23], number[24], number[25]
    )  # fmt: skip
    triangle, material, which, taps, place, mirrors = whole[0], whole[1], whole[2], whole[3], whole[4], whole[5]
    amplitude, grains, owner = number[26], number[27], whole[6]
    mixed, nearest = np.bool_(True), np.bool_(False)  # of texture lookups

    for first in range(0, rays, _CHUNK):
        last = min(first + _CHUNK, rays)
        met = np.int64(0)
        for ray in range(first, last):
            if hit[ray] >= 0:
                triangle[met], material[met], place[met] = hit[ray], material_of[hit[ray]], ray - first
                x[met], y[met] = x_of[ray], y_of[ray]
                met += 1

        _interpolate(met, x, y, triangle, plane, normals, uv, depth, u, v, ux, uy, vx, vy, nx, ny, nz)
        _footprint(
            met, material, materials, textures, u, v, ux, uy, vx, vy, which, at_u, at_v, step_u, step_v, taps, texels, fine_texels
        )
        look_up(met, textures, atlas, which, at_u, at_v, step_u, step_v, taps, texels, mixed, texture, space, whole_space)
        lookups = _fine(met, material, materials, fine_texels, u, v, owner, amplitude, which, at_u, at_v, taps, texels)
        look_up(lookups, textures, atlas, which, at_u, at_v, step_u, step_v, taps, texels, nearest, fine, space, whole_space)
        _grain(met, lookups, owner, amplitude, fine, grains)
        _light(
            met, x, y, depth, sight, illumination, nx, ny, nz, dx, dy, dz, distance, facing, cosine, half, lit, ux, uy, vx
        )
        _shadow(met, depth_map, bias, cosine, ux, uy, vx, lit)
        _color(met, material, materials, illumination, texture, grains, ny, cosine, half, lit, owner, amplitude, color)

        mirrored = np.int64(0)
        for i in range(met):
            if materials[material[i]].mirror * light.gloss > 0.0:
                mirrors[mirrored] = i
                ux[mirrored], uy[mirrored], vx[mirrored] = dx[i], dy[i], dz[i]
                mirrored += 1
        _sky_lookups(mirrored, cloud, uy, ux, vx, which, at_u, at_v, taps, texels)
        look_up(mirrored, textures, atlas, which, at_u, at_v, at_u, at_v, taps, texels, nearest, fine, space, whole_space)
        _sky_color(mirrored, uy, illumination, fine)
        for k in range(mirrored):
            i = mirrors[k]
            mirror = materials[material[i]].mirror * light.gloss * (0.15 + 0.85 * (1.0 - facing[i]) ** 3)
            for channel in range(3):
                color[channel, i] = (1.0 - mirror) * color[channel, i] + mirror * fine[channel, k]
        _haze(met, haze, light.horizon, distance, color)

        if met < last - first:  # some rays meet the sky
            for i in range(met):
                for channel in range(3):
                    radiance[channel, place[i]] = color[channel, i]
            missed = np.int64(0)
            for ray in range(first, last):
                if hit[ray] < 0:
                    dx[missed] = sight[0, 0] * x_of[ray] + sight[1, 0] * y_of[ray] + sight[2, 0]
                    dy[missed] = sight[0, 1] * x_of[ray] + sight[1, 1] * y_of[ray] + sight[2, 1]
                    dz[missed] = sight[0, 2] * x_of[ray] + sight[1, 2] * y_of[ray] + sight[2, 2]
                    size = math.sqrt(dx[missed] * dx[missed] + dy[missed] * dy[missed] + dz[missed] * dz[missed])
                    dx[missed], dy[missed], dz[missed] = dx[missed] / size, dy[missed] / size, dz[missed] / size
                    place[missed] = ray - first
                    missed += 1
            _sky_lookups(missed, cloud, dy, dx, dz, which, at_u, at_v, taps, texels)
            look_up(missed, textures, atlas, which, at_u, at_v, at_u, at_v, taps, texels, nearest, color, space, whole_space)
            _sky_color(missed, dy, illumination, color)
            for i in range(missed):
                for channel in range(3):
                    radiance[channel, place[i]] = color[channel, i]
        seen = radiance if met < last - first else color

        for ray in range(first, last):
            row, column = np.uint32(y_of[ray] + 0.5), np.uint32(x_of[ray] + 0.5)
            for channel in range(3):
                image[row, column, channel] += share[ray] * seen[channel, ray - first]
