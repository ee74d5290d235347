"""Entry point of `python -m mirror_ppl.evaluate`, see :mod:`mirror_ppl.commands.evaluate`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("evaluate")
