"""Entry point of `python -m mirror_ppl.fit`, see :mod:`mirror_ppl.commands.fit`."""

from mirror_ppl.commands import call

if __name__ == "__main__":
    call("fit")
