"""``cgsf train``: networks and refiners by recipe."""

import os

import click


@click.command(short_help="Train a network or a refiner.")
@click.argument("recipe")
@click.option("-o", "--output", required=True, metavar="RUN", help="Run folder; one with a checkpoint is continued.")
@click.option("--cache", metavar="FOLDER", help="Samples to train with, in place of the recipe's.")
@click.option("--starts", metavar="FOLDER", help="States to refine, in place of the recipe's.")
@click.option("--steps", type=click.IntRange(1), help="Length of the run, in place of the recipe's.")
@click.option("--minutes", type=click.FloatRange(0), help="Stop after this time, to be continued.")
@click.option("--threads", type=click.IntRange(1), help="CPU threads of a process.")
@click.option("--export", metavar="FILE", help="Write the best weights to this .safetensors file (a joint run: three).")
def command(
    recipe: str, output: str, cache: str | None, starts: str | None, steps: int | None, minutes: float | None,
    threads: int | None, export: str | None,
) -> None:  # fmt: skip
    """Train by a RECIPE: a .toml file, or the name of one that shipped weights were made with (as selector-variational).

    Several processes share the work under torchrun: torchrun --nproc-per-node 2 -m cgsf.cli train RECIPE ...
    """
    from cgsf.recipe import read_recipe, with_changes
    from cgsf.training import export_best, run_recipe

    settings = with_changes(read_recipe(recipe), cache, starts, steps)
    numbers = run_recipe(settings, output, seconds=60 * minutes if minutes else float("inf"), threads=threads)
    if os.environ.get("RANK", "0") != "0":  # the first process of several speaks for all
        return
    click.echo(", ".join(f"{name} {value:.5g}" for name, value in numbers.items()))
    if export:
        export_best(settings, output, export)
        click.echo(f"{export}: the best weights of the run")
