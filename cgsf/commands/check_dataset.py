"""``cgsf check-dataset``: warp with the truth and report samples whose images do not fit."""

from __future__ import annotations

from pathlib import Path

import click

from cgsf.commands.options import dataset_options, parse_options


@click.command()
@click.argument("name")
@click.argument("root", type=click.Path(path_type=Path))
@click.option("--limit", type=click.IntRange(1), help="Check at most so many samples, evenly spread.")
@dataset_options
def command(name: str, root: Path, limit: int | None, options: tuple[str, ...]) -> None:
    """Check signs, units and pairing of data set NAME in ROOT: its truth must warp its images onto each other.

    Exits with code 1 if a sample is suspect.
    """
    import numpy as np
    from tqdm import tqdm

    from cgsf.datasets import open_dataset
    from cgsf.datasets.check import check_sample

    dataset = open_dataset(name, root, **parse_options(options))
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(limit or len(dataset), len(dataset))).round().astype(int))
    suspects, residuals = 0, dict[str, list[float]]()
    for index in tqdm(chosen, unit="sample", disable=None):
        findings = check_sample(dataset[int(index)])
        for finding in findings:
            residuals.setdefault(finding.quantity, []).append(finding.residual)
        complaints = [finding.complaint for finding in findings if finding.complaint]
        suspects += bool(complaints)
        for complaint in complaints:
            click.echo(f"{dataset.names[int(index)]}: {complaint}")
    for quantity, values in residuals.items():
        click.echo(f"{quantity}: median residual {np.nanmedian(values):.4f} over {len(values)} samples")
    if not residuals:
        click.echo("no truth to check")
    click.echo(f"{len(chosen)} samples checked, {suspects} suspect")
    if suspects:
        raise SystemExit(1)
