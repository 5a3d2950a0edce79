"""The solver: start, rigid proposals, coarse-to-fine minimisation of the energy."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from variational.camera import StereoCamera
from variational.confidence import confidence
from variational.descent import DescentConfig, FromZeroConfig, History, RefineConfig, descend_energy, from_zero, refine
from variational.edges import EdgesConfig, other_sides
from variational.energy import EnergyConfig
from variational.evidence import EvidenceConfig
from variational.frames import Frames
from variational.fusion import FusionConfig
from variational.initialise import MIN_SIDE, StartName, initialise, sample
from variational.jit import side_by_side
from variational.matching import MatchingConfig
from variational.objects import ObjectsConfig
from variational.planes import PlanesConfig
from variational.proposals import MEASURED, keep, propose
from variational.pyramid import resize_image
from variational.rigid import RigidConfig
from variational.shared_pattern import pattern_amplitude
from variational.state import D1, enlarge_state, flow_of
from variational.terms.constancy import ConstancyConfig
from variational.visibility import backward_flow, project_visibility

logger = logging.getLogger(__name__)
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class SolverConfig:
    """Everything that the solver can be told.

    Parameters
    ----------
    start : {"matching", "opencv", "zero"}
        Starting state: our census matching and dense inverse search, OpenCV's matching and the same flow, or nothing,
        from which a coarse-to-fine minimisation begins.
    most_pixels : int
        Larger images are worked on at a size of about so many pixels, which bounds the time and loses what is thin; 0 for
        no such limit.
    proposals : bool
        Fuse the start with rigid motions (variational.proposals).
    matching, rigid, objects, planes, fusion, evidence, edges, from_zero, refine, constancy
        Settings of the parts.
    descent, energy
        First-order descent of the consistency energy after all else, and that energy; off unless descent.levels > 0.
    """

    start: StartName = "matching"
    most_pixels: int = 0
    proposals: bool = True
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    rigid: RigidConfig = field(default_factory=RigidConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    planes: PlanesConfig = field(default_factory=PlanesConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    edges: EdgesConfig = field(default_factory=EdgesConfig)
    from_zero: FromZeroConfig = field(default_factory=FromZeroConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    constancy: ConstancyConfig = field(default_factory=ConstancyConfig)
    descent: DescentConfig = field(default_factory=DescentConfig)
    energy: EnergyConfig = field(default_factory=EnergyConfig)

    def __post_init__(self) -> None:
        if self.most_pixels < 0:
            raise ValueError(f"SolverConfig.most_pixels must not be negative, got {self.most_pixels}")


@dataclass(frozen=True, eq=False)
class Solution:
    """What the solver found.

    Parameters
    ----------
    state : np.ndarray
        (5, H, W) float32.
    visible : np.ndarray
        (H, W) bool, True where left1's pixel is seen in left2.
    confidence : np.ndarray
        (H, W) float32 in [0, 1].
    moving : np.ndarray or None
        (H, W) bool, True where a pixel does not follow the camera's motion; None where that is not known.
    camera_motion : np.ndarray or None
        (4, 4) float64, takes static points from left1's frame to left2's, metres; None without a calibration.
    guessed_camera : StereoCamera or None
        Without a calibration, the one that the motions were fitted with: its baseline is arbitrary.
    initial_state : np.ndarray
        (5, H, W), where the solver started.
    backward_flow : np.ndarray
        (H, W, 2), left2 -> left1 on left2's grid.
    history : list of dict
        Energy per level and iteration.
    reason : str
        Why the minimisation stopped.
    seconds : dict
        Time per stage.
    """

    state: np.ndarray
    visible: np.ndarray
    confidence: np.ndarray
    moving: np.ndarray | None
    camera_motion: np.ndarray | None
    guessed_camera: StereoCamera | None
    initial_state: np.ndarray
    backward_flow: np.ndarray
    history: list[dict]
    reason: str
    seconds: dict[str, float]


def solve(
    frames: Frames, config: SolverConfig = SolverConfig(), camera: StereoCamera | None = None, progress: Progress | None = None
) -> Solution:
    """Scene flow of two rectified stereo pairs by minimising the consistency energy.

    Parameters
    ----------
    frames : Frames
        At least MIN_SIDE pixels on every side.
    config : SolverConfig
    camera : StereoCamera or None
        Makes rigid motions metric; without one they are fitted up to the camera.
    progress : callable or None
        Called with the stage's name and the fraction done.

    Returns
    -------
    Solution
        Finite everywhere.

    Raises
    ------
    ValueError
        If the images are too small.
    """
    height, width = frames.left1.shape[:2]
    if min(height, width) < MIN_SIDE:
        raise ValueError(f"images of {width} x {height} pixels are too small: the solver needs {MIN_SIDE} on every side")
    if 0 < config.most_pixels < height * width:
        size = max(np.sqrt(config.most_pixels / (height * width)), MIN_SIDE / min(height, width))
        shape = (round(height * size), round(width * size))
        # averaging over pixels weakens a pattern as it does noise, and may hide it
        overlook = max(config.matching.overlook, size * pattern_amplitude(frames.grey))
        smaller = replace(config, most_pixels=0, matching=replace(config.matching, overlook=overlook))
        return _solve_smaller(frames, smaller, camera, progress, shape)
    matching = replace(config.matching, overlook=max(config.matching.overlook, pattern_amplitude(frames.grey)))
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str, fraction: float) -> Iterator[None]:
        if progress:
            progress(name, fraction)
        begin = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - begin

    history: History = []
    reason = "all stages done"
    with stage("start", 0.0):
        start = initialise(frames, config.start, matching)
    initial = start.state
    if config.start == "zero":
        with stage("from zero", 0.1):
            start, history = from_zero(frames, config.from_zero, config.constancy, matching)
    proposal = keep(start)
    if config.proposals:
        with stage("proposals", 0.5):
            proposal = propose(
                start, frames, camera, matching, config.rigid, config.objects, config.planes,
                config.fusion, config.evidence, config.edges,
            )  # fmt: skip
    with stage("refine", 0.8):
        matched = (start.match1.matched, start.match2.matched)
        rigid = proposal.labels != MEASURED
        state, steps = refine(frames, proposal.state, rigid, matched, config.refine, config.constancy)
        history += steps
    if config.descent.levels:
        with stage("descent", 0.85):
            state, steps, reason = descend_energy(frames, state, start.backward_flow, config.descent, config.energy)
            history += steps
    with stage("visibility", 0.9):
        backward, visible, matched2 = side_by_side(
            lambda: backward_flow(state, start.backward_flow), lambda: project_visibility(state),
            lambda: sample(start.match2.matched.astype(np.float32), flow_of(state)) > 0.5,
        )  # fmt: skip
        trust = confidence(state, proposal.cost, start.match1.matched, matched2, visible)
    if progress:
        progress("done", 1.0)
    moving = proposal.labels != 0 if proposal.motions else None
    motion = proposal.motions[0].transform if proposal.motions and camera else None
    guessed = None if camera else proposal.camera
    return Solution(state, visible, trust, moving, motion, guessed, initial, backward, history, reason, seconds)


def _solve_smaller(
    frames: Frames, config: SolverConfig, camera: StereoCamera | None, progress: Progress | None, shape: tuple[int, int]
) -> Solution:
    """Solve at a smaller `shape` and bring everything back to the frames' own."""
    begin = time.perf_counter()
    (height, width), (rows, columns) = frames.shape, shape
    images = Frames(*(resize_image(image, shape) for image in (frames.left1, frames.right1, frames.left2, frames.right2)))
    scaled = camera.scaled(columns / width, rows / height) if camera else None
    resizing = time.perf_counter() - begin
    found = solve(images, config, scaled, progress)
    begin = time.perf_counter()

    def enlarged(mask: np.ndarray) -> np.ndarray:
        return cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST_EXACT) > 0

    state = enlarge_state(found.state, frames.shape)
    source = other_sides(state[D1], frames.left1, config.edges)
    backward = cv2.resize(found.backward_flow, (width, height)) * np.array([width / columns, height / rows], np.float32)
    return replace(
        found,
        state=np.take(state.reshape(5, -1), source, axis=1),
        visible=enlarged(found.visible),
        confidence=cv2.resize(found.confidence, (width, height)),
        moving=None if found.moving is None else enlarged(found.moving).ravel()[source],
        guessed_camera=None if found.guessed_camera is None else found.guessed_camera.scaled(width / columns, height / rows),
        initial_state=enlarge_state(found.initial_state, frames.shape),
        backward_flow=backward,
        seconds={**found.seconds, "resizing": resizing + time.perf_counter() - begin},
    )
