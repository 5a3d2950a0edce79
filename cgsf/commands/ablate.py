"""``cgsf ablate``: what a refiner owes to its inputs, or to the energy's terms."""

import click


@click.command(short_help="Compare refiners without some inputs or terms.")
@click.argument("recipe")
@click.argument("subject", type=click.Choice(["inputs", "terms"]))
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder of the runs; unfinished ones are continued.")
@click.option("--cache", metavar="FOLDER", help="Samples to train with, in place of the recipe's.")
@click.option("--starts", metavar="FOLDER", help="States to refine, in place of the recipe's.")
@click.option("--steps", type=click.IntRange(1), default=300, show_default=True, help="Length of each run.")
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="Runs of each variant.")
@click.option("--threads", type=click.IntRange(1), help="CPU threads.")
def command(
    recipe: str, subject: str, output: str, cache: str | None, starts: str | None, steps: int,
    seeds: int, threads: int | None,
) -> None:  # fmt: skip
    """Train variants of the refiner of RECIPE, all alike, and write one table.

    SUBJECT inputs: the state X, the energy's map L, its gradient. SUBJECT terms: pd, pf, df on and off.
    """
    from tqdm import tqdm

    from cgsf.ablation import ablate
    from cgsf.recipe import read_recipe, with_changes
    from cgsf.threads import bound_threads

    if threads:
        bound_threads(threads)
    settings = with_changes(read_recipe(recipe), cache, starts)
    table = ablate(
        settings, subject, output, steps, seeds,  # type: ignore[arg-type]
        watch=lambda runs: tqdm(list(runs), desc=subject, unit="run", disable=None),
    )  # fmt: skip
    click.echo(table)
