"""What a refinement starts from: the state of the networks, of the solver, or of OpenCV."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cgsf.baselines import CompositionConfig, compose
from cgsf.camera_motion import find_homography
from cgsf.config import to_table
from cgsf.errors import InputError
from cgsf.feedforward import FeedforwardConfig, run_networks, weights_path
from cgsf.formats.files import read_bytes
from cgsf.scene_flow import SceneFlow
from variational.camera import StereoCamera
from variational.frames import Frames
from variational.solver import SolverConfig

if TYPE_CHECKING:
    from learned.batch import Batch


@dataclass(frozen=True)
class StartConfig:
    """What makes the start, and how.

    Parameters
    ----------
    initial : {"feedforward", "variational", "opencv"}
        What makes the start.
    device : str
        Any device that torch knows, for networks.
    feedforward, variational, opencv
        Settings of each.
    """

    initial: Literal["feedforward", "variational", "opencv"] = "feedforward"
    device: str = "cpu"
    feedforward: FeedforwardConfig = field(default_factory=FeedforwardConfig)
    variational: SolverConfig = field(default_factory=SolverConfig)
    opencv: CompositionConfig = field(default_factory=CompositionConfig)


def load_start_config(initial: str, preset: str = "default", **networks: str | None) -> StartConfig:
    """The settings of a start under a preset; `networks` replace fields of `FeedforwardConfig`, unless they are None.

    Raises
    ------
    InputError
        If there is no such preset, or the settings do not fit.
    """
    from cgsf.pipelines import load_config, with_settings

    config: StartConfig = with_settings(load_config("hybrid", preset), {"initial": initial})
    return replace(config, feedforward=with_settings(config.feedforward, networks))


def make_start(frames: Frames, config: StartConfig, camera: StereoCamera | None = None, progress: Any = None) -> SceneFlow:
    """A start with its backward flow; errors are those of the method that makes it."""
    return _MAKERS[config.initial](frames, config, camera, progress)


def start_maps(start: SceneFlow) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State (5, H, W), backward flow (2, H, W) and evidence (2, H, W: confidence and visibility in [0, 1]) of a start,
    float32 and finite: what it leaves open (NaN) is zero."""
    if start.backward_flow is None:
        raise InputError(f"the method {start.method!r} gives no backward flow: its states cannot be refined")
    state = start.state()
    state = state if np.isfinite(state).all() else np.nan_to_num(state, posinf=0, neginf=0)
    backward = start.backward_flow.transpose(2, 0, 1)
    confidence = np.ones(start.shape, np.float32) if start.confidence is None else start.confidence
    return state, backward, np.stack([confidence, start.visible.astype(np.float32)])


def to_batch(frames: Frames, start: SceneFlow, camera: StereoCamera | None = None) -> Batch:
    """Frames and a start as tensors, with the camera's motion in it."""
    import torch

    from learned.batch import Batch

    # channels stay innermost in memory: the energy, which wants them there, need not copy them back; grey is repeated without
    # a copy, and the energy computes it once
    images = torch.from_numpy(np.stack([frames.left1, frames.right1, frames.left2, frames.right2]))
    maps = start_maps(start)
    homography = torch.from_numpy(find_homography(maps[0], maps[1].transpose(1, 2, 0), camera))[None]
    state, backward, evidence = (torch.from_numpy(np.ascontiguousarray(each))[None] for each in maps)
    return Batch(images.permute(0, 3, 1, 2).expand(-1, 3, -1, -1)[None], None, state, backward, evidence, homography=homography)


def describe(config: StartConfig) -> dict[str, Any]:
    """All that a start depends on beside the images, as plain values; weights by their checksums."""
    settings = getattr(config, config.initial)
    about = {"initial": config.initial, "settings": to_table(settings)}
    if config.initial == "feedforward":
        about["weights"] = [zlib.crc32(read_bytes(weights_path(name))) for name in (settings.disparity, settings.motion)]
    return about


def _networks(frames: Frames, config: StartConfig, camera: StereoCamera | None, progress: Any) -> SceneFlow:
    return run_networks(frames, replace(config.feedforward, device=config.device), camera, progress)


def _solver(frames: Frames, config: StartConfig, camera: StereoCamera | None, progress: Any) -> SceneFlow:
    from cgsf.pipelines import solve_variational

    return solve_variational(frames, config.variational, camera, progress)


def _opencv(frames: Frames, config: StartConfig, camera: StereoCamera | None, progress: Any) -> SceneFlow:
    """OpenCV's composition, with a backward flow for the visible mask."""
    reverse = compose(Frames(frames.left2, frames.right2, frames.left1, frames.right1), config.opencv)
    return replace(compose(frames, config.opencv, camera, progress), backward_flow=reverse.flow)


_MAKERS = {"feedforward": _networks, "variational": _solver, "opencv": _opencv}
