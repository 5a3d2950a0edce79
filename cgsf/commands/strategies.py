"""``cgsf strategies``: learned refinement beside gradient descent on outputs and on parameters."""

import click

from cgsf.commands.options import dataset_options, parse_options, preset_option
from cgsf.errors import InputError


@click.command(short_help="Compare the online refinement strategies.")
@click.argument("dataset")
@click.argument("root")
@click.option("-o", "--output", required=True, metavar="OUT", help="A new folder for states and tables.")
@click.option("--strategy", "strategies", multiple=True, type=click.Choice(["learned", "outputs", "parameters"]),
              help="May be given several times; all unless given.")  # fmt: skip
@click.option("--initial", type=click.Choice(["feedforward", "variational", "opencv"]), default="feedforward",
              show_default=True, help="What the refinement starts from; parameters needs feedforward.")  # fmt: skip
@preset_option
@dataset_options
@click.option("--refiner", metavar="NAME", help="The refiner's weights: a name that ships, or a .safetensors file.")
@click.option("--steps", type=click.IntRange(1), help="Of every strategy, in place of each one's own number.")
@click.option("--count", type=click.IntRange(1), help="Only the first samples.")
@click.option("--video", is_flag=True, help="The samples are successive frames: parameters adapts as it goes.")
@click.option("--threads", type=click.IntRange(1), help="CPU threads.")
@click.option("--pictures", is_flag=True, help="Energy, gradient, change and error of the steps; times are longer then.")
def command(
    dataset: str, root: str, output: str, strategies: tuple[str, ...], initial: str, preset: str, options: tuple[str, ...],
    refiner: str | None, steps: int | None, count: int | None, video: bool,
    threads: int | None, pictures: bool,
) -> None:  # fmt: skip
    """Refine the samples of DATASET in the folder ROOT by several strategies: one table of scores, energy and time."""
    from tqdm import tqdm

    from cgsf.datasets import open_dataset
    from cgsf.pipelines import load_config, with_settings
    from cgsf.strategies import compare_strategies, strategies_table
    from cgsf.threads import bound_threads

    if threads:
        bound_threads(threads)
    chosen = strategies or (("learned", "outputs", "parameters") if initial == "feedforward" else ("learned", "outputs"))
    if "parameters" in chosen and initial != "feedforward":
        raise InputError("parameters adapts networks: it needs --initial feedforward")
    config = with_settings(load_config("hybrid", preset), {"initial": initial, "refiner": refiner, "steps": steps})
    samples = open_dataset(dataset, root, **parse_options(options))
    outcomes = compare_strategies(
        samples, output, config, chosen, video=video, pictures=pictures,  # type: ignore[arg-type]
        watch=lambda indices: tqdm(list(indices)[:count], desc=dataset, unit="frame", disable=None),
    )  # fmt: skip
    click.echo(strategies_table(outcomes))
