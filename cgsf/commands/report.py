"""``cgsf report``: the table of the results page, ours beside OpenCV's compositions, in one run."""

import click

from cgsf.commands.options import method_option, preset_option


@click.command(short_help="One table over several data sets.")
@click.argument("root")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for predictions and tables.")
@method_option(multiple=True)
@preset_option
@click.option("--peers", is_flag=True, help="Add OpenCV's compositions.")
@click.option("--initial", is_flag=True, help="Score the states that the methods start from, too.")
def command(root: str, output: str, method: tuple[str, ...], preset: str, peers: bool, initial: bool) -> None:
    """Score methods on every data set that ROOT holds in a folder of its name: kitti2015, kitti2012, frames, rendered.

    Each method solves one frame before the clock matters, so that the times are warm.
    """
    from tqdm import tqdm

    from cgsf.evaluate import report_all
    from cgsf.pipelines import METHODS

    others = [name for name in METHODS if name.startswith("opencv")] if peers else []
    report = report_all(
        root, output, [*dict.fromkeys([*method, *others])], preset, initial=initial,
        watch=lambda indices: tqdm(indices, unit="frame", disable=None),
    )  # fmt: skip
    click.echo(report.table())
