"""The consistency energy and its analytic gradient: the gradient oracle that everything else uses.

``L = w_pd L_pd + w_pf L_pf + w_df L_df + w_s L_s`` per pixel, the energy its sum; formulas stand in
:mod:`variational.terms`, the table formula -> function in docs/energy.md. Defaults are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial

import numpy as np

from variational.frames import Frames
from variational.jit import over_rows, rowwise, side_by_side, total
from variational.state import check_state
from variational.terms.coupling import coupling_band, scatter_band
from variational.terms.photometric import padded_planes, photometric_band, window_overlap
from variational.terms.smoothness import edge_weights, smoothness_band
from variational.terms.visibility import flow_planes, visible_band

STRIP_ROWS = 8
"""Rows of all planes that a core's second-level cache holds together, at any usual width."""


@dataclass(frozen=True)
class EnergyConfig:
    """Weights and options of the energy; a term of weight zero is switched off and costs nothing.

    Parameters
    ----------
    stereo_weight : float
        w_pd of both stereo pairs' photometric error.
    flow_weight : float
        w_pf of the photometric error of left1 and left2.
    coupling_weight : float
        w_df of ``|D1 + C - D2(p + F)|``, per pixel of disparity.
    smoothness_weight : float
        w_s of the first differences, per pixel; raising it flattens.
    ssim_share : float
        alpha in [0, 1]: structural similarity against absolute difference in the photometric error.
    edge_sharpness : float
        Factor inside the smoothness term's exponential; raising it frees more of the image's edges.
    visible_relative, visible_absolute : float
        w1 and w2 (square pixels) of the forward-backward check; raising them calls more pixels visible.
    drop_outside : bool
        Leave out photometric errors of pixels whose match lies outside the other image.
    charbonnier_intensity, charbonnier_px : float
        eps of the Charbonnier penalty in the photometric terms (intensity) and in coupling and smoothness (pixels);
        0 is the plain absolute value, second-order minimisers need more.
    """

    stereo_weight: float = 1.0
    flow_weight: float = 1.0
    coupling_weight: float = 1.0
    smoothness_weight: float = 0.1
    ssim_share: float = 0.85
    edge_sharpness: float = 1.0
    visible_relative: float = 0.01
    visible_absolute: float = 0.05
    drop_outside: bool = False
    charbonnier_intensity: float = 0.0
    charbonnier_px: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"EnergyConfig.{field.name} must be finite and not negative, got {value}")
        if self.ssim_share > 1:
            raise ValueError(f"EnergyConfig.ssim_share must be in [0, 1], got {self.ssim_share}")


@rowwise
def _row_terms(first: int, last: int, state: np.ndarray, edges1: np.ndarray, edges2: np.ndarray, backward: np.ndarray,
               find_visible: bool, visible: np.ndarray, w_coupling: float, w_smooth: float, eps_px: float, w1: float,
               w2: float, loss: np.ndarray, gradient: np.ndarray, index: np.ndarray, parts: np.ndarray) -> None:
    """Begin the map and the gradient with all that needs no other row of them: visibility, smoothness, coupling.

    They go strip by strip, so that the strip's map and gradient stay in the cache from term to term: at large sizes
    memory is what a plain sweep a term would wait for.
    """
    for strip in range(first, last, STRIP_ROWS):
        end = min(strip + STRIP_ROWS, last)
        loss[strip:end] = 0
        gradient[:, strip:end] = 0
        if find_visible:
            visible_band(strip, end, state[3], state[4], backward, w1, w2, visible)
        if w_smooth > 0:
            for channel in range(5):
                smoothness_band(strip, end, state[channel], edges2 if channel == 1 else edges1, w_smooth, eps_px, loss,
                                gradient[channel])
        if w_coupling > 0:
            coupling_band(strip, end, state, state[1].reshape(-1), visible, w_coupling, eps_px, loss, gradient, index,
                          parts)


