"""Entry point of `python -m mirror_ppl.simulate`, see :mod:`mirror_ppl.commands.simulate`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("simulate")
