"""The one exception that stands for bad input."""


class InputError(ValueError):
    """Something that the user gave cannot be used; the message is one line that says what to do.

    The command line prints it and exits with code 2. Everything else that is raised is a defect of the program.
    """
