"""``cgsf import-weights``: the authors' published checkpoints as weights of this program."""

from pathlib import Path

import click

from cgsf.errors import InputError


@click.command("import-weights")
@click.argument("architecture", type=click.Choice(["ganet", "pwcnet"]))
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Where to write; FILE.safetensors unless given.")
@click.option("--max-disparity", type=int, default=192, show_default=True, help="Of GA-Net, pixels; a multiple of 12.")
@click.option("--source", help="For the model card: who trained these weights, on what.")
@click.option("--licence", help="For the model card.")
def command(architecture: str, file: Path, output: Path | None, max_disparity: int, source: str | None,
            licence: str | None) -> None:
    """Turn a published GA-Net (deep) or PWC-Net (dense) checkpoint into safetensors.

    FILE is the authors' .pth or .pth.tar. Only its tensors are read, no code in it is run. With the result:
    [feedforward] disparity = "FILE.safetensors" (or motion = ...) in a preset.
    """
    from learned.checkpoint import CheckpointError, ModelCard, import_published, save

    output = output or file.with_suffix(".safetensors")
    if output.suffix != ".safetensors":
        raise InputError(f"{output}: the name of the output must end in .safetensors")
    try:
        net = import_published(architecture, file, max_disparity)
    except (CheckpointError, ValueError) as error:
        raise InputError(str(error)) from None
    card = ModelCard(source or f"published {architecture} checkpoint {file.name}", licence or ModelCard.licence)
    save(net, output, card)
    click.echo(f"{output} ({sum(p.numel() for p in net.parameters()):,} parameters)")
