"""Options and progress bars that several subcommands share."""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from cgsf.errors import InputError

preset_option = click.option(
    "--preset", default="default", show_default=True, metavar="NAME", help="Settings: a preset's name or a .toml file."
)

photos_option = click.option(
    "--photos", type=click.Path(path_type=Path, file_okay=False), help="Folder of pictures to use as textures."
)
workers_option = click.option(
    "--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes; the result does not depend on it."
)
dataset_options = click.option(
    "--option", "options", multiple=True, metavar="NAME=VALUE", help="Of the data set, as split=training."
)


def parse_options(texts: tuple[str, ...]) -> dict[str, Any]:
    """``NAME=VALUE`` texts, with TOML values or bare words for strings."""
    parsed: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(f"--option must be NAME=VALUE, got {text!r}")
        try:
            parsed[name] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parsed[name] = value
    return parsed


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


@contextmanager
def count_bar(total: int, unit: str = "sample") -> Iterator[Callable[[int], None]]:
    """A bar on stderr with the time left for ``progress(done)``; silent where stderr is no terminal."""
    from tqdm import tqdm

    with tqdm(total=total, unit=unit, disable=None) as bar:

        def progress(done: int) -> None:
            if bar.n == 0 and done > 1:  # what an earlier call made is not this one's speed
                bar.initial = done
            bar.update(done - bar.n)

        yield progress
