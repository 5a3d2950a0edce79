"""Pictures of a result: what was seen, what was estimated, how wrong it is."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cgsf.datasets.sample import Truth
from cgsf.metrics import error_maps
from cgsf.scene_flow import SceneFlow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Upper ends of the error classes in pixels, with KITTI's colours; blue turns to yellow at its threshold of 3 px.
ERROR_STEPS_PX = (0.1875, 0.375, 0.75, 1.5, 3, 6, 12, 24, 48)
_ERROR_COLOURS = ("#313695", "#4575b4", "#74add1", "#abd9e9", "#e0f3f8",
                  "#fee090", "#fdae61", "#f46d43", "#d73027", "#a50026")  # fmt: skip


def flow_colours(flow: np.ndarray, largest_px: float | None = None) -> np.ndarray:
    """Flow as colours: direction is the hue, length the saturation, zero is white, unknown (NaN) black.

    Parameters
    ----------
    flow : ndarray (..., 2)
        u, v in pixels; red is to the right, and the hue runs clockwise on the screen (yellow-green is downwards).
    largest_px : float, optional
        The length of full saturation; the 99th percentile of the lengths without. Longer vectors get darker.

    Returns
    -------
    ndarray (..., 3) uint8
        RGB.
    """
    known = np.isfinite(flow).all(-1)
    u, v = np.moveaxis(np.where(known[..., None], flow, 0).astype(np.float64), -1, 0)
    length = np.hypot(u, v) / (largest_length(flow) if largest_px is None else largest_px)
    hue = np.arctan2(v, u) / (2 * np.pi) % 1
    saturation = np.minimum(length, 1)
    value = np.where(known, 1 / np.maximum(length, 1) ** 0.5, 0)
    # the standard six-sector formula, hsv to rgb, for all three channels at once
    sector = (hue[..., None] * 6 + np.array([5, 3, 1])) % 6
    ramp = np.clip(np.minimum(sector, 4 - sector), 0, 1)
    return (255 * value[..., None] * (1 - saturation[..., None] * ramp) + 0.5).astype(np.uint8)


def largest_length(flow: np.ndarray) -> float:
    """The 99th percentile of the vectors' lengths in pixels, at least 0.1."""
    lengths = np.hypot(flow[..., 0], flow[..., 1])
    lengths = lengths[np.isfinite(lengths)]
    return max(float(np.percentile(lengths, 99)), 0.1) if lengths.size else 0.1


def overview(images: Sequence[np.ndarray], result: SceneFlow, truth: Truth | None = None, title: str = "") -> bytes:
    """Everything about one frame in one picture.

    Parameters
    ----------
    images : four ndarrays (H, W, c)
        left1, right1, left2, right2 in [0, 1], grey or BGR.
    result : SceneFlow
        Panels whose map is None are left out.
    truth : Truth, optional
        Adds the error maps.
    title : str

    Returns
    -------
    bytes
        A PNG file.
    """
    panels: list[tuple[str, Callable[[Axes], None]]] = [
        (name, _image_panel(image)) for name, image in zip(("left1", "right1", "left2", "right2"), images, strict=True)
    ]
    disparities = np.stack([result.disparity1, result.disparity2])
    known = disparities[np.isfinite(disparities)]
    low, high = np.percentile(known, [0.5, 99.5]) if known.size else (0.0, 1.0)
    panels += [
        ("disparity at time 1 (left1)", _map_panel(result.disparity1, "turbo", (low, high), "px")),
        ("disparity at time 2 (left2's grid)", _map_panel(result.disparity2, "turbo", (low, high), "px")),
        ("optical flow left1 → left2", _flow_panel(result.flow)),
        ("disparity change", _change_panel(result.disparity_change)),
        ("visible in left2 (white)", _mask_panel(result.visible)),
    ]
    if result.moving is not None:
        panels.append(("moving by itself (white)", _mask_panel(result.moving)))
    if result.confidence is not None:
        panels.append(("confidence", _map_panel(result.confidence, "viridis", (0, 1), "0 to 1")))
    if result.loss is not None:
        limit = float(np.percentile(result.loss, 99)) or 1.0
        panels.append(("consistency loss", _map_panel(result.loss, "magma", (0, limit), "energy per pixel")))
    if truth is not None:
        panels += [(f"error of {name}", _error_panel(error)) for name, error in error_maps(result, truth).items()]
    return _render(panels, result.shape, title)


