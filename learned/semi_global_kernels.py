"""CPU kernels of semi-global aggregation: C-contiguous, forward (float32, or bfloat16 as its bits) and backward (float32).

Channels come innermost, as channels-last volumes have them, and pixels and channels are one axis: costs (B, D, H * W * C).
Channels side by side are the lanes of the vector registers. Forward, a row, or a bundle of neighbouring columns, is copied
to the cache, swept there and back, and its result written once: memory is what a sweep waits for. Every disparity lies
on a page of its own, so that memory is touched in runs of many values.
"""

from __future__ import annotations

import numpy as np

from learned.bfloat16 import narrow, widen
from learned.jit import lanes, tasks
from learned.threads import over_tasks

# Values in a run: of a bundle of columns forward, of a bundle or of a row's piece backward.
_RUN, _RUN_BACK = 256, 512
# Disparities that share the loads of their weights.
_ROWS = 4
_EPSILON = np.float32(1e-12)


def semi_global_forward(cost: np.ndarray, guidance: np.ndarray, out: np.ndarray, chosen: np.ndarray,
                        scale_and_shift: np.ndarray) -> None:
    """Largest of the four directions; where asked for, scaled, shifted and rectified.

    Parameters
    ----------
    cost : (B, D, H * W * C) float32 or uint16
    guidance : (B, H, W, 4, 5, C) float32 or uint16
        Raw weights.
    out : like cost
        Written.
    chosen : like cost but uint8, or empty
        Written: the index of the direction that won (the first of equals).
    scale_and_shift : (2, C) float32, or (2, 0)
    """
    batch, height, width, _, _, channels = guidance.shape
    columns = max(1, _RUN // channels)
    arrays = cost, guidance, out, chosen, scale_and_shift
    over_tasks(_both_ways, batch * -(-width // columns), True, columns, *arrays)
    over_tasks(_both_ways, batch * height, False, 1, *arrays)


@tasks
def _both_ways(first: int, last: int, vertical: bool, bundle: int, cost: np.ndarray, guidance: np.ndarray, out: np.ndarray,
               chosen: np.ndarray, scale_and_shift: np.ndarray) -> None:
    """Sweeps there and back of bundles of columns or of single rows; rows come last and keep what is larger already."""
    _, height, width, _, _, channels = guidance.shape
    depth = cost.shape[1]
    steps, lines = (height, width) if vertical else (width, height)
    bundles = (lines + bundle - 1) // bundle
    for task in range(first, last):
        b, start = task // bundles, task % bundles * bundle
        count = min(bundle, lines - start)
        wide = count * channels
        here = np.empty((steps, depth, wide), np.float32)
        # one row more at either end of the disparities, for the neighbours that do not exist
        there, back = np.empty((steps, depth + 2, wide), np.float32), np.empty((2, depth + 2, wide), np.float32)
        best, weights = np.empty((2, wide), np.float32), np.empty((5, wide), np.float32)
        for step in range(steps):
            at = (step * width + start if vertical else start * width + step) * channels
            _copy(cost, b, at, wide, here[step])
            y, x = (step, start) if vertical else (start, step)
            _normalise(guidance, b, y, x, vertical, 0 if vertical else 2, count, weights)
            if step == 0:
                _begin(here[step], 0, weights, there[step], best[0])
            else:
                _advance(here[step], 0, weights, there[step - 1], best[(step - 1) % 2], there[step], best[step % 2])
        for step in range(steps - 1, -1, -1):
            at = (step * width + start if vertical else start * width + step) * channels
            y, x = (step, start) if vertical else (start, step)
            now, before = step % 2, (step + 1) % 2
            _normalise(guidance, b, y, x, vertical, 1 if vertical else 3, count, weights)
            if step == steps - 1:
                _begin(here[step], 0, weights, back[now], best[now])
            else:
                _advance(here[step], 0, weights, back[before], best[before], back[now], best[now])
            if chosen.size > 0:
                _choose(there[step], back[now], b, at, vertical, out, chosen)
            if vertical:
                _keep_larger(there[step], back[now], b, at, out)
            elif scale_and_shift.size == 0:
                _keep_largest(there[step], back[now], b, at, out)
            else:
                _keep_rectified(there[step], back[now], b, at, scale_and_shift, out)


def semi_global_backward(cost: np.ndarray, guidance: np.ndarray, chosen: np.ndarray, gradient: np.ndarray,
                         to_cost: np.ndarray, to_guidance: np.ndarray) -> None:
    """Gradients with respect to the costs (added to zeros) and to the raw guidance (written); all float32.

    Shapes as in the forward kernel. Each bundle is walked again with all its states kept, then walked back.
    """
    batch, height, width, _, _, channels = guidance.shape
    run = max(1, _RUN_BACK // channels)
    for direction in range(4):
        bundles = -(-width // run) if direction < 2 else height
        over_tasks(_backward, batch * bundles, direction, run, cost, guidance, chosen, gradient, to_cost, to_guidance)


@tasks
def _backward(first: int, last: int, direction: int, run: int, cost: np.ndarray, guidance: np.ndarray, chosen: np.ndarray,
              gradient: np.ndarray, to_cost: np.ndarray, to_guidance: np.ndarray) -> None:
    _, height, width, _, _, channels = guidance.shape
    depth = cost.shape[1]
    vertical, backwards = direction < 2, direction % 2 == 1
    steps, lines = (height, width) if vertical else (width, height)
    bundle, block = (run, 1) if vertical else (1, run)
    bundles = (lines + bundle - 1) // bundle
    for task in range(first, last):
        b, start = task // bundles, task % bundles * bundle
        count = min(bundle, lines - start)
        wide = count * channels
        here = np.empty((depth, block * wide), np.float32)
        states, best = np.empty((steps, depth + 2, wide), np.float32), np.empty((steps, wide), np.float32)
        weights = np.empty((steps, 5, wide), np.float32)
        for done in range(0, steps, block):
            size = min(block, steps - done)
            begin = steps - done - size if backwards else done
            at = (begin * width + start if vertical else start * width + begin) * channels
            _copy(cost, b, at, size * wide, here)
            for step in range(done, done + size):
                s = size - 1 - step + done if backwards else step - done
                y, x = (begin + s, start) if vertical else (start, begin + s)
                _normalise(guidance, b, y, x, vertical, direction, count, weights[step])
                if step == 0:
                    _begin(here, s * wide, weights[step], states[step], best[step])
                else:
                    _advance(here, s * wide, weights[step], states[step - 1], best[step - 1], states[step], best[step])
        # what flows into a state, again with a row more; what its maximum gets from the next pixel
        flows, share = np.zeros((2, depth + 2, wide), np.float32), np.zeros(wide, np.float32)
        own, to_here = np.empty((depth, block * wide), np.float32), np.empty((depth, block * wide), np.float32)
        to_weights = np.empty((5, wide), np.float32)
        for done in range(0, steps, block):
            size = min(block, steps - done)
            begin = done if backwards else steps - done - size
            at = (begin * width + start if vertical else start * width + begin) * channels
            _copy(cost, b, at, size * wide, here)
            _collect(gradient, chosen, b, at, size * wide, direction, own)
            for back in range(done, done + size):
                step = steps - 1 - back
                s = back - done if backwards else done + size - 1 - back
                y, x = (begin + s, start) if vertical else (start, begin + s)
                now, later = back % 2, (back + 1) % 2
                after = min(step + 1, steps - 1)
                if step == 0:
                    _finish(here, s * wide, weights[step], weights[after], states[step], best[step], flows[later],
                            share, own, s * wide, flows[now], to_here, to_weights)
                else:
                    _retreat(here, s * wide, weights[step], weights[after], states[step - 1], best[step - 1],
                             states[step], best[step], flows[later], share, own, s * wide, flows[now], to_here,
                             to_weights)
                _denormalise(guidance, b, y, x, vertical, direction, count, weights[step], to_weights, to_guidance)
            _add(to_here, b, at, size * wide, to_cost)


# Indices are unsigned below: for a signed one numba checks whether it is negative, and nothing is vectorised.
@lanes
def _copy(volume: np.ndarray, b: int, at: int, length: int, block: np.ndarray) -> None:
    """Values ``at`` ... of every plane to a block (D, length or more)."""
    first = np.uint64(at)
    for d in range(block.shape[0]):
        for v in range(length):
            block[d, v] = widen(volume[b, d, first + np.uint64(v)])


@lanes
def _add(block: np.ndarray, b: int, at: int, length: int, volume: np.ndarray) -> None:
    first = np.uint64(at)
    for d in range(block.shape[0]):
        for v in range(length):
            volume[b, d, first + np.uint64(v)] += block[d, v]


@lanes
def _normalise(guidance: np.ndarray, b: int, y: int, x: int, vertical: bool, direction: int, count: int,
               weights: np.ndarray) -> None:
    """weights (5, lanes) = the raw guidance of ``count`` neighbouring pixels / its L1 norm."""
    channels = guidance.shape[5]
    for j in range(count):
        yy, xx = (y, x + j) if vertical else (y + j, x)
        for c in range(channels):
            norm = np.float32(0)
            for k in range(5):
                norm += abs(widen(guidance[b, yy, xx, direction, k, c]))
            scale = np.float32(1) / max(norm, _EPSILON)
            for k in range(5):
                weights[k, j * channels + c] = widen(guidance[b, yy, xx, direction, k, c]) * scale


@lanes
def _denormalise(guidance: np.ndarray, b: int, y: int, x: int, vertical: bool, direction: int, count: int,
                 weights: np.ndarray, to_weights: np.ndarray, to_guidance: np.ndarray) -> None:
    """Through w = r / |r|_1: dr_k = (dw_k - sign(r_k) sum_j dw_j w_j) / |r|_1."""
    channels = guidance.shape[5]
    for j in range(count):
        yy, xx = (y, x + j) if vertical else (y + j, x)
        for c in range(channels):
            v = j * channels + c
            norm, dot = np.float32(0), np.float32(0)
            for k in range(5):
                norm += abs(guidance[b, yy, xx, direction, k, c])
                dot += to_weights[k, v] * weights[k, v]
            scale = np.float32(1) / max(norm, _EPSILON)
            for k in range(5):
                sign = np.sign(guidance[b, yy, xx, direction, k, c])
                to_guidance[b, yy, xx, direction, k, c] = (to_weights[k, v] - sign * dot) * scale


@lanes
def _begin(cost: np.ndarray, at: int, weights: np.ndarray, state: np.ndarray, best: np.ndarray) -> None:
    """First pixel of a line: no neighbour exists, all five terms are the cost itself."""
    depth, wide = state.shape[0] - 2, state.shape[1]
    first = np.uint64(at)
    best[:] = -np.inf
    for d in range(depth):
        for v in range(wide):
            total = weights[0, v] + weights[1, v] + weights[2, v] + weights[3, v] + weights[4, v]
            value = cost[d, first + np.uint64(v)] * total
            state[d + 1, v] = value
            best[v] = value if value > best[v] else best[v]


@lanes
def _advance(cost: np.ndarray, at: int, weights: np.ndarray, before: np.ndarray, best_before: np.ndarray,
             after: np.ndarray, best: np.ndarray) -> None:
    """One step of the recursion, and the maximum over the disparities of the result; costs (D, L) from ``at`` on."""
    depth, wide = after.shape[0] - 2, after.shape[1]
    first = np.uint64(at)
    best[:] = -np.inf
    for v in range(wide):
        before[0, v], before[depth + 1, v] = cost[0, first + np.uint64(v)], cost[depth - 1, first + np.uint64(v)]
    shared = depth // _ROWS * _ROWS
    for d in range(0, shared, _ROWS):
        _advance_rows(d, _ROWS, cost, at, weights, before, best_before, after, best)
    for d in range(shared, depth):
        _advance_rows(d, 1, cost, at, weights, before, best_before, after, best)


@lanes
def _advance_rows(d: int, rows: int, cost: np.ndarray, at: int, weights: np.ndarray, before: np.ndarray,
                  best_before: np.ndarray, after: np.ndarray, best: np.ndarray) -> None:
    first = np.uint64(at)
    for v in range(after.shape[1]):
        w0, w1, w2, w3 = weights[0, v], weights[1, v], weights[2, v], weights[3, v]
        rest, largest = weights[4, v] * best_before[v], best[v]
        below, own = before[d, v], before[d + 1, v]
        for k in range(d, d + rows):
            above = before[k + 2, v]
            value = w0 * cost[k, first + np.uint64(v)] + w1 * own + w2 * below + w3 * above + rest
            after[k + 1, v] = value
            largest = value if value > largest else largest
            below, own = own, above
        best[v] = largest


@lanes
def _keep_larger(one: np.ndarray, other: np.ndarray, b: int, at: int, out: np.ndarray) -> None:
    first = np.uint64(at)
    for d in range(one.shape[0] - 2):
        for v in range(one.shape[1]):
            larger = other[d + 1, v] if other[d + 1, v] > one[d + 1, v] else one[d + 1, v]
            out[b, d, first + np.uint64(v)] = narrow(larger, out)


@lanes
def _keep_largest(one: np.ndarray, other: np.ndarray, b: int, at: int, out: np.ndarray) -> None:
    """Of these two and of what is there already."""
    first = np.uint64(at)
    for d in range(one.shape[0] - 2):
        for v in range(one.shape[1]):
            present = out[b, d, first + np.uint64(v)]
            larger = other[d + 1, v] if other[d + 1, v] > one[d + 1, v] else one[d + 1, v]
            out[b, d, first + np.uint64(v)] = narrow(larger, out) if larger > widen(present) else present


@lanes
def _keep_rectified(one: np.ndarray, other: np.ndarray, b: int, at: int, scale_and_shift: np.ndarray, out: np.ndarray) -> None:
    """Of all three too; the one bundle is a single pixel: its lanes are the channels."""
    first = np.uint64(at)
    for d in range(one.shape[0] - 2):
        for v in range(one.shape[1]):
            present = widen(out[b, d, first + np.uint64(v)])
            larger = other[d + 1, v] if other[d + 1, v] > one[d + 1, v] else one[d + 1, v]
            value = (larger if larger > present else present) * scale_and_shift[0, v] + scale_and_shift[1, v]
            out[b, d, first + np.uint64(v)] = narrow(value if value > 0 else np.float32(0), out)


@lanes
def _choose(one: np.ndarray, other: np.ndarray, b: int, at: int, vertical: bool, out: np.ndarray, chosen: np.ndarray) -> None:
    """Which direction wins, before ``out`` is written."""
    first = np.uint64(at)
    for d in range(one.shape[0] - 2):
        for v in range(one.shape[1]):
            second = other[d + 1, v] > one[d + 1, v]
            if vertical:
                chosen[b, d, first + np.uint64(v)] = 1 if second else 0
            else:
                larger = other[d + 1, v] if second else one[d + 1, v]
                if larger > widen(out[b, d, first + np.uint64(v)]):
                    chosen[b, d, first + np.uint64(v)] = 3 if second else 2


@lanes
def _collect(gradient: np.ndarray, chosen: np.ndarray, b: int, at: int, length: int, direction: int, own: np.ndarray
             ) -> None:
    """The incoming gradient where this direction was the largest."""
    first, label = np.uint64(at), np.uint8(direction)
    for d in range(own.shape[0]):
        for v in range(length):
            won = chosen[b, d, first + np.uint64(v)] == label
            own[d, v] = gradient[b, d, first + np.uint64(v)] if won else np.float32(0)


@lanes
def _retreat(cost: np.ndarray, at: int, weights: np.ndarray, weights_later: np.ndarray, before: np.ndarray,
             best_before: np.ndarray, state: np.ndarray, best: np.ndarray, later: np.ndarray, share: np.ndarray,
             own: np.ndarray, to: int, flow: np.ndarray, to_here: np.ndarray, to_weights: np.ndarray) -> None:
    depth, wide = to_here.shape[0], share.size
    first, target = np.uint64(at), np.uint64(to)
    to_weights[:] = 0
    for v in range(wide):
        before[0, v], before[depth + 1, v] = cost[0, first + np.uint64(v)], cost[depth - 1, first + np.uint64(v)]
    shared = depth // _ROWS * _ROWS
    for d in range(0, shared, _ROWS):
        _retreat_rows(d, _ROWS, cost, at, weights, weights_later, before, state, best, later, share, own, to, flow,
                      to_here, to_weights)
    for d in range(shared, depth):
        _retreat_rows(d, 1, cost, at, weights, weights_later, before, state, best, later, share, own, to, flow,
                      to_here, to_weights)
    for v in range(wide):
        # to_weights[4] holds the sum of the flow so far
        share[v] = weights[4, v] * to_weights[4, v]
        to_weights[4, v] *= best_before[v]
        to_here[0, target + np.uint64(v)] += weights[2, v] * flow[1, v]
        to_here[depth - 1, target + np.uint64(v)] += weights[3, v] * flow[depth, v]


@lanes
def _retreat_rows(d: int, rows: int, cost: np.ndarray, at: int, weights: np.ndarray,
                  weights_later: np.ndarray, before: np.ndarray, state: np.ndarray, best: np.ndarray,
                  later: np.ndarray, share: np.ndarray, own: np.ndarray, to: int, flow: np.ndarray,
                  to_here: np.ndarray, to_weights: np.ndarray) -> None:
    first, target = np.uint64(at), np.uint64(to)
    for v in range(share.size):
        w0, l1, l2, l3 = weights[0, v], weights_later[1, v], weights_later[2, v], weights_later[3, v]
        top, rest = best[v], share[v]
        t0, t1, t2, t3, t4 = to_weights[0, v], to_weights[1, v], to_weights[2, v], to_weights[3, v], to_weights[4, v]
        below, same = before[d, v], before[d + 1, v]
        later_below, later_same = later[d, v], later[d + 1, v]
        for k in range(d, d + rows):
            above, later_above = before[k + 2, v], later[k + 2, v]
            largest = state[k + 1, v] == top
            f = (own[k, target + np.uint64(v)] + l1 * later_same + l2 * later_above + l3 * later_below
                 + (rest if largest else np.float32(0)))
            rest = np.float32(0) if largest else rest
            flow[k + 1, v] = f
            to_here[k, target + np.uint64(v)] = w0 * f
            t0 += f * cost[k, first + np.uint64(v)]
            t1 += f * same
            t2 += f * below
            t3 += f * above
            t4 += f
            below, same, later_below, later_same = same, above, later_same, later_above
        share[v] = rest
        to_weights[0, v], to_weights[1, v], to_weights[2, v], to_weights[3, v], to_weights[4, v] = t0, t1, t2, t3, t4


@lanes
def _finish(cost: np.ndarray, at: int, weights: np.ndarray, weights_later: np.ndarray, state: np.ndarray,
            best: np.ndarray, later: np.ndarray, share: np.ndarray, own: np.ndarray, to: int, flow: np.ndarray,
            to_here: np.ndarray, to_weights: np.ndarray) -> None:
    """``_retreat`` at the first pixel of a line."""
    depth, wide = to_here.shape[0], share.size
    first, target = np.uint64(at), np.uint64(to)
    to_weights[:] = 0
    for d in range(depth):
        for v in range(wide):
            largest = state[d + 1, v] == best[v]
            f = (own[d, target + np.uint64(v)] + weights_later[1, v] * later[d + 1, v]
                 + weights_later[2, v] * later[d + 2, v] + weights_later[3, v] * later[d, v]
                 + (share[v] if largest else np.float32(0)))
            share[v] = np.float32(0) if largest else share[v]
            total = weights[0, v] + weights[1, v] + weights[2, v] + weights[3, v] + weights[4, v]
            to_here[d, target + np.uint64(v)] = f * total
            to_weights[0, v] += f * cost[d, first + np.uint64(v)]
    for k in range(1, 5):
        for v in range(wide):
            to_weights[k, v] = to_weights[0, v]
