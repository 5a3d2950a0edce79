"""Photometric term: structural similarity and absolute difference of an image and a warped one.

``pe(a, b) = alpha clip((1 - SSIM(a, b)) / 2, 0, 1) + (1 - alpha) rho(a - b)``, mean over channels, where b(p) is the
source sampled bilinearly at p + d(p). With the means over 3 x 3 pixels ``ma, mb, maa, mbb, mab`` of a, b, a^2, b^2 and
a b::

    SSIM = (2 ma mb + C1) (2 (mab - ma mb) + C2) / ((ma^2 + mb^2 + C1) (maa - ma^2 + mbb - mb^2 + C2))

The means reflect at the border (pixel -1 is pixel 1; an axis of one pixel reflects to itself).

Gradient. SSIM at p depends on the warped pixels through three means, so with ``P, Q, R`` its derivatives by mb, mbb and
mab, the derivative of the sum by one warped pixel *gathers* from its neighbours, the adjoint of the 3 x 3 mean::

    dE / db(q) = M^T[P](q) + 2 b(q) M^T[Q](q) + a(q) M^T[R](q) + (1 - alpha) rho'(b - a)

and the chain rule with the sampler's derivative gives dE / dd. One pass streams over the rows: row y + 2 is warped,
SSIM is taken at row y + 1, and row y receives its gradient, so that nothing larger than a few rows is ever stored.

Reference: Godard et al. 2017 (doi:10.1109/CVPR.2017.699); Wang et al. 2004 (doi:10.1109/TIP.2003.819861).
"""

import numpy as np

from variational.jit import real, rowwise, scalar
from variational.penalties import penalty
from variational.sampling import cell, interpolate

C1, C2 = 0.01**2, 0.03**2


def padded_planes(image: np.ndarray, dtype: np.dtype | type) -> np.ndarray:
    """``(H, W, c)`` image as the kernels want it: ``(c, H + 2, W + 2)``, contiguous, reflected by one pixel."""
    planes = image.transpose(2, 0, 1).astype(dtype, copy=False)
    return np.ascontiguousarray(np.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="reflect"))


@scalar
def ssim(ma: float, mb: float, maa: float, mbb: float, mab: float, c1: float, c2: float) -> tuple[float, ...]:
    """Structural similarity of the five means, and its derivatives P, Q, R by mb, mbb and mab."""
    product, square_a, square_b = ma * mb, ma * ma, mb * mb
    n1, n2 = product + product + c1, (mab - product) + (mab - product) + c2
    d1, d2 = square_a + square_b + c1, (maa - square_a) + (mbb - square_b) + c2
    inverse = real(1, ma) / (d1 * d2)
    s = n1 * n2 * inverse
    p = (ma * (n2 - n1) - s * mb * (d2 - d1)) * inverse
    r = n1 * inverse
    return s, p + p, -s * d1 * inverse, r + r


def window_overlap(size: int, dtype: np.dtype | type) -> np.ndarray:
    """``(3, size)``: how often the reflected 3-windows of pixels q - 1, q and q + 1 hold pixel q.

    1 each inside; 0 where there is no such pixel, 2 where a window reflects onto q. The adjoint of the mean in one
    axis.
    """
    centres = np.arange(size)[:, None]
    seen = np.abs(centres + [-1, 0, 1])
    seen = np.maximum(np.where(seen < size, seen, 2 * size - 2 - seen), 0)  # as `reflect`
    counts = np.zeros((3, size), dtype)
    np.add.at(counts, (centres - seen + 1, seen), 1)
    return counts


@scalar
def reflect(i: int, size: int) -> int:
    """Index of the pixel that stands for pixel `i`, which is at most one outside an axis of `size` pixels."""
    i = abs(i)
    return max(i if i < size else size + size - 2 - i, 0)


@rowwise
def _locate_along(d: np.ndarray, sign: float, y: int, shape: tuple[int, int], visible: np.ndarray, weight: float,
                  drop_outside: bool, index: np.ndarray, fraction: np.ndarray, inside: np.ndarray,
                  keep: np.ndarray) -> None:
    """Cells along x of one row of positions in the padded source, and `keep`, the weight of each pixel's error."""
    zero, one, width = real(0, weight), real(1, weight), real(shape[1], weight)
    start = np.int32((y + 1) * (shape[1] + 2) + 1)
    for i in range(index.size):
        x = np.int32(i)
        shift, fraction[i], within = cell(sign * d[i], real(x, weight), width)
        index[i] = start + x + np.int32(shift)
        inside[i] = one if within else zero
        keep[i] = weight if visible[i] and (within or not drop_outside) else zero


@rowwise
def _locate_down(d: np.ndarray, y: int, shape: tuple[int, int], weight: float, drop_outside: bool, index: np.ndarray,
                 fraction: np.ndarray, inside: np.ndarray, keep: np.ndarray) -> None:
    """Move the cells of :func:`_locate_along` along y."""
    zero, one, height, row = real(0, weight), real(1, weight), real(shape[0], weight), real(y, weight)
    stride = np.int32(shape[1] + 2)
    for i in range(index.size):
        shift, fraction[i], within = cell(d[i], row, height)
        index[i] += np.int32(shift) * stride
        inside[i] = one if within else zero
        keep[i] = keep[i] if within or not drop_outside else zero


