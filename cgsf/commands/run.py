"""``cgsf run``: scene flow of four images."""

import click

from cgsf.commands.options import method_option, preset_option, stage_bar


@click.command(short_help="Scene flow of four images.")
@click.argument("left1")
@click.argument("right1")
@click.argument("left2")
@click.argument("right2")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for the results; made if it is missing.")
@method_option()
@preset_option
@click.option("--device", metavar="NAME", help="For networks: cpu, cuda, mps ...; the preset's unless given.")
@click.option("--calibration", metavar="FILE", help="KITTI calibration, or JSON with fx fy cx cy baseline.")
@click.option("--initial", type=click.Choice(["feedforward", "variational", "opencv"]), help="What the refinement starts from.")
@click.option("--strategy", type=click.Choice(["learned", "outputs", "parameters"]), help="How to refine.")
@click.option("--steps", type=click.IntRange(1), help="Refinement steps.")
@click.option("--refiner", metavar="NAME", help="The refiner's weights: a name that ships, or a .safetensors file.")
@click.option("--steps-picture", metavar="FILE", help="Write energy, gradient and change of every refinement step to a .png.")
def command(
    left1: str, right1: str, left2: str, right2: str, output: str, method: str, preset: str, calibration: str | None,
    device: str | None, **settings: str | int | None,
) -> None:
    """Scene flow of two rectified stereo pairs: LEFT1 RIGHT1 at time 1, LEFT2 RIGHT2 at time 2.

    Writes scene_flow.npz, disp_0.png, disp_1.png, flow.png, overview.png, run.json, and with a calibration points.ply.
    """
    from cgsf.run import run

    with stage_bar() as progress:
        result = run((left1, right1, left2, right2), output, method, preset, calibration, progress, device, settings)
    click.echo(f"{output}: solved in {result.seconds['total']:.2f} s")
