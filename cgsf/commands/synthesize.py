"""``cgsf synthesize``: rendered stereo video with exact truth, as KITTI folders."""

from __future__ import annotations

from pathlib import Path

import click

from cgsf.commands.options import count_bar, photos_option, workers_option
from cgsf.errors import InputError


@click.command()
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder to write.")
@click.option("--family", "families", multiple=True, default=["street"], show_default=True, help="street or things.")
@click.option("--count", type=click.IntRange(1), default=20, show_default=True, help="Number of samples.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the first sample.")
@click.option("--height", type=click.IntRange(16), default=376, show_default=True)
@click.option("--width", type=click.IntRange(16), default=1242, show_default=True)
@photos_option
@workers_option
def command(
    output: Path, families: tuple[str, ...], count: int, seed: int, height: int, width: int, photos: Path | None,
    workers: int,
) -> None:  # fmt: skip
    """Render stereo video with exact truth. An interrupted run goes on where it stopped when it is called again.

    For training, see cgsf cache samples.
    """
    from cgsf.synthetic.export import write_kitti

    if len(families) > 1:
        raise InputError("KITTI folders hold one family; call once for each with its own folder")
    options = {"photos": photos} if photos is not None else {}
    with count_bar(count) as progress:
        write_kitti(output, families[0], count, seed, height, width, workers, progress, **options)
    click.echo(f"{count} samples in {output}")
