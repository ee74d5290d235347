"""Commands, run in this process."""

from mirror_ppl.console import run


def command(module, *args):
    """The exit status of a command of the package with these arguments."""
    return run(
        module.Options,
        module.main,
        prog=module.PROGRAM,
        description=module.DESCRIPTION,
        args=[str(arg) for arg in args],
    )
