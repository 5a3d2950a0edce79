"""CPU kernels of semi-global aggregation: float32, C-contiguous, forward and backward.

Channels come innermost, as channels-last volumes have them, and pixels and channels are one axis: costs (B, D, H * W * C).
Channels side by side are the lanes of the vector registers. Every disparity lies on a page of its own, so memory is
touched in runs of about ``_RUN`` values: a vertical sweep walks that many lanes of neighbouring columns at once, a
horizontal one copies the next pixels of its row to a block, itself a small volume, that stays in the cache.
"""

from __future__ import annotations

import numpy as np

from learned.jit import lanes, parallel, prange

_RUN = 512
# Disparities that share the loads of their weights.
_ROWS = 4
_EPSILON = np.float32(1e-12)


@parallel
def semi_global_forward(cost: np.ndarray, guidance: np.ndarray, out: np.ndarray, chosen: np.ndarray) -> None:
    """Largest of the four directions.

    Parameters
    ----------
    cost : (B, D, H * W * C) float32
    guidance : (B, H, W, 4, 5, C) float32
        Raw weights.
    out : like cost
        Written.
    chosen : like cost but uint8, or empty
        Written: the index of the direction that won (the first of equals).
    """
    batch, height, width, _, _, channels = guidance.shape
    depth = cost.shape[1]
    run = max(1, _RUN // channels)
    for direction in range(4):
        vertical, backwards = direction < 2, direction % 2 == 1
        steps, lines = (height, width) if vertical else (width, height)
        bundle, block = (run, 1) if vertical else (1, run)
        tasks = (lines + bundle - 1) // bundle
        for task in prange(batch * tasks):
            b, start = task // tasks, task % tasks * bundle
            count = min(bundle, lines - start)
            wide = count * channels
            here = np.empty((1, depth, 0 if vertical else block * wide), np.float32)
            aggregated = np.empty((1, depth, block * wide), np.float32)
            # one row more at either end of the disparities, for the neighbours that do not exist
            states, best = np.empty((2, depth + 2, wide), np.float32), np.empty((2, wide), np.float32)
            weights = np.empty((5, wide), np.float32)
            for done in range(0, steps, block):
                size = min(block, steps - done)
                begin = steps - done - size if backwards else done
                at = (begin * width + start if vertical else start * width + begin) * channels
                if not vertical:
                    _copy(cost, b, at, size * wide, here)
                for step in range(done, done + size):
                    s = size - 1 - step + done if backwards else step - done
                    y, x = (begin + s, start) if vertical else (start, begin + s)
                    source, i, first = (cost, b, at) if vertical else (here, 0, s * wide)
                    now, before = step % 2, (step + 1) % 2
                    _normalise(guidance, b, y, x, vertical, direction, count, weights)
                    if step == 0:
                        _begin(source, i, first, weights, states[now], best[now], aggregated, s * wide, True)
                    else:
                        _advance(source, i, first, weights, states[before], best[before], states[now], best[now],
                                 aggregated, s * wide, True)
                if chosen.size > 0:
                    _keep_largest(aggregated, b, at, size * wide, direction, out, chosen)
                else:
                    _keep_largest_only(aggregated, b, at, size * wide, direction, out)


@parallel
def semi_global_backward(cost: np.ndarray, guidance: np.ndarray, chosen: np.ndarray, gradient: np.ndarray,
                         to_cost: np.ndarray, to_guidance: np.ndarray) -> None:
    """Gradients with respect to the costs (added to zeros) and to the raw guidance (written).

    Shapes as in the forward kernel. Each bundle is walked again with all its states kept, then walked back.
    """
    batch, height, width, _, _, channels = guidance.shape
    depth = cost.shape[1]
    run = max(1, _RUN // channels)
    for direction in range(4):
        vertical, backwards = direction < 2, direction % 2 == 1
        steps, lines = (height, width) if vertical else (width, height)
        bundle, block = (run, 1) if vertical else (1, run)
        tasks = (lines + bundle - 1) // bundle
        for task in prange(batch * tasks):
            b, start = task // tasks, task % tasks * bundle
            count = min(bundle, lines - start)
            wide = count * channels
            here = np.empty((1, depth, 0 if vertical else block * wide), np.float32)
            states, best = np.empty((steps, depth + 2, wide), np.float32), np.empty((steps, wide), np.float32)
            weights = np.empty((steps, 5, wide), np.float32)
            unused = np.empty((1, depth, 0), np.float32)
            for done in range(0, steps, block):
                size = min(block, steps - done)
                begin = steps - done - size if backwards else done
                at = (begin * width + start if vertical else start * width + begin) * channels
                if not vertical:
                    _copy(cost, b, at, size * wide, here)
                for step in range(done, done + size):
                    s = size - 1 - step + done if backwards else step - done
                    y, x = (begin + s, start) if vertical else (start, begin + s)
                    source, i, first = (cost, b, at) if vertical else (here, 0, s * wide)
                    _normalise(guidance, b, y, x, vertical, direction, count, weights[step])
                    if step == 0:
                        _begin(source, i, first, weights[step], states[step], best[step], unused, 0, False)
                    else:
                        _advance(source, i, first, weights[step], states[step - 1], best[step - 1], states[step],
                                 best[step], unused, 0, False)
            # what flows into a state, again with a row more; what its maximum gets from the next pixel
            flows, share = np.zeros((2, depth + 2, wide), np.float32), np.zeros(wide, np.float32)
            own, to_here = np.empty((depth, block * wide), np.float32), np.empty((depth, block * wide), np.float32)
            to_weights = np.empty((5, wide), np.float32)
            for done in range(0, steps, block):
                size = min(block, steps - done)
                begin = done if backwards else steps - done - size
                at = (begin * width + start if vertical else start * width + begin) * channels
                if not vertical:
                    _copy(cost, b, at, size * wide, here)
                _collect(gradient, chosen, b, at, size * wide, direction, own)
                for back in range(done, done + size):
                    step = steps - 1 - back
                    s = back - done if backwards else done + size - 1 - back
                    y, x = (begin + s, start) if vertical else (start, begin + s)
                    source, i, first = (cost, b, at) if vertical else (here, 0, s * wide)
                    now, later = back % 2, (back + 1) % 2
                    after = min(step + 1, steps - 1)
                    if step == 0:
                        _finish(source, i, first, weights[step], weights[after], states[step], best[step], flows[later],
                                share, own, s * wide, flows[now], to_here, to_weights)
                    else:
                        _retreat(source, i, first, weights[step], weights[after], states[step - 1], best[step - 1],
                                 states[step], best[step], flows[later], share, own, s * wide, flows[now], to_here,
                                 to_weights)
                    _denormalise(guidance, b, y, x, vertical, direction, count, weights[step], to_weights, to_guidance)
                _add(to_here, b, at, size * wide, to_cost)


# Indices are unsigned below: for a signed one numba checks whether it is negative, and nothing is vectorised.
@lanes
def _copy(volume: np.ndarray, b: int, at: int, length: int, block: np.ndarray) -> None:
    """Values ``at`` ... of every plane to a block (1, D, length)."""
    first = np.uint64(at)
    for d in range(block.shape[1]):
        for v in range(length):
            block[0, d, v] = volume[b, d, first + np.uint64(v)]


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
                norm += abs(guidance[b, yy, xx, direction, k, c])
            scale = np.float32(1) / max(norm, _EPSILON)
            for k in range(5):
                weights[k, j * channels + c] = guidance[b, yy, xx, direction, k, c] * scale


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
def _begin(cost: np.ndarray, i: int, at: int, weights: np.ndarray, state: np.ndarray, best: np.ndarray,
           aggregated: np.ndarray, to: int, write: bool) -> None:
    """First pixel of a line: no neighbour exists, all five terms are the cost itself."""
    depth, wide = state.shape[0] - 2, state.shape[1]
    first, target = np.uint64(at), np.uint64(to)
    best[:] = -np.inf
    for d in range(depth):
        for v in range(wide):
            total = weights[0, v] + weights[1, v] + weights[2, v] + weights[3, v] + weights[4, v]
            value = cost[i, d, first + np.uint64(v)] * total
            state[d + 1, v] = value
            best[v] = value if value > best[v] else best[v]
            if write:
                aggregated[0, d, target + np.uint64(v)] = value


@lanes
def _advance(cost: np.ndarray, i: int, at: int, weights: np.ndarray, before: np.ndarray, best_before: np.ndarray,
             after: np.ndarray, best: np.ndarray, aggregated: np.ndarray, to: int, write: bool) -> None:
    """One step of the recursion, and the maximum over the disparities of the result."""
    depth, wide = after.shape[0] - 2, after.shape[1]
    first = np.uint64(at)
    best[:] = -np.inf
    for v in range(wide):
        before[0, v], before[depth + 1, v] = cost[i, 0, first + np.uint64(v)], cost[i, depth - 1, first + np.uint64(v)]
    shared = depth // _ROWS * _ROWS
    for d in range(0, shared, _ROWS):
        _advance_rows(d, _ROWS, cost, i, at, weights, before, best_before, after, best, aggregated, to, write)
    for d in range(shared, depth):
        _advance_rows(d, 1, cost, i, at, weights, before, best_before, after, best, aggregated, to, write)


@lanes
def _advance_rows(d: int, rows: int, cost: np.ndarray, i: int, at: int, weights: np.ndarray, before: np.ndarray,
                  best_before: np.ndarray, after: np.ndarray, best: np.ndarray, aggregated: np.ndarray, to: int,
                  write: bool) -> None:
    first, target = np.uint64(at), np.uint64(to)
    for v in range(after.shape[1]):
        w0, w1, w2, w3 = weights[0, v], weights[1, v], weights[2, v], weights[3, v]
        rest, largest = weights[4, v] * best_before[v], best[v]
        below, own = before[d, v], before[d + 1, v]
        for k in range(d, d + rows):
            above = before[k + 2, v]
            value = w0 * cost[i, k, first + np.uint64(v)] + w1 * own + w2 * below + w3 * above + rest
            after[k + 1, v] = value
            if write:
                aggregated[0, k, target + np.uint64(v)] = value
            largest = value if value > largest else largest
            below, own = own, above
        best[v] = largest


@lanes
def _keep_largest(aggregated: np.ndarray, b: int, at: int, length: int, direction: int, out: np.ndarray,
                  chosen: np.ndarray) -> None:
    first, label = np.uint64(at), np.uint8(direction)
    for d in range(aggregated.shape[1]):
        if direction == 0:
            for v in range(length):
                out[b, d, first + np.uint64(v)] = aggregated[0, d, v]
                chosen[b, d, first + np.uint64(v)] = label
        else:
            for v in range(length):
                value, largest = aggregated[0, d, v], out[b, d, first + np.uint64(v)]
                out[b, d, first + np.uint64(v)] = value if value > largest else largest
                chosen[b, d, first + np.uint64(v)] = label if value > largest else chosen[b, d, first + np.uint64(v)]


@lanes
def _keep_largest_only(aggregated: np.ndarray, b: int, at: int, length: int, direction: int, out: np.ndarray) -> None:
    first = np.uint64(at)
    for d in range(aggregated.shape[1]):
        if direction == 0:
            for v in range(length):
                out[b, d, first + np.uint64(v)] = aggregated[0, d, v]
        else:
            for v in range(length):
                value, largest = aggregated[0, d, v], out[b, d, first + np.uint64(v)]
                out[b, d, first + np.uint64(v)] = value if value > largest else largest


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
def _retreat(cost: np.ndarray, i: int, at: int, weights: np.ndarray, weights_later: np.ndarray, before: np.ndarray,
             best_before: np.ndarray, state: np.ndarray, best: np.ndarray, later: np.ndarray, share: np.ndarray,
             own: np.ndarray, to: int, flow: np.ndarray, to_here: np.ndarray, to_weights: np.ndarray) -> None:
    depth, wide = to_here.shape[0], share.size
    first, target = np.uint64(at), np.uint64(to)
    to_weights[:] = 0
    for v in range(wide):
        before[0, v], before[depth + 1, v] = cost[i, 0, first + np.uint64(v)], cost[i, depth - 1, first + np.uint64(v)]
    shared = depth // _ROWS * _ROWS
    for d in range(0, shared, _ROWS):
        _retreat_rows(d, _ROWS, cost, i, at, weights, weights_later, before, state, best, later, share, own, to, flow,
                      to_here, to_weights)
    for d in range(shared, depth):
        _retreat_rows(d, 1, cost, i, at, weights, weights_later, before, state, best, later, share, own, to, flow,
                      to_here, to_weights)
    for v in range(wide):
        # to_weights[4] holds the sum of the flow so far
        share[v] = weights[4, v] * to_weights[4, v]
        to_weights[4, v] *= best_before[v]
        to_here[0, target + np.uint64(v)] += weights[2, v] * flow[1, v]
        to_here[depth - 1, target + np.uint64(v)] += weights[3, v] * flow[depth, v]


@lanes
def _retreat_rows(d: int, rows: int, cost: np.ndarray, i: int, at: int, weights: np.ndarray,
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
            t0 += f * cost[i, k, first + np.uint64(v)]
            t1 += f * same
            t2 += f * below
            t3 += f * above
            t4 += f
            below, same, later_below, later_same = same, above, later_same, later_above
        share[v] = rest
        to_weights[0, v], to_weights[1, v], to_weights[2, v], to_weights[3, v], to_weights[4, v] = t0, t1, t2, t3, t4


@lanes
def _finish(cost: np.ndarray, i: int, at: int, weights: np.ndarray, weights_later: np.ndarray, state: np.ndarray,
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
            to_weights[0, v] += f * cost[i, d, first + np.uint64(v)]
    for k in range(1, 5):
        for v in range(wide):
            to_weights[k, v] = to_weights[0, v]