@rowwise
def _warp_along(source: np.ndarray, index: np.ndarray, fx: np.ndarray, in_x: np.ndarray, right: int, b: np.ndarray,
                slope_x: np.ndarray) -> None:
    """Sample one row of one channel between two neighbours: b, and its derivative. `right`: step."""
    for i in range(index.size):
        k = np.uint32(index[i])
        v0, v1 = source[k], source[k + right]
        b[i + 1] = v0 + fx[i] * (v1 - v0)
        slope_x[i] = (v1 - v0) * in_x[i]


@rowwise
def _warp(source: np.ndarray, index: np.ndarray, fx: np.ndarray, fy: np.ndarray, in_x: np.ndarray, in_y: np.ndarray,
          right: int, below: int, b: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray) -> None:
    """Sample one row of one channel in its cells: b, and its derivatives along x and y. `right`, `below`: steps."""
    for i in range(index.size):
        k = np.uint32(index[i])
        v00, v01, v10, v11 = source[k], source[k + right], source[k + below], source[k + right + below]
        b[i + 1], along_x, along_y = interpolate(v00, v01, v10, v11, fx[i], fy[i])
        slope_x[i] = along_x * in_x[i]
        slope_y[i] = along_y * in_y[i]


@scalar
def _column(a0: float, a1: float, a2: float, b0: float, b1: float, b2: float) -> tuple[float, ...]:
    """Sums over one column of three pixels: of a, b, a^2, b^2 and a b."""
    return (a0 + a1 + a2, b0 + b1 + b2,
            a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2, a0 * b0 + a1 * b1 + a2 * b2)


@rowwise
def _error(a0: np.ndarray, a1: np.ndarray, a2: np.ndarray, b0: np.ndarray, b1: np.ndarray, b2: np.ndarray,
           keep: np.ndarray, alpha: float, eps: float, loss: np.ndarray, p: np.ndarray, q: np.ndarray,
           r: np.ndarray) -> None:
    """Add one row's error to `loss`; P, Q and R of every pixel, times its weight in the energy.

    The sums of the two columns before the newest are carried along, which LLVM keeps in vector registers.
    """
    ninth, one, half, zero = real(1 / 9, eps), real(1, eps), real(0.5, eps), real(0, eps)
    c1, c2 = real(C1, eps), real(C2, eps)
    la, lb, laa, lbb, lab = _column(a0[0], a1[0], a2[0], b0[0], b1[0], b2[0])
    ma, mb, maa, mbb, mab = _column(a0[1], a1[1], a2[1], b0[1], b1[1], b2[1])
    for i in range(keep.size):
        ra, rb, raa, rbb, rab = _column(a0[i + 2], a1[i + 2], a2[i + 2], b0[i + 2], b1[i + 2], b2[i + 2])
        s, dp, dq, dr = ssim((la + ma + ra) * ninth, (lb + mb + rb) * ninth, (laa + maa + raa) * ninth,
                             (lbb + mbb + rbb) * ninth, (lab + mab + rab) * ninth, c1, c2)
        la, lb, laa, lbb, lab = ma, mb, maa, mbb, mab
        ma, mb, maa, mbb, mab = ra, rb, raa, rbb, rab
        difference, _ = penalty(b1[i + 1] - a1[i + 1], eps)
        dissimilarity = (one - s) * half
        clipped = zero if dissimilarity < zero else (one if dissimilarity > one else dissimilarity)
        loss[i] += keep[i] * (alpha * clipped + (one - alpha) * difference)
        scale = zero if clipped != dissimilarity else -alpha * half * ninth * keep[i]
        p[i + 1] = scale * dp
        q[i + 1] = scale * dq
        r[i + 1] = scale * dr


@rowwise
def _gradient(p0: np.ndarray, p1: np.ndarray, p2: np.ndarray, q0: np.ndarray, q1: np.ndarray, q2: np.ndarray,
              r0: np.ndarray, r1: np.ndarray, r2: np.ndarray, above: float, here: float, below: float,
              overlap: np.ndarray, a: np.ndarray, b: np.ndarray, keep: np.ndarray, beta: float, eps: float,
              derivative: np.ndarray) -> None:
    """dE / db of one row and channel; the four weights are those of :func:`window_overlap`."""
    lp, mp = above * p0[0] + here * p1[0] + below * p2[0], above * p0[1] + here * p1[1] + below * p2[1]
    lq, mq = above * q0[0] + here * q1[0] + below * q2[0], above * q0[1] + here * q1[1] + below * q2[1]
    lr, mr = above * r0[0] + here * r1[0] + below * r2[0], above * r0[1] + here * r1[1] + below * r2[1]
    for i in range(keep.size):
        rp = above * p0[i + 2] + here * p1[i + 2] + below * p2[i + 2]
        rq = above * q0[i + 2] + here * q1[i + 2] + below * q2[i + 2]
        rr = above * r0[i + 2] + here * r1[i + 2] + below * r2[i + 2]
        left, centre, right = overlap[0, i], overlap[1, i], overlap[2, i]
        _, slope = penalty(b[i + 1] - a[i + 1], eps)
        db = beta * keep[i] * slope + left * lp + centre * mp + right * rp
        db += (b[i + 1] + b[i + 1]) * (left * lq + centre * mq + right * rq)
        db += a[i + 1] * (left * lr + centre * mr + right * rr)
        lp, lq, lr = mp, mq, mr
        mp, mq, mr = rp, rq, rr
        derivative[i] = db