def comparison(state: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Estimate, truth and error side by side, a row each for D1, the flow and the disparity change.

    Parameters
    ----------
    state, truth : ndarray (5, H, W)
        In pixels, NaN where unknown; maps that the state does not have at all are left out.

    Returns
    -------
    ndarray (rows * H, 3 * W, 3) uint8
        RGB. Errors have the classes of `ERROR_STEPS_PX`, black where the truth is unknown.
    """
    rows = []
    for channels in ((0,), (3, 4), (2,)):
        got, true = (np.stack([maps[channel] for channel in channels], -1).astype(np.float64) for maps in (state, truth))
        if np.isfinite(got).any():
            shown = true if np.isfinite(true).any() else got
            error = np.hypot.reduce(np.abs(got - true), axis=-1) if len(channels) == 2 else np.abs(got - true)[..., 0]
            rows.append(np.concatenate([_coloured(got, shown), _coloured(true, shown), error_colours(error)], 1))
    return np.concatenate(rows)


def error_colours(error: np.ndarray) -> np.ndarray:
    """Errors (H, W) in pixels as RGB (H, W, 3) uint8 by the classes of `ERROR_STEPS_PX`; NaN is black."""
    table = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in _ERROR_COLOURS], np.uint8)
    colours = table[np.searchsorted(ERROR_STEPS_PX, np.nan_to_num(error), "right")]
    return np.where(np.isfinite(error)[..., None], colours, np.uint8(0))


def _coloured(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(H, W, 1 or 2) as RGB, with the range of `reference`."""
    if values.shape[2] == 2:
        return flow_colours(values, largest_length(reference))
    from matplotlib import colormaps

    low, high = np.nanpercentile(reference, [0.5, 99.5])
    scaled = np.clip((values[..., 0] - low) / max(high - low, 1e-6), 0, 1)
    colours = (255 * colormaps["turbo"](np.nan_to_num(scaled))[..., :3] + 0.5).astype(np.uint8)
    return np.where(np.isfinite(values), colours, np.uint8(0))


def _render(panels: Sequence[tuple[str, Callable[[Axes], None]]], shape: tuple[int, int], title: str) -> bytes:
    from matplotlib.figure import Figure

    height, width = shape
    columns = 2 if width > 2 * height else 4
    rows = -(-len(panels) // columns)
    panel_width = 12.0 / columns + 1.2
    panel_height = 0.86 * panel_width * min(height / width, 2) + 0.4
    size = (columns * panel_width, rows * panel_height + 0.5)
    figure: Figure = Figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.03, hspace=0.0, wspace=0.0)  # type: ignore[union-attr, call-arg]
    if title:
        figure.suptitle(title, fontsize=13)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    for axes, (name, draw) in zip(grid, panels, strict=False):
        axes.set_title(name, fontsize=11)
        draw(axes)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    return content.getvalue()


def _image_panel(image: np.ndarray) -> Callable[[Axes], None]:
    rgb = image[..., ::-1] if image.shape[2] == 3 else np.repeat(image, 3, -1)
    return lambda axes: _show(axes, np.clip(rgb, 0, 1))


def _map_panel(values: np.ndarray, colours: str, limits: tuple[float, float], unit: str) -> Callable[[Axes], None]:
    def draw(axes: Axes) -> None:
        shown = _show(axes, values, cmap=colours, vmin=limits[0], vmax=max(limits[1], limits[0] + 1e-6))
        _bar(axes, shown, unit)

    return draw


def _change_panel(change: np.ndarray) -> Callable[[Axes], None]:
    known = np.abs(change[np.isfinite(change)])
    limit = max(float(np.percentile(known, 99)), 0.1) if known.size else 0.1
    return _map_panel(change, "RdBu", (-limit, limit), "px; blue comes nearer")


def _mask_panel(mask: np.ndarray) -> Callable[[Axes], None]:
    return lambda axes: _show(axes, mask, cmap="gray", vmin=0, vmax=1)


def _flow_panel(flow: np.ndarray) -> Callable[[Axes], None]:
    largest = largest_length(flow)

    def draw(axes: Axes) -> None:
        _show(axes, flow_colours(flow, largest))
        legend = axes.inset_axes((1.015, 0.12, 0.125, 0.88), transform=axes.transAxes)
        across = np.linspace(-1, 1, 101)
        wheel = np.stack(np.meshgrid(across, across), -1)
        colours = flow_colours(wheel, 1.0)
        colours[np.hypot(wheel[..., 0], wheel[..., 1]) > 1] = 255
        legend.imshow(colours, extent=(-1, 1, 1, -1))
        legend.set_axis_off()
        legend.set_title(f"rim\n{largest:.1f} px", fontsize=9)

    return draw


def _error_panel(error: np.ndarray) -> Callable[[Axes], None]:
    from matplotlib.colors import BoundaryNorm, ListedColormap

    def draw(axes: Axes) -> None:
        edges = (0, *ERROR_STEPS_PX)
        colours = ListedColormap(_ERROR_COLOURS).with_extremes(bad="black")
        shown = _show(axes, _thicken(error), cmap=colours, norm=BoundaryNorm(edges, len(edges), extend="max"))
        bar = _bar(axes, shown, "px; black unknown")
        bar.set_ticks([0.375, 1.5, 3, 6, 24], labels=["0.4", "1.5", "3", "6", "24"])
        bar.minorticks_off()

    return draw


def _thicken(error: np.ndarray) -> np.ndarray:
    """Sparse truth is hard to see in a reduced picture: unknown pixels take the largest error next to them."""
    if np.isfinite(error).mean() > 0.7:
        return error
    import cv2

    spread = cv2.dilate(np.nan_to_num(error, nan=-1.0).astype(np.float32), np.ones((3, 3)))
    return np.where(np.isfinite(error), error, np.where(spread < 0, np.nan, spread))


def _show(axes: Axes, values: np.ndarray, **options: Any) -> Any:
    return axes.imshow(values, interpolation="antialiased", interpolation_stage="rgba", **options)


def _bar(axes: Axes, shown: Any, label: str) -> Any:
    place = axes.inset_axes((1.015, 0.0, 0.02, 1.0), transform=axes.transAxes)
    bar = axes.figure.colorbar(shown, cax=place)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=9)
    return bar
