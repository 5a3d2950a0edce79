"""Methods by name, and the one function that runs any of them.

A method is a function ``(frames, config, camera, progress) -> SceneFlow``: frames are validated, the camera may be
None, progress may be None or ``progress(stage, fraction)``. Its settings are a frozen dataclass that presets fill.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cgsf.calibration import Calibration
from cgsf.config import from_table, read_preset
from cgsf.errors import InputError
from cgsf.intake import to_frames, warn_of_oddities
from cgsf.scene_flow import SceneFlow
from variational.camera import StereoCamera
from variational.frames import Frames

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Method:
    """Where a method is found; nothing is imported before it is used.

    Parameters
    ----------
    function : str
        ``module:function`` with the signature above.
    summary : str
        One line for people.
    section : str or None
        The table of a preset that holds its settings.
    config : str or None
        ``module:Class``, the dataclass of its settings.
    fixed : dict
        Settings that make this method of several that share a function; a preset cannot change them.
    starts : tuple of str
        Tables of a preset that fill the settings of the same names: of the methods that this one may start from.
    """

    function: str
    summary: str
    section: str | None = None
    config: str | None = None
    fixed: tuple[tuple[str, Any], ...] = ()
    starts: tuple[str, ...] = ()


def _composition(flow: str, filtered: bool) -> Method:
    text = f"OpenCV: semi-global matching{', filtered,' if filtered else ''} and {flow} flow"
    fixed = (("flow", flow), ("filtered", filtered))
    return Method("cgsf.baselines:compose", text, "opencv", "cgsf.baselines:CompositionConfig", fixed)


def _refined(initial: str, summary: str) -> Method:
    starts = ("feedforward", "variational", "opencv")
    return Method("cgsf.refined:run_refined", summary, "refined", "cgsf.refined:RefinedConfig", (("initial", initial),), starts)


METHODS: dict[str, Method] = {
    "variational": Method(
        "cgsf.pipelines:solve_variational", "coarse-to-fine energy minimisation", "variational",
        "variational.solver:SolverConfig",
    ),
    "opencv": _composition("dis", False),
    **{f"opencv-{flow}": _composition(flow, False) for flow in ("deepflow", "rlof", "farneback")},
    **{f"opencv-wls-{flow}": _composition(flow, True) for flow in ("dis", "deepflow", "rlof", "farneback")},
    "feedforward": Method(
        "cgsf.feedforward:run_networks", "the networks alone", "feedforward", "cgsf.feedforward:FeedforwardConfig",
    ),
    "hybrid": _refined("feedforward", "the networks, then the learned refiner"),
    "variational+refiner": _refined("variational", "energy minimisation, then the learned refiner"),
    "zero": Method("cgsf.baselines:nothing", "zero everywhere"),
}  # fmt: skip


def estimate(
    left1: np.ndarray,
    right1: np.ndarray,
    left2: np.ndarray,
    right2: np.ndarray,
    method: str = "variational",
    calibration: Calibration | StereoCamera | str | Path | None = None,
    preset: str = "default",
    progress: Progress | None = None,
) -> SceneFlow:
    """Scene flow of two rectified stereo pairs.

    Parameters
    ----------
    left1, right1, left2, right2 : ndarray (H, W) or (H, W, c)
        uint8, uint16, or floating point in [0, 1]; grey, or colour in BGR order; alpha is left out.
    method : str
        A key of `METHODS`.
    calibration : Calibration, StereoCamera, path of a calibration file, or None
        With it, depth and motion in metres, and whatever the method makes of a camera.
    preset : str
        A preset's name, or the path of a ``.toml`` file.
    progress : callable, optional
        Called with the stage's name and the fraction done.

    Returns
    -------
    SceneFlow
        In pixels; ``seconds["total"]`` is the time of the solving alone.

    Raises
    ------
    InputError
        If the images, the method, the preset or the calibration cannot be used.

    Examples
    --------
    >>> import cgsf, cv2
    >>> images = [cv2.imread(f"{name}.png") for name in ("left1", "right1", "left2", "right2")]  # doctest: +SKIP
    >>> flow = cgsf.estimate(*images).flow  # doctest: +SKIP
    """
    return solve((left1, right1, left2, right2), method, load_config(method, preset), calibration, progress)


def solve(
    images: Sequence[np.ndarray],
    method: str,
    config: Any,
    calibration: Calibration | StereoCamera | str | Path | None = None,
    progress: Progress | None = None,
) -> SceneFlow:
    """`estimate` with a configuration that is loaded already."""
    if isinstance(calibration, str | Path):
        calibration = Calibration.read(calibration)
    elif calibration is not None and not isinstance(calibration, Calibration):
        calibration = Calibration.from_camera(calibration)
    frames = to_frames(images)
    warn_of_oddities(frames)
    function = _load(find_method(method).function)
    start = time.perf_counter()
    result: SceneFlow = function(frames, config, None if calibration is None else calibration.camera(), progress)
    total = time.perf_counter() - start
    return replace(result, method=method, calibration=calibration, seconds={**result.seconds, "total": total})


def find_method(name: str) -> Method:
    """The entry of `METHODS`; `InputError` with the names that exist for another."""
    if name not in METHODS:
        raise InputError(f"unknown method {name!r}; there are {', '.join(METHODS)}")
    return METHODS[name]


def load_config(method: str, preset: str = "default") -> Any:
    """The settings of a method under a preset: an instance of its dataclass, None if it has no settings.

    Raises
    ------
    InputError
        For an unknown method or preset, a table that belongs to no method, and settings that do not fit.
    """
    entry = find_method(method)
    tables = read_preset(preset)
    sections = {other.section for other in METHODS.values() if other.section} | {"description"}
    unknown = [key for key in tables if key not in sections]
    if unknown:
        raise InputError(f"preset {preset}: unknown table {unknown[0]!r}; there are {', '.join(sorted(sections))}")
    if entry.config is None or entry.section is None:
        return None
    table = {name: tables[name] for name in entry.starts if name in tables}
    return from_table(_load(entry.config), table | tables.get(entry.section, {}) | dict(entry.fixed), entry.section)


def with_settings(config: Any, settings: dict[str, Any]) -> Any:
    """The settings of a method with some of them replaced; None stands for those that shall stay as they are.

    Raises
    ------
    InputError
        For settings that this method does not have, or that do not fit together.
    """
    given = {name: value for name, value in settings.items() if value is not None}
    missing = [name for name in given if not hasattr(config, name)]
    if missing:
        raise InputError(f"this method has no setting {missing[0]!r}; hybrid and variational+refiner have them all")
    try:
        return replace(config, **given) if given else config
    except ValueError as error:
        raise InputError(str(error)) from None


def on_device(config: Any, device: str | None) -> Any:
    """The settings with another device; `InputError` for a method that has none, as it runs on the CPU alone."""
    if device is None:
        return config
    if not hasattr(config, "device"):
        raise InputError("this method runs on the CPU alone: leave --device out, or take --method feedforward")
    return replace(config, device=device)


def consistency_loss(frames: Frames, result: SceneFlow) -> np.ndarray:
    """The paper's consistency energy of each pixel, (H, W) float32, at a result."""
    from variational.energy import Energy, EnergyConfig

    energy = Energy(frames, EnergyConfig(), backward_flow=result.backward_flow)
    loss, _ = energy.value_and_gradient(result.state())
    return np.asarray(loss, np.float32)


def solve_variational(frames: Frames, config: Any, camera: StereoCamera | None, progress: Progress | None) -> SceneFlow:
    """The handwritten solver; keeps the state that it started from."""
    from variational.initialise import MIN_SIDE
    from variational.solver import solve as minimise

    if min(frames.shape) < MIN_SIDE:
        height, width = frames.shape
        raise InputError(f"the images are too small ({width} x {height}): the solver needs {MIN_SIDE} pixels a side")
    solution = minimise(frames, config, camera, progress)
    lens, guessed = solution.guessed_camera, {}
    if lens:
        guessed["guessed_camera"] = {"focal_px": lens.fx, "cx": lens.cx, "cy": lens.cy}
    initial = SceneFlow.from_state(solution.initial_state, np.ones(frames.shape, bool), method="initial state")
    return SceneFlow.from_state(
        solution.state,
        solution.visible,
        confidence=solution.confidence,
        moving=solution.moving,
        camera_motion=solution.camera_motion,
        backward_flow=solution.backward_flow,
        seconds=dict(solution.seconds),
        record={"reason": solution.reason, "history": solution.history, **guessed},
        initial=initial,
    )


def _load(place: str) -> Any:
    module, name = place.split(":")
    return getattr(importlib.import_module(module), name)