@rowwise
def _chain(derivative: np.ndarray, slope: np.ndarray, sign: float, grad: np.ndarray) -> None:
    """Chain rule: add dE / db times the derivative of b by one displacement."""
    for i in range(derivative.size):
        grad[i] += sign * derivative[i] * slope[i]


@rowwise
def photometric_band(first: int, last: int, target: np.ndarray, source: np.ndarray, dx: np.ndarray, dy: np.ndarray,
                     moves_down: bool, sign: float, visible: np.ndarray, overlap_y: np.ndarray, overlap_x: np.ndarray,
                     weight: float, alpha: float, eps: float, drop_outside: bool, loss: np.ndarray,
                     grad_x: np.ndarray, grad_y: np.ndarray, with_gradient: bool) -> None:
    """Add the term of rows `first` to `last` (excluded) to the map and the gradient.

    Parameters
    ----------
    target : np.ndarray
        a, as :func:`padded_planes` gives it.
    source : np.ndarray
        The image to sample, likewise, with the last two axes flattened.
    dx, dy : np.ndarray
        ``(H, W)`` displacements in pixels.
    moves_down : bool
        False for a stereo pair, where nothing moves vertically: then `dy` and `grad_y` are left alone.
    sign : float
        1 or -1 times dx is the displacement: disparities point to the left.
    visible : np.ndarray
        ``(H, W)`` bool; the term is zero elsewhere.
    overlap_y, overlap_x : np.ndarray
        :func:`window_overlap` of the two axes.
    weight, alpha, eps, drop_outside :
        As in :class:`variational.energy.EnergyConfig`.
    loss, grad_x, grad_y : np.ndarray
        ``(H, W)``, added to.
    """
    channels, height, width = target.shape[0], target.shape[1] - 2, target.shape[2] - 2
    shape, kind = (height, width), target.dtype.type
    weight, sign, alpha, eps = kind(weight / channels), kind(sign), kind(alpha), kind(eps)
    right, below = np.uint32(min(width - 1, 1)), np.uint32((width + 2) * min(height - 1, 1))
    index, rows = np.empty(width, np.int32), np.empty((6, width), target.dtype)
    fx, fy, in_x, in_y, derivative, spare = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    # Rings of three rows, row y in slot y % 3. P, Q and R are zero in their padding.
    keep, slopes = np.empty((3, width), target.dtype), np.empty((2, channels, 3, width), target.dtype)
    warped = np.empty((channels, 3, width + 2), target.dtype)
    pqr = np.empty((3, channels, 3, width + 2), target.dtype)
    pqr[:] = 0
    for step in range(first - 2, last + 2):
        y = step
        if 0 <= y < height:
            slot = y % 3
            _locate_along(dx[y], sign, y, shape, visible[y], weight, drop_outside, index, fx, in_x, keep[slot])
            if moves_down:
                _locate_down(dy[y], y, shape, weight, drop_outside, index, fy, in_y, keep[slot])
            for c in range(channels):
                b = warped[c, slot]
                if moves_down:
                    _warp(source[c], index, fx, fy, in_x, in_y, right, below, b, slopes[0, c, slot], slopes[1, c, slot])
                else:
                    _warp_along(source[c], index, fx, in_x, right, b, slopes[0, c, slot])
                b[0], b[width + 1] = b[min(2, width)], b[max(width - 1, 1)]
        y = step - 1
        if max(first - 1, 0) <= y < min(last + 1, height):
            slot, above, under = y % 3, reflect(y - 1, height) % 3, reflect(y + 1, height) % 3
            row_loss = loss[y] if first <= y < last else spare
            for c in range(channels):
                b = warped[c]
                _error(target[c, y], target[c, y + 1], target[c, y + 2], b[above], b[slot], b[under], keep[slot], alpha,
                       eps, row_loss, pqr[0, c, slot], pqr[1, c, slot], pqr[2, c, slot])
        y = step - 2
        if with_gradient and first <= y < last:
            slot, up, down = y % 3, (y + 2) % 3, (y + 1) % 3
            for c in range(channels):
                p, q, r = pqr[0, c], pqr[1, c], pqr[2, c]
                _gradient(p[up], p[slot], p[down], q[up], q[slot], q[down], r[up], r[slot], r[down], overlap_y[0, y],
                          overlap_y[1, y], overlap_y[2, y], overlap_x, target[c, y + 1], warped[c, slot], keep[slot],
                          kind(1) - alpha, eps, derivative)
                _chain(derivative, slopes[0, c, slot], sign, grad_x[y])
                if moves_down:
                    _chain(derivative, slopes[1, c, slot], kind(1), grad_y[y])
