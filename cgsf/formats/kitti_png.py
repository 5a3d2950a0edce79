"""KITTI's 16-bit PNG maps (the devkit's io_disp.h and io_flow.h).

Disparity: one channel, ``value / 256`` pixels, 0 = unknown. Flow: three channels in the order u, v, valid (the
library sees them reversed, as BGR), ``(value - 32768) / 64`` pixels, valid = 0 or 1.
"""

from pathlib import Path

import numpy as np

from cgsf.errors import InputError
from cgsf.formats.images import decode, write_png


def read_disparity(path: str | Path) -> np.ndarray:
    """Disparity in pixels, (H, W) float32, NaN where unknown."""
    raw = decode(path)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise InputError(f"{path}: is no KITTI disparity map (16-bit grey PNG), but {raw.dtype} {raw.shape}")
    return np.where(raw > 0, raw.astype(np.float32) / 256, np.float32(np.nan))


def write_disparity(path: str | Path, disparity: np.ndarray) -> None:
    """Write disparity in pixels, (H, W); NaN becomes *unknown*, finite values are cut to [1/256, 255.996]."""
    known = np.isfinite(disparity)
    raw = np.clip(np.rint(np.where(known, disparity, 0) * np.float64(256)), 1, 65535)
    write_png(path, np.where(known, raw, 0).astype(np.uint16))


def read_flow(path: str | Path) -> np.ndarray:
    """Flow (u, v) in pixels, (H, W, 2) float32, NaN where unknown."""
    raw = decode(path)
    if raw.ndim != 3 or raw.shape[2] != 3 or raw.dtype != np.uint16:
        raise InputError(f"{path}: is no KITTI flow map (16-bit colour PNG), but {raw.dtype} {raw.shape}")
    flow = (raw[..., :0:-1].astype(np.float32) - 32768) / 64
    flow[raw[..., 0] == 0] = np.nan
    return flow


def write_flow(path: str | Path, flow: np.ndarray) -> None:
    """Write flow (u, v) in pixels, (H, W, 2); NaN becomes *unknown*, finite values are cut to [-512, 511.98]."""
    known = np.isfinite(flow).all(-1, keepdims=True)
    raw = np.clip(np.rint(np.where(known, flow, 0) * np.float64(64) + 32768), 0, 65535)
    raw = np.where(known, raw, 0).astype(np.uint16)
    write_png(path, np.concatenate([known.astype(np.uint16), raw[..., 1:], raw[..., :1]], -1))
