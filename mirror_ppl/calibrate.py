"""Entry point of `python -m mirror_ppl.calibrate`, see :mod:`mirror_ppl.commands.calibrate`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("calibrate")
