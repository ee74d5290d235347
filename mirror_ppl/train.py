"""Entry point of `python -m mirror_ppl.train`, see :mod:`mirror_ppl.commands.train`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("train")
