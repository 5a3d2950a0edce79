"""Which rays make a picture: one through the centre of a pixel, more where two surfaces share it."""

import numpy as np

from cgsf.synthetic.caster import Caster
from variational.jit import rowwise


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
def _list_rays(
    edge: np.ndarray, hit: np.ndarray, offsets: np.ndarray, edge_hit: np.ndarray, surface: np.ndarray, x: np.ndarray,
    y: np.ndarray, met: np.ndarray, share: np.ndarray,
) -> int:  # fmt: skip
    """Rays of a picture, row by row; of a pixel's rays only the first on every surface, with its share of the pixel."""
    count, place, several = 0, 0, len(offsets)
    for row in range(hit.shape[0]):
        for column in range(hit.shape[1]):
            if not edge[row, column]:
                x[count], y[count], met[count], share[count] = column, row, hit[row, column], 1.0
                count += 1
                continue
            first = count
            for k in range(several):
                n = edge_hit[place + k]
                own = surface[n] if n >= 0 else -1
                j = first
                while j < count and (surface[met[j]] if met[j] >= 0 else -1) != own:
                    j += 1
                if j == count:
                    x[count], y[count] = column + offsets[k, 0], row + offsets[k, 1]
                    met[count], share[count] = n, 0.0
                    count += 1
                share[j] += 1.0 / several
            place += several
    return count


def picture_rays(
    caster: Caster, inverse_depth: np.ndarray, hit: np.ndarray, surface: np.ndarray, offsets: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The rays of a picture and their shares of the pixels.

    Parameters
    ----------
    caster : Caster
        The camera.
    inverse_depth, hit : ndarray (H, W)
        From `Caster.centres`.
    surface : ndarray (N,)
        Smooth surface that each triangle belongs to.
    offsets : ndarray (K, 2)
        Rays of a pixel at an edge relative to its centre; none for a picture without anti-aliasing.

    Returns
    -------
    rays : int
        Their number; the arrays are longer.
    x, y : ndarray (R,) float64
        The rays in pixels.
    met : ndarray (R,) int32
        Triangle, or -1.
    share : ndarray (R,) float32
        Adds up to 1 over a pixel's rays.
    """
    edge, edge_hit = np.zeros(hit.shape, bool), np.empty(0, np.int32)
    if len(offsets):
        find_edges(hit, inverse_depth, surface, edge)
        edge_hit = caster.within(edge, offsets)
    most = hit.size + edge_hit.size
    x, y, met, share = np.empty(most), np.empty(most), np.empty(most, np.int32), np.empty(most, np.float32)
    rays = _list_rays(edge, hit, offsets, edge_hit, surface, x, y, met, share)
    return rays, x, y, met, share
