"""``cgsf synthesize``: rendered stereo video with exact truth, as KITTI folders or as a training cache."""

from __future__ import annotations

from pathlib import Path

import click

from cgsf.errors import InputError


@click.command()
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder to write."
)
@click.option(
    "--family",
    "families",
    multiple=True,
    default=["street"],
    show_default=True,
    help="street or things; both with --cache.",
)
@click.option("--count", type=click.IntRange(1), default=20, show_default=True, help="Number of samples.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the first sample.")
@click.option("--height", type=click.IntRange(16), default=376, show_default=True)
@click.option("--width", type=click.IntRange(16), default=1242, show_default=True)
@click.option(
    "--photos", type=click.Path(path_type=Path, file_okay=False), help="Folder of pictures to use as textures."
)
@click.option(
    "--workers",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Processes; the result does not depend on it.",
)
@click.option(
    "--cache", is_flag=True, help="Write a memory-mapped training cache in place of KITTI folders (one process)."
)
def command(
    output: Path,
    families: tuple[str, ...],
    count: int,
    seed: int,
    height: int,
    width: int,
    photos: Path | None,
    workers: int,
    cache: bool,
) -> None:
    """Render stereo video with exact truth. An interrupted run goes on where it stopped when it is called again."""
    from tqdm import tqdm

    from cgsf.synthetic.export import write_cache, write_kitti

    if len(families) > 1 and not cache:
        raise InputError("KITTI folders hold one family; call once for each with its own folder, or use --cache")
    options = {"photos": photos} if photos is not None else {}
    with tqdm(total=count, unit="sample", disable=None) as bar:

        def progress(done: int) -> None:
            bar.update(done - bar.n)

        if cache:
            write_cache(output, families, count, seed, height, width, progress, **options)
        else:
            write_kitti(output, families[0], count, seed, height, width, workers, progress, **options)
    click.echo(f"{count} samples in {output}")
