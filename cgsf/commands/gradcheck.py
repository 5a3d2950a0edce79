"""``cgsf gradcheck``: analytic gradient against autograd against central differences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cgsf.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from cgsf.gradcheck import Scene


class Size(click.ParamType):
    """``HxW``, both at least 8."""

    name = "HxW"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        parts = str(value).lower().split("x")
        if len(parts) != 2 or not all(part.isdigit() and int(part) >= 8 for part in parts):
            self.fail(f"{value!r} is not a size: give height x width, for example 48x64, each at least 8", param, ctx)
        return int(parts[0]), int(parts[1])


@click.command()
@click.option("--frames", type=click.Path(path_type=Path), help="Folder of four images to check on as well.")
@click.option("--size", type=Size(), default="48x64", show_default=True,
              help="Of the random scene; frames are resized to it.")
@click.option("--dtype", type=click.Choice(["float64", "float32"]), default="float64", show_default=True)
@click.option("--terms", default="stereo,flow,coupling,smoothness,all", show_default=True, help="Which, by comma.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--json", "json_file", type=click.Path(path_type=Path, dir_okay=False), help="File for the table.")
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False),
              help="For gradcheck.json and pictures.")
@click.option("--damage", hidden=True, help="Make this term's gradient 1 % wrong, to see the check fail.")
def command(frames: Path | None, size: tuple[int, int], dtype: str, terms: str, seed: int, json_file: Path | None,
            output: Path | None, damage: str | None) -> None:
    """Check the analytic gradient against autograd and central differences; exit code 1 where they disagree."""
    from cgsf import gradcheck

    chosen = [term.strip() for term in terms.split(",") if term.strip()]
    for term in [*chosen, *([damage] if damage else [])]:
        if term not in gradcheck.TERMS:
            raise InputError(f"unknown term {term!r}; known are {', '.join(gradcheck.TERMS)}")
    scenes = [gradcheck.random_scene(size, seed)]
    if frames is not None:
        scenes.append(_real_scene(frames, size, seed))
    rows, deviations = gradcheck.gradcheck(scenes, chosen, dtype, damage, seed)

    click.echo(f"{'scene':16} {'term':10} ch  max dev  mean dev differences order  kinks %   sums")
    for row in rows:
        click.echo(f"{row.scene:16.16} {row.term:10} {row.channel:2} {row.max_deviation:8.1e} {row.mean_deviation:8.1e}"
                   f" {row.difference:11.1e} {row.order:5.2f} {100 * row.kinks:8.3f} {row.total:7.1e}"
                   f"{'' if row.ok else '  FAIL'}")
    table = json.dumps({"dtype": dtype, "seed": seed, "rows": [row.as_json() for row in rows]}, indent=1)
    if json_file is not None:
        json_file.write_text(table)
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        (output / "gradcheck.json").write_text(table)
        for name, deviation in deviations.items():
            _write_picture(output / f"{name.replace(' ', '_')}.png", name, deviation)
    failed = sorted({row.term for row in rows if not row.ok})
    if failed:
        click.echo(f"outside tolerance: {', '.join(failed)}")
        raise SystemExit(1)
    click.echo("every cell is within tolerance")


def _real_scene(folder: Path, size: tuple[int, int], seed: int) -> Scene:
    """The folder's images at the wanted size."""
    from cgsf.datasets.folder import Folder
    from cgsf.gradcheck import frames_scene
    from variational.frames import Frames
    from variational.pyramid import resize_image

    sample = Folder(folder)[0]
    images = (sample.left1, sample.right1, sample.left2, sample.right2)
    return frames_scene(folder.name, Frames(*(resize_image(image, size) for image in images)), seed)


def _write_picture(path: Path, title: str, deviation: np.ndarray) -> None:
    """Where the two gradients differ: one panel a channel, decades of relative deviation."""
    import matplotlib
    import numpy as np

    matplotlib.use("agg")
    from matplotlib import pyplot

    from variational.state import CHANNELS

    figure, axes = pyplot.subplots(1, 5, figsize=(15, 3), layout="constrained")
    for axis, plane, name in zip(axes, deviation, CHANNELS, strict=True):
        picture = axis.imshow(np.log10(np.maximum(plane, 1e-17)), vmin=-17, vmax=0, cmap="magma")
        axis.set(title=name, xticks=[], yticks=[])
    figure.colorbar(picture, ax=axes, label="log10 relative deviation")
    figure.suptitle(title)
    figure.savefig(path)
    pyplot.close(figure)
