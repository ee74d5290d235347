"""Entry point of `python -m mirror_ppl.compare`, see :mod:`mirror_ppl.commands.compare`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("compare")
