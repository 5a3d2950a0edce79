"""Options and progress bars that several subcommands share."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click

preset_option = click.option(
    "--preset", default="default", show_default=True, metavar="NAME", help="Settings: a preset's name or a .toml file."
)


def method_option(multiple: bool = False) -> Callable[[Any], Any]:
    """``--method NAME``; given several times if `multiple`."""
    default = ["variational"] if multiple else "variational"
    text = "How to solve; may be given several times." if multiple else "How to solve."
    return click.option("--method", default=default, show_default=True, metavar="NAME", multiple=multiple, help=text)


@contextmanager
def stage_bar() -> Iterator[Callable[[str, float], None]]:
    """A bar on stderr for ``progress(stage, fraction)``; silent where stderr is no terminal."""
    from tqdm import tqdm

    layout = "{desc:<24}{percentage:3.0f}% |{bar}| {elapsed}"
    with tqdm(total=1.0, disable=None, leave=False, bar_format=layout) as bar:

        def progress(stage: str, fraction: float) -> None:
            bar.set_description(stage)
            bar.update(fraction - bar.n)

        yield progress
