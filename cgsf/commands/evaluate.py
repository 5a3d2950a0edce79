"""``cgsf evaluate``: scores of methods on a data set."""

import click

from cgsf.commands.options import dataset_options, method_option, parse_options, preset_option


@click.command(short_help="Score methods on a data set.")
@click.argument("dataset")
@click.argument("root")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for predictions and tables.")
@method_option(multiple=True)
@preset_option
@dataset_options
@click.option("--keep-going", is_flag=True, help="Leave bad frames out in place of stopping.")
@click.option("--initial", is_flag=True, help="Score the states that the methods start from, too.")
@click.option("--pictures", is_flag=True, help="An overview.png for every new prediction.")
def command(
    dataset: str, root: str, output: str, method: tuple[str, ...], preset: str, options: tuple[str, ...],
    keep_going: bool, initial: bool, pictures: bool,
) -> None:  # fmt: skip
    """Score methods on the data set DATASET in the folder ROOT.

    Predictions are kept in OUT: scoring again needs no solving. Writes frames.csv, scores.json and table.md.
    """
    from tqdm import tqdm

    from cgsf.datasets import open_dataset
    from cgsf.evaluate import evaluate

    samples = open_dataset(dataset, root, **parse_options(options))
    report = evaluate(
        samples, dataset, output, method, preset, keep_going=keep_going, initial=initial, pictures=pictures,
        watch=lambda indices: tqdm(indices, desc=dataset, unit="frame", disable=None),
    )  # fmt: skip
    click.echo(report.table())
    for name, message in report.failures.items():
        click.echo(f"left out {name}: {message}", err=True)