class Energy:
    """The energy of one set of frames, at one resolution, as a function of the state.

    Parameters
    ----------
    frames : Frames
        The four images.
    config : EnergyConfig
        Weights and options.
    backward_flow : np.ndarray or None
        ``(H, W, 2)`` flow left2 -> left1 on left2's grid, in pixels, held fixed; None calls every pixel visible.
    visible_stereo1, visible_stereo2 : np.ndarray or None
        ``(H, W)`` bool: left1's (left2's) pixels that are seen in right1 (right2); None calls every pixel visible.

    Raises
    ------
    ValueError
        In one line, where a shape is not the frames'.
    """

    def __init__(self, frames: Frames, config: EnergyConfig = EnergyConfig(), backward_flow: np.ndarray | None = None,
                 visible_stereo1: np.ndarray | None = None, visible_stereo2: np.ndarray | None = None) -> None:
        self.frames, self.config, self.backward_flow = frames, config, backward_flow
        if backward_flow is not None and backward_flow.shape != (*frames.shape, 2):
            raise ValueError(f"backward_flow must have shape {(*frames.shape, 2)}, not {backward_flow.shape}")
        everywhere = np.ones(frames.shape, np.bool_)
        self._visible = [everywhere if mask is None else _mask(mask, frames.shape)
                         for mask in (visible_stereo1, visible_stereo2)]
        self._everywhere = everywhere
        self._prepared: dict[np.dtype, tuple[np.ndarray, ...]] = {}

    def value_and_gradient(self, state: np.ndarray, visible: np.ndarray | None = None,
                           out: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The per-pixel map and the gradient of its sum.

        Parameters
        ----------
        state : np.ndarray
            ``(5, H, W)``, float32 or float64, in pixels; decides the precision of everything.
        visible : np.ndarray or None
            ``(H, W)`` bool to use in place of the forward-backward check (to hold it fixed during a line search, say).
        out : tuple of np.ndarray or None
            Contiguous arrays of the state's type to write the map and the gradient to, in place of new ones.

        Returns
        -------
        loss : np.ndarray
            ``(H, W)``; its sum is the energy (:func:`variational.jit.total`: same bits for any threads).
        gradient : np.ndarray
            ``(5, H, W)``, derivative of the sum, per pixel of disparity or flow.
        """
        return self._run(state, visible, True, out)

    def value(self, state: np.ndarray, visible: np.ndarray | None = None) -> float:
        """The energy: the sum of the map, in float64. Cheaper than with the gradient."""
        return total(self._run(state, visible, False, None)[0])

    def _run(self, state: np.ndarray, visible: np.ndarray | None, with_gradient: bool,
             out: tuple[np.ndarray, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
        shape, config = self.frames.shape, self.config
        check_state(state, shape)
        uses_visible = config.flow_weight + config.coupling_weight > 0
        find_visible = visible is None and self.backward_flow is not None and uses_visible
        if visible is not None:
            mask = _mask(visible, shape)
        else:
            mask = np.empty(shape, np.bool_) if find_visible else self._everywhere
        loss, gradient = out or (np.empty(shape, state.dtype), np.empty(state.shape, state.dtype))
        for array, wanted in ((loss, shape), (gradient, state.shape)):
            if array.shape != wanted or array.dtype != state.dtype or not array.flags.c_contiguous:
                raise ValueError(f"out must hold contiguous {state.dtype} arrays of shapes {shape} and {state.shape}")
        index, parts = np.empty(shape, np.int32), np.empty((3, *shape), state.dtype)  # of the coupling term
        left1, right1, left2, right2, left2_source, edges1, edges2, backward, *overlap = self._inputs(state.dtype)
        w_coupling, options = float(config.coupling_weight), (float(config.ssim_share), float(config.charbonnier_intensity),
                                                              bool(config.drop_outside))
        over_rows(_row_terms, shape[0], state, edges1, edges2, backward, find_visible, mask, w_coupling,
                  float(config.smoothness_weight), float(config.charbonnier_px), float(config.visible_relative),
                  float(config.visible_absolute), loss, gradient, index, parts)

        def photometric(weight: float, target: np.ndarray, source: np.ndarray, dx: int, sign: float, dy: int | None,
                        seen: np.ndarray) -> None:
            """Add the term of a target image and a source that channels `dx` and `dy` of the state lead to."""
            moves = dy is not None
            if weight > 0:
                over_rows(photometric_band, shape[0], target, source, state[dx], state[dy if moves else dx], moves, sign,
                          seen, *overlap, float(weight), *options, loss, gradient[dx], gradient[dy if moves else dx],
                          with_gradient)

        photometric(config.stereo_weight, left1, right1, 0, -1.0, None, self._visible[0])
        photometric(config.stereo_weight, left2, right2, 1, -1.0, None, self._visible[1])
        photometric(config.flow_weight, left1, left2_source, 3, 1.0, 4, mask)
        if w_coupling > 0 and with_gradient:
            over_rows(scatter_band, shape[0], index, parts, gradient[1].reshape(-1))
        return loss, gradient

    def _inputs(self, dtype: np.dtype) -> tuple[np.ndarray, ...]:
        """What does not depend on the state, prepared once for each type."""
        if dtype not in self._prepared:
            frames, sharpness = self.frames, self.config.edge_sharpness
            left1, right1, left2, right2 = side_by_side(*(
                partial(padded_planes, image, dtype) for image in (frames.left1, frames.right1, frames.left2, frames.right2)))
            edges1, edges2 = edge_weights(left1, sharpness), edge_weights(left2, sharpness)
            channels = left1.shape[0]
            backward = np.zeros((2, 1), dtype) if self.backward_flow is None else flow_planes(self.backward_flow, dtype)
            self._prepared[dtype] = (
                left1, right1.reshape(channels, -1), left2, right2.reshape(channels, -1), left2.reshape(channels, -1),
                edges1, edges2, backward, window_overlap(frames.shape[0], dtype), window_overlap(frames.shape[1], dtype))
        return self._prepared[dtype]


def _mask(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    if mask.dtype != np.bool_ or mask.shape != shape:
        raise ValueError(f"a visible mask must be bool of shape {shape}, not {mask.dtype} {mask.shape}")
    return np.ascontiguousarray(mask)
