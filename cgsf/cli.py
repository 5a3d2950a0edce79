"""The command line: a group whose subcommands are imported only when they are called.

A subcommand lives in ``cgsf/commands/NAME.py`` and defines a click command called ``command``. It parses, calls one
documented Python function, and prints. The table below is all that ``cgsf --help`` needs to read.
"""

import importlib
import logging
from typing import Any

import click

import cgsf
from cgsf.errors import InputError

#: command -> (module in cgsf.commands, one line for ``cgsf --help``)
COMMANDS = {
    "run": ("run", "Scene flow of four images."),
    "evaluate": ("evaluate", "Score methods on a data set."),
    "strategies": ("strategies", "Learned refinement beside gradient descent on outputs and on parameters."),
    "report": ("report", "One table over several data sets, beside OpenCV's compositions."),
    "cache": ("cache", "Samples and starts on disk, for training."),
    "train": ("train", "Train a network or a refiner by a recipe."),
    "ablate": ("ablate", "What a refiner owes to its inputs, or to the energy's terms."),
    "demo": ("demo", "Make a small stereo video, solve it, score it: needs no data."),
    "import-weights": ("import_weights", "Published GA-Net and PWC-Net checkpoints for this program."),
    "synthesize": ("synthesize", "Render stereo video with exact truth."),
    "check-dataset": ("check_dataset", "Warp with a data set's truth: are signs, units and pairing right?"),
    "gradcheck": ("gradcheck", "Check the analytic gradient against autograd and differences."),
}


class BadInput(click.ClickException):
    """One line on stderr and exit code 2."""

    exit_code = 2

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class LazyGroup(click.Group):
    """A click group that knows its commands by name and imports one when it is needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        return importlib.import_module(f"cgsf.commands.{COMMANDS[name][0]}").command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the subcommand; bad input and files that refuse become one line on stderr and exit code 2."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            raise BadInput(str(error)) from error
        except OSError as error:
            if error.filename is None and error.strerror is None:
                raise
            place = f"{error.filename}: " if error.filename is not None else ""
            raise BadInput(f"{place}{error.strerror}") from error


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(cgsf.__version__, prog_name="cgsf")
@click.option("-v", "--verbose", is_flag=True, help="Say what is being done.")
def main(verbose: bool) -> None:
    """Dense 3D scene flow from stereo video."""
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.INFO if verbose else logging.WARNING)
    logging.getLogger("cgsf").setLevel(logging.INFO if verbose else logging.WARNING)


if __name__ == "__main__":
    main()
