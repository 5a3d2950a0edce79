"""``cgsf cache``: what training reads, made once: samples, and the states that a refiner starts from."""

from __future__ import annotations

from pathlib import Path

import click

from cgsf.commands.options import count_bar, dataset_options, parse_options, photos_option, preset_option, workers_option
from cgsf.errors import InputError


@click.group(short_help="Samples and starts on disk, for training.")
def command() -> None:
    """Make what training reads. An interrupted call goes on where it stopped when it is called again."""


@command.command(short_help="Rendered samples, or those of a data set.")
@click.option("-o", "--output", required=True, metavar="FOLDER", help="Folder of the cache.")
@click.option("--family", "families", multiple=True, metavar="NAME", help="Render these in turns: street, things.")
@click.option("--dataset", metavar="NAME", help="Or read a data set of this name ...")
@click.option("--root", metavar="FOLDER", help="... in this folder; it needs no truth.")
@dataset_options
@click.option("--truth", metavar="METHOD", help="Of a data set: take what this method says, where it is surest, for the truth.")
@click.option(
    "--keep", type=click.FloatRange(0, 1, min_open=True), default=0.7, show_default=True, help="Share of the surest pixels."
)
@click.option("--reverse", is_flag=True, help="With --truth: every sample with its two times exchanged, too.")
@click.option(
    "--harder", type=click.IntRange(1), metavar="N", help="Of a data set with a truth, or --truth: N harder variants each."
)
@click.option("--count", type=click.IntRange(1), help="Number of samples; all of a data set, 1000 rendered ones.")
@click.option("--size", default="320x640", show_default=True, metavar="HxW", help="Height and width in pixels.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the first rendered sample.")
@photos_option
@workers_option
def samples(
    output: str, families: tuple[str, ...], dataset: str | None, root: str | None, options: tuple[str, ...],
    truth: str | None, keep: float, reverse: bool, harder: int | None, count: int | None, size: str, seed: int,
    photos: Path | None, workers: int,
) -> None:  # fmt: skip
    """Cache samples: rendered ones (--family), or those of a data set (--dataset and --root).

    A data set's larger images are cut to the size around their centre; harder variants (pieces pasted in front, texture
    taken away, reflections, too dark or too bright) somewhere.
    """
    from cgsf.datasets import Dataset, open_dataset
    from cgsf.harder import Harder
    from cgsf.pseudo_truth import PseudoTruth
    from cgsf.sample_cache import write_cache
    from cgsf.synthetic import export

    if bool(families) == bool(dataset) or bool(dataset) != bool(root):
        raise InputError("give either --family (once or more), or --dataset and --root")
    if (families and (truth or harder)) or (reverse and not truth):
        raise InputError("--truth and --harder are for a data set, and --reverse for --truth")
    height, width = _size(size)
    if families:
        count = count or 1000
        more = {"photos": str(photos)} if photos else {}
        with count_bar(count) as progress:
            export.write_cache(output, families, count, seed, height, width, progress, workers, **more)
    else:
        source: Dataset = open_dataset(str(dataset), str(root), **parse_options(options))
        if truth:
            source = PseudoTruth(source, truth, keep, reverse)
        if harder:
            source = Harder(source, harder, (height, width))
        count = min(count or len(source), len(source))
        with count_bar(count) as progress:
            write_cache(output, source.names[:count], source.__getitem__, (height, width), progress, workers)
    click.echo(f"{output}: {count} samples of {height} x {width} pixels")


@command.command(short_help="The states that a refiner starts from.")
@click.option("-o", "--output", required=True, metavar="FOLDER", help="Folder of the starts.")
@click.option("--cache", required=True, metavar="FOLDER", help="The samples.")
@click.option("--initial", required=True, type=click.Choice(["feedforward", "variational", "opencv"]), help="What makes them.")
@preset_option
@click.option("--disparity", metavar="FILE", help="Weights of the disparity network, in place of those that ship.")
@click.option("--motion", metavar="FILE", help="Weights of the motion network, in place of those that ship.")
@click.option("--precision", type=click.Choice(["auto", "float32", "bfloat16"]), help="Of the networks' convolutions.")
@click.option("--count", type=click.IntRange(1), help="Only for the first samples.")
@click.option("--threads", type=click.IntRange(1), help="CPU threads.")
def starts(
    output: str, cache: str, initial: str, preset: str, disparity: str | None, motion: str | None,
    precision: str | None, count: int | None, threads: int | None,
) -> None:  # fmt: skip
    """Cache the starts of a cache's samples: state, backward flow and evidence of a method."""
    from cgsf.sample_cache import SampleCache
    from cgsf.start_cache import write_starts
    from cgsf.starts import load_start_config
    from cgsf.threads import bound_threads

    if threads:
        bound_threads(threads, networks=initial == "feedforward")
    source = SampleCache(cache)
    config = load_start_config(initial, preset, disparity=disparity, motion=motion, precision=precision)
    with count_bar(min(count or len(source), len(source))) as progress:
        made = write_starts(output, source, config, count, progress)
    click.echo(f"{output}: {len(made)} starts")


def _size(text: str) -> tuple[int, int]:
    """``HxW`` as two numbers."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and min(int(height), int(width)) >= 16):
        raise InputError(f"--size must be HEIGHTxWIDTH, each at least 16 pixels, as 320x640; got {text!r}")
    return int(height), int(width)
