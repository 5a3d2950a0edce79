"""CPU kernels of ``learned.guided_aggregation``: float32, C-contiguous, forward and backward.

Semi-global aggregation takes the channels innermost, and pixels and channels as one axis: costs (B, D, H * W * C). A
task walks a bundle of neighbouring lines, whose channels side by side are the lanes of the vector registers; the costs
of one step are gathered to (D, lanes), so that the four directions share the arithmetic. Planes have some unused values
at their end (:func:`padding`): image sizes would set them a multiple of 4096 bytes apart, to collide in the cache.
"""

from __future__ import annotations

import numpy as np

from learned.jit import lanes, parallel, prange

# Lanes to aim at: a few vector registers wide, and three (D, lanes) arrays still fit the first-level cache.
_LANES = 64
_EPSILON = np.float32(1e-12)


def padding(plane: int) -> int:
    """Values to append to a plane so that the next one begins 64 bytes further, modulo 4096."""
    return (16 - plane) % 1024


@parallel
def semi_global_forward(cost: np.ndarray, guidance: np.ndarray, out: np.ndarray, chosen: np.ndarray) -> None:
    """Largest of the four directions.

    Parameters
    ----------
    cost : (B, D, H * W * C + padding) float32
    guidance : (B, H, W, 4, 5, C) float32
        Raw weights.
    out : like cost
        Comes in as minus infinity.
    chosen : like cost but uint8, or empty
        Comes in as zeros, gets the index of the direction that won (the first of equals).
    """
    batch, height, width, _, _, channels = guidance.shape
    depth = cost.shape[1]
    for direction in range(4):
        vertical, backwards = direction < 2, direction % 2 == 1
        steps, lines = (height, width) if vertical else (width, height)
        bundle = max(1, _LANES // channels)
        tasks = (lines + bundle - 1) // bundle
        for task in prange(batch * tasks):
            b, start = task // tasks, task % tasks * bundle
            count = min(bundle, lines - start)
            wide, row = bundle * channels, width * channels
            pieces, length = (1, count * channels) if vertical else (count, channels)
            here, weights = np.zeros((depth, wide), np.float32), np.zeros((5, wide), np.float32)
            # one row more at either end of the disparities, for the neighbours that do not exist
            states, best = np.zeros((2, depth + 2, wide), np.float32), np.zeros((2, wide), np.float32)
            for step in range(steps):
                i = steps - 1 - step if backwards else step
                y, x = (i, start) if vertical else (start, i)
                at = (y * width + x) * channels
                _gather(cost, b, at, row, pieces, length, here)
                _normalise(guidance, b, y, x, vertical, direction, count, weights)
                now, before = step % 2, (step + 1) % 2
                if step == 0:
                    _begin(here, weights, states[now], best[now])
                else:
                    _advance(here, weights, states[before], best[before], states[now], best[now])
                if chosen.size > 0:
                    _keep_largest(states[now], b, at, row, pieces, length, direction, out, chosen)
                else:
                    _keep_largest_only(states[now], b, at, row, pieces, length, out)


@parallel
def semi_global_backward(cost: np.ndarray, guidance: np.ndarray, chosen: np.ndarray, gradient: np.ndarray,
                         to_cost: np.ndarray, to_guidance: np.ndarray) -> None:
    """Gradients with respect to the costs (added to zeros) and to the raw guidance (written).

    Shapes as in the forward kernel. Each bundle is walked again with all its states kept, then walked back.
    """
    batch, height, width, _, _, channels = guidance.shape
    depth = cost.shape[1]
    for direction in range(4):
        vertical, backwards = direction < 2, direction % 2 == 1
        steps, lines = (height, width) if vertical else (width, height)
        bundle = max(1, _LANES // channels)
        tasks = (lines + bundle - 1) // bundle
        for task in prange(batch * tasks):
            b, start = task // tasks, task % tasks * bundle
            count = min(bundle, lines - start)
            wide, row = bundle * channels, width * channels
            pieces, length = (1, count * channels) if vertical else (count, channels)
            here = np.zeros((depth, wide), np.float32)
            states, best = np.zeros((steps, depth + 2, wide), np.float32), np.zeros((steps, wide), np.float32)
            weights = np.zeros((steps, 5, wide), np.float32)
            for step in range(steps):
                i = steps - 1 - step if backwards else step
                y, x = (i, start) if vertical else (start, i)
                at = (y * width + x) * channels
                _gather(cost, b, at, row, pieces, length, here)
                _normalise(guidance, b, y, x, vertical, direction, count, weights[step])
                if step == 0:
                    _begin(here, weights[step], states[step], best[step])
                else:
                    _advance(here, weights[step], states[step - 1], best[step - 1], states[step], best[step])
            # what flows into a state, again with one row more at either end; its sum over the disparities
            flows, totals = np.zeros((2, depth + 2, wide), np.float32), np.zeros((2, wide), np.float32)
            to_here, to_weights = np.zeros((depth, wide), np.float32), np.zeros((5, wide), np.float32)
            for step in range(steps - 1, -1, -1):
                i = steps - 1 - step if backwards else step
                y, x = (i, start) if vertical else (start, i)
                at = (y * width + x) * channels
                now, later = step % 2, (step + 1) % 2
                _gather(cost, b, at, row, pieces, length, here)
                _collect(gradient, chosen, b, at, row, pieces, length, direction, flows[now])
                if step < steps - 1:
                    _receive(flows[later], totals[later], weights[step + 1], states[step], best[step], flows[now])
                if step == 0:
                    _finish(here, weights[step], flows[now], to_here, to_weights)
                else:
                    _release(here, weights[step], states[step - 1], best[step - 1], flows[now], totals[now],
                             to_here, to_weights)
                _scatter_add(to_here, b, at, row, pieces, length, to_cost)
                _denormalise(guidance, b, y, x, vertical, direction, count, weights[step], to_weights, to_guidance)


# Indices are unsigned below: for a signed one numba checks whether it is negative, and nothing is vectorised.
@lanes
def _gather(volume: np.ndarray, b: int, at: int, row: int, pieces: int, length: int, here: np.ndarray) -> None:
    """``pieces`` runs of ``length`` values, a row apart, side by side in here (D, lanes)."""
    for d in range(here.shape[0]):
        for j in range(pieces):
            first, lane = np.uint64(at + j * row), np.uint64(j * length)
            for v in range(length):
                here[d, lane + np.uint64(v)] = volume[b, d, first + np.uint64(v)]


@lanes
def _scatter_add(here: np.ndarray, b: int, at: int, row: int, pieces: int, length: int, volume: np.ndarray) -> None:
    for d in range(here.shape[0]):
        for j in range(pieces):
            first, lane = np.uint64(at + j * row), np.uint64(j * length)
            for v in range(length):
                volume[b, d, first + np.uint64(v)] += here[d, lane + np.uint64(v)]


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
def _begin(here: np.ndarray, weights: np.ndarray, state: np.ndarray, best: np.ndarray) -> None:
    """First pixel of a line: no neighbour exists, all five terms are the cost itself."""
    depth, wide = here.shape
    best[:] = -np.inf
    for d in range(depth):
        for v in range(wide):
            value = here[d, v] * (weights[0, v] + weights[1, v] + weights[2, v] + weights[3, v] + weights[4, v])
            state[d + 1, v] = value
            best[v] = value if value > best[v] else best[v]


@lanes
def _advance(here: np.ndarray, weights: np.ndarray, before: np.ndarray, best_before: np.ndarray, after: np.ndarray,
             best: np.ndarray) -> None:
    """One step of the recursion, and the maximum over the disparities of the result."""
    depth, wide = here.shape
    best[:] = -np.inf
    for v in range(wide):
        before[0, v], before[depth + 1, v] = here[0, v], here[depth - 1, v]
    for d in range(depth):
        for v in range(wide):
            value = (weights[0, v] * here[d, v] + weights[1, v] * before[d + 1, v] + weights[2, v] * before[d, v]
                     + weights[3, v] * before[d + 2, v] + weights[4, v] * best_before[v])
            after[d + 1, v] = value
            best[v] = value if value > best[v] else best[v]


@lanes
def _keep_largest(state: np.ndarray, b: int, at: int, row: int, pieces: int, length: int, direction: int,
                  out: np.ndarray, chosen: np.ndarray) -> None:
    label = np.uint8(direction)
    for d in range(state.shape[0] - 2):
        for j in range(pieces):
            first, lane = np.uint64(at + j * row), np.uint64(j * length)
            for v in range(length):
                value, largest = state[d + 1, lane + np.uint64(v)], out[b, d, first + np.uint64(v)]
                out[b, d, first + np.uint64(v)] = value if value > largest else largest
                chosen[b, d, first + np.uint64(v)] = label if value > largest else chosen[b, d, first + np.uint64(v)]


@lanes
def _keep_largest_only(state: np.ndarray, b: int, at: int, row: int, pieces: int, length: int, out: np.ndarray
                       ) -> None:
    for d in range(state.shape[0] - 2):
        for j in range(pieces):
            first, lane = np.uint64(at + j * row), np.uint64(j * length)
            for v in range(length):
                value, largest = state[d + 1, lane + np.uint64(v)], out[b, d, first + np.uint64(v)]
                out[b, d, first + np.uint64(v)] = value if value > largest else largest


@lanes
def _collect(gradient: np.ndarray, chosen: np.ndarray, b: int, at: int, row: int, pieces: int, length: int,
             direction: int, flow: np.ndarray) -> None:
    """The incoming gradient where this direction was the largest."""
    for d in range(flow.shape[0] - 2):
        for j in range(pieces):
            first, lane = np.uint64(at + j * row), np.uint64(j * length)
            for v in range(length):
                won = chosen[b, d, first + np.uint64(v)] == direction
                flow[d + 1, lane + np.uint64(v)] = gradient[b, d, first + np.uint64(v)] if won else np.float32(0)


@lanes
def _receive(later: np.ndarray, later_total: np.ndarray, weights: np.ndarray, state: np.ndarray, best: np.ndarray,
             flow: np.ndarray) -> None:
    """Add what the next pixel of the line used of this one; the first maximum gets the maximum's share."""
    depth, wide = flow.shape[0] - 2, flow.shape[1]
    for d in range(1, depth + 1):
        for v in range(wide):
            largest = state[d, v] == best[v]
            share = weights[4, v] * later_total[v] if largest else np.float32(0)
            later_total[v] = np.float32(0) if largest else later_total[v]
            flow[d, v] += (weights[1, v] * later[d, v] + weights[2, v] * later[d + 1, v]
                           + weights[3, v] * later[d - 1, v] + share)


@lanes
def _release(here: np.ndarray, weights: np.ndarray, before: np.ndarray, best_before: np.ndarray, flow: np.ndarray,
             total: np.ndarray, to_here: np.ndarray, to_weights: np.ndarray) -> None:
    """From the gradient of a state to that of its own costs and weights; its sum over the disparities."""
    depth, wide = here.shape
    to_weights[:] = 0
    total[:] = 0
    for v in range(wide):
        before[0, v], before[depth + 1, v] = here[0, v], here[depth - 1, v]
    for d in range(depth):
        for v in range(wide):
            f = flow[d + 1, v]
            total[v] += f
            to_here[d, v] = weights[0, v] * f
            to_weights[0, v] += f * here[d, v]
            to_weights[1, v] += f * before[d + 1, v]
            to_weights[2, v] += f * before[d, v]
            to_weights[3, v] += f * before[d + 2, v]
    for v in range(wide):
        to_weights[4, v] = total[v] * best_before[v]
        to_here[0, v] += weights[2, v] * flow[1, v]
        to_here[depth - 1, v] += weights[3, v] * flow[depth, v]


@lanes
def _finish(here: np.ndarray, weights: np.ndarray, flow: np.ndarray, to_here: np.ndarray, to_weights: np.ndarray
            ) -> None:
    """``_release`` at the first pixel of a line."""
    depth, wide = here.shape
    to_weights[:] = 0
    for d in range(depth):
        for v in range(wide):
            f = flow[d + 1, v]
            to_here[d, v] = f * (weights[0, v] + weights[1, v] + weights[2, v] + weights[3, v] + weights[4, v])
            to_weights[0, v] += f * here[d, v]
    for k in range(1, 5):
        for v in range(wide):
            to_weights[k, v] = to_weights[0, v]


@parallel
def local_forward(cost: np.ndarray, weights: np.ndarray, out: np.ndarray) -> None:
    """out(d, y, x) += sum over the 75 taps of weight(tap, y, x) cost(d + dd, y + dy, x + dx), the centre where outside.

    Shapes (B, D, H, W), (B, 75, H, W), (B, D, H, W); ``out`` comes in as zeros.
    """
    batch, depth, height, width = cost.shape
    for task in prange(batch * height):
        b, y = task // height, task % height
        for d in range(depth):
            for tap in range(75):
                dd, yy, dx = d + tap // 25 - 1, y + tap // 5 % 5 - 2, tap % 5 - 2
                begin, end = _inside(dx, width) if 0 <= dd < depth and 0 <= yy < height else (width, width)
                weight, centre, total = weights[b, tap, y], cost[b, d, y], out[b, d, y]
                if begin < end:
                    neighbour = cost[b, dd, yy, begin + dx :]
                    _multiply_add(weight[begin:end], neighbour, total[begin:])
                _multiply_add(weight[:begin], centre, total)
                _multiply_add(weight[end:], centre[end:], total[end:])


@parallel
def local_backward(cost: np.ndarray, weights: np.ndarray, gradient: np.ndarray, to_cost: np.ndarray,
                   to_weights: np.ndarray) -> None:
    """Gradients with respect to the costs and to the normalised weights, both added to zeros.

    A row of the costs is gathered from the rows that looked at it, so that no two tasks write to one place.
    """
    batch, depth, height, width = cost.shape
    for task in prange(batch * height):
        b, y = task // height, task % height
        for d in range(depth):
            own, centre, total = gradient[b, d, y], cost[b, d, y], to_cost[b, d, y]
            for tap in range(75):
                offset_d, offset_y, dx = tap // 25 - 1, tap // 5 % 5 - 2, tap % 5 - 2
                begin, end = _inside(dx, width)
                weight, to_weight = weights[b, tap, y], to_weights[b, tap, y]
                looker_d, looker_y = d - offset_d, y - offset_y
                if 0 <= looker_d < depth and 0 <= looker_y < height and begin < end:
                    _multiply_add(weights[b, tap, looker_y, begin:end], gradient[b, looker_d, looker_y, begin:],
                                  total[begin + dx :])
                dd, yy = d + offset_d, y + offset_y
                if 0 <= dd < depth and 0 <= yy < height:
                    if begin < end:
                        _multiply_add(own[begin:end], cost[b, dd, yy, begin + dx :], to_weight[begin:])
                else:
                    begin = end = width
                _multiply_add(own[:begin], weight, total)
                _multiply_add(own[end:], weight[end:], total[end:])
                _multiply_add(own[:begin], centre, to_weight)
                _multiply_add(own[end:], centre[end:], to_weight[end:])


@lanes
def _inside(dx: int, width: int) -> tuple[int, int]:
    """Begin and end of the x for which x + dx is inside too; both ``width`` if there are none."""
    begin, end = max(0, -dx), min(width, width - dx)
    return (begin, end) if begin < end else (width, width)


@lanes
def _multiply_add(a: np.ndarray, b: np.ndarray, total: np.ndarray) -> None:
    """total += a b, for the length of a."""
    for x in range(a.size):
        total[x] += a[x] * b[x]
