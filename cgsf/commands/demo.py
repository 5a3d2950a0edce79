"""``cgsf demo``: everything at once, without any data."""

import click

from cgsf.commands.options import method_option, preset_option


@click.command(short_help="Make a small stereo video, solve it, score it.")
@click.option("-o", "--output", default="cgsf_demo", show_default=True, metavar="OUT", help="Folder for the results.")
@method_option()
@preset_option
def command(output: str, method: str, preset: str) -> None:
    """Make a small stereo video with exact truth, solve it, score it, draw it. Needs no data and no network.

    The first run compiles and takes longer.
    """
    from cgsf.demo import demo

    click.echo("making and solving a stereo video ...", err=True)
    click.echo(demo(output, method, preset).table())
    click.echo(f"outliers in %, errors in pixels; look at {output}/overview.png")
